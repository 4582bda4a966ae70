"""Blocks of several sensors get the number of their pulse, whatever their counters are."""

import numpy as np
import pytest

from ertis_numba.devices.capture.sync_counts import PulseAligner

SHORTEST_S = 0.0364


def pulses_of(seed, *, n_sensors, rate_hz, n=60, lose=0.1, jitter_s=0.01, regular=True):
    """Yield (sensor, counter, arrived_ns, pulse) in order of arrival; sensors are armed one after the other."""
    random = np.random.default_rng(seed)
    interval_s = np.full(n, 1 / rate_hz) if regular else random.uniform(1.0, 4.0, n) / rate_hz
    times_s = np.cumsum(interval_s) + 1.0
    events = []
    for sensor in range(n_sensors):
        armed = 0 if sensor == 0 else int(random.integers(0, 3))
        started = int(random.integers(0, 2)) - armed  # firmware that counts from 0, or from 1
        for pulse in range(armed, n):
            first_of_all = sensor == 0 and pulse == 0
            if random.random() < lose and not first_of_all:
                continue
            late_s = random.uniform(0, jitter_s)
            events.append((times_s[pulse] + late_s, f"s{sensor}", pulse + started, pulse))
    for time_s, sensor, counter, pulse in sorted(events):
        yield sensor, counter, round(time_s * 1e9), pulse


def numbered(events, sensors, counts=None):
    counts = counts or PulseAligner(sensors, shortest_s=SHORTEST_S)
    found, now_ns = [], 0
    for sensor, counter, now_ns, pulse in events:
        found += counts.add(sensor, (sensor, pulse), counter, now_ns)
    return found + counts.release(now_ns, at_once=True), counts


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.parametrize("n_sensors", [1, 2, 4])
@pytest.mark.parametrize("regular", [True, False])
def test_measurements_get_the_number_of_their_pulse(seed, n_sensors, regular):
    sensors = [f"s{number}" for number in range(n_sensors)]
    events = list(pulses_of(seed, n_sensors=n_sensors, rate_hz=[5.0, 10.0, 20.0][seed % 3], regular=regular))
    found, counts = numbered(events, sensors)
    assert len(found) == len(events)
    assert all(number == pulse for (_, pulse), number in found)
    assert counts.realigned == 0


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("n_sensors", [1, 3])
def test_returning_sensor_is_aligned_again(seed, n_sensors):
    sensors = [f"s{number}" for number in range(n_sensors)]
    events = list(pulses_of(seed, n_sensors=n_sensors, rate_hz=10.0, lose=0.0))
    last = sensors[-1]
    counts = PulseAligner(sensors, shortest_s=SHORTEST_S)
    found, now_ns, restarted = [], 0, None
    for sensor, counter, arrived_ns, pulse in events:
        now_ns = arrived_ns
        if sensor == last and 20 <= pulse < 20 + seed:
            continue
        if sensor == last and pulse >= 20 + seed and seed:
            if restarted is None:
                restarted = counter - 7
                found += counts.reset(last)
            counter -= restarted  # noqa: PLW2901
        found += counts.add(sensor, (sensor, pulse), counter, now_ns)
    found += counts.release(now_ns, at_once=True)
    assert all(number == pulse for (_, pulse), number in found)
    assert counts.realigned == 0


def test_unnoticed_missed_pulse_is_corrected():
    """A sensor may ignore a pulse while it measures, and not count it."""
    events = [
        (sensor, counter - (sensor == "s1" and counter >= 30), now_ns, pulse)
        for sensor, counter, now_ns, pulse in pulses_of(3, n_sensors=2, rate_hz=10.0, lose=0.0)
    ]
    first = next(counter for sensor, counter, _, pulse in events if sensor == "s1" and pulse == 40)
    found, counts = numbered(events, ["s0", "s1"])
    assert first
    assert counts.realigned >= 1
    assert all(number == pulse for (sensor, pulse), number in found if pulse >= 35)


def test_held_measurements_are_released_before_a_restart():
    counts = PulseAligner(["a", "b"], shortest_s=SHORTEST_S)
    found = [each for number in range(4) for each in counts.add("a", ("a", number), number, number * 100_000_000)]
    found += counts.add("b", ("b", 2), 100, 205_000_000)
    assert not [item for (item, _), _ in found if item == "b"]  # too few to decide
    assert counts.reset("b") == [(("b", 2), 2)]
    assert counts.reset("b") == []
    found += [each for number in range(4, 8) for each in counts.add("a", ("a", number), number, number * 100_000_000)]
    found += [each for number in (4, 5, 6) for each in counts.add("b", ("b", number), number - 4, number * 100_000_000)]
    assert all(pulse == number for (_, pulse), number in found)
    assert len(found) == 11


def test_held_measurements_are_released_after_a_timeout():
    counts = PulseAligner(["a", "b"], shortest_s=SHORTEST_S)
    assert counts.add("b", "early", 4, 1_000_000_000) == []  # the first sensor has said nothing yet
    assert counts.release(1_400_000_000) == []
    assert counts.release(1_600_000_000) == [("early", 0)]


@pytest.mark.parametrize("seed", range(20))
def test_late_blocks_change_nothing(seed):
    """On a busy host, a block may arrive after the next pulse; the majority decides."""
    random = np.random.default_rng(seed)
    late = [
        (sensor, counter, now_ns + (round(random.uniform(0.05e9, 0.12e9)) if random.random() < 0.12 else 0), pulse)
        for sensor, counter, now_ns, pulse in pulses_of(seed, n_sensors=4, rate_hz=10.0, lose=0.0)
    ]
    found, _ = numbered(sorted(late, key=lambda event: event[2]), ["s0", "s1", "s2", "s3"])
    assert len(found) == len(late)
    groups = {}
    for (_, pulse), number in found:
        groups.setdefault(number, set()).add(pulse)
    mixed = [number for number, pulses in groups.items() if len(pulses) > 1]
    assert not [number for number in mixed if number > 10]
    assert len(mixed) <= 3  # while offsets are found, a late block may stand alone
