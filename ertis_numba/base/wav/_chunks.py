"""Chunks of a WAV file: encoding, samples and metadata."""

import struct
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import quoted
from ertis_numba.base.wav._form import Form, read_form
from ertis_numba.base.wav._lengths import (
    HEADER_BYTES,
    WRAP,
    Content,
    chain_fits,
    is_chunk,
    is_mark,
    places_after,
    sample_bytes,
)

__all__ = ["Chunks", "Samples", "lengths_notes", "read_chunks", "samples_of"]

_FIRST = 12  # after RIFF, its length, and WAVE
_MAX_METADATA_BYTES = 2**20
_FILES = {b"RIFF", b"RIFX", b"RF64", b"BW64"}


@dataclass(slots=True)
class Chunks:
    """Chunks of a WAV file, by name, with the places where they begin."""

    places: dict[bytes, int] = field(default_factory=dict)
    bodies: dict[bytes, bytes] = field(default_factory=dict)
    lists: dict[bytes, bytes] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    wide: dict[bytes, int] = field(default_factory=dict)  # lengths and number of samples in a ds64 chunk
    form: Form | None = None
    n_bytes: int = 0  # of the samples

    @property
    def start(self) -> int:
        """Place of the first sample."""
        return self.places[b"data"] + HEADER_BYTES

    def metadata(self) -> dict[str, bytes]:
        """Return the contents of all chunks but the samples; see `WavFile.chunks`."""
        return {name.decode("latin-1").strip(): body for name, body in (self.bodies | self.lists).items()}


def read_chunks(content: Content) -> tuple[Chunks, Form]:
    """Return the chunks of a WAV file, and the encoding of its samples."""
    chunks = Chunks()
    place: int | None = _FIRST
    last = (b"RIFF", 0)
    while place is not None and place + HEADER_BYTES <= len(content):
        last = (content.header(place)[0], place)
        place = _read(content, chunks, place)
    return chunks, _require_complete(content, chunks, *last)


def _require_complete(content: Content, chunks: Chunks, last: bytes, place: int) -> Form:
    """Return the encoding; refuse a file without it, or without samples."""
    path, form = content.path, chunks.form
    missing = "fmt" if form is None else "" if b"data" in chunks.places else "data"
    if form is None or missing:
        raise DataError(
            f"{path} has no samples: no {missing} chunk follows the chunk {last.decode('latin-1')!r} at byte {place} "
            f"of {len(content)}; copy the file again, or save it again as WAV"
        )
    if not chunks.n_bytes:
        raise DataError(
            f"{path} has no samples: its data chunk at byte {chunks.places[b'data']} is empty; record it again, "
            "or leave it out"
        )
    if chunks.n_bytes % form.frame_bytes:
        raise DataError(
            f"{path} has {chunks.n_bytes} bytes of samples, not a multiple of its frame size, {form.frame_bytes} "
            "bytes; copy the file again, or save it again as WAV"
        )
    return form


def _read(content: Content, chunks: Chunks, place: int) -> int | None:
    """Read the chunk at a place, and return the place of the next one, if any."""
    name, n_bytes = content.header(place)
    start = place + HEADER_BYTES
    _require_single(content, chunks, name, place)
    chunks.places.setdefault(name, place)
    if name == b"data":
        length = sample_bytes(content, place, chunks.wide.get(name), chunks.form.frame_bytes if chunks.form else 1)
        chunks.n_bytes = length.n_bytes
        chunks.notes += [length.note] if length.note else []
        return next((end for end in places_after(start, length.n_bytes) if chain_fits(content, end)), None)
    if n_bytes == WRAP - 1:
        n_bytes = chunks.wide.get(name, n_bytes)
    _keep(content, chunks, name, content.read(start, min(n_bytes, _MAX_METADATA_BYTES)))
    return next((end for end in places_after(start, n_bytes) if is_chunk(content, end)), None)


def _keep(content: Content, chunks: Chunks, name: bytes, body: bytes) -> None:
    """Store the content of a chunk that is not the samples."""
    if name == b"LIST":
        chunks.lists.setdefault(body[:4], body[4:])
        return
    if name == b"fmt " and chunks.form is None:
        chunks.form = read_form(body, content.order, chunks.places[name], content.path)
        chunks.notes += chunks.form.notes
    elif name == b"ds64":
        chunks.wide |= _wide_lengths(body, content.order)
    chunks.bodies.setdefault(name, body)


def _wide_lengths(body: bytes, order: str) -> dict[bytes, int]:
    """Return the lengths in a ds64 chunk by chunk, and the number of samples as that of ``fact``."""
    if len(body) < struct.calcsize("<QQQ"):
        return {}
    lengths = dict(zip((b"RIFF", b"data", b"fact"), struct.unpack_from(f"{order}QQQ", body), strict=True))
    row = struct.Struct(f"{order}4sQ")
    table = body[28:]
    whole = table[: len(table) - len(table) % row.size]
    return dict(row.iter_unpack(whole)) | lengths


def _require_single(content: Content, chunks: Chunks, name: bytes, place: int) -> None:
    """Refuse samples in several places."""
    path = content.path
    if name == b"fmt " and name in chunks.places:
        known = chunks.places[name]
        length = HEADER_BYTES + content.header(known)[1]
        if content.read(known, length) != content.read(place, length):
            raise DataError(
                f"{path} has different fmt chunks at bytes {known} and {place}; save the file again as WAV with the "
                "program that wrote it"
            )
    if name == b"data" and name in chunks.places:
        copy = quoted(path.with_name(f"{path.stem}_first.wav"))
        raise DataError(
            f"{path} has data chunks at bytes {chunks.places[name]} and {place}; keep the samples of the first with "
            f"'sox {quoted(path)} {copy}'"
        )
    if name in _FILES:
        raise DataError(
            f"{path} contains a second WAV file from byte {place} on; separate them with "
            f"'head -c {place} {quoted(path)} > first.wav' and "
            f"'tail -c +{place + 1} {quoted(path)} > second.wav'"
        )


def lengths_notes(content: Content, chunks: Chunks, form: Form) -> list[str]:
    """Return notes on lengths that differ from the file without an effect on the samples."""
    notes = []
    n_samples = chunks.n_bytes // form.frame_bytes
    fact = chunks.bodies.get(b"fact", b"")
    stated = struct.unpack_from(f"{content.order}I", fact)[0] if len(fact) >= 4 else 0
    wide = chunks.wide.get(b"fact", 0)
    for name, number in (("fact", stated), ("ds64", wide)):
        if number and not is_mark(number) and number not in {n_samples, n_samples % WRAP}:
            place = chunks.places[name.encode()]
            notes.append(f"the {name} chunk at byte {place} states {number} samples, but the file has {n_samples}")
    riff = content.header(0)[1]
    riff = chunks.wide.get(b"RIFF", riff) if riff == WRAP - 1 else riff
    if not is_mark(riff) and (riff + HEADER_BYTES - len(content) + 1) % WRAP > 2:
        notes.append(f"the RIFF chunk states {riff} bytes, but {len(content) - HEADER_BYTES} follow")
    return notes


_SIZES = (1, 2, 4, 8)  # bytes of NumPy's integers


class Samples(Protocol):
    """Samples as (sample, channel), such as an array; slices along the first axis are arrays."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the slices."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of samples and of channels."""

    def __getitem__(self, samples: slice, /) -> NDArray[Any]:
        """Return consecutive samples."""


def samples_of(content: NDArray[np.uint8], n_channels: int, sample_bytes: int, kind: str, order: str) -> Samples:
    """Return a view of complete frames (byte,) as samples; ``kind`` is ``i`` or ``f``, ``order`` is ``<`` or ``>``."""
    if sample_bytes in _SIZES:
        dtype = np.dtype("u1" if sample_bytes == 1 else f"{order}{kind}{sample_bytes}")
        return content.view(dtype).reshape(-1, n_channels)
    wide = next(size for size in _SIZES if size > sample_bytes)
    return _Packed(content.reshape(-1, n_channels, sample_bytes), np.dtype(f"{order}i{wide}"))


@dataclass(frozen=True, slots=True)
class _Packed:
    """Integers of 3, 5, 6 or 7 bytes; slices fill the low bytes of the next larger type with zeros."""

    content: NDArray[np.uint8]
    dtype: np.dtype[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.content.shape[:2]

    def __getitem__(self, samples: slice) -> NDArray[Any]:
        packed = self.content[samples]
        wide = np.zeros((*packed.shape[:2], self.dtype.itemsize), np.uint8)
        missing = self.dtype.itemsize - packed.shape[2]
        used = slice(missing, None) if self.dtype == self.dtype.newbyteorder("<") else slice(packed.shape[2])
        wide[..., used] = packed
        return wide.view(self.dtype)[..., 0]
