"""Messages between publisher and applications; `ertis_numba.network.messages` contains the other half."""

from typing import Annotated, Final, Literal, TypeAlias, get_args

from msgspec import Meta

from ertis_numba.base.constants import ImageDtype
from ertis_numba.network.message_fields import (
    Count,
    Int64,
    Message,
    Name,
    Number,
    OfMeasurement,
    Position,
    Quaternion,
    Uint32,
)

__all__ = [
    "PRODUCTS",
    "PRODUCT_MESSAGES",
    "Description",
    "Group",
    "Image",
    "MeasuredProduct",
    "Points",
    "Product",
    "ProductMessage",
    "Raw",
    "Report",
    "Subscribe",
]

Product: TypeAlias = Literal["energyscape", "points", "raw", "group", "status"]
PRODUCTS: Final[tuple[Product, ...]] = get_args(Product)
"""Products that applications can request."""


class Subscribe(Message, frozen=True, kw_only=True):
    """An application subscribes to products; sent each second, and whenever it has consumed a product."""

    routes = (("application", "publisher"),)

    sensors: Annotated[tuple[Name, ...], Meta(max_length=32)] | None = None
    products: Annotated[tuple[Product, ...], Meta(min_length=1, max_length=8)]
    consumed: Count = 0  # taken since the connection was made
    credit: Annotated[int, Meta(ge=1, le=64)] = 2  # further products that the publisher may send


class Description(Message, frozen=True, kw_only=True):
    """Sensor description, sent before the first product that refers to it.

    Payloads: settings as TOML, then azimuth, elevation and range as little-endian float64, which are empty for products
    without such axes. Products refer to it by ``number``, until the connection ends.
    """

    routes = (("publisher", "application"),)
    payload = "settings (TOML), azimuth, elevation, range (float64)"

    number: Count
    sensor: Name
    translation_m: Position | None = None
    rotation_xyzw: Quaternion | None = None


class MeasuredProduct(OfMeasurement, frozen=True, kw_only=True):
    """Product of one measurement, which refers to a description of its sensor."""

    number: Count
    """Number of the product among all that this subscriber has requested since it connected, from 0; dropped products
    leave a gap.
    """
    dropped: Count
    """Number of products dropped for this subscriber, for want of credit."""
    description: Count


class Image(MeasuredProduct, frozen=True, kw_only=True, omit_defaults=True):
    """An energyscape. Payloads: its amplitudes, little-endian, cut into frames.

    With the dtype ``uint8``, they are levels: code c from 1 to 255 is ``floor_db + (c - 1) * step_db`` dBFS, and 0 is
    more than half a step below ``floor_db``, or no sound. Other types lack both fields.
    """

    routes = (("publisher", "application"),)
    payload = "amplitude, in frames of 512 KiB"
    product = "energyscape"

    shape: tuple[Count, Count]  # (direction, range)
    dtype: ImageDtype
    received_ns: Int64  # arrival of the measurement, by a monotonic clock of the central node
    published_ns: Int64  # departure of the image, by the same clock
    floor_db: float | None = None
    step_db: float | None = None


class Points(MeasuredProduct, frozen=True, kw_only=True):
    """A point cloud. Payload: ``(point, 4)`` little-endian float32, each x, y, z in m and the amplitude."""

    routes = (("publisher", "application"),)
    payload = "`(point, 4)` float32: x, y, z in m, amplitude"
    product = "points"

    n_points: Count
    received_ns: Int64
    published_ns: Int64


class Raw(MeasuredProduct, frozen=True, kw_only=True):
    """A measurement as received. Payload: its samples, little-endian."""

    routes = (("publisher", "application"),)
    payload = "samples"
    product = "raw"

    temperature_c: float
    humidity_percent: float
    pressure_pa: float
    crc32: Uint32


class Group(Message, frozen=True, kw_only=True):
    """Simultaneous measurements, once all have arrived or no more are expected.

    ``group`` is the pulse of the SYNC chain. ``members`` are (sensor, session_id, sequence), ``missing`` sensors.
    ``spread_ns`` is the last minus the first timestamp. Flags: ``incomplete``, sensors are missing; ``clock``,
    timestamps disagree although counters agree; ``pulse``, a sensor has lost a pulse or seen one twice.
    """

    routes = (("publisher", "application"),)
    product = "group"

    number: Count
    dropped: Count
    group: Int64
    members: Annotated[tuple[tuple[Name, Count, Number], ...], Meta(max_length=32)]
    missing: Annotated[tuple[Name, ...], Meta(max_length=32)]
    spread_ns: Count
    flags: tuple[Literal["incomplete", "clock", "pulse"], ...] = ()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors whose measurements have arrived."""
        return tuple(sensor for sensor, _, _ in self.members)


class Report(Message, frozen=True, kw_only=True):
    """Status of the central node. Payload: `Status` as MessagePack. Both numbers are 0 in answers to `AskStatus`."""

    routes = (("central", "application"), ("publisher", "application"))
    payload = "status (MessagePack)"
    product = "status"

    number: Count = 0
    dropped: Count = 0


ProductMessage: TypeAlias = Image | Points | Raw | Group | Report
"""Headers of products: number, drops, times."""
PRODUCT_MESSAGES: Final[tuple[type[ProductMessage], ...]] = get_args(ProductMessage)
