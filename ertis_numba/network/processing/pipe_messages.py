"""Messages between the central node, its workers and its publisher."""

from typing import Literal

import msgspec

from ertis_numba.base.constants import ImageDtype
from ertis_numba.frames.level_codes import LevelCodes
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
    "StartWorker",
    "Started",
    "StatusNote",
    "ToPublisher",
    "ToWorker",
    "Unusable",
    "Wanted",
]


class _Note(msgspec.Struct, frozen=True, kw_only=True, tag=True):
    pass


class StartWorker(_Note, frozen=True, kw_only=True):
    """Configuration of a worker: `ProcessingOptions`, and its share of the threads."""

    device: str
    dtype: str
    threads: int
    at_once: int
    deadline_s: float
    plan: Literal["nominal", "measured"]


class SlotMemory(_Note, frozen=True, kw_only=True):
    """A slot; its descriptor comes with the message."""

    slot: int
    words_bytes: int
    image_bytes: int


class Prepare(_Note, frozen=True, kw_only=True):
    """Request to prepare for a kind, and to measure its times if ``measure`` is set."""

    kind: int
    settings: str
    measure: bool


class ProcessJob(_Note, frozen=True, kw_only=True):
    """Request to make an image of the samples in a slot."""

    job: int
    kind: int
    slot: int
    words_bytes: int
    threads: int
    points: bool
    sensor: str = ""
    predict: bool = False
    """Predict the error of the image."""
    check_sound: bool = False
    """Compare the sound with the settings."""


class Release(_Note, frozen=True, kw_only=True):
    """No more measurements of a kind will come."""

    kind: int


ToWorker = StartWorker | SlotMemory | Prepare | ProcessJob | Release


class Ready(_Note, frozen=True, kw_only=True):
    """A worker has loaded its modules, and found a device."""

    device: str
    threads: int


class Prepared(_Note, frozen=True, kw_only=True):
    """A worker is ready for a kind."""

    kind: int
    settings: str
    azimuth_rad: bytes
    elevation_rad: bytes
    range_m: bytes
    shape: tuple[int, int]
    wide_s: float = 0.0  # time of one measurement on all threads
    many_s: float = 0.0  # time of one measurement with a share of the threads


class Unusable(_Note, frozen=True, kw_only=True):
    """No pipeline can be made for a kind."""

    kind: int
    text: str


class JobFinished(_Note, frozen=True, kw_only=True):
    """The image is in its slot, with its points if requested."""

    job: int
    took_s: float
    n_points: int
    levels: LevelCodes | None = None


class JobFailed(_Note, frozen=True, kw_only=True):
    """There is no image. With ``again``, another worker may succeed."""

    job: int
    text: str
    again: bool


class Predicted(_Note, frozen=True, kw_only=True):
    """Warning about a sensor's images, and the log event that reports it."""

    sensor: str
    event: Literal[
        "error_budget",
        "call_mismatch",
        "start_mismatch",
        "layout_mismatch",
        "sample_fault",
        "coarse_grid",
        "check_failed",
    ]
    warning: str


FromWorker = Ready | Prepared | Unusable | JobFinished | JobFailed | Predicted


class Begin(_Note, frozen=True, kw_only=True):
    """Configuration of a publisher."""

    address: str
    name: str = ""
    public: str = ""
    secret: str = ""
    allow: str = ""


class Describe(_Note, frozen=True, kw_only=True):
    """Description of products, sent before the first of them."""

    description: Description
    payloads: tuple[bytes, ...]


class Publish(_Note, frozen=True, kw_only=True):
    """A measurement and its products are in a slot, until `ProductsQueued` releases it."""

    job: int
    slot: int
    data: Data
    received_ns: int
    description: int | None  # None without an image
    raw_description: int
    shape: tuple[int, int]
    dtype: ImageDtype
    levels: LevelCodes | None
    n_points: int
    words_bytes: int


class Grouped(_Note, frozen=True, kw_only=True):
    """A closed group."""

    group: Group


class StatusNote(_Note, frozen=True, kw_only=True):
    """Status of the central node, as MessagePack."""

    status: bytes


ToPublisher = Begin | SlotMemory | Describe | Publish | Grouped | StatusNote


class Started(_Note, frozen=True, kw_only=True):
    """The publisher has started, so that applications can subscribe; or it has failed with an error."""

    address: str
    error: str = ""


class ProductsQueued(_Note, frozen=True, kw_only=True):
    """Subscribers of a product will get it; its slot is free."""

    job: int
    published_ns: int


class Wanted(_Note, frozen=True, kw_only=True):
    """Sensors whose points are subscribed; None stands for all."""

    points: tuple[str, ...] | None


class Served(_Note, frozen=True, kw_only=True):
    """State of the publisher, sent each second."""

    subscribers: tuple[SubscriberStatus, ...]
    refused: dict[str, int]
    reports: int  # accepted StatusNote messages
    keys_note: str = ""  # error of the allow list


FromPublisher = Started | ProductsQueued | Wanted | Served
