"""Times in the names of files that recorders write."""

import re
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

__all__ = ["MAX_DIFFERENCE_S", "NAMES", "StatedTime", "day_first", "has_year_last", "times_in_names"]

NAMES: Final = "file names"
"""Source of times in names."""

_ZONE: Final = r"(?P<zone>Z|[+-]\d{2}:?\d{2}(?!\d))?"
_STAMP: Final = re.compile(
    r"(?<!\d)(?P<year>(?:19|20|21|22)\d\d|\d\d)(?P<between>[-_.]?)(?P<month>\d\d)(?P=between)(?P<day>\d\d)"
    r"[-_T $~]{0,3}"
    r"(?P<hour>\d\d)(?P<gap>[-_.:]?)(?P<minute>\d\d)(?P=gap)(?P<second>\d\d)"
    r"(?:[-_.,]?(?P<fraction>\d{3}(?:\d{3})?)(?!\d))?" + _ZONE + r"(?!\d)"
)
_YEAR_LAST: Final = re.compile(r"(?<!\d)[0-3]\d(?P<gap>[-_. ]?)[0-3]\d(?P=gap)(?:19|20)\d\d(?!\d)")
_HEX: Final = re.compile(r"[0-9A-F]{8}", re.IGNORECASE)
MAX_DIFFERENCE_S: Final = 2.0
"""Largest difference of times that agree: recorders state times before or after the first sample."""
_YEARS: Final = range(1900, 2262)  # 64 bits of nanoseconds end in 2262.
_FIRST_YEARS: Final = (*range(1900, 1990), 2000)
_UNSET: Final = timedelta(days=31)
_HEX_S: Final = range(round(datetime(2014, 1, 1, tzinfo=UTC).timestamp()), 2**31)


class StatedTime(NamedTuple):
    """Time at which a file begins, as its source states it."""

    clock: datetime  # without a zone
    offset: timedelta | None  # from UTC; None if not stated, and UTC is assumed
    source: str  # such as GUANO
    resolution_s: float = 1.0

    @classmethod
    def of(cls, stated: datetime, source: str) -> "StatedTime":
        """Return the stated time for a time with or without a zone; raise ValueError if no recorder can state it."""
        if stated.year not in _YEARS:
            raise ValueError(stated)
        resolution_s = 1e-3 if stated.microsecond else 1.0
        return cls(stated.replace(tzinfo=None), stated.utcoffset(), source, resolution_s)

    @property
    def was_set(self) -> bool:
        """False for the first days of a year from which clocks count until they are set, such as 1970 or 2000."""
        return self.clock.year not in _FIRST_YEARS or self.clock - datetime(self.clock.year, 1, 1) >= _UNSET  # noqa: DTZ001

    @property
    def since_1970_ns(self) -> int:
        """Nanoseconds since 1970-01-01 UTC."""
        since = self.clock - (self.offset or timedelta()) - datetime(1970, 1, 1)  # noqa: DTZ001  both without a zone
        return since // timedelta(microseconds=1) * 1000


def times_in_names(names: Sequence[str]) -> list[StatedTime | None]:
    """Return the times in names of files; None for names without date and time.

    Recognised are date and time in digits, such as ``20240518_042537.WAV``, ``SMU01234_20240518_042537_250.wav``,
    ``T2024-05-18_04-25-37_0001234.WAV`` and ``240518_042537.wav``, and Unix seconds as eight hexadecimal digits, such
    as ``5AFC0B40.WAV``. Eight decimal digits are a counter unless another name contains a letter.
    """
    stems = [name.rpartition(".")[0] or name for name in names]
    are_hex = any(_HEX.fullmatch(stem) and not stem.isdigit() for stem in stems)
    return [_stamp(stem) or (_unix_seconds(stem) if are_hex else None) for stem in stems]


def _stamp(stem: str) -> StatedTime | None:
    for found in _STAMP.finditer(stem):
        part = {name: int(found[name] or 0) for name in ("year", "month", "day", "hour", "minute", "second")}
        if part["year"] < 100 and (found["between"] or found["gap"]):
            continue  # 24-05-18 may be any order of day, month and year.
        try:
            clock = datetime(  # noqa: DTZ001  the offset is separate
                part["year"] + 2000 * (part["year"] < 100),
                part["month"],
                part["day"],
                part["hour"],
                part["minute"],
                part["second"],
                round(1e6 * float(f"0.{found['fraction'] or 0}")),
            )
            time = StatedTime.of(clock, NAMES)
            return time._replace(offset=_offset(found["zone"]), resolution_s=1e-3 if found["fraction"] else 1.0)
        except ValueError:  # Digits that are no date.
            continue
    return None


def day_first(name: str) -> datetime | None:
    """Return the time in a name with six digits of a date, read as day, month and year; None if it is none."""
    found = _STAMP.search(name.rpartition(".")[0] or name)
    if found is None or len(found["year"]) > 2:
        return None
    digits = "".join(found[part] for part in ("year", "month", "day", "hour", "minute", "second"))
    with suppress(ValueError):
        return datetime.strptime(digits, "%d%m%y%H%M%S")  # noqa: DTZ007  the zone is unknown
    return None


def has_year_last(name: str) -> bool:
    """Return True for a name with a date whose year follows day and month, in either order."""
    return _YEAR_LAST.search(name) is not None


def _offset(zone: str | None) -> timedelta | None:
    return datetime.strptime(zone, "%z").utcoffset() if zone else None


def _unix_seconds(stem: str) -> StatedTime | None:
    if not _HEX.fullmatch(stem) or int(stem, 16) not in _HEX_S:
        return None
    return StatedTime.of(datetime.fromtimestamp(int(stem, 16), UTC), NAMES)
