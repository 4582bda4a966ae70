"""Compute sums and images with the CPU's kernels, and store them in a file. Runs on both processors.

Usage: python -m tests.arm.images FILE.npz
"""

import sys

import numpy as np

from ertis_numba import kernels
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy
from tests.cases import SHORT, noise

_PLAN = {"max_error_db": 0.0, "oversampling": 2, "delay_taps": 2, "stopband_attenuation_db": 60.0, "focal_zones": 1}
PLANS = {
    f"{precision}, {name}": Accuracy(precision=precision, beam_taps=beam_taps, beam_density=2.0, **_PLAN)
    for precision in ("int16", "float32")
    for name, beam_taps in (("beam grid", 4), ("direct", 0))
}
"""Complete plans by name, so that both processors run the same one."""


def whole_sums():
    """Return levels of 16-bit sums of random numbers, with a beam grid and without."""
    cpu, random = kernels.load("cpu"), np.random.default_rng(1)
    n_ranges, n_nodes, n_directions, width = 300, 40, 77, cpu.tile_ranges + 9
    starts = np.arange(0, n_ranges, cpu.tile_ranges, dtype=np.int32)
    tiles = random.integers(-4000, 4000, (len(starts), 32, 2, width, 2), np.int16)
    scales = random.random(len(starts)).astype(np.float32)
    rows = random.integers(0, 64, (n_directions, 64))
    offsets = (rows * width + random.integers(0, 9, rows.shape)).astype(np.int32)
    weights = random.integers(-1000, 1000, (n_directions, 64, 2, 2), np.int16)
    places = np.sort(random.integers(0, n_nodes - 1, (n_directions, 8)).astype(np.int32), axis=0)
    taps = random.integers(-8000, 8000, (n_directions, 8, 2), np.int16)
    order = random.permutation(n_directions).astype(np.int32)
    direct, interpolated = np.empty((2, n_directions, n_ranges), np.float32)
    one, given = np.float32(1), (tiles, scales, starts, n_ranges)
    cpu.delay_and_sum_envelope_int16(*given, offsets, weights, one, direct)
    beams = (offsets[:n_nodes], weights[:n_nodes], places, taps, order)
    cpu.interpolated_beams_envelope_int16(*given, *beams, one, 2, interpolated)
    return {"sums, direct": direct, "sums, beam grid": interpolated}


def images():
    """Return an image of noise for each plan."""
    settings = SHORT.replace(processing=SHORT.processing.replace(directions="3d:200"))
    measurement = noise(settings)
    return {
        name: Pipeline(settings.replace(accuracy=plan), "cpu", predict=False).process(measurement).amplitude
        for name, plan in PLANS.items()
    }


if __name__ == "__main__":
    np.savez(sys.argv[1], instruction_set=kernels.load("cpu").instruction_set, **whole_sums(), **images())
