"""Grouping of measurements with faults of pulses, clocks and networks."""

import msgspec
import pytest

from ertis_numba.network.messages import decode, encode
from ertis_numba.network.processing.groups import Groups
from tests.driven import data

INTERVAL_NS = 100_000_000
HOUR_NS = 3_600_000_000_000
LATENCY_NS = 3_000_000


class CountedPlatform:
    """Sensors on one SYNC chain, with a monotonic clock per session and a wall clock that may be set."""

    def __init__(self, *runs):
        self.groups = Groups()
        self.closed = []
        self.ahead = {}  # of a sensor's clock
        self.shift = {}  # of its count
        self.runs = dict(runs)  # sensor: epoch

    def register(self, before_ns=3 * 10**9 // 2):
        for sensor in self.runs:
            self.groups.register(sensor, 10**12 - before_ns)

    def pulse(self, number, *, without=(), late=0):
        at_ns = 10**12 + number * INTERVAL_NS
        for sensor, session_id in self.runs.items():
            if sensor in without:
                continue
            measured = data(
                sensor,
                number,
                session_id=session_id,
                sync_count=number + self.shift.get(sensor, 0),
                timestamp_ns=10**18 + at_ns + self.ahead.get(sensor, 0),
                monotonic_ns=at_ns + 1000 * session_id * INTERVAL_NS,
            )
            self.closed += self.groups.add(measured, at_ns + LATENCY_NS + late)
        return at_ns

    def wait(self, number):
        self.closed += self.groups.tick(10**12 + number * INTERVAL_NS)

    def reported(self):
        return [(group.group, group.sensors, group.flags) for group in self.closed]


@pytest.fixture
def four():
    made = CountedPlatform(*((name, 1) for name in "abcd"))
    made.register()
    return made


def test_group_stays_open_while_sensors_still_arrive():
    platform = CountedPlatform(("a", 1))
    platform.register(0)
    platform.pulse(0)
    platform.runs["b"] = 1
    platform.register(0)
    platform.pulse(0, without=("a",))
    assert not platform.closed
    platform.wait(25)
    assert platform.reported() == [(0, ("a", "b"), ())]


def test_group_closes_when_it_is_complete(four):
    four.pulse(0)
    assert four.reported() == [(0, ("a", "b", "c", "d"), ())]
    assert four.closed[0].members == tuple((name, 1, 0) for name in "abcd")
    assert (four.closed[0].missing, four.closed[0].spread_ns) == ((), 0)
    assert four.groups.closed == {"complete": 1}


def test_incomplete_group_closes_after_its_time_limit(four):
    for number in range(3):
        four.pulse(number, without=("c",) if number == 1 else ())
    assert [group.group for group in four.closed] == [0, 2]
    four.wait(20)
    assert four.reported()[-1] == (1, ("a", "b", "d"), ("incomplete",))
    assert four.closed[-1].missing == ("c",)


def test_group_does_not_wait_for_a_departed_sensor(four):
    four.pulse(0)
    for number in range(1, 80):
        four.pulse(number, without=("d",))
        four.wait(number)
    assert four.reported()[-1] == (79, ("a", "b", "c"), ())


def test_clock_step_flags_the_group_and_shifts_nothing(four):
    for number in range(20):
        four.ahead["b"] = HOUR_NS if number >= 10 else 0
        four.pulse(number)
    assert [group.group for group in four.closed] == list(range(20))
    assert all(group.sensors == ("a", "b", "c", "d") for group in four.closed)
    assert [group.flags for group in four.closed] == [()] * 10 + [("clock",)] * 10
    assert four.closed[-1].spread_ns == HOUR_NS


def test_counts_of_several_sessions_are_aligned_by_time():
    platform = CountedPlatform(("a", 1), ("b", 2))
    platform.register()
    platform.shift["b"] = -7  # it was armed seven pulses later
    for number in range(20):
        platform.pulse(number)
    platform.wait(40)
    assert platform.reported() == [(number, ("a", "b"), ()) for number in range(20)]


@pytest.mark.parametrize("shift", [-1, 1])
def test_lost_or_double_pulse_flags_its_groups_only(shift):
    platform = CountedPlatform(("a", 1), ("b", 2), ("c", 3))
    platform.register()
    for number in range(60):
        platform.shift["b"] = shift if number >= 20 else 0
        platform.pulse(number)
    platform.wait(90)
    reported = platform.reported()
    # Some groups are flagged while nobody can know yet.
    flagged = [group for group, _, flags in reported if flags]
    assert any("pulse" in flags for _, _, flags in reported)
    assert all(19 <= group <= 30 for group in flagged)
    for group in platform.closed:
        pulses = {sensor: sequence for sensor, _, sequence in group.members}
        assert pulses.get("a") == pulses.get("c")  # they have lost nothing
        if not group.flags:
            assert len(pulses) == 3
            assert len(set(pulses.values())) == 1
    assert sum(not group.flags for group in platform.closed) >= 52


def test_clock_step_of_a_single_session_shifts_nothing():
    platform = CountedPlatform(("a", 1), ("b", 2))
    platform.register()
    for number in range(30):
        platform.ahead["b"] = HOUR_NS if number >= 15 else 0
        platform.pulse(number)
    platform.wait(50)
    assert [group.group for group in platform.closed] == list(range(30))
    assert platform.reported()[-1] == (29, ("a", "b"), ("clock",))


def test_fast_clock_does_not_separate_its_sensor():
    platform = CountedPlatform(("a", 1), ("b", 2))
    platform.register()
    for number in range(10):
        platform.pulse(number, without=("b",))
    platform.ahead["b"] = HOUR_NS
    for number in range(10, 30):
        platform.pulse(number)
    platform.wait(50)
    assert platform.reported()[-1] == (29, ("a", "b"), ("clock",))


def test_late_measurement_is_counted(four):
    four.pulse(0, without=("d",))
    four.wait(12)
    four.runs = {"d": 1}
    four.pulse(0)
    assert four.groups.closed == {"incomplete": 1, "measurement too late": 1}


def test_ended_sessions_are_forgotten(four):
    for session_id in range(2, 80):
        four.runs = dict.fromkeys("abcd", session_id)
        for number in range(3):
            four.pulse(3 * session_id + number)
    four.wait(250)  # who comes after all others have gone is compared by the interval, after a while
    assert four.reported()[-1] == (233, ("a", "b", "c", "d"), ())


def test_slow_clock_is_distinguished_from_old_measurements():
    """A computer without a battery starts in the past, but its measurements are as new as those of others."""
    platform = CountedPlatform(("a", 1), ("b", 2))
    platform.register()
    for number in range(10):
        platform.pulse(number, without=("b",))
    platform.ahead["b"] = -HOUR_NS
    for number in range(10, 60):
        platform.pulse(number)
    platform.wait(90)
    assert platform.reported()[-1] == (59, ("a", "b"), ("clock",))
    assert sum(group.sensors == ("a", "b") for group in platform.closed) >= 25


def test_node_that_catches_up_keeps_its_times():
    platform = CountedPlatform(("a", 1), ("b", 2))
    platform.register()
    for number in range(40):
        platform.pulse(number, without=("b",))
    for number in range(40):  # b sends what it has kept, ten times as fast
        at_ns = 10**12 + number * INTERVAL_NS
        old = data("b", number, session_id=2, sync_count=number, timestamp_ns=10**18 + at_ns, monotonic_ns=at_ns)
        platform.groups.add(old, 10**12 + (400 + number) * INTERVAL_NS // 10)
    assert platform.groups.closed["measurement too late"] > 20


@pytest.mark.parametrize(
    "wrong",
    [
        lambda number: {"timestamp_ns": -(2**63) if number % 2 else 10**18},
        lambda number: {"sync_count": -(2**63) if number % 2 else 2**63 - 1},
        lambda number: {"sync_count": number + 10**6 * (number > 100)},
        lambda number: {"sync_count": 3 * number * number},
        lambda number: {"monotonic_ns": (-1) ** number * 2**62},
        lambda number: {"monotonic_ns": 3600 * 10**9 * number, "timestamp_ns": 3600 * 10**9 * number},
    ],
    ids=["timestamp", "count", "far", "away", "clock", "fast"],
)
def test_faulty_sensor_does_not_change_groups_of_others(wrong):
    platform = CountedPlatform(("a", 1), ("b", 2))
    platform.register()
    values = {"timestamp_ns": 10**18, "monotonic_ns": 0, "sync_count": 0}
    for number in range(600):
        at_ns = 10**12 + number * INTERVAL_NS
        values |= {"sync_count": number, "timestamp_ns": 10**18 + at_ns, "monotonic_ns": at_ns}
        evil = data("evil", number, session_id=9, **(values | wrong(number)))
        platform.closed += platform.groups.add(evil, at_ns + LATENCY_NS)
        platform.pulse(number)
        platform.wait(number + 0.5) if number % 4 == 0 else None
    platform.wait(640)
    for group in platform.closed:
        assert msgspec.structs.asdict(decode(encode(group))) == msgspec.structs.asdict(group)
    both = [group for group in platform.closed if {"a", "b"} <= set(group.sensors)]
    assert len(both) >= 580


def test_sessions_after_a_faulty_sensor_are_grouped():
    platform = CountedPlatform(("evil", 9))
    platform.register()
    for number in range(300):
        platform.shift["evil"] = number * 10**6
        platform.pulse(number)
    platform.runs = {"a": 1, "b": 2}
    platform.register()
    for number in range(300, 400):
        platform.pulse(number)
    platform.wait(440)
    assert sum({"a", "b"} <= set(group.sensors) for group in platform.closed) >= 90
