"""Timing of measurements by counters and time stamps: rate, jitter, drift and contradictions."""

import re

import numpy as np
import pytest

from ertis_numba.frames import Stamp
from ertis_numba.sensor_check.clock import check_clock

START_NS = 1_700_000_000_000_000_000
JITTER_NS = np.random.default_rng(8).normal(0, 1e5, 200)


def stamp(number, *, count=None, time_s=None, late_ns=0, session_id=1):
    """A stamp of 10 Hz with the jitter of a host."""
    time_s = number / 10 if time_s is None else time_s
    time_ns = START_NS + round(time_s * 1e9) + round(JITTER_NS[number]) + late_ns
    count = number if count is None else count
    return Stamp(sequence=number, sync_count=count, timestamp_ns=time_ns, session_id=session_id)


def timed(*numbers, **changes):
    return [stamp(number, **changes) for number in numbers]


def test_rate_jitter_and_drift_are_measured():
    stamps = [stamp(number, time_s=number * 0.1 * (1 + 30e-6)) for number in range(200)]
    clock = check_clock(stamps, 0.04, 10.0)
    assert clock.rate_hz == pytest.approx(10, rel=40e-6)
    assert clock.jitter_s == pytest.approx(1e-4, rel=0.2)
    assert clock.drift_ppm == pytest.approx(-30, abs=4 * clock.rate_sd_ppm)
    assert (clock.faults, clock.drift_fault, clock.drift_unknown) == ((), "", "")
    assert check_clock(stamps, 0.04).drift_unknown == "the nominal rate is not known; add it with --rate"


def test_fast_clock_is_a_fault():
    stamps = [stamp(number, time_s=number * 0.1 * (1 - 300e-6)) for number in range(200)]
    assert re.match(
        r"the clock runs (29\d|30\d) ppm fast relative to the host", check_clock(stamps, 0.04, 10).drift_fault
    )


def test_short_recording_does_not_show_the_drift():
    assert "is not precise enough; record for a longer time" in check_clock(timed(*range(5)), 0.04, 10.0).drift_unknown


def test_late_time_stamps_are_no_fault():
    stamps = [stamp(number, late_ns=95_000_000 * (number in {20, 90})) for number in range(150)]
    clock = check_clock(stamps, 0.04, 10.0)
    assert clock.faults == ()
    assert clock.jitter_s < 2e-4
    assert clock.drift_fault == ""


def test_uncounted_pulses_are_a_fault():
    stamps = [stamp(number, time_s=(number + 3 * (number >= 50)) / 10) for number in range(100)]
    ((text, remedy),) = check_clock(stamps, 0.04).faults
    assert text == "the counter has 3 pulses fewer than the time at measurement 50"
    assert remedy.startswith("check the SYNC cable")


def test_measurements_that_overlap_are_a_fault():
    ((text, _),) = check_clock(timed(*range(30)), 0.11).faults
    assert re.fullmatch(r"measurements begin every (99\.99|100) ms, but last 110 ms according to the settings", text)


def test_falling_time_stamps_are_a_fault():
    stamps = [stamp(number, late_ns=-(10**10) * (number >= 20)) for number in range(40)]
    assert check_clock(stamps, 0.04).faults[0][0] == "time stamps fall at measurement 20"


def test_rate_far_from_the_nominal_one_is_a_fault():
    clock = check_clock(timed(*range(40)), 0.04, 12.0)
    assert clock.faults[0][0] == "measurements have a rate of 10 Hz, but the nominal rate is 12 Hz"


@pytest.mark.parametrize(
    ("stamps", "why"),
    [
        ([Stamp(sequence=n, sync_count=n, timestamp_ns=n) for n in range(9)], "not from a clock"),
        (timed(0, 1), "2 measurements with rising counters are fewer than 3"),
        (timed(*range(9), count=4), "0 measurements with rising counters"),
        ([stamp(n, time_s=n**2 / 10) for n in range(30)], "no constant rate"),
    ],
)
def test_timing_may_be_unknown(stamps, why):
    clock = check_clock(stamps, 0.04)
    assert why in clock.timing_unknown
    assert clock.faults == ()


def test_sessions_have_their_own_counters():
    stamps = [*timed(*range(50)), *(stamp(n, time_s=100 + n / 10, count=n - 50, session_id=2) for n in range(50, 150))]
    clock = check_clock(stamps, 0.04)
    assert clock.faults == ()
    assert clock.rate_hz == pytest.approx(10, rel=1e-4)
