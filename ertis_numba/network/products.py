"""Decoding of a publisher's messages to frames."""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError, ErtisError
from ertis_numba.frames import Energyscape, Measurement, PointCloud, Stamp
from ertis_numba.frames.level_codes import LevelCodes
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import received_settings
from ertis_numba.network.messages import Description, Group, Image, Message, Points, Raw, Report
from ertis_numba.network.product_messages import ProductMessage
from ertis_numba.network.status import Status
from ertis_numba.network.trace import mark
from ertis_numba.settings import Settings

__all__ = ["Arrival", "Item", "Payload", "ProductReader", "trace"]

Item: TypeAlias = Energyscape | PointCloud | Measurement | Group | Status
"""Products that an application receives."""
Payload: TypeAlias = Sequence[bytes | memoryview]

_AXES = 3
_MAX_OF_SENSOR = 64  # Limit on descriptions.
_COLUMNS = 4  # Columns of a point: x, y, z and amplitude.


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A received product."""

    item: Item
    header: ProductMessage
    arrived_ns: int  # complete arrival by time.monotonic_ns, as header.monotonic_ns on this machine
    arrived_utc_ns: int  # by the system clock
    connection: int  # product numbers count from 0 in each
    translation_m: tuple[float, float, float] | None = None  # of the sensor on its platform; None if unknown
    rotation_xyzw: tuple[float, float, float, float] | None = None

    @property
    def age_s(self) -> float | None:
        """Time from the emission to the arrival here, if both clocks agree; None without a timestamp or a set clock."""
        stamp: Stamp | None = getattr(self.header, "stamp", None)
        return (self.arrived_utc_ns - stamp.timestamp_ns) / 1e9 if stamp is not None and stamp.is_timed else None

    @property
    def made_in_s(self) -> float | None:
        """Time from the measurement's arrival at the central node to departure; None if not computed there."""
        if not isinstance(self.header, Image | Points):
            return None
        return (self.header.published_ns - self.header.received_ns) / 1e9


@dataclass(frozen=True, slots=True, eq=False)
class _Described:
    header: Description
    settings: Settings
    axes: list[NDArray[np.float64]]

    @classmethod
    def of(cls, header: Description, payload: Payload) -> "_Described":
        if len(payload) != 1 + _AXES:
            raise DataError(f"a description has {len(payload)} payloads; send settings and {_AXES} axes")
        try:
            settings = received_settings(bytes(payload[0]), f"settings of sensor {header.sensor}", are_applied=True)
        except ErtisError as error:
            raise DataError(f"a description cannot be used ({error})") from error
        axes = []
        for axis in payload[1:]:
            if len(axis) % 8:
                raise DataError(f"an axis has {len(axis)} bytes; send float64")
            axes.append(np.frombuffer(axis, dtype="<f8").astype(np.float64))  # The copy outlives its frame.
        return cls(header, settings, axes)


@dataclass(slots=True)
class ProductReader:
    """Decoder of the products of one connection; arrays are copies, which the caller may change."""

    _described: dict[int, _Described] = field(default_factory=dict)

    def __contains__(self, number: int) -> bool:
        return number in self._described

    def describe(self, header: Description, payload: Payload) -> None:
        """Store a description for later products."""
        # Each change of settings brings a description. A connection that lasts for months must not keep them all.
        of_sensor = [number for number, kept in self._described.items() if kept.header.sensor == header.sensor]
        stale = of_sensor[: max(0, len(of_sensor) - _MAX_OF_SENSOR)]
        for number in stale:
            del self._described[number]
        self._described[header.number] = _Described.of(header, payload)

    def description(self, number: int) -> Description:
        """Return the description of a product."""
        return self.described(number).header

    def read(self, header: ProductMessage, payload: Payload) -> Item:
        """Return the frame of a message."""
        return _DECODERS[type(header)](self, header, payload)

    def described(self, number: int) -> _Described:
        """Return a description with its settings and axes; raises the errors of `read`."""
        if number not in self._described:
            raise DataError(f"a product refers to description {number}, which has not arrived; send it first")
        return self._described[number]


def trace(stage: str, header: ProductMessage) -> None:
    """Record that an image has passed a stage; see `ertis_numba.network.trace`."""
    if isinstance(header, Image):
        mark(stage, header.sensor, header.sequence)


def _image(reader: ProductReader, header: Image, payload: Payload) -> Energyscape:
    described = reader.described(header.description)
    azimuth_rad, elevation_rad, range_m = described.axes
    wanted = (len(azimuth_rad), len(range_m))
    if header.shape != wanted or len(elevation_rad) != len(azimuth_rad):
        raise DataError(f"an image has shape {header.shape}, but its axes give {wanted}; send matching axes")
    amplitude, step_db = _array(payload, header.shape, header.dtype), 0.0
    if header.dtype == "uint8":
        levels = LevelCodes.checked(header.floor_db, header.step_db, "an image")
        amplitude, step_db = levels.decode(amplitude), levels.step_db
    return Energyscape(
        amplitude.astype(np.float32, copy=False),
        azimuth_rad,
        elevation_rad,
        range_m,
        described.settings,
        header.stamp,
        level_step_db=step_db,
    )


def _points(reader: ProductReader, header: Points, payload: Payload) -> PointCloud:
    described = reader.described(header.description)
    rows = _array(payload, (header.n_points, _COLUMNS), "float32")
    return PointCloud(
        np.ascontiguousarray(rows[:, :3]),
        np.ascontiguousarray(rows[:, 3]),
        described.settings,
        header.stamp,
        described.header.translation_m,
        described.header.rotation_xyzw,
    )


def _measurement(reader: ProductReader, header: Raw, payload: Payload) -> Measurement:
    settings = reader.described(header.description).settings
    wanted = sample_format(settings)
    words = _array(payload, wanted.shape, wanted.dtype.name)
    if zlib.crc32(words.data) != header.crc32:
        raise DataError(
            f"measurement {header.sequence} of sensor {header.sensor} does not match the CRC-32 in its header; send "
            "it again"
        )
    air = settings.air.replace(
        temperature_c=header.temperature_c,
        humidity_percent=header.humidity_percent,
        pressure_pa=header.pressure_pa,
    )
    return Measurement(words, settings if air == settings.air else settings.replace(air=air), header.stamp)


def _array(payload: Payload, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    """Return an array from the data of one or more frames."""
    came = sum(len(frame) for frame in payload)
    kind = np.dtype(dtype).newbyteorder("<")
    wanted = kind.itemsize
    for size in shape:
        wanted *= size  # Python integers of any size: a header alone allocates nothing.
    if came != wanted:
        raise DataError(f"{came} bytes arrived for {dtype} of shape {shape}, which needs {wanted}; send all of it")
    made = np.empty(shape, kind)
    flat, start = made.reshape(-1).view(np.uint8), 0
    for frame in payload:
        flat[start : start + len(frame)] = np.frombuffer(frame, np.uint8)
        start += len(frame)
    return made.astype(kind.newbyteorder("="), copy=False)


_DECODERS: Final[dict[type[Message], Callable[[ProductReader, Any, Payload], Item]]] = {
    Image: _image,
    Points: _points,
    Raw: _measurement,
    Group: lambda _, header, __: header,
    Report: lambda _, __, payload: Status.decode(b"".join(payload)),
}
"""Decoder of each product."""
