"""Directions along and at the ends of the axes, and the smallest images and arrays."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array
from ertis_numba.simulation import Point
from ertis_numba.simulation.effects import EFFECTS
from tests import reference
from tests.cases import SHORT, noise, words_of
from tests.hard_cases.echoes import echo_signals, echo_words
from tests.hard_cases.forced import EIGHT, image_of
from tests.hard_cases.tuned import tuned
from tests.scenes import EAR, SENSOR, heard, scene_of

pytestmark = pytest.mark.usefixtures("sound_unchecked")

ONE = Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8)
TWO_IN_ONE_PLACE = Array(layout="pair", positions_m=((0.01, 0.02, -0.03),) * 2, word_bits=8)


def with_processing(settings=SHORT, **changes):
    return settings.replace(processing=settings.processing.replace(**changes))


def with_grid(tmp_path, rows_deg):
    """Settings with directions from a file of azimuth and elevation."""
    path = tmp_path / "grid.csv"
    path.write_text("\n".join(f"{azimuth}, {elevation}" for azimuth, elevation in rows_deg))
    return with_processing(directions=str(path))


def require_same(amplitude, other):
    """Require equality within rounding: -120 dB of the largest value."""
    assert_allclose(amplitude, np.broadcast_to(other, amplitude.shape), rtol=0, atol=1e-6 * amplitude.max())


def require_exact(settings, measurement):
    pipeline = Pipeline(settings)
    amplitude = pipeline.process(measurement).amplitude
    directions = unit_vectors(pipeline.grid.azimuth_rad, pipeline.grid.elevation_rad)
    wanted = reference.exact(measurement.data, settings, directions, pipeline.range_m)
    assert reference.error_db(amplitude, wanted) < -42
    return amplitude


@pytest.mark.parametrize("azimuth_deg", [-90.0, 90.0])
def test_echo_in_the_plane_of_the_array_is_found(azimuth_deg):
    """The peak is within 5° where the beam is broadest; the other end of the axis is at least 20 dB below it."""
    settings = with_processing(directions="2d:181")
    image = Pipeline(settings).process(
        Measurement(echo_words(settings, azimuth_deg=azimuth_deg, range_m=0.7, level=0.5), settings)
    )
    [peak] = find_peaks(image, top=1)
    assert peak.azimuth_deg == pytest.approx(azimuth_deg, abs=5)
    assert peak.range_m == pytest.approx(0.7, abs=5e-4)
    near, other = (image.amplitude[index].max() for index in ((0, -1) if azimuth_deg < 0 else (-1, 0)))
    assert near == pytest.approx(0.5, rel=0.1)
    assert other < near / 10


def test_planar_array_images_front_and_back_equally():
    """Azimuths α and 180° − α have the same delays, hence the same image except for rounding."""
    amplitude = require_exact(with_processing(directions="2d:9", azimuth_limits_deg=(-180.0, 180.0)), noise(SHORT))
    require_same(amplitude[[5, 8, 0]], amplitude[[7, 4, 4]])  # 45° and 135°, 180° and 0°
    assert reference.error_db(amplitude[5], amplitude[6]) > -10


@pytest.mark.parametrize("pole_deg", [-90, 90])
def test_azimuth_is_irrelevant_at_the_poles(tmp_path, pole_deg):
    rows = [(azimuth, pole_deg) for azimuth in (-180, -90, -37.5, 0, 90, 180)]
    amplitude = require_exact(with_grid(tmp_path, rows), noise(SHORT))
    require_same(amplitude, amplitude[3])


def test_echo_from_the_pole_is_found_once(tmp_path):
    """Six entries of the grid are the same direction."""
    rows = [(azimuth, 90) for azimuth in range(0, 360, 60)]
    rows += [(azimuth, elevation) for elevation in (70, 75, 80, 85) for azimuth in range(-180, 180, 10)]
    settings = with_grid(tmp_path, rows)
    up = np.array([0.0, 0.0, 1.0])
    positions_m = microphones(settings.array).enabled_positions_m
    later = np.rint(-(positions_m @ up) / sound_speed_m_s(settings.air) * settings.recording.sample_rate_hz).astype(int)
    ahead = echo_signals(settings, azimuth_deg=0.0, range_m=0.7, level=0.5)
    words = words_of(np.stack([np.roll(row, shift) for row, shift in zip(ahead, later, strict=True)]))
    peaks = find_peaks(Pipeline(settings).process(Measurement(words, settings)), min_level_db=-6)
    assert len(peaks) == 1
    assert peaks[0].elevation_deg == pytest.approx(90, abs=1.5)
    assert math.isfinite(peaks[0].azimuth_deg)


@pytest.mark.parametrize("array", [SHORT.array, ONE], ids=["32 microphones", "one microphone"])
@pytest.mark.parametrize("range_m", [(0.7, 0.7), (0.0, 0.0)])
def test_image_of_one_direction_and_one_range_is_exact(array, range_m):
    """The image consists of one number, which equals that of the exact image."""
    settings = tuned(
        with_processing(SHORT.replace(array=array), directions="2d:1", range_m=range_m), max_error_db=-60.0
    )
    assert require_exact(settings, noise(settings)).shape == (1, 1)


def test_coincident_microphones_act_as_one():
    """With equal bits the image equals that of one microphone and is the same in all directions."""
    pair, single = SHORT.replace(array=TWO_IN_ONE_PLACE), SHORT.replace(array=ONE)
    bits = np.random.default_rng(1).integers(0, 2, SHORT.recording.n_samples, dtype=np.uint8)
    both = require_exact(pair, Measurement(3 * bits, pair))
    alone = Pipeline(single).process(Measurement(bits, single)).amplitude
    assert_allclose(both, np.broadcast_to(alone, both.shape), rtol=0, atol=1e-2 * alone.max())  # two approximations
    require_same(both, both[0])


def test_coincident_microphones_are_averaged():
    pair = SHORT.replace(array=TWO_IN_ONE_PLACE)
    require_exact(pair, noise(pair))


# ---- through the simulator -------------------------------------------------------------------------


def test_image_of_one_microphone_is_its_envelope():
    scene = scene_of(Point(range_m=0.4, strength_db=-20), sensor=EIGHT.replace(array=EAR.array))
    [peak] = find_peaks(image_of(scene), top=1)
    assert peak.range_m == pytest.approx(0.4, abs=0.005)


def test_array_of_coincident_microphones_is_accepted():
    array = Array(layout="pair", positions_m=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), word_bits=8)
    scene = scene_of(Point(azimuth_deg=40, range_m=0.3), sensor=SENSOR.replace(array=array))
    first, second = heard(scene, *EFFECTS)
    assert_allclose(first, second)
