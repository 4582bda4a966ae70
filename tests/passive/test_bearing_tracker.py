"""Tracks of bearings: events with the right times and directions, and none from single false alarms."""

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Bearing
from ertis_numba.passive import BearingTracker
from ertis_numba.passive.direction_filter import DirectionFilter

BAND_HZ, STEP_S = (30e3, 40e3), 0.1


def bearing(azimuth_deg, elevation_deg=0.0, *, size_deg=0.5, level_dbfs=-60.0, band_hz=BAND_HZ):
    return Bearing(
        azimuth_deg=azimuth_deg,
        elevation_deg=elevation_deg,
        sideways_deg=size_deg,
        upwards_deg=size_deg,
        correlation=0.0,
        band_hz=band_hz,
        level_dbfs=level_dbfs,
        snr_db=0.0,
    )


def test_filter_is_the_textbook_filter_for_small_angles():
    """Compare with the matrix equations in one fixed plane."""
    random = np.random.default_rng(0)
    rows = 1e-3 * random.standard_normal((20, 2))
    found = DirectionFilter(
        bearing(*rows[0], size_deg=1e-3), acceleration_deg_s=0.01, speed_deg_s=0.02, array_error_deg=5e-4
    )
    noise = (1e-3**2 + 5e-4**2) * np.eye(2)
    state, covariance = np.array([*rows[0], 0, 0]), np.diag([noise[0, 0], noise[0, 0], 0.02**2, 0.02**2])
    step = np.block([[np.eye(2), STEP_S * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
    drive = 0.01**2 * np.kron([[STEP_S**3 / 3, STEP_S**2 / 2], [STEP_S**2 / 2, STEP_S]], np.eye(2))
    seen = np.eye(4)[:2]
    for row in rows[1:]:
        found.predict(STEP_S)
        state, covariance = step @ state, step @ covariance @ step.T + drive
        spread = seen @ covariance @ seen.T + noise
        expected = (row - state[:2]) @ np.linalg.inv(spread) @ (row - state[:2])
        assert found.distance(bearing(*row, size_deg=1e-3)) == pytest.approx(expected, rel=1e-5)
        found.update(bearing(*row, size_deg=1e-3))
        gain = covariance @ seen.T @ np.linalg.inv(spread)
        state, covariance = state + gain @ (row - state[:2]), covariance - gain @ seen @ covariance
    assert np.degrees(found.direction[1:]) == pytest.approx(state[:2], abs=1e-8)
    assert np.degrees(found.velocity_rad_s) == pytest.approx(state[2:], abs=1e-7)
    assert found.covariance == pytest.approx(np.radians(1) ** 2 * covariance, rel=1e-4, abs=1e-16)


def test_moving_source_is_one_event_with_its_velocity():
    random, tracker = np.random.default_rng(1), BearingTracker(array_error_deg=0.01)
    for k in range(60):
        truth_deg = -60 + 20 * k * STEP_S
        events = tracker.add([bearing(*(random.normal((truth_deg, 5.0), 0.5)))], time_s=10 + k * STEP_S)
        assert len(events) == (k > 0)
    (event,) = tracker.finish()
    assert event.is_over
    assert event.n_bearings == 60
    assert event.start_s == 10
    assert event.duration_s == pytest.approx(5.9)
    assert event.azimuth_deg == pytest.approx(truth_deg, abs=4 * event.sideways_deg)
    assert event.elevation_deg == pytest.approx(5, abs=4 * event.upwards_deg)
    assert event.sideways_deg < 0.4  # less than a bearing
    assert event.sideways_deg_s == pytest.approx(20, abs=4)


def test_uncertainty_is_that_of_the_errors():
    random, ratios = np.random.default_rng(2), []
    for _ in range(60):
        tracker = BearingTracker(array_error_deg=1e-3, acceleration_deg_s=0.1)
        for k in range(12):
            (*_, event) = tracker.add([bearing(*random.normal((30, 10), 0.5))], time_s=k * STEP_S) or [None]
        ratios.append((event.azimuth_deg - 30) * np.cos(np.radians(10)) / event.sideways_deg)
    assert np.std(ratios) == pytest.approx(1, abs=0.3)


def test_single_false_alarms_are_no_events():
    random, tracker = np.random.default_rng(3), BearingTracker()
    for k in range(200):
        found = [bearing(*random.uniform((-80, -60), (80, 60)))] if k % 4 == 0 else []
        assert tracker.add(found, time_s=k * STEP_S) == []
    assert tracker.finish() == []


def test_event_needs_two_bearings_of_three_and_ends_after_misses():
    tracker, heard = BearingTracker(max_misses=3), [1, 0, 1, 1, 0, 0, 1, 0, 0, 0, 0]
    counts = [
        [(event.n_bearings, event.is_over) for event in tracker.add([bearing(20)] * each, time_s=k * STEP_S)]
        for k, each in enumerate(heard)
    ]
    assert counts == [[], [], *([(n, False)] for n in (2, 3, 3, 3, 4, 4, 4)), [(4, True)], []]


def test_end_and_direction_are_those_of_the_last_bearing():
    tracker = BearingTracker()
    for k in range(5):
        (*_, event) = tracker.add([bearing(3.0 * k, level_dbfs=-60.0 - k)], time_s=k * STEP_S) or [None]
    for k in range(5, 8):
        (later,) = tracker.add([], time_s=k * STEP_S)
        assert later.is_over == (k == 7)
        assert (later.end_s, later.azimuth_deg) == (event.end_s, event.azimuth_deg)
    assert event.end_s == pytest.approx(0.4)
    assert event.level_dbfs == -60


def test_sources_that_are_apart_or_in_other_bands_are_separate_events():
    tracker = BearingTracker()
    for k in range(4):
        found = [bearing(-20 - k / 5), bearing(20 + k / 5), bearing(20, band_hz=(40e3, 50e3)), bearing(160)]
        events = tracker.add(found[:: -1 if k % 2 else 1], time_s=k * STEP_S)
    assert sorted(round(event.azimuth_deg) for event in events) == [-21, 20, 21, 160]
    assert sorted(event.number for event in events) == [1, 2, 3, 4]
    assert {event.n_bearings for event in events} == {4}


def test_angles_that_are_not_resolved_do_not_matter():
    tracker = BearingTracker()
    for k in range(3):
        flat = bearing(20, 30.0 * (k - 1))
        blind = Bearing(**{name: getattr(flat, name) for name in flat.__slots__} | {"upwards_deg": np.inf})
        events = tracker.add([blind], time_s=k * STEP_S)
    assert len(events) == 1


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"max_misses": 0}, "max_misses"), ({"array_error_deg": 0.0}, "array_error"), ({"speed_deg_s": -1.0}, "speed")],
)
def test_arguments_outside_their_limits_are_refused(changes, words):
    with pytest.raises(ArgumentError, match=words):
        BearingTracker(**changes)


def test_maps_out_of_order_are_refused():
    tracker = BearingTracker()
    tracker.add([], time_s=1.0)
    with pytest.raises(ArgumentError, match="add maps in the order"):
        tracker.add([], time_s=1.0)
    with pytest.raises(ArgumentError, match=r"bearings\[0\]"):
        tracker.add([3], time_s=2.0)
