"""Capon images computed in several rounds, which otherwise only large images need."""

import importlib

import numpy as np

from tests import reference
from tests.on_device import KERNELS

MODULE = importlib.import_module("ertis_numba.kernels._cuda.combine_capon")
N_MICS, N_RANGES, N_DIRECTIONS, N_SNAPSHOTS = 3, 40, 5, 4


def test_capon_rounds_cover_all_directions_and_ranges(monkeypatch):
    random = np.random.default_rng(1)
    signals = random.standard_normal((N_MICS, 1, N_RANGES + 9, 2)).astype(np.float32).view(np.complex64)[..., 0]
    offsets = np.arange(N_MICS) * (N_RANGES + 9) + random.integers(0, 10, (N_DIRECTIONS, N_MICS))
    offsets = offsets.astype(np.int32)
    weights = np.ones((N_DIRECTIONS, N_MICS), dtype=np.complex128)
    monkeypatch.setattr(MODULE, "_MAX_BYTES", 2 * 16 * N_RANGES * (N_SNAPSHOTS + 1))  # two directions or 20 windows
    launched = []
    launch = MODULE.launch
    monkeypatch.setattr(MODULE, "launch", lambda *given: launched.append(given[1]) or launch(*given))
    out = np.full((N_DIRECTIONS, N_RANGES), 12_345, dtype=np.float32)
    KERNELS["cuda"].combine_capon(signals, offsets, weights, N_SNAPSHOTS, 0.1, out)
    scale, rounds = launched[:2], launched[2:]
    assert scale == [(1,), (1,)]
    assert rounds == [(1, 4, 2), (1,), (1, 4, 2), (1,), (1, 4, 1), (1,)]  # 64 threads for 74 windows
    expected = reference.capon(signals, offsets, weights, N_SNAPSHOTS, 0.1, N_RANGES)
    assert np.abs(out - expected).max() < 2e-6 * expected.max()
