"""Measurements in the form of a sensor's blocks, with arrival times."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Behaviour

__all__ = ["CHANNELS", "COUNTERS", "FOOTER", "FRAME_BYTES", "HEADER", "Block", "Instant", "encode_block"]

HEADER: Final = 1_364_413_970
"""First word of a block."""

FOOTER: Final = 792_823_410
"""Last word of a block."""

FRAME_BYTES: Final = 12
"""Bytes of header, counter and footer."""

CHANNELS: Final = 32
"""Number of microphones; each has one bit of every word."""

COUNTERS: Final = 2**32
"""Range of a counter before it wraps around."""


@dataclass(frozen=True, slots=True)
class Instant:
    """Time of an arrival."""

    realtime_ns: int  # since 1970-01-01 UTC
    monotonic_ns: int
    uncertainty_ns: int  # longest possible delay before it was read


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One measurement as a sensor sent it."""

    counter: int
    data: NDArray[np.uint32]  # PDM words in separate, read-only memory
    arrived: Instant  # of the first byte
    behaviour: Behaviour = "unknown"  # set by SonarDriver: active if it was told to emit its call


def encode_block(counter: int, words: NDArray[np.uint32]) -> bytes:
    """Return a measurement, words of (sample,) uint32, in the form that a sensor sends."""
    counter = checks.integer("counter", counter, 0, COUNTERS - 1)
    if words.dtype.kind != "u" or words.dtype.itemsize != 4 or words.ndim != 1:
        raise ArgumentError(f"words are {words.dtype} of shape {words.shape}; use (sample,) uint32")
    payload = words.astype("<u4", copy=False).tobytes()
    return HEADER.to_bytes(4, "little") + counter.to_bytes(4, "little") + payload + FOOTER.to_bytes(4, "little")
