"""Times of poses in text, and their unit."""

import itertools
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError

__all__ = ["TIME_UNITS", "times_of"]

TIME_UNITS: Final = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds in each unit of times."""
_NAMES: Final = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_FIRST_S: Final = 10**8  # Year 1973: times before it count from a start. The ranges of units do not overlap.
_MAX_NS: Final = 2**62  # As for Trajectory.
_LONG_S: Final = 10.0  # Interval between poses that is doubtful.
_OTHER_UNIT: Final = "if they have another unit, choose it (time_unit)"
_DATE: Final = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)[T ](?P<time>\d\d:\d\d:\d\d)(?:[.,](?P<rest>\d+))?\s*(?P<zone>[Zz]|[+-]\d\d:?\d\d)?"
)


def times_of(cells: Sequence[tuple[int, str]], unit: str | None) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return times of (line, text) cells in ns, and notes on their unit."""
    # Without a unit, it is that in which the times lie between 1973 and 2116; smaller ones are seconds.
    dates = [_DATE.fullmatch(text.strip()) for _, text in cells]
    if cells and dates[0] is not None:
        return _times_of_dates(cells, dates)
    times = [_decimal(*cell) for cell in cells]
    notes: tuple[str, ...] = ()
    if unit is None:
        unit, notes = _unit_of(times)
    times_ns = []
    for (line, text), value in zip(cells, times, strict=True):
        time_ns = int((value * TIME_UNITS[unit]).to_integral_value()) if abs(value) < _MAX_NS else _MAX_NS + 1
        if abs(time_ns) > _MAX_NS:
            raise DataError(
                f"line {line}: time {text} in {_NAMES[unit]} is beyond the year 2116; correct the time, or choose its "
                "unit (time_unit)"
            )
        times_ns.append(time_ns)
    return np.array(times_ns, np.int64), notes


def _times_of_dates(
    cells: Sequence[tuple[int, str]], dates: Sequence[re.Match[str] | None]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return times in nanoseconds for dates of ISO 8601, and a note if they have no time zone."""
    times_ns = []
    for (line, text), date in zip(cells, dates, strict=True):
        try:
            if date is None:
                raise ValueError  # noqa: TRY301  the same answer as for a date that does not exist
            zone = date["zone"] if date["zone"] and date["zone"] not in "Zz" else "+00:00"
            whole = datetime.fromisoformat(f"{date['day']}T{date['time']}{zone}")
        except ValueError:
            raise DataError(f"line {line}: {text!r} is not a date; use dates as in 2023-11-14T22:13:20.5Z") from None
        times_ns.append(round(whole.timestamp()) * 10**9 + int((date["rest"] or "0").ljust(9, "0")[:9]))
    n_local = sum(not date["zone"] for date in dates if date is not None)
    note = f"dates without a time zone read as UTC; the first is {cells[0][1].strip()}; add a zone, as in +02:00, or Z"
    return np.array(times_ns, np.int64), (note,) if n_local else ()


def _decimal(line: int, text: str) -> Decimal:
    """Return a time as a decimal number, which keeps nanoseconds, unlike float64."""
    try:
        value = Decimal("nan" if "_" in text else text)  # Python would ignore _ in numbers.
        if value.is_finite() and (not value or abs(value.adjusted()) < 400):
            return value
    except ArithmeticError:
        pass
    raise DataError(f"line {line}: time {text!r} is not a number; use decimal numbers, such as seconds since 1970")


def _unit_of(times: Sequence[Decimal]) -> tuple[str, tuple[str, ...]]:
    """Return the unit of times by their magnitude, and notes if it is not that of seconds since 1970."""
    ordered = sorted(map(abs, times))
    usual = ordered[len(ordered) // 2]
    if usual < _FIRST_S:
        return "s", _relative_notes(times)
    for unit, ns_per_unit in TIME_UNITS.items():
        if _FIRST_S * 10**9 <= usual * ns_per_unit <= _MAX_NS:
            if unit == "s":
                return unit, _relative_notes(times) if _step(times) > _LONG_S else ()
            first = datetime.fromtimestamp(float(times[0] * ns_per_unit) / 1e9, UTC)
            note = f"times are read as {_NAMES[unit]} since 1970; the first is {first:%Y-%m-%d %H:%M:%S} UTC"
            step_s = _step(times) * ns_per_unit / 10**9
            return unit, (note if step_s <= _LONG_S else f"{note}; rows are {step_s:f} s apart; {_OTHER_UNIT}",)
    raise DataError(
        f"times such as {usual:g} are no dates from 1973 to 2116 in any unit; correct them, or choose their unit "
        f"(time_unit): {', '.join(TIME_UNITS)}"
    )


def _step(times: Sequence[Decimal]) -> Decimal:
    """Return the median interval between times."""
    steps = sorted(abs(after - before) for before, after in itertools.pairwise(times))
    return steps[len(steps) // 2] if steps else Decimal(0)


def _relative_notes(times: Sequence[Decimal]) -> tuple[str, ...]:
    """Return a note if small times may have another unit than seconds, or may be numbers of frames."""
    if len(times) < 2:
        return ()
    step_s = _step(times)
    are_whole = all(int(value.as_tuple().exponent) >= 0 for value in times)  # without a decimal point
    if step_s <= _LONG_S and not (are_whole and step_s):
        return ()
    note = f"times from {times[0]:f} to {times[-1]:f} are read as seconds, {step_s:f} s from row to row; {_OTHER_UNIT}"
    return (note,)
