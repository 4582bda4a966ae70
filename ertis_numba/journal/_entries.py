"""Sensors, measurements and gaps of a journal, and their rows."""

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, SettingsError
from ertis_numba.frames import BEHAVIOURS, Measurement, Stamp
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import mounting, received_settings, self_contained, storable
from ertis_numba.journal._tables import row_crc32
from ertis_numba.settings import Air, Settings

__all__ = ["JournalEntry", "JournalKey", "JournalSensor", "require_same_settings", "verified_values"]

_INT64 = (-(2**63), 2**63 - 1)
_UNKNOWN = 7 * (0.0,)  # Unknown mounting: translation, and a rotation that no mounting has.
_MAX_BYTES = 999_000_000  # Limit on one measurement: the limit of SQLite, with a margin for the rest of the row.


@dataclass(slots=True, eq=False)
class JournalEntry:
    """A measurement in a journal.

    Attributes
    ----------
    measurement : Measurement
        Sensor, session_id and sequence number are the key. Choose a random session_id whenever sequence numbers
        restart.
    monotonic_ns : int
        Time of arrival by a monotonic clock, in nanoseconds.
    crc32 : int, optional
        CRC-32 of the little-endian data. `Journal.append` computes it if it is None, the default.
    """

    measurement: Measurement
    monotonic_ns: int
    crc32: int | None = None


class JournalKey(NamedTuple):
    """Key of a measurement; ``place`` counts all rows of a journal in order of arrival."""

    place: int
    sensor: str
    session_id: int
    sequence: int


@dataclass(frozen=True, slots=True, eq=False)
class JournalSensor:
    """Sensor of a journal, with settings that depend on no other file; ``dtype`` of its data is little-endian."""

    # `rotation_xyzw` rotates the sensor frame into that of the platform; None if the mounting is unknown.

    name: str
    settings: Settings
    firmware: str
    translation_m: tuple[float, ...] | None
    rotation_xyzw: tuple[float, ...] | None
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @classmethod
    def from_settings(
        cls,
        name: str,
        settings: Settings,
        *,
        firmware: str = "",
        translation_m: Sequence[float] | None = None,
        rotation_xyzw: Sequence[float] | None = None,
    ) -> Self:
        """Return a sensor; refuse one that a recording cannot contain."""
        settings = storable(settings)
        words = sample_format(settings)
        place = mounting(checks.sensor_name(name), translation_m, rotation_xyzw)
        made = cls(
            name=name,
            settings=settings,
            firmware=firmware,
            translation_m=tuple(place["translation_m"].tolist()) if place else None,
            rotation_xyzw=tuple(place["rotation_xyzw"].tolist()) if place else None,
            shape=words.shape,
            dtype=words.dtype,
        )
        if made.n_bytes > _MAX_BYTES:
            raise ArgumentError(
                f"a measurement of sensor {name} has {made.n_bytes / 1e6:.0f} MB, but the limit of a journal is "
                f"{_MAX_BYTES / 1e6:.0f} MB; use fewer samples"
            )
        return made

    @property
    def n_bytes(self) -> int:
        """Size of one measurement's data."""
        return math.prod(self.shape) * self.dtype.itemsize

    def row(self) -> tuple[Any, ...]:
        """Return the row in the table."""
        place = (*(self.translation_m or _UNKNOWN[:3]), *(self.rotation_xyzw or _UNKNOWN[3:]))
        return (self.name, self.settings.to_toml(), self.firmware, *place)

    @classmethod
    def from_row(cls, path: Path, row: Sequence[Any]) -> Self:
        """Return the sensor of a row."""
        name, text, firmware, *place = verified_values(path, "a sensor", row)
        try:
            settings = received_settings(text, f"{path}: settings of sensor {name}")
        except SettingsError as error:
            raise DataError(str(error)) from error
        if tuple(place) == _UNKNOWN:
            return cls.from_settings(name, settings, firmware=firmware)
        return cls.from_settings(name, settings, firmware=firmware, translation_m=place[:3], rotation_xyzw=place[3:])

    def entry_row(self, entry: JournalEntry, sensor_id: int) -> tuple[Any, ...]:
        """Return the row of a measurement; refuse data that does not match this sensor."""
        *values, words = self.entry_values(entry)
        numbered = (sensor_id, *values)
        return (*numbered, row_crc32(numbered), words)

    def entry_values(self, entry: JournalEntry, *, fill: bool = True) -> tuple[Any, ...]:
        """Return the values of a measurement and its data, and ``fill`` in its CRC-32."""
        stamp, air = entry.measurement.stamp, entry.measurement.settings.air
        words = self._sample_data(entry.measurement.data)
        checks.choice("behaviour", stamp.behaviour, BEHAVIOURS)
        if entry.crc32 is None and fill:
            entry.crc32 = zlib.crc32(words.data)
        return (
            checks.integer("session_id", stamp.session_id, 0, _INT64[1]),
            checks.integer("sequence", stamp.sequence, 0, _INT64[1]),
            checks.integer("sync_count", stamp.sync_count, *_INT64),
            checks.integer("timestamp_ns", stamp.timestamp_ns, *_INT64),
            checks.integer("timestamp_uncertainty_ns", stamp.timestamp_uncertainty_ns, 0, 2**32 - 1),
            checks.integer("monotonic_ns", entry.monotonic_ns, *_INT64),
            float(air.temperature_c),
            float(air.humidity_percent),
            float(air.pressure_pa),
            stamp.behaviour,
            None if entry.crc32 is None else checks.integer("crc32", entry.crc32, 0, 2**32 - 1),
            words,
        )

    def _sample_data(self, words: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.unsignedinteger[Any]]:
        checks.shape(f"a measurement of sensor {self.name}", words.shape, self.shape)
        if words.dtype.newbyteorder("<") != self.dtype:
            raise ArgumentError(f"a measurement of sensor {self.name} contains {words.dtype}; pass {self.dtype.name}")
        return np.ascontiguousarray(words, dtype=self.dtype)

    def entry(self, path: Path, row: Sequence[Any]) -> JournalEntry:
        """Return the measurement of a row."""
        *values, words = row
        record = f"measurement {row[3]} of sensor {self.name}"
        _, session_id, sequence, sync_count, time_ns, uncertainty_ns, monotonic_ns, *air, behaviour, crc32 = (
            verified_values(path, record, values)
        )
        behaviour = "unknown" if behaviour is None else behaviour  # The row is from an earlier version.
        if behaviour not in BEHAVIOURS:
            raise DamagedError(
                f"{path}: {record} has behaviour {str(behaviour)[:40]!r}, wanted one of {', '.join(BEHAVIOURS)}; "
                "copy it again if you can"
            )
        if not isinstance(words, bytes):  # The recorded type is damaged.
            words = b""
        got = zlib.crc32(words)
        if got != crc32 or len(words) != self.n_bytes:
            raise DamagedError(
                f"{path}: {record} has CRC-32 {got:08x}, but its record states {crc32:08x}: the journal is "
                "damaged; copy it again if you can"
            )
        settings = self.settings
        if (given := Air(temperature_c=air[0], humidity_percent=air[1], pressure_pa=air[2])) != settings.air:
            settings = settings.replace(air=given)
        stamp = Stamp(
            sensor=self.name,
            sequence=sequence,
            sync_count=sync_count,
            timestamp_ns=time_ns,
            timestamp_uncertainty_ns=uncertainty_ns,
            session_id=session_id,
            behaviour=behaviour,
        )
        array = np.frombuffer(words, dtype=self.dtype).reshape(self.shape)
        return JournalEntry(Measurement(array, settings, stamp), monotonic_ns, crc32)


def verified_values(path: Path, name: str, row: Sequence[Any]) -> list[Any]:
    """Check the CRC-32 of a row, and return its values without number and CRC-32."""
    _, *values, wanted = row
    got = row_crc32(value for value in values if value is not None)  # columns that a former version lacked
    if got != wanted:
        raise DamagedError(
            f"{path}: the record of {name} has CRC-32 {got}, but should have {wanted!r}: the journal is damaged; "
            "copy it again if you can"
        )
    return values


def require_same_settings(sensor: JournalSensor, settings: Settings) -> None:
    """Refuse settings that differ from those of the sensor in more than the air."""
    came = self_contained(settings)
    for name in ("array", "call", "recording"):
        if getattr(came, name) != getattr(sensor.settings, name):
            raise ArgumentError(
                f"a measurement has other {name} settings than sensor {sensor.name}; add a sensor for it"
            )
