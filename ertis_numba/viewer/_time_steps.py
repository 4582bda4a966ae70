"""Time steps of a file, and the last measurement of each sensor."""

import bisect
import itertools
import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self

from ertis_numba.frames import Stamp

__all__ = ["UNTIMED_S", "SensorTimeline", "TimeStep", "time_steps_of", "usual_s"]

UNTIMED_S: Final = 0.1
"""Interval between measurements without timestamps."""
_PAUSE_S, _LONGEST_PAUSE_S = 10.0, 600.0  # that is played at least, and at most, whatever is usual
_PAUSE: Final = 10.0  # of what usually lies between two moments, beyond which it is a pause
_TOGETHER_NS: Final = 10_000_000  # measurements of several sensors that are shown as one


@dataclass(frozen=True, slots=True)
class TimeStep:
    """Measurements shown together, as (sensor, number): at most one per sensor."""

    time_s: float  # from the first time step
    measurements: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class SensorTimeline:
    """Measurements of a sensor along the time steps."""

    places: tuple[int, ...]  # rising indices of the time steps
    numbers: tuple[int, ...]  # indices of the measurements in the file
    interval_s: float | None  # typical; None for a single measurement

    @classmethod
    def of(cls, sensor: str, time_steps: tuple[TimeStep, ...]) -> Self:
        """Find the measurements of a sensor."""
        found = [
            (place, number)
            for place, time_step in enumerate(time_steps)
            for name, number in time_step.measurements
            if name == sensor
        ]
        places, numbers = tuple(place for place, _ in found), tuple(number for _, number in found)
        return cls(places, numbers, usual_s([time_steps[place].time_s for place in places]))

    def last(self, after: int, until: int) -> tuple[int, int] | None:
        """Return index and number of the last measurement after one time step and up to another, or None."""
        index = bisect.bisect_right(self.places, until) - 1
        return (self.places[index], self.numbers[index]) if index >= 0 and self.places[index] > after else None


def usual_s(times_s: Iterable[float]) -> float | None:
    """Return the median interval of times; None for a single one."""
    between_s = [after_s - before_s for before_s, after_s in itertools.pairwise(times_s)]
    return statistics.median_low(between_s) if between_s else None


def time_steps_of(stamps: dict[str, list[Stamp]]) -> tuple[tuple[TimeStep, ...], list[str]]:
    """Return the time steps of measurements in the order of their times, and notes on replaced times."""
    # Without clocks, times count from an arbitrary start; single measurements get the typical distance to neighbours.
    given = {name: [stamp.timestamp_ns for stamp in each] for name, each in stamps.items()}
    known = _known(stamps)
    begin_ns = min(
        (at_ns for name in given for at_ns, is_known in zip(given[name], known[name], strict=True) if is_known),
        default=0,
    )
    rows = sorted(
        (at_ns, name, number)
        for name, each in given.items()
        for number, at_ns in enumerate(_placed_ns(each, known[name], begin_ns))
    )
    begun_ns: list[int] = []
    together: list[dict[str, int]] = []
    for at_ns, name, number in rows:
        if not together or name in together[-1] or at_ns - begun_ns[-1] > _TOGETHER_NS:
            begun_ns.append(at_ns)
            together.append({})
        together[-1][name] = number
    times_s, notes = _without_pauses([(at_ns - begun_ns[0]) / 1e9 for at_ns in begun_ns])
    time_steps = tuple(TimeStep(time_s, tuple(each.items())) for time_s, each in zip(times_s, together, strict=True))
    if any(itertools.chain.from_iterable(known.values())):
        notes = [_unset_note(name, each) for name, each in known.items() if not all(each)] + notes
    return time_steps, notes


def _known(stamps: dict[str, list[Stamp]]) -> dict[str, list[bool]]:
    """Return True for each measurement whose time can be compared with those of others."""
    some_timed = any(stamp.is_timed for each in stamps.values() for stamp in each)
    n_times = {name: len({stamp.timestamp_ns for stamp in each}) for name, each in stamps.items()}
    some_differ = any(count > 1 for count in n_times.values())
    return {
        name: [
            (stamp.is_timed or not some_timed)
            and (n_times[name] > 1 or (len(each) == 1 and (some_timed or some_differ)))
            for stamp in each
        ]
        for name, each in stamps.items()
    }


def _placed_ns(given: list[int], known: list[bool], begin_ns: int) -> list[int]:
    """Return the times of a sensor's measurements; a sensor without known times starts with the others."""
    between = [
        after_ns - before_ns if is_known == was_known and after_ns > before_ns else None
        for (before_ns, after_ns), (was_known, is_known) in zip(
            itertools.pairwise(given), itertools.pairwise(known), strict=True
        )
    ]
    usual_ns = statistics.median_low([each for each in between if each is not None] or [round(UNTIMED_S * 1e9)])
    between_ns = [usual_ns if each is None else each for each in between]
    placed_ns = list(given)
    first = known.index(True) if any(known) else 0
    if given and not any(known):
        placed_ns[0] = begin_ns
    for number in range(first + 1, len(given)):
        placed_ns[number] = given[number] if known[number] else placed_ns[number - 1] + between_ns[number - 1]
    for number in range(first - 1, -1, -1):
        placed_ns[number] = placed_ns[number + 1] - between_ns[number]
    return placed_ns


def _without_pauses(times_s: list[float]) -> tuple[list[float], list[str]]:
    """Return times without long pauses, and a note on shortened ones."""
    between_s = [after_s - before_s for before_s, after_s in itertools.pairwise(times_s)]
    if not between_s:
        return times_s, []
    max_s = min(max(_PAUSE_S, _PAUSE * statistics.median_low(between_s)), _LONGEST_PAUSE_S)
    longest_s, count = max(between_s), sum(each_s > max_s for each_s in between_s)
    if not count:
        return times_s, []
    pauses = "a pause" if count == 1 else f"{count} pauses"
    note = f"{pauses} of more than {max_s:g} s (up to {longest_s:.0f} s) is played as {max_s:g} s"
    shortened_s = [0.0, *itertools.accumulate(min(each_s, max_s) for each_s in between_s)]
    return shortened_s, [note if count == 1 else note.replace(" is ", " are ")]


def _unset_note(name: str, known: list[bool]) -> str:
    count = len(known) - sum(known)
    return (
        f"sensor {name!r}: {count} of {len(known)} measurements have no timestamp, because the clock was not "
        "set; they are shown at the typical interval"
    )
