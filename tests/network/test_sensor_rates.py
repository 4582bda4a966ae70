"""Rates of measurements in the status of a central node."""

import numpy as np
import pytest

from ertis_numba.network.central_node import _streams
from ertis_numba.network.central_node._streams import SensorTrack

NOW_S = 1000.0


def rate_hz(monkeypatch, measured_s, arrived_s=None, *, session_id=7, now_s=NOW_S):
    track = SensorTrack()
    for made_s, came_s in zip(measured_s, measured_s if arrived_s is None else arrived_s, strict=True):
        track.took(4, session_id, arrived_s=came_s, measured_s=made_s)
    monkeypatch.setattr(_streams.time, "monotonic", lambda: now_s)
    return track.status().rate_hz


def steady_s(period_s, n, end_s=NOW_S):
    return end_s - period_s * np.arange(n)[::-1]


@pytest.mark.parametrize("period_s", [0.01, 0.1, 0.5, 2.0, 5.0, 60.0])
def test_rates_are_those_of_the_measurements(monkeypatch, period_s):
    assert rate_hz(monkeypatch, steady_s(period_s, 40)) == pytest.approx(1 / period_s, abs=1e-3)


@pytest.mark.parametrize("pause_s", [1.0, 2.0, 10.0, 3600.0])
@pytest.mark.parametrize("n_after", [1, 2, 5, 40])
def test_a_pause_does_not_change_the_rate(monkeypatch, pause_s, n_after):
    after_s = steady_s(0.1, n_after)
    before_s = steady_s(0.1, 50, after_s[0] - pause_s)
    assert rate_hz(monkeypatch, [*before_s, *after_s]) == pytest.approx(10.0)


def test_kept_measurements_that_arrive_at_once_have_the_rate_at_which_they_were_made(monkeypatch):
    made_s = steady_s(0.1, 600, NOW_S - 30.0)
    assert rate_hz(monkeypatch, made_s, NOW_S - 0.001 * np.arange(600)[::-1]) == pytest.approx(10.0)


def test_a_clock_that_was_set_or_stands_still_does_not_change_the_rate(monkeypatch):
    arrived_s = steady_s(0.1, 30)
    assert rate_hz(monkeypatch, arrived_s + 3600.0 * (np.arange(30) > 20), arrived_s) == pytest.approx(10.0)
    assert rate_hz(monkeypatch, np.zeros(30), arrived_s) == pytest.approx(10.0)


def test_a_silent_sensor_has_no_rate(monkeypatch):
    assert rate_hz(monkeypatch, steady_s(0.1, 30), now_s=NOW_S + 3.5) == 0.0
    assert rate_hz(monkeypatch, steady_s(5.0, 30), now_s=NOW_S + 9.0) == pytest.approx(0.2)
    assert rate_hz(monkeypatch, steady_s(5.0, 30), now_s=NOW_S + 13.0) == 0.0
    assert rate_hz(monkeypatch, steady_s(5.0, 1)) == 0.0
    assert rate_hz(monkeypatch, []) == 0.0
