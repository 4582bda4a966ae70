"""Checksums of SQLite's write-ahead log, and commits that SQLite will not read.

SQLite stops reading a log at the first frame with a wrong checksum. After a power cut, that frame belongs to the last
transaction, which was never reported. If a later transaction follows, the frame was synced, so it is damaged.
See https://sqlite.org/fileformat.html, sections 4.1 and 4.2.
"""

import struct
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.journal._database import PAGE_BYTES

__all__ = ["WriteAheadLog", "read_log"]

_HEADER_BYTES: Final = 32
_FRAME: Final = struct.Struct(">6I")  # Page, pages after a commit or 0, two salts, two checksums.
_MAGIC: Final = 0x377F0682  # With the last bit set, checksums read big-endian words.
_VERSION: Final = 3_007_000
_PAGE_BYTES: Final = range(512, 65_537)


@dataclass(frozen=True, slots=True, eq=False)
class WriteAheadLog:
    """A write-ahead log on the disk; SQLite reads ``n_read`` frames, up to the commit before a wrong checksum."""

    # `n_lost_commits` counts the commits that SQLite will not read although they were synced.

    content: bytes
    n_read: int
    n_frames: int
    n_lost_commits: int

    @property
    def is_truncated(self) -> bool:
        """True if frames of this generation follow those that SQLite reads: damaged ones, or a torn end."""
        _, page_bytes = _format(self.content)
        place = _HEADER_BYTES + self.n_read * (_FRAME.size + page_bytes)
        return self.n_lost_commits > 0 or self.content[place + 8 : place + 16] == self.content[16:24]

    @property
    def repaired(self) -> bytes:
        """Copy of the log with new checksums, so that SQLite reads all frames."""
        big_endian, page_bytes = _format(self.content)
        frame_bytes = _FRAME.size + page_bytes
        salts = self.content[16:24]
        check = np.frombuffer(self.content, ">u4", 2, offset=24).astype(np.uint32)
        made = bytearray(self.content[:_HEADER_BYTES])
        for place in range(_HEADER_BYTES, _HEADER_BYTES + self.n_frames * frame_bytes, frame_bytes):
            frame = self.content[place : place + frame_bytes]
            sums = _sums(_words(frame, big_endian=big_endian, page_bytes=page_bytes))[0]
            check = _advance(check, 1 + page_bytes // 8) + sums
            made += frame[:8] + salts + check.astype(">u4").tobytes() + frame[_FRAME.size :]
        return bytes(made)


def read_log(path: Path) -> WriteAheadLog | None:
    """Return the write-ahead log of a journal; None if it does not exist, or if SQLite cannot have written it."""
    try:
        content = path.with_name(f"{path.name}-wal").read_bytes()
    except OSError:
        return None
    is_begun = _has_sound_header(content)
    if not is_begun:
        content = _guess_header(content) + content[_HEADER_BYTES:]
    big_endian, page_bytes = _format(content)
    frame_bytes = _FRAME.size + page_bytes
    n_frames = (len(content) - _HEADER_BYTES) // frame_bytes
    if n_frames < 1:
        return None
    frames = content[_HEADER_BYTES : _HEADER_BYTES + n_frames * frame_bytes]
    heads = np.frombuffer(frames, np.uint8).reshape(n_frames, frame_bytes)[:, : _FRAME.size]
    heads = np.ascontiguousarray(heads).view(">u4").astype(np.uint32)
    sums = _sums(_words(frames, big_endian=big_endian, page_bytes=page_bytes))
    first = np.frombuffer(content, ">u4", 2, offset=24).astype(np.uint32)
    before = np.vstack([first[None, :], heads[:-1, 4:]])
    same = (heads[:, 2:4] == np.frombuffer(content, ">u4", 2, offset=16)).all(axis=1)
    sound = same & (_advance(before, 1 + page_bytes // 8) + sums == heads[:, 4:]).all(axis=1)
    commits = np.flatnonzero(same & (heads[:, 1] > 0))
    n_sound = n_frames if sound.all() else int(np.argmin(sound))
    n_read = max((int(place) + 1 for place in commits if place < n_sound and is_begun), default=0)
    return WriteAheadLog(
        content=content,
        n_read=n_read,
        n_frames=int(commits[-1]) + 1 if len(commits) else 0,
        # A truncated header begins a new generation: the previous one is completely in the main file.
        n_lost_commits=_count_lost(commits[commits >= n_read], sound) if is_begun else 0,
    )


def _count_lost(commits: NDArray[np.intp], sound: NDArray[np.bool_]) -> int:
    """Count commits that a later transaction proves to be synced."""
    # Its checksums must continue those of the commit, unlike remnants of earlier crashes.
    for place in range(len(commits) - 1, 0, -1):
        if sound[commits[place - 1] + 1 : commits[place] + 1].all():
            return place
    return 0


def _has_sound_header(content: bytes) -> bool:
    big_endian, page_bytes = _format(content)
    if page_bytes not in _PAGE_BYTES or page_bytes & (page_bytes - 1):
        return False
    return content[24:32] == _header_check(content, big_endian=big_endian)


def _guess_header(content: bytes) -> bytes:
    """Return a header for the frames after a damaged header, with the salts that most of them have."""
    frame_bytes = _FRAME.size + PAGE_BYTES
    salts = Counter(content[place : place + 8] for place in range(_HEADER_BYTES + 8, len(content), frame_bytes))
    largest = max(salts, key=salts.__getitem__, default=b"").ljust(8, b"\0")
    words = struct.pack(">4I8s", _MAGIC, _VERSION, PAGE_BYTES, 0, largest)
    return words + _header_check(words, big_endian=False)


def _header_check(header: bytes, *, big_endian: bool) -> bytes:
    words = np.frombuffer(header, ">u4" if big_endian else "<u4", 6).astype(np.uint32)
    return bytes(_sums(words[None, :])[0].astype(">u4").tobytes())


def _format(content: bytes) -> tuple[bool, int]:
    """Return True if checksums read big-endian words, and the page size, which is 0 if this is not a log."""
    if len(content) < _HEADER_BYTES:
        return False, 0
    magic, _, page_bytes = struct.unpack_from(">3I", content)
    return bool(magic & 1), page_bytes if magic & ~1 == _MAGIC else 0


def _words(frames: bytes, *, big_endian: bool, page_bytes: int) -> NDArray[np.uint32]:
    """Return the checksummed part of frames: the first two words of each header, and the page."""
    words = np.frombuffer(frames, ">u4" if big_endian else "<u4").astype(np.uint32, copy=False)
    words = words.reshape(-1, (_FRAME.size + page_bytes) // 4)
    return np.concatenate([words[:, :2], words[:, 6:]], axis=1)


def _sums(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the checksum of each row of words, starting from zero.

    For each pair of words x, y, SQLite computes s ← s + x + t and t ← t + y + s, modulo 2³². This step is linear, so
    each pair contributes a multiple of itself to the result.
    """
    even, odd = words[:, 0::2], words[:, 1::2]
    low, middle, high = _steps(even.shape[1])
    both = even + odd
    first = (even * low[::-1] + both * middle[::-1]).sum(axis=1, dtype=np.uint32)
    second = (even * middle[::-1] + both * high[::-1]).sum(axis=1, dtype=np.uint32)
    return np.stack([first, second], axis=1)


def _advance(check: NDArray[np.uint32], n_pairs: int) -> NDArray[np.uint32]:
    """Return checksums after ``n_pairs`` further pairs of zero words."""
    low, middle, high = (int(step[-1]) for step in _steps(n_pairs + 1))
    step = np.array([[low, middle], [middle, high]], np.uint32)
    return check @ step  # The matrix is symmetric.


@cache
def _steps(n_pairs: int) -> tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]:
    """Return the three distinct elements of the powers 0, 1, … of the matrix [[1, 1], [1, 2]]."""
    powers = np.empty((3, n_pairs), np.uint32)
    low, middle, high = 1, 0, 1
    for place in range(n_pairs):
        powers[:, place] = low, middle, high
        low, middle, high = (low + middle) % 2**32, (middle + high) % 2**32, (middle + 2 * high) % 2**32
    return powers[0], powers[1], powers[2]
