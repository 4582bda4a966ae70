"""Arrays of 1 to 1024 microphones and words of 8 to 64 bits, compared with the exact image."""

import tracemalloc

import numpy as np
import pytest

from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Recording
from ertis_numba.simulation import Point
from ertis_numba.simulation.render import Simulator
from tests import reference
from tests.cases import SHORT, noise
from tests.hard_cases.forced import EIGHT
from tests.hard_cases.tuned import tuned
from tests.scenes import line_array, only, scene_of

# A fifth of the usual clock keeps the reference spectra of 1024 microphones below 200 MB.
SLOW = SHORT.replace(
    recording=Recording(sample_rate_hz=900_000.0, n_samples=4_000),
    processing=SHORT.processing.replace(directions="2d:3", range_m=(0.1, 0.4), range_decimation=20),
)


def spiral(n_mics, word_bits):
    """Microphones on a sunflower spiral of 10 cm; no permutation of bits leaves the array unchanged."""
    number = np.arange(n_mics)
    radius_m, angle_rad = 0.05 * np.sqrt((number + 0.5) / n_mics), 2.399_963 * number
    places_m = np.stack([0.01 * np.cos(5.0 * number), radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad)], -1)
    return Array(layout="spiral", positions_m=tuple(map(tuple, places_m.tolist())), word_bits=word_bits)


@pytest.mark.parametrize("precision", ["float32", "int16"])
@pytest.mark.parametrize("word_bits", [8, 16, 32, 64])
@pytest.mark.parametrize("n_mics", [1, 2, 31, 33, 64])
def test_image_of_any_array_size_is_exact(n_mics, word_bits, precision):
    """The error is below -42 dB; one misplaced bit of 33 microphones would cause -15 dB."""
    require_exact(spiral(n_mics, word_bits), precision)


@pytest.mark.parametrize(("word_bits", "precision"), [(8, "float32"), (64, "int16")])
def test_image_of_1024_microphones_is_exact(word_bits, precision):
    require_exact(spiral(1024, word_bits), precision)


def require_exact(array, precision):
    settings = tuned(SLOW.replace(array=array), precision=precision)
    pipeline, measurement = Pipeline(settings, predict=False), noise(settings)
    assert measurement.data.dtype.itemsize * 8 == array.word_bits
    amplitude = pipeline.process(measurement).amplitude
    directions = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    wanted = reference.exact(measurement.data, settings, directions, pipeline.range_m)
    assert reference.error_db(amplitude, wanted) < -42


# ---- through the simulator -------------------------------------------------------------------------


def test_pipeline_handles_1024_microphones():
    """The simulator needs memory for 128 microphones at a time."""
    sensor = EIGHT.replace(array=line_array(1024, 1e-3), recording=Recording(n_samples=40_000))
    scene = scene_of(Point(range_m=0.5, azimuth_deg=30, strength_db=-20), sensor=sensor)
    simulator = Simulator(scene, plan=only("spreading", "absorption"))
    tracemalloc.start()
    measurement = simulator.render()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert measurement.data.shape == (40_000, 16)
    assert peak < 250e6  # the signals alone would take 330 MB
    ones = np.unpackbits(measurement.data[::16].view(np.uint8), axis=1).mean(axis=0)
    assert np.all(np.abs(ones - 0.5) < 0.1)
