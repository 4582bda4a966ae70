"""Random faults of a line: effects of a cable, a hub and a full buffer on the bytes of a block."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from ertis_numba.base import checks
from ertis_numba.devices.blocks import FRAME_BYTES

__all__ = ["KINDS", "BlockFault", "Faults", "Spoilt", "Stall", "Unplug"]

KINDS: Final = ("flip", "duplicate", "lose", "add", "swap", "cut", "drop", "stall", "unplug")
"""Possible faults of a block, in the order of their application."""

_SHORT_READS: Final = "short_reads"
_MAX_BYTES: Final = 4095  # Limit on a piece, the size of a terminal's buffer, and on a loss.
_PARTS: Final = {"header": 0, "counter": 4, "footer": -4}
_WORD: Final = 4


@dataclass(frozen=True, slots=True)
class Stall:
    """Pause in sending."""

    duration_s: float


@dataclass(frozen=True, slots=True)
class Unplug:
    """Removal of the sensor; nothing of this block follows."""


@dataclass(frozen=True, slots=True)
class BlockFault:
    """One fault in a block, of one of `KINDS`."""

    kind: str
    place: int  # first affected byte, counted after earlier faults
    n_bytes: int  # affected bytes
    detail: str = ""  # part of the block for a flip, place of the added bytes for a swap

    def __str__(self) -> str:
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.kind} {self.n_bytes} at {self.place}{detail}"


@dataclass(frozen=True, slots=True)
class Spoilt:
    """A block to be sent in pieces, in their order, with the applied faults; without any, it is unchanged."""

    pieces: tuple[bytes | Stall | Unplug, ...]
    faults: tuple[BlockFault, ...]

    @property
    def note(self) -> str:
        """All faults as text, such as ``lose 37 at 120, stall 0 at 400``; empty if there are none."""
        return ", ".join(map(str, self.faults))

    @property
    def data(self) -> bytes:
        """All bytes that are sent."""
        return b"".join(piece for piece in self.pieces if isinstance(piece, bytes))


class Faults:
    """Random generator of faults; the same seed and blocks give the same faults.

    ``flip``: a byte is changed, half of the time in header, counter or footer. ``duplicate``: the block is sent twice.
    ``lose``: bytes are cut out, half of the time whole words. ``add``: random bytes are inserted. ``swap``: bytes are
    lost in one place and as many random ones added in another. ``cut``: the rest is never sent; ``drop``: nothing is
    sent. ``stall``: a pause. ``unplug``: the sensor is removed in the middle. Each has its own probability per block.
    """

    def __init__(
        self, seed: int = 0, kinds: Mapping[str, float] | None = None, *, longest_stall_s: float = 0.02
    ) -> None:
        kinds = {} if kinds is None else kinds
        for kind in kinds:
            checks.choice("kind of fault", kind, (*KINDS, _SHORT_READS))
        self._short_reads = bool(kinds.get(_SHORT_READS, False))
        self._chances = np.array(
            [checks.between(f"probability of {kind}", kinds.get(kind, 0.0), 0.0, 1.0) for kind in KINDS]
        )
        self._longest_stall_s = checks.between("longest_stall_s", longest_stall_s, 0.0, 3600.0)
        self._random = np.random.default_rng(checks.integer("seed", seed, 0))
        self._faults: list[BlockFault] = []

    def spoil(self, block: bytes) -> Spoilt:
        """Return a block to be sent, with its faults."""
        self._faults = []
        data = bytearray(block)
        drawn = {kind for kind, hit in zip(KINDS, self._random.random(len(KINDS)) < self._chances, strict=True) if hit}
        for kind, spoil in {
            "flip": self._flip,
            "duplicate": self._duplicate,
            "lose": self._lose,
            "add": self._add,
            "swap": self._swap,
            "cut": self._cut,
            "drop": self._drop,
        }.items():
            if kind in drawn and data:
                spoil(data)
        pieces: list[bytes | Stall | Unplug] = []
        begin = 0
        if "stall" in drawn and data:
            begin = self._note("stall", self._place(data), 0)
            pieces = [*self._pieces(data[:begin]), Stall(float(self._random.uniform(0.0, self._longest_stall_s)))]
        if "unplug" in drawn:
            end = self._note("unplug", int(self._random.integers(begin, len(data) + 1)), 0)
            return Spoilt((*pieces, *self._pieces(data[begin:end]), Unplug()), tuple(self._faults))
        return Spoilt((*pieces, *self._pieces(data[begin:])), tuple(self._faults))

    def _note(self, kind: str, place: int, n_bytes: int, detail: str = "") -> int:
        self._faults.append(BlockFault(kind, place, n_bytes, detail))
        return place

    def _place(self, data: bytearray) -> int:
        return int(self._random.integers(len(data)))

    def _length(self) -> int:
        """Return a number of bytes, with equal probability for each order of magnitude."""
        return int(_MAX_BYTES ** self._random.random())

    def _bytes(self, count: int) -> bytes:
        return self._random.bytes(count)

    def _flip(self, data: bytearray) -> None:
        parts = list(_PARTS)
        part = parts[self._random.integers(len(parts))] if self._random.random() < 0.5 else "words"
        if part == "words":
            place = int(self._random.integers(8, len(data) - 4)) if len(data) > FRAME_BYTES else 0
        else:
            place = _PARTS[part] % len(data) + int(self._random.integers(_WORD))
        data[place] ^= int(self._random.integers(1, 256))
        self._note("flip", place, 1, part)

    def _duplicate(self, data: bytearray) -> None:
        self._note("duplicate", len(data), len(data))
        data *= 2

    def _lose(self, data: bytearray) -> None:
        place, count = self._place(data), self._length()
        if self._random.random() < 0.5:
            place, count = place - place % _WORD, count + -count % _WORD
        count = min(count, len(data) - place)
        del data[place : place + count]
        self._note("lose", place, count)

    def _add(self, data: bytearray) -> None:
        place, added = int(self._random.integers(len(data) + 1)), self._bytes(self._length())
        data[place:place] = added
        self._note("add", place, len(added))

    def _swap(self, data: bytearray) -> None:
        place = self._place(data)
        count = min(self._length(), len(data) - place)
        del data[place : place + count]
        again = int(self._random.integers(len(data) + 1))
        data[again:again] = self._bytes(count)
        self._note("swap", place, count, f"at {again}")

    def _cut(self, data: bytearray) -> None:
        place = self._place(data)
        self._note("cut", place, len(data) - place)
        del data[place:]

    def _drop(self, data: bytearray) -> None:
        self._note("drop", 0, len(data))
        data.clear()

    def _pieces(self, data: bytearray) -> list[bytes]:
        """Return pieces that fit into a terminal's buffer."""
        pieces, begin = [], 0
        while begin < len(data):
            length = int(self._random.integers(1, _MAX_BYTES + 1)) if self._short_reads else _MAX_BYTES
            pieces.append(bytes(data[begin : begin + length]))
            begin += length
        return pieces
