"""Tables of a journal, and their version."""

import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

__all__ = [
    "APPLICATION_ID",
    "COMPLETE_VERSION",
    "POSES",
    "TABLES",
    "VERSION",
    "Column",
    "create_poses_statement",
    "create_statements",
    "insert_statement",
    "row_crc32",
    "select_statement",
    "upgrade_statements",
]

APPLICATION_ID: Final = 0x6552544A
"""``eRTJ``, stored by SQLite in the header of the file, beside the version."""

VERSION: Final = 4
"""Highest version of a journal: 3 until measurements are discarded from it, 4 afterwards.

Versions 1 and 2 have no column ``behaviour``. Opening adds it without values.
"""

COMPLETE_VERSION: Final = 3
"""Version of a journal whose row numbers have no holes, except at the front."""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table: ``kind`` in the notation of SQLite, ``units`` in that of UDUNITS, empty without a unit."""

    name: str
    kind: str
    description: str
    units: str = ""


_ID = Column("id", "INTEGER", "order of arrival, from 1")
_CHECK = Column("row_crc32", "INTEGER", "CRC-32 over the columns before it without id")
_SENSOR = Column("sensor", "INTEGER", "id of the sensor")
_SESSION_ID = Column("epoch", "INTEGER", "session of the sensor, chosen at random when sequence numbers restart")

TABLES: Final[Mapping[str, tuple[Column, ...]]] = {
    "journal": (
        _ID,
        Column("target", "BLOB", "path of the recording to be made, relative to the journal's folder, as bytes"),
        Column("source", "TEXT", "source of the measurements"),
        Column("created", "TEXT", "creation time of the journal, ISO 8601"),
        _CHECK,
    ),
    "sensors": (
        _ID,
        Column("name", "TEXT", "name or serial number"),
        Column("settings", "TEXT", "settings as TOML, including the array"),
        Column("firmware", "TEXT", "version of the sensor's firmware"),
        Column("x_m", "REAL", "position of the sensor", "m"),
        Column("y_m", "REAL", "position of the sensor", "m"),
        Column("z_m", "REAL", "position of the sensor", "m"),
        Column(
            "rotation_x",
            "REAL",
            "unit quaternion that rotates the sensor frame into the platform frame; 0 if unknown",
        ),
        Column("rotation_y", "REAL", "part of the same quaternion"),
        Column("rotation_z", "REAL", "part of the same quaternion"),
        Column("rotation_w", "REAL", "part of the same quaternion"),
        _CHECK,
    ),
    "measurements": (
        _ID,
        _SENSOR,
        _SESSION_ID,
        Column("sequence", "INTEGER", "number given at capture; it rises within a session of a sensor"),
        Column("sync_count", "INTEGER", "pulse of the SYNC chain, equal for sensors that emitted together"),
        Column("timestamp_ns", "INTEGER", "start of the emission", "nanoseconds since 1970-01-01T00:00:00"),
        Column("timestamp_uncertainty_ns", "INTEGER", "uncertainty of timestamp_ns", "ns"),
        Column("monotonic_ns", "INTEGER", "time of arrival by a monotonic clock", "ns"),
        Column("temperature_c", "REAL", "air temperature", "degree_Celsius"),
        Column("humidity_percent", "REAL", "relative humidity", "percent"),
        Column("pressure_pa", "REAL", "air pressure", "Pa"),
        Column("behaviour", "TEXT", "active if the call was emitted, passive if not, or unknown"),
        Column("crc32", "INTEGER", "CRC-32 of words"),
        _CHECK,
        Column("words", "BLOB", "PDM words, little-endian, as they lie in a recording"),
    ),
    "gaps": (
        _ID,
        _SENSOR,
        _SESSION_ID,
        Column("first", "INTEGER", "first missing sequence number"),
        Column("last", "INTEGER", "last missing sequence number"),
        Column("reason", "TEXT", "reason of the loss"),
        _CHECK,
    ),
    "poses": (
        _ID,
        Column("sensors", "TEXT", "names of the sensors on the platform, separated by commas"),
        Column("timestamp_ns", "INTEGER", "time of the pose", "nanoseconds since 1970-01-01T00:00:00"),
        Column("x_m", "REAL", "position of the platform in the world frame", "m"),
        Column("y_m", "REAL", "position of the platform in the world frame", "m"),
        Column("z_m", "REAL", "position of the platform in the world frame", "m"),
        Column("rotation_x", "REAL", "unit quaternion that rotates the platform frame into the world frame"),
        Column("rotation_y", "REAL", "part of the same quaternion"),
        Column("rotation_z", "REAL", "part of the same quaternion"),
        Column("rotation_w", "REAL", "part of the same quaternion"),
        Column(
            "covariance",
            "BLOB",
            "6 by 6 doubles, little-endian: covariance of x, y, z in m² and of the rotation about the world's x, y, z "
            "in rad²; empty if unknown",
        ),
        Column("source", "TEXT", "origin of the pose"),
        _CHECK,
    ),
}

POSES: Final = "poses"
"""Table that a journal has only once poses are stored in it."""


def create_statements() -> Iterable[str]:
    """Yield the statements that create the tables, and the index of keys."""
    yield from (_create_statement(table) for table in TABLES if table != POSES)
    yield "CREATE UNIQUE INDEX key ON measurements (sensor, epoch, sequence)"
    yield f"PRAGMA application_id = {APPLICATION_ID}"
    yield f"PRAGMA user_version = {COMPLETE_VERSION}"


def create_poses_statement() -> str:
    """Return the statement that creates the table of poses if it does not exist."""
    return _create_statement(POSES).replace("CREATE TABLE", "CREATE TABLE IF NOT EXISTS", 1)


def _create_statement(table: str) -> str:
    kinds = ", ".join(
        f"{column.name} {column.kind} {'PRIMARY KEY' if column is _ID else 'NOT NULL'}" for column in TABLES[table]
    )
    return f"CREATE TABLE {table} ({kinds})"


def upgrade_statements(version: int) -> Iterable[str]:
    """Yield the statements that bring the tables of an earlier version to the present one."""
    yield "BEGIN"
    yield "ALTER TABLE measurements ADD COLUMN behaviour TEXT"
    yield f"PRAGMA user_version = {version + COMPLETE_VERSION - 1}"
    yield "COMMIT"


def insert_statement(table: str) -> str:
    """Return the statement that adds a row, given all its columns but ``id``."""
    names = [column.name for column in TABLES[table] if column is not _ID]
    return f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join('?' * len(names))})"  # noqa: S608  our own


def select_statement(table: str, where: str = "") -> str:
    """Return the statement that reads rows with all their columns."""
    return f"SELECT {', '.join(column.name for column in TABLES[table])} FROM {table} {where}"  # noqa: S608  our own


def row_crc32(values: Iterable[float | str | bytes | None]) -> int:
    """Return the CRC-32 of a row: of each value its type letter, its length in bytes, and its bytes.

    The length is a little-endian 32-bit integer. The types are: I, an integer as decimal digits with a ``-`` if
    negative; R, a little-endian double; T, text as UTF-8; B, bytes; N, NULL without bytes.
    """
    check = 0
    for value in values:
        letter, data = _bytes_of(value)
        check = zlib.crc32(data, zlib.crc32(letter + struct.pack("<I", len(data)), check))
    return check


def _bytes_of(value: float | str | bytes | None) -> tuple[bytes, bytes]:
    match value:
        case None:
            return b"N", b""
        case int():
            return b"I", b"%d" % value
        case float():
            return b"R", struct.pack("<d", value + 0.0)  # SQLite stores -0.0 as 0.0.
        case str():
            return b"T", value.encode()
        case _:
            return b"B", value
