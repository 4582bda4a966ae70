"""What the central node, its workers and its publisher tell each other over their pipes."""

from typing import Literal

import msgspec

from ertis_numba.network.messages import Data, Description, Group
from ertis_numba.network.status import SubscriberStatus

__all__ = [
    "Begin",
    "Describe",
    "FromPublisher",
    "FromWorker",
    "Grouped",
    "JobFailed",
    "JobFinished",
    "Predicted",
    "Prepare",
    "Prepared",
    "ProcessJob",
    "ProductsQueued",
    "Publish",
    "Ready",
    "Release",
    "Served",
    "SlotMemory",
    "Started",
    "StatusNote",
    "ToPublisher",
    "ToWorker",
    "Unusable",
    "Wanted",
]


class _Note(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    pass


class SlotMemory(_Note, frozen=True, kw_only=True):
    """A slot; its file comes with the message."""

    slot: int
    words_bytes: int
    image_bytes: int


class Prepare(_Note, frozen=True, kw_only=True):
    """A worker is to be ready for measurements of a kind, and to measure how long they take if ``measure`` is set."""

    kind: int
    settings: str
    measure: bool


class ProcessJob(_Note, frozen=True, kw_only=True):
    """A worker is to make an image of the words in a slot."""

    job: int
    kind: int
    slot: int
    words_bytes: int
    threads: int
    points: bool
    predict_for: str = ""
    """Sensor whose images need a predicted error, if any."""


class Release(_Note, frozen=True, kw_only=True):
    """No more measurements of a kind will come."""

    kind: int


ToWorker = SlotMemory | Prepare | ProcessJob | Release


class Ready(_Note, frozen=True, kw_only=True):
    """A worker has loaded what it needs, and found a device."""

    device: str
    threads: int


class Prepared(_Note, frozen=True, kw_only=True):
    """A worker is ready for a kind.

    Times are of one measurement: on all threads, and as one of many of which each has its share of them.
    """

    kind: int
    settings: str
    azimuth_rad: bytes
    elevation_rad: bytes
    range_m: bytes
    shape: tuple[int, int]
    wide_s: float = 0.0
    many_s: float = 0.0


class Unusable(_Note, frozen=True, kw_only=True):
    """No pipeline can be made for a kind."""

    kind: int
    text: str


class JobFinished(_Note, frozen=True, kw_only=True):
    """The image is in its slot, and its points are, where they were asked for."""

    job: int
    took_s: float
    n_points: int


class JobFailed(_Note, frozen=True, kw_only=True):
    """There is no image. With ``again``, another worker may do better."""

    job: int
    text: str
    again: bool


class Predicted(_Note, frozen=True, kw_only=True):
    """Warning about a sensor's images, and the log event that reports it."""

    sensor: str
    event: Literal["error_budget", "call_mismatch"]
    warning: str


FromWorker = Ready | Prepared | Unusable | JobFinished | JobFailed | Predicted


class Begin(_Note, frozen=True, kw_only=True):
    """What a publisher is to be."""

    address: str
    name: str = ""
    public: str = ""
    secret: str = ""
    allow: str = ""


class Describe(_Note, frozen=True, kw_only=True):
    """What products are about, before the first of them."""

    description: Description
    payloads: tuple[bytes, ...]


class Publish(_Note, frozen=True, kw_only=True):
    """A measurement and what was made of it are in a slot, until `ProductsQueued` says otherwise."""

    job: int
    slot: int
    data: Data
    received_ns: int
    description: int
    raw_description: int
    shape: tuple[int, int]
    dtype: Literal["float32", "float16"]
    n_points: int
    words_bytes: int


class Grouped(_Note, frozen=True, kw_only=True):
    """A group is closed."""

    group: Group


class StatusNote(_Note, frozen=True, kw_only=True):
    """How the central node is, as MessagePack."""

    status: bytes


ToPublisher = Begin | SlotMemory | Describe | Publish | Grouped | StatusNote


class Started(_Note, frozen=True, kw_only=True):
    """Applications can subscribe, or why they cannot."""

    address: str
    error: str = ""


class ProductsQueued(_Note, frozen=True, kw_only=True):
    """Whoever wants it will get a product; its slot is free."""

    job: int
    published_ns: int


class Wanted(_Note, frozen=True, kw_only=True):
    """Sensors whose points somebody wants; None are all."""

    points: tuple[str, ...] | None


class Served(_Note, frozen=True, kw_only=True):
    """How it goes; sent each second.

    ``reports`` counts those `StatusNote` that were taken, ``keys_note`` says why the list of keys cannot be used.
    """

    subscribers: tuple[SubscriberStatus, ...]
    refused: dict[str, int]
    reports: int
    keys_note: str = ""


FromPublisher = Started | ProductsQueued | Wanted | Served
