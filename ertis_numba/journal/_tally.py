"""Highest numbers that a journal contains, stored in a file beside it.

A damaged log can lose measurements without an error from SQLite. The tally is written after each commit, without a
sync, and never lists a number that was not stored.
"""

import json
import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

__all__ = ["TALLY", "SequenceRange", "Tally"]

TALLY: Final = "-tally"
"""Suffix of the file, after the name of the journal."""

_BLOCK_BYTES: Final = 512  # Size of a sector, which a disk writes as a whole.


@dataclass(slots=True)
class SequenceRange:
    """First and last stored number of a session; numbers up to ``discarded`` may be deleted, -1 if none was."""

    sensor: str
    session_id: int
    first: int
    last: int
    discarded: int = -1


_FIELDS: Final = tuple(field.name for field in fields(SequenceRange))


class Tally:
    """File with one block for each session, updated after each commit; ``damage`` lists losses that no gap covers."""

    def __init__(self, journal: Path) -> None:
        self.path = journal.with_name(f"{journal.name}{TALLY}")
        self._descriptor = -1
        self._identity = 0
        self._was_read = False
        self._places: dict[tuple[str, int], int] = {}
        self.ranges: dict[tuple[str, int], SequenceRange] = {}
        self.damage = ""

    def begin(self, identity: int) -> None:
        """Start a tally for a new journal of this identity."""
        self._identity = identity
        if self._descriptor >= 0:
            with suppress(OSError):
                self._begin()

    def read(self, identity: int, *, any_journal: bool = False) -> None:
        """Read and continue the tally of an earlier process, for the journal of this identity or for any journal."""
        self._identity = identity
        try:
            content = self.path.read_bytes()
        except OSError:
            return
        blocks = dict(_blocks(content))
        if blocks.get(0, {}).get("journal") != identity and not any_journal:
            return
        self._was_read = True
        self.damage = blocks.pop(0, {}).get("damage", "")
        for place, block in blocks.items():
            mark = SequenceRange(**block)
            self._places[mark.sensor, mark.session_id] = place
            self.ranges[mark.sensor, mark.session_id] = mark

    def record(self, sensor: str, session_id: int, first: int, last: int) -> None:
        """Register stored numbers; errors are ignored, so that the loss of these numbers could go unnoticed."""
        mark = self.ranges.setdefault((sensor, session_id), SequenceRange(sensor, session_id, first, last))
        mark.last = max(mark.last, last)
        with suppress(OSError):
            self._put(mark)

    def note_damage(self, text: str) -> None:
        """Store a description of losses that the journal cannot represent as gaps."""
        self.damage = text
        with suppress(OSError):
            self._begin()

    def discard(self, sensor: str, session_id: int, up_to: int) -> None:
        """Register durably that numbers may be deleted."""
        mark = self.ranges.get((sensor, session_id))
        if mark is not None and up_to > mark.discarded:
            mark.discarded = up_to
            self._put(mark)
            os.fsync(self._descriptor)

    def limit(self, acked: Mapping[tuple[str, int], int]) -> None:
        """Remove numbers above the acknowledged ones, because a failed journal does not contain them reliably."""
        for run, mark in self.ranges.items():
            last = max(acked.get(run, -1), mark.first - 1)
            if mark.last > last:
                mark.last = last
                self._put(mark)

    def _put(self, mark: SequenceRange) -> None:
        place = self._places.setdefault((mark.sensor, mark.session_id), max(self._places.values(), default=0) + 1)
        if self._descriptor < 0:
            self._begin()
        self._write(place, {name: getattr(mark, name) for name in _FIELDS})

    def _begin(self) -> None:
        """Open the file and write its header; keep earlier content only if it was read."""
        if self._descriptor < 0:
            flags = os.O_CREAT | os.O_RDWR | (0 if self._was_read else os.O_TRUNC) | getattr(os, "O_BINARY", 0)
            self._descriptor = os.open(self.path, flags, 0o666)
        self._write(0, {"journal": self._identity} | ({"damage": self.damage} if self.damage else {}))

    def _write(self, place: int, block: dict[str, Any]) -> None:
        text = json.dumps(block, ensure_ascii=False).encode()
        line = b"%08x %s" % (zlib.crc32(text), text)
        if len(line) >= _BLOCK_BYTES:  # Sensors with very long names have no block.
            return
        os.lseek(self._descriptor, place * _BLOCK_BYTES, os.SEEK_SET)
        os.write(self._descriptor, line.ljust(_BLOCK_BYTES - 1) + b"\n")

    def close(self) -> None:
        """Close the file; closing twice is harmless."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def remove(self) -> None:
        """Close the file and remove it."""
        self.close()
        self.path.unlink(missing_ok=True)


def _blocks(content: bytes) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the index and content of each block with a correct CRC-32."""
    for begin in range(0, len(content), _BLOCK_BYTES):
        check, _, text = content[begin : begin + _BLOCK_BYTES].rstrip().partition(b" ")
        if check == b"%08x" % zlib.crc32(text):
            yield begin // _BLOCK_BYTES, json.loads(text)
