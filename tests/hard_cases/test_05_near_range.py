"""Reflectors at 5 to 30 cm, ranges from 0 on, and delays of points at and inside the array."""

import mpmath
import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.frames import Measurement
from ertis_numba.geometry import far_field_delays, microphones, spherical_delays, unit_vectors
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Recording
from ertis_numba.simulation import Electronics, Emitter, Point
from ertis_numba.simulation.effects import EFFECTS
from tests import reference
from tests.cases import SHORT
from tests.hard_cases.echoes import echo_words
from tests.hard_cases.forced import EIGHT, image_of
from tests.scenes import SENSOR, heard, scene_of, seen

NEAR = SHORT.replace(
    recording=Recording(n_samples=24_000), processing=SHORT.processing.replace(directions="2d:91", range_m=(0.0, 0.45))
)
PLACES_M = microphones(Array()).enabled_positions_m
SPEED_M_S = 343.0


@pytest.mark.parametrize(("range_m", "plane_db"), [(0.05, -9.0), (0.1, -3.2), (0.2, -0.8), (0.3, -0.4)])
def test_spherical_wavefronts_keep_the_level_of_near_echoes(range_m, plane_db):
    """Plane-wave focusing weakens the echo of a point by 0.4 dB at 30 cm and by 9 dB at 5 cm.

    At 5 cm the array of 7 cm is no longer small, and the image's peak is 11° off. From 10 cm on the peak is within
    1°, and at all ranges within 1 mm. Delays to the point itself keep the level within 0.1 dB.
    """
    words = echo_words(NEAR, azimuth_deg=20.0, range_m=range_m, level=0.5, spherical=True)
    image = Pipeline(NEAR, predict=False).process(Measurement(words, NEAR))
    [peak] = find_peaks(image, top=1)
    assert peak.range_m == pytest.approx(range_m, abs=1e-3)
    assert peak.azimuth_deg == pytest.approx(20, abs=1 if range_m > 0.05 else 15)
    toward = unit_vectors(np.radians([20.0]), np.zeros(1))
    ranges_m = range_m + np.arange(-30, 31) * 2e-4
    plane, spherical = (reference.exact(words, NEAR, toward, ranges_m, spherical=is_so) for is_so in (False, True))
    assert 20 * np.log10(spherical.max() / 0.5) == pytest.approx(0, abs=0.12)
    assert 20 * np.log10(plane.max() / 0.5) == pytest.approx(plane_db, abs=0.15)
    everywhere = unit_vectors(image.azimuth_rad, image.elevation_rad)
    assert reference.error_db(image.amplitude, reference.exact(words, NEAR, everywhere, image.range_m)) < -45


def test_image_includes_an_echo_at_range_0():
    """An echo that begins at sample 0 lies at range 0, where the record begins."""
    words = echo_words(NEAR, azimuth_deg=0.0, range_m=0.0, level=0.5)
    image = Pipeline(NEAR, predict=False).process(Measurement(words, NEAR))
    assert image.range_m[0] == 0
    assert image.amplitude[:, 0].max() == image.amplitude.max() == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(
    ("range_m", "bound_s"), [(0.0, 1e-19), (1e-9, 1e-19), (0.05, 1e-18), (1.0, 1e-17), (640.0, 2e-15), (1e4, 3e-14)]
)
def test_delays_of_points_are_exact_to_the_last_digit(range_m, bound_s):
    """At 10 km ``‖r u − p‖ − r`` loses 11 of 16 digits: the error is 7e-15 s in float64 and 4e-6 s in float32.

    The reference has 50 digits. A period of 50 kHz is 2e-5 s long, and a phase of the image 2e-6 s or less.
    """
    random = np.random.default_rng(1)
    directions = unit_vectors(random.uniform(-1.5, 1.5, 20), random.uniform(-1.5, 1.5, 20))
    found_s = spherical_delays(PLACES_M, directions, range_m=range_m, sound_speed_m_s=SPEED_M_S)
    with mpmath.workdps(50):
        for direction, row_s in zip(directions, found_s, strict=True):
            for place_m, delay_s in zip(PLACES_M, row_s, strict=True):
                way = [range_m * mpmath.mpf(u) - mpmath.mpf(p) for u, p in zip(direction, place_m, strict=True)]
                wanted_s = (mpmath.norm(way) - range_m) / SPEED_M_S
                assert abs(wanted_s - mpmath.mpf(delay_s)) < bound_s


def test_delays_in_float32_err_by_a_fifth_of_a_period_at_10_km():
    """Float32 delays are off by 4e-6 s at 10 km and by 3e-7 s at 640 m."""
    toward = unit_vectors(np.linspace(-1.5, 1.5, 20), np.zeros(20))
    for range_m, error_s in ((640.0, 1e-7), (1e4, 2e-6)):
        points_m = np.float32(range_m) * toward.astype(np.float32)[:, None] - PLACES_M.astype(np.float32)
        naive_s = (np.linalg.norm(points_m, axis=-1) - np.float32(range_m)) / np.float32(SPEED_M_S)
        exact_s = spherical_delays(PLACES_M, toward, range_m=range_m, sound_speed_m_s=SPEED_M_S)
        assert np.abs(naive_s - exact_s).max() > error_s


def test_microphone_at_the_focus_has_a_finite_delay():
    """The microphone receives the echo earlier by the whole range, without a division by zero distance."""
    place_m = PLACES_M[5]
    range_m = float(np.linalg.norm(place_m))
    delays_s = spherical_delays(PLACES_M, place_m[None] / range_m, range_m=range_m, sound_speed_m_s=SPEED_M_S)
    assert np.isfinite(delays_s).all()
    assert delays_s[0, 5] == pytest.approx(-range_m / SPEED_M_S, rel=1e-15)
    assert np.argmin(delays_s[0]) == 5


def test_delays_of_a_point_at_the_centre_are_distances():
    """The direction is irrelevant at range 0, although delays of plane waves still depend on it."""
    toward = unit_vectors(np.array([-1.0, 0.3, 1.2]), np.array([0.0, 0.5, -1.0]))
    delays_s = spherical_delays(PLACES_M, toward, range_m=0.0, sound_speed_m_s=SPEED_M_S)
    assert delays_s == pytest.approx(np.tile(np.linalg.norm(PLACES_M, axis=1) / SPEED_M_S, (3, 1)), rel=1e-14)
    assert np.ptp(far_field_delays(PLACES_M, toward, sound_speed_m_s=SPEED_M_S), axis=0).max() > 1e-5


# ---- through the simulator -------------------------------------------------------------------------


@pytest.mark.parametrize("range_m", [0.05, 0.1])
def test_target_within_the_length_of_the_call_is_found(range_m):
    """The echo of such a target arrives before the call ends."""
    scene = scene_of(Point(azimuth_deg=20, range_m=range_m, strength_db=-60), sensor=EIGHT)
    [peak] = find_peaks(image_of(scene), top=1)
    assert peak.range_m == pytest.approx(range_m, abs=0.005)
    assert peak.azimuth_deg == pytest.approx(20, abs=2)


@pytest.mark.parametrize("range_m", [0.001, 0.005])
def test_target_on_the_array_has_a_bounded_level(range_m):
    scene = scene_of(Point(range_m=range_m, strength_db=-90), sensor=EIGHT)
    assert image_of(scene).amplitude.max() < 1
    assert np.abs(heard(scene, "spreading")).max() < 1.001 * 10 ** (-90 / 20) * 1e4


@pytest.mark.parametrize("place_m", [(0.0, 0.0, 0.0), SENSOR.array.positions_m[1]])
def test_target_at_emitter_or_microphone_has_a_bounded_level(place_m):
    sensor = SENSOR.replace(emitter=Emitter(diameter_m=0.02), electronics=Electronics(microphone_diameter_m=0.002))
    scene = scene_of(Point(position_m=place_m, strength_db=-90), sensor=sensor)
    signals = heard(scene, *EFFECTS)
    assert np.all(np.isfinite(signals))
    assert np.abs(signals).max() < 1.001 * 10 ** (-90 / 20) * 1e4


def test_ground_truth_of_a_target_at_the_centre_is_finite():
    [reflector] = seen(scene_of(Point(position_m=(0.0, 0.0, 0.0))), "spreading")
    assert reflector.range_m == 0
    assert np.isfinite(reflector.azimuth_deg)
