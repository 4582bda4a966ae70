"""Variables and format version of each kind of file.

All kinds are HDF5 and netCDF-4 at once: every axis is a dimension scale, so that xarray, h5dump and MATLAB show the
same names. One group ``/sensors/<name>`` holds one sensor.
"""

import functools
import hashlib
import math
import os
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from typing import Final

import h5py
import numpy as np

from ertis_numba.base import checks

__all__ = [
    "ACOUSTIC_MAP",
    "BEARINGS",
    "CHUNK_ROWS",
    "CONVENTIONS",
    "ENERGYSCAPE",
    "ENERGYSCAPE_OF_LEVELS",
    "FORMAT_VERSION",
    "OCCUPANCY_MAP",
    "OLDEST_VERSION",
    "POINTS",
    "POSES",
    "RECORDING",
    "RECORDING_OF_PCM",
    "STAMPS",
    "TRUTH",
    "VERSION_WITHOUT_POSES",
    "VOXEL_MAP",
    "Variable",
    "content_sha256",
    "content_uuid",
    "date_created",
    "sensor_path",
    "software_versions",
]

CONVENTIONS: Final = "CF-1.11 ertis-1.0"
FORMAT_VERSION: Final = 4  # Version 2 had no behaviour, and 3 had no poses.
OLDEST_VERSION: Final = 2  # Variables and settings had other names before.
VERSION_WITHOUT_POSES: Final = 3  # Earlier versions of this package read files without poses.
CHUNK_ROWS: Final = 512  # Applies to columns with one number per measurement.
_DIGEST_ITEMS: Final = 2**20


@dataclass(frozen=True, slots=True)
class Variable:
    """Array of a file, which is a coordinate if it has the name of its only axis."""

    # `dtype` is a NumPy type, `str` for text, or empty if the settings determine it. Older files lack `optional` ones.

    name: str
    dims: tuple[str, ...]
    dtype: str
    description: str
    units: str = ""
    optional: bool = False


STAMPS: Final = (
    Variable("time", ("time",), "<i8", "start of the emission", "nanoseconds since 1970-01-01T00:00:00"),
    Variable("time_uncertainty", ("time",), "<u4", "uncertainty of time", "ns"),
    Variable("sequence", ("time",), "<i8", "number given at capture; a gap is a loss"),
    Variable("sync_count", ("time",), "<i8", "pulse of the SYNC chain, equal for sensors that emitted together"),
    Variable("session_id", ("time",), "<i8", "identifier of the session that gave the sequence numbers"),
    Variable("behaviour", ("time",), "|i1", "1 if the call was emitted, 0 if not, -1 if unknown", optional=True),
    Variable("crc32", ("time",), "<u4", "CRC-32 of the row of pdm, pcm or amplitude, as its bytes lie in the file"),
)

_SETTINGS = Variable("settings", (), "str", "settings as TOML, including the array")

RECORDING: Final = (
    *STAMPS,
    Variable("temperature", ("time",), "<f8", "air temperature", "degree_Celsius"),
    Variable("humidity", ("time",), "<f8", "relative humidity", "percent"),
    Variable("pressure", ("time",), "<f8", "air pressure", "Pa"),
    Variable("pdm", ("time", "sample", "word"), "", "PDM words; bit m, least significant first, is channel m"),
    _SETTINGS,
    Variable("microphone", ("microphone",), "<i4", "channel"),
    Variable("microphone_position", ("microphone", "axis"), "<f8", "x, y, z in the sensor frame", "m"),
    Variable("microphone_enabled", ("microphone",), "|i1", "1 if the channel has a microphone that is used"),
    Variable("calibration_gain", ("microphone",), "<f8", "sensitivity; signals are divided by it"),
    Variable("calibration_delay", ("microphone",), "<f8", "delay of the microphone; signals are advanced by it", "s"),
    Variable("call", ("call_sample",), "<f4", "emitted call, full scale 1"),
    Variable("gap_first", ("gap",), "<i8", "first missing sequence number"),
    Variable("gap_last", ("gap",), "<i8", "last missing sequence number"),
    Variable("gap_reason", ("gap",), "str", "reason of the loss"),
    Variable("gap_session_id", ("gap",), "<i8", "session of the missing numbers"),
)

RECORDING_OF_PCM: Final = tuple(
    Variable("pcm", ("time", "sample", "microphone"), "", "PCM; full scale is 32768 of int16, 1 of float32")
    if variable.name == "pdm"
    else variable
    for variable in RECORDING
)
"""Variables of a recording with PCM microphones."""

POSES: Final = (
    Variable(
        "pose_position", ("time", "axis"), "<f8", "x, y, z of the platform in the world frame", "m", optional=True
    ),
    Variable(
        "pose_rotation",
        ("time", "quaternion"),
        "<f8",
        "unit quaternion x, y, z, w that rotates the platform frame into the world frame",
        optional=True,
    ),
    Variable(
        "pose_covariance",
        ("time", "pose_row", "pose_column"),
        "<f8",
        "covariance of x, y, z in m² and of the rotation about the world's x, y, z in rad²",
        optional=True,
    ),
    Variable("pose_source", (), "str", "origin of the poses", optional=True),
)
"""Variables of files with poses of the platform; they follow all others."""

POINTS: Final = (
    Variable("point_count", ("time",), "<u4", "number of points of the image", optional=True),
    Variable("point_position", ("point", "axis"), "<f4", "x, y, z in the frame of the platform", "m", optional=True),
    Variable("point_amplitude", ("point",), "<f4", "amplitude, as that of images", optional=True),
    Variable(
        "point_uncertainty",
        ("point", "component"),
        "<f4",
        "standard deviation of the position along range and across it",
        "m",
        optional=True,
    ),
    Variable("point_confirmed", ("point",), "|i1", "1 if enough echoes agree, 0 if not, -1 if unknown", optional=True),
)
"""Points that a fusion has located; those of the first image come first, the strongest of each image first."""

ENERGYSCAPE: Final = (
    *STAMPS,
    Variable(
        "amplitude",
        ("time", "direction", "range"),
        "",
        "amplitude of the envelope; 1 is a full-scale echo in every microphone",
    ),
    Variable("azimuth", ("direction",), "<f8", "azimuth, from x forward towards y", "radian"),
    Variable("elevation", ("direction",), "<f8", "elevation, from the horizontal plane towards z", "radian"),
    Variable("range", ("range",), "<f8", "half of the sound path", "m"),
    _SETTINGS,
)

LEVELS: Final = Variable(
    "level",
    ("time", "direction", "range"),
    "|u1",
    "level of the envelope; 0 dB is a full-scale echo in every microphone, and the fill value is below all levels",
    "dB",
)
"""Variable of images of 8-bit levels, in place of ``amplitude``."""

ENERGYSCAPE_OF_LEVELS: Final = (
    *STAMPS[:-1],
    Variable("crc32", ("time",), "<u4", "CRC-32 of the row of level, as its bytes lie in the file"),
    LEVELS,
    *ENERGYSCAPE[len(STAMPS) + 1 :],
)

ACOUSTIC_MAP: Final = (
    *STAMPS[:-1],
    Variable("crc32", ("time",), "<u4", "CRC-32 of the row of power, as its bytes lie in the file"),
    Variable(
        "power",
        ("time", "direction", "band"),
        "",
        "mean square of the sound from a direction at the array; full scale is 1, so that a full-scale tone has 1/2",
    ),
    Variable("azimuth", ("direction",), "<f8", "azimuth, from x forward towards y", "radian"),
    Variable("elevation", ("direction",), "<f8", "elevation, from the horizontal plane towards z", "radian"),
    Variable("band_edge", ("band", "edge"), "<f8", "lower and upper edge of each band", "Hz"),
    Variable("n_measurements", ("time",), "<i8", "measurements whose powers were averaged"),
    Variable("n_blocks", ("time",), "<i8", "blocks of samples whose powers were averaged"),
    Variable("masked", ("time",), "<f8", "time of the call, left out at the start of each measurement", "s"),
    Variable(
        "false_alarm",
        ("time",),
        "<f8",
        "probability that noise alone yields any bearing; NaN if none was searched",
        optional=True,
    ),
    _SETTINGS,
)
"""Variables of acoustic maps; the stamp of a map is that of its last measurement."""

BEARINGS: Final = (
    Variable("bearing_count", ("time",), "<u4", "number of sources that were found", optional=True),
    Variable("bearing_direction", ("bearing", "angle"), "<f8", "azimuth and elevation", "degree", optional=True),
    Variable(
        "bearing_uncertainty",
        ("bearing", "angle"),
        "<f8",
        "standard deviation of the direction along the sphere, horizontally and vertically; infinite if unknown",
        "degree",
        optional=True,
    ),
    Variable("bearing_correlation", ("bearing",), "<f8", "correlation of the two errors", optional=True),
    Variable("bearing_band", ("bearing", "edge"), "<f8", "lower and upper edge of the band", "Hz", optional=True),
    Variable("bearing_level", ("bearing",), "<f8", "level at the array without noise, in dBFS", "dB", optional=True),
    Variable("bearing_snr", ("bearing",), "<f8", "power relative to the noise of a microphone", "dB", optional=True),
    Variable(
        "bearing_doubts",
        ("bearing",),
        "<u1",
        "bit 0: may be crosstalk; bit 1: interference",
        optional=True,
    ),
)
"""Bearings of the sources in acoustic maps; those of the first map come first."""

OCCUPANCY_MAP: Final = (
    Variable("log_odds", ("y", "x"), "<f4", "logarithm of p / (1 - p) of the probability p that a cell is occupied"),
    Variable("x", ("x",), "<f8", "centres of the cells in the world frame", "m"),
    Variable("y", ("y",), "<f8", "centres of the cells in the world frame", "m"),
)
"""Variables of an occupancy map of two dimensions, in the root of its file."""

VOXEL_MAP: Final = (
    replace(OCCUPANCY_MAP[0], dims=("z", "y", "x")),
    *OCCUPANCY_MAP[1:],
    Variable("z", ("z",), "<f8", "centres of the cells in the world frame", "m"),
)
"""Variables of an occupancy map of three dimensions."""

TRUTH: Final = (
    Variable("scene", (), "str", "scene as TOML"),
    Variable("name", ("measurement", "target"), "str", "names of the reflectors in the scene"),
    Variable("azimuth", ("measurement", "target"), "<f8", "azimuth of the reflectors", "radian"),
    Variable("elevation", ("measurement", "target"), "<f8", "elevation of the reflectors", "radian"),
    Variable("range", ("measurement", "target"), "<f8", "distance of the reflectors from the sensor's origin", "m"),
    Variable(
        "level",
        ("measurement", "target"),
        "<f8",
        "level of the echo, relative to the strongest of the sensor's own call",
        "dB",
    ),
    Variable(
        "velocity",
        ("measurement", "target", "axis"),
        "<f8",
        "x, y, z in the sensor frame, relative to the sensor",
        "m/s",
    ),
    Variable(
        "emitter",
        ("measurement", "target"),
        "str",
        "sensor whose call the reflector returns, if not its own",
        optional=True,
    ),
    Variable(
        "frame_position",
        ("measurement", "axis"),
        "<f8",
        "x, y, z of the frame of the reflectors in the scene",
        "m",
        optional=True,
    ),
    Variable(
        "frame_rotation",
        ("measurement", "quaternion"),
        "<f8",
        "unit quaternion x, y, z, w that rotates the frame of the reflectors into the scene",
        optional=True,
    ),
    Variable("source_name", ("source",), "str", "names of the sources of sound in the scene", optional=True),
    Variable("source_kind", ("source",), "str", "tone, noise or sonar", optional=True),
    Variable(
        "source_band", ("source", "edge"), "<f8", "lowest and highest frequency of the sound", "Hz", optional=True
    ),
    Variable(
        "source_position",
        ("measurement", "source", "axis"),
        "<f8",
        "x, y, z in the world frame",
        "m",
        optional=True,
    ),
    Variable("source_azimuth", ("measurement", "source"), "<f8", "azimuth of the sources", "radian", optional=True),
    Variable("source_elevation", ("measurement", "source"), "<f8", "elevation of the sources", "radian", optional=True),
    Variable(
        "source_range",
        ("measurement", "source"),
        "<f8",
        "distance of the sources from the sensor's origin",
        "m",
        optional=True,
    ),
    Variable(
        "source_level",
        ("measurement", "source"),
        "<f8",
        "RMS of the sound at the microphones, relative to full scale",
        "dB",
        optional=True,
    ),
)
"""Variables of the group ``truth`` of a sensor."""


def content_sha256(group: h5py.Group, table: Iterable[Variable]) -> str:
    """Return the SHA-256 over the variables of a sensor, in hexadecimal."""
    # It covers only the CRC-32 of each row of measurements, so that a file can be checked in parts.
    digest = hashlib.sha256()
    _digest(digest, group, table)
    if "truth" in group:
        digest.update(f"seed{group['truth'].attrs['seed']}".encode())
        _digest(digest, group["truth"], TRUTH)
    return digest.hexdigest()


def _digest(digest: "hashlib._Hash", group: h5py.Group, table: Iterable[Variable]) -> None:
    for variable in table:
        if variable.dtype and (variable.name in group or not variable.optional):
            dataset = group[variable.name]
            digest.update(variable.name.encode())
            # The truth of many measurements may exceed the memory, so it is read in parts.
            rows = max(1, _DIGEST_ITEMS // max(1, math.prod(dataset.shape[1:])))
            for first in range(0, dataset.shape[0], rows) if dataset.shape else ():
                digest.update(np.asarray(dataset[first : first + rows]).tobytes())
            if not dataset.shape:
                digest.update(np.asarray(dataset[()]).tobytes())


def content_uuid(contents: Mapping[str, str]) -> str:
    """Return the identity of a file, a UUID of version 8 that its content determines (RFC 9562, section 5.8)."""
    (content,) = contents.values() if len(contents) == 1 else (_joined(contents),)
    made = bytearray(bytes.fromhex(content)[:16])
    made[6] = made[6] & 0x0F | 0x80
    made[8] = made[8] & 0x3F | 0x80
    return str(uuid.UUID(bytes=bytes(made)))


def _joined(contents: Mapping[str, str]) -> str:
    lines = "".join(f"{name} {content}\n" for name, content in sorted(contents.items()))
    return hashlib.sha256(lines.encode()).hexdigest()


def sensor_path(name: str) -> str:
    """Return the group of a sensor."""
    return f"/sensors/{checks.sensor_name(name)}"


def date_created() -> str:
    """Return the current time as ISO 8601, or that of SOURCE_DATE_EPOCH for reproducible builds."""
    fixed = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.fromtimestamp(int(fixed), UTC) if fixed else datetime.now(UTC)
    return now.strftime("%Y-%m-%dT%H:%M:%SZ")


def software_versions() -> dict[str, str]:
    """Return the versions of the packages that compute a result."""
    return {name: _version(name) for name in ("ertis-numba", "numba", "numpy", "scipy")}


@functools.cache  # Each look-up reads files.
def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "unknown"
