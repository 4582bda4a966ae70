"""Groups of images of the same SYNC pulse, in whatever order they arrive."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from ertis_numba.frames import Stamp
from ertis_numba.fusion.pulses import PulseGroups

PERIOD_NS = 100_000_000
SENSORS = "front", "left", "back"


class StampedItem(NamedTuple):
    """An item with a stamp only."""

    stamp: Stamp


def item(sensor, count, *, later_ns=0):
    return StampedItem(Stamp(sensor=sensor, sync_count=count, timestamp_ns=10**18 + count * PERIOD_NS + later_ns))


HOUR_NS = 3_600_000_000_000


def counted(sensor, count, *, session_id=7, later_ns=0):
    """An item of a session, whose clock may be wrong."""
    stamp = item(sensor, count, later_ns=later_ns).stamp
    return StampedItem(replace(stamp, session_id=session_id))


class Arrivals:
    """A collector whose items arrive at times of the test, and its notes."""

    def __init__(self):
        self.notes, self.at_ns = [], 0
        self.groups = PulseGroups(self.notes.append, lambda: self.at_ns)

    def add(self, number, *items):
        """Add items that arrive at the pulse of a number."""
        self.at_ns = number * PERIOD_NS
        return [group for each in items for group in self.groups.add(each)]


def summary(groups):
    """SYNC count and sensors of each group."""
    return [(next(iter(group.values())).stamp.sync_count, *sorted(group)) for group in groups]


def test_images_that_overtake_those_of_another_sensor_wait_for_them():
    groups = PulseGroups.of(SENSORS)
    order = [("front", 0), ("left", 0), ("front", 1), ("back", 0), ("left", 1), ("back", 1)]
    found = [summary(groups.add(item(*each))) for each in order]
    assert found == [[], [], [], [(0, "back", "front", "left")], [], [(1, "back", "front", "left")]]


@pytest.mark.parametrize("seed", range(5))
def test_groups_are_complete_and_in_order_if_each_sensor_is(seed):
    draws = np.random.default_rng(seed)
    # Each sensor's images keep their order, and are late by up to two periods.
    arrivals = [
        (time, item(sensor, count, later_ns=shift_ns))
        for sensor, shift_ns in zip(SENSORS, (0, 180_000_000, -40_000_000), strict=True)
        for count, time in enumerate(np.maximum.accumulate(np.arange(40) + draws.uniform(0, 2, 40)))
    ]
    groups = PulseGroups.of(SENSORS)
    found = [groups.add(each) for _, each in sorted(arrivals, key=lambda arrival: arrival[0])]
    assert summary(itertools.chain(*found)) == [(count, *sorted(SENSORS)) for count in range(40)]


def test_pulse_ends_once_a_missing_sensor_has_an_image_of_the_next_one():
    groups = PulseGroups.of(SENSORS)
    order = [("front", 0), ("left", 0), ("front", 1), ("left", 1), ("back", 1)]
    found = [summary(groups.add(item(*each))) for each in order]
    assert found == [[], [], [], [], [(0, "front", "left"), (1, "back", "front", "left")]]


def test_sensor_that_stops_delays_some_pulses_only():
    groups = PulseGroups.of(SENSORS)
    for count, sensor in itertools.product(range(2), SENSORS):
        groups.add(item(sensor, count))
    found = [summary(groups.add(item(sensor, count))) for count in range(2, 8) for sensor in ("front", "left")]
    assert [count for group in found for count, *_ in group] == [*range(2, 8)]
    assert found[-3:] == [[(6, "front", "left")], [], [(7, "front", "left")]]


def test_late_and_repeated_images_are_left_out():
    groups = PulseGroups.of(["front"])
    assert summary(groups.add(item("front", 5))) == [(5, "front")]
    assert groups.add(item("front", 5)) == []
    assert groups.add(item("left", 4)) == []
    assert groups.close() == {}


def test_close_returns_open_groups_from_the_earliest():
    groups = PulseGroups.of(SENSORS)
    for each in (("left", 4), ("front", 3)):
        groups.add(item(*each))
    assert summary([groups.close(), groups.close()]) == [(3, "front"), (4, "left")]
    assert groups.close() == {}


def test_first_pulse_of_unknown_sensors_ends_when_the_second_begins():
    groups = PulseGroups.of([])
    order = [("front", 0), ("left", 0), ("back", 0), ("front", 1), ("left", 1), ("back", 1)]
    found = [summary(groups.add(item(*each))) for each in order]
    assert found == [[], [], [], [(0, "back", "front", "left")], [], [(1, "back", "front", "left")]]


@pytest.mark.parametrize("apart_ns", [0, 120_000_000, 450_000_000])
def test_recorded_items_are_grouped_whatever_the_difference_of_clocks_below_half_a_second(apart_ns):
    """At 10 Hz, clocks that differ by 0.45 s put four pulses of one sensor before the first of the other."""
    items = [item("front", count) for count in range(20)]
    items += [item("left", count, later_ns=apart_ns) for count in range(20) if count != 7]
    expected = [(count, "front", *(["left"] if count != 7 else [])) for count in range(20)]
    assert summary(PulseGroups.recorded(items)) == expected
    assert summary(PulseGroups.recorded(reversed(items))) == expected


def test_recorded_items_of_another_chain_remove_no_pulse():
    """Pulses twice a second and ten times a second, which begin at the same time."""
    slow = [StampedItem(Stamp(sensor="front", sync_count=n, timestamp_ns=n * 500_000_000)) for n in range(6)]
    fast = [StampedItem(Stamp(sensor="left", sync_count=n, timestamp_ns=n * 100_000_000)) for n in range(10)]
    groups = PulseGroups.recorded(slow + fast)
    assert sorted(group["front"].stamp.sync_count for group in groups if "front" in group) == list(range(6))
    assert sorted(group["left"].stamp.sync_count for group in groups if "left" in group) == list(range(10))


@pytest.mark.parametrize(
    "wrong_ns",
    [
        lambda sensor, count: HOUR_NS if (sensor, count) == ("left", 10) else 0,
        lambda sensor, count: -HOUR_NS if (sensor, count) == ("left", 10) else 0,
        lambda _, count: HOUR_NS if count == 10 else 0,
        lambda _, count: -HOUR_NS if count >= 10 else 0,
        lambda _, count: HOUR_NS if count >= 10 else 0,
        lambda sensor, count: -count * 700_000_000 if sensor == "left" else 0,
    ],
    ids=["one ahead", "one behind", "all ahead once", "set back", "set ahead", "too slow"],
)
def test_wrong_clock_of_a_session_changes_no_group(wrong_ns):
    arrivals = Arrivals()
    found = [
        group
        for count in range(30)
        for group in arrivals.add(
            count, *(counted(each, count, later_ns=wrong_ns(each, count)) for each in ("front", "left"))
        )
    ]
    assert summary(found)[1:] == [(count, "front", "left") for count in range(1, 30)]
    assert arrivals.notes == []


@pytest.mark.parametrize("ahead_ns", [HOUR_NS, -HOUR_NS])
def test_session_with_another_clock_stops_no_other(ahead_ns):
    """Sensors of two nodes, of which one has a wrong clock: each node's pulses are complete."""
    arrivals = Arrivals()
    found = [
        group
        for count in range(40)
        for group in arrivals.add(
            count,
            *(counted(each, count) for each in ("front", "left")),
            *(counted(each, count, session_id=8, later_ns=ahead_ns) for each in ("right", "back")),
        )
    ]
    for sensors in (("front", "left"), ("back", "right")):
        counts = [count for count, *names in summary(found) if tuple(names) == sensors]
        assert counts[-20:] == [*range(counts[-1] - 19, counts[-1] + 1)]
        assert counts[-1] >= 37


def test_measurement_of_the_future_does_not_end_the_pulses_of_another_session():
    arrivals = Arrivals()
    found = []
    for count in range(20):
        late_ns = HOUR_NS if count == 5 else 0
        found += arrivals.add(count, counted("front", count), counted("left", count, session_id=8, later_ns=late_ns))
    assert [(count, *names) for count, *names in summary(found) if count > 6] == [
        (count, "front", "left") for count in range(7, 20)
    ]


def test_counter_that_restarts_within_its_session_begins_anew_and_is_noted():
    arrivals = Arrivals()
    for count in range(100, 120):
        arrivals.add(count, counted("front", count))
    found = [(number, group) for number in range(30) for group in arrivals.add(120 + number, counted("front", number))]
    first = found[0][0]
    assert 10 <= first <= 12
    assert summary(group for _, group in found) == [(count, "front") for count in range(first, 30)]
    (note,) = arrivals.notes
    assert note.startswith("images of sensor front were left out for 1.0 s, because their SYNC counts or times went")
    assert note.endswith(f"its pulses count anew from {first}")


def test_restarted_node_with_a_new_session_continues_at_once():
    arrivals = Arrivals()
    for count in range(100, 110):
        arrivals.add(count, counted("front", count))
    found = [
        group
        for number in range(5)
        for group in arrivals.add(120 + number, counted("front", number, session_id=9, later_ns=120 * PERIOD_NS))
    ]
    assert summary(found) == [(number, "front") for number in range(5)]
