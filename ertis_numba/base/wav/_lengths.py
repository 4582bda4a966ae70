"""The true length of the samples, where a header states another one.

Lengths have 32 bits. They wrap around in files above 4 GiB, and programs that write to a pipe, or lose power, leave a
mark. Therefore each length that a header can mean is compared with the file: it fits if the file, or a chain of
complete chunks, ends there.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import quoted

__all__ = [
    "HEADER_BYTES",
    "WRAP",
    "Content",
    "Length",
    "chain_fits",
    "is_chunk",
    "is_mark",
    "places_after",
    "sample_bytes",
]

WRAP: Final = 2**32
HEADER_BYTES: Final = 8
_MARKS: Final = (  # lengths that programs write before they are known, each with those of similar programs
    range(1),  # recorders that write it at the end
    range(0x7FFF0000, 0x80000100),  # sox, arecord and GStreamer
    range(0xFFFF0000, WRAP),  # ffmpeg
)
_KNOWN: Final = b"LISTbextiXMLguanid3 ID3 cue junkJUNKPAD _PMXafspsmplinstaxmlchnaPEAKwamdumidlevlplst"
_TRAILERS: Final = tuple(_KNOWN[place : place + 4] for place in range(0, len(_KNOWN), 4))
"""Chunks that follow samples."""
_TAIL_BYTES = 2**24
_MAX_CHUNKS = 4096
_MAX_LEFT_BYTES = 2**16  # between the last chunk and the end of the file
_PIECE_BYTES = 2**24


@dataclass(frozen=True, slots=True)
class Content:
    """Bytes of a file, mapped into memory."""

    path: Path
    view: NDArray[np.uint8]
    order: str

    def __len__(self) -> int:
        return len(self.view)

    def read(self, place: int, n_bytes: int) -> bytes:
        """Return up to ``n_bytes`` from a place on."""
        return self.view[place : place + n_bytes].tobytes()

    def header(self, place: int) -> tuple[bytes, int]:
        """Return the name and the stated length of the chunk at a place."""
        name, n_bytes = struct.unpack(f"{self.order}4sI", self.read(place, HEADER_BYTES))
        return name, n_bytes


@dataclass(frozen=True, slots=True)
class Length:
    """Length of the samples, and the reason where it is not the stated one."""

    n_bytes: int
    note: str = ""


def is_mark(n_bytes: int) -> bool:
    """Return True if programs write this length before they know it."""
    return any(n_bytes in mark for mark in _MARKS)


def places_after(start: int, n_bytes: int) -> tuple[int, ...]:
    """Return where a chunk may begin after content: behind the byte that pads an odd length, or without it."""
    end = start + n_bytes
    return (end + 1, end) if n_bytes % 2 else (end,)


def is_chunk(content: Content, place: int) -> bool:
    """Return True if the name of a chunk may stand at a place."""
    name = content.read(place, 4)
    return place + HEADER_BYTES <= len(content) and name.isascii() and name.decode().isprintable()


def chain_fits(content: Content, place: int) -> bool:
    """Return True if complete chunks fill the file from a place to its end, give or take one byte."""
    seen: set[int] = set()
    places = [place]
    while places and len(seen) < _MAX_CHUNKS:
        place = places.pop()
        if -1 <= place - len(content) <= 1:
            return True
        if place not in seen and is_chunk(content, place):
            seen.add(place)
            _, n_bytes = content.header(place)
            places += reversed(places_after(place + HEADER_BYTES, n_bytes))
    return False


def sample_bytes(content: Content, place: int, wide: int | None, frame_bytes: int) -> Length:
    """Return the length of the samples; ``wide`` is that of a ds64 chunk, and ``frame_bytes`` is 1 if unknown."""
    _, narrow = content.header(place)
    start = place + HEADER_BYTES
    room = len(content) - start
    stated = wide if wide is not None and narrow == WRAP - 1 else narrow
    others = {length for length in (wide, narrow) if length is not None}
    wrapped = set(range(narrow + WRAP, room + 1, WRAP))
    fits = [
        length
        for length in sorted(others | wrapped)
        if length <= room
        and (length == stated or not length % frame_bytes)
        and any(chain_fits(content, end) for end in places_after(start, length))
    ]
    where = f"the data chunk at byte {place} states {stated} bytes"
    if stated in fits and (stated or not room or len(fits) == 1):
        return Length(stated)
    if len(fits) == 1:
        return Length(fits[0], f"{where}, but the file contains {fits[0]}, which were read")
    if is_mark(stated):
        length = _end_of_samples(content, start) - start
        length -= length % frame_bytes
        return Length(length, f"{where}, which means unknown; the samples were read to the end, {length} bytes")
    return _of_misfit(content, start, stated, room, where)


def _of_misfit(content: Content, start: int, stated: int, room: int, where: str) -> Length:
    """Return the length of samples that are followed by neither a chunk nor the end of the file."""
    n_bytes = len(content)
    if stated > room:
        riff = content.header(0)[1]
        if riff + HEADER_BYTES == n_bytes:
            return Length(
                room, f"{where}, but the file ends after {room}, as the RIFF chunk states; these bytes were read"
            )
        raise DataError(
            f"{content.path} is truncated: {where}, but the file ends after {room}; copy it again, or read what is "
            f"left of it with {_read_on(content.path)}"
        )
    left = room - stated
    if stated + WRAP <= room or not (left <= min(_MAX_LEFT_BYTES, stated) or _is_zero(content, start + stated)):
        raise DataError(
            f"{content.path}: {where}, but {room} follow, and no chunk begins at byte {start + stated}; "
            f"read all of them with {_read_on(content.path)}"
        )
    return Length(stated, f"{left} bytes from byte {start + stated} on belong to no chunk and were left out")


def _read_on(path: Path) -> str:
    """Return a command that reads samples to the end of a file."""
    source, target = quoted(path), quoted(path.with_name(f"{path.stem}_complete.wav"))
    return f"'ffmpeg -ignore_length 1 -i {source} -c copy -rf64 auto {target}'"


def _end_of_samples(content: Content, start: int) -> int:
    """Return the place where samples of unknown length end: that of known chunks at the end, or of the file."""
    first = max(start, len(content) - _TAIL_BYTES)
    tail = content.read(first, _TAIL_BYTES)
    end = len(content)
    for name in _TRAILERS:
        place = tail.rfind(name)
        while place >= 0:
            if first + place + HEADER_BYTES <= len(content) and chain_fits(content, first + place):
                end = min(end, first + place)
            place = tail.rfind(name, 0, place)
    return end


def _is_zero(content: Content, place: int) -> bool:
    """Return True if only zeros follow."""
    return not any(
        content.view[first : first + _PIECE_BYTES].any() for first in range(place, len(content), _PIECE_BYTES)
    )
