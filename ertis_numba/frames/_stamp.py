"""Origin of a measurement: sensor, sequence number and time."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final, Literal, TypeAlias

from ertis_numba.settings import Settings

__all__ = ["BEHAVIOURS", "Behaviour", "Stamp", "is_passive"]

Behaviour: TypeAlias = Literal["active", "passive", "unknown"]
"""Statement whether a measurement has emitted its call."""

BEHAVIOURS: Final[tuple[Behaviour, ...]] = ("active", "passive", "unknown")

_MIN_CLOCK_NS: Final = 946_684_800 * 10**9  # the year 2000; a clock with an earlier time was never set


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamp:
    """Sensor, sequence number and time of a measurement.

    Attributes
    ----------
    sensor : str, default "sensor"
        Serial number or name of the sensor.
    sequence : int, default 0
        Sequence number given at capture. A gap in the numbers is a lost measurement.
    sync_count : int, default 0
        Pulse number of the SYNC chain; equal for all sensors that emitted together.
    timestamp_ns : int, default 0
        Start of the emission in nanoseconds since 1970-01-01 UTC.
    timestamp_uncertainty_ns : int, default 0
        Uncertainty of the time in nanoseconds.
    session_id : int, default 0
        Number of the sensor's session. The triple (sensor, session_id, sequence) is unique.
    behaviour : {"active", "passive", "unknown"}, default "unknown"
        ``active`` if the call was emitted, ``passive`` if not.

    Examples
    --------
    >>> from ertis_numba import Stamp
    >>> Stamp(sensor="eRTIS-7", timestamp_ns=1_700_000_000_000_000_000).utc
    '2023-11-14 22:13:20.000 UTC'
    """

    sensor: str = "sensor"
    sequence: int = 0
    sync_count: int = 0
    timestamp_ns: int = 0
    timestamp_uncertainty_ns: int = 0
    session_id: int = 0
    behaviour: Behaviour = "unknown"

    @property
    def is_timed(self) -> bool:
        """True if the time is a date: clocks that were never set, and those of simulations, begin at 1970."""
        return self.timestamp_ns >= _MIN_CLOCK_NS

    @property
    def iso(self) -> str | None:
        """Time in ISO 8601 format with nanoseconds; None if `is_timed` is False."""
        if not self.is_timed:
            return None
        seconds, nanoseconds = divmod(self.timestamp_ns, 10**9)
        return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{nanoseconds:09d}Z"

    @property
    def utc(self) -> str | None:
        """Time as text with milliseconds, such as ``2023-11-14 22:13:20.000 UTC``; None if `is_timed` is False."""
        iso = self.iso
        return iso and f"{iso[:10]} {iso[11:23]} UTC"


def is_passive(settings: Settings, stamp: Stamp) -> bool:
    """Return True if a measurement becomes an acoustic map, by its behaviour if processing.mode is auto."""
    mode = settings.processing.mode
    return mode == "passive" or (mode == "auto" and stamp.behaviour == "passive")
