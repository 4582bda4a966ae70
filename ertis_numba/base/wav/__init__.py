"""WAV files: samples and metadata, with each stated length compared with the file."""

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.base.file_kinds import problem_of
from ertis_numba.base.wav._chunks import Samples, lengths_notes, read_chunks, samples_of
from ertis_numba.base.wav._form import Form
from ertis_numba.base.wav._lengths import Content

__all__ = ["Samples", "WavFile", "read_wav", "wav_bytes"]

_CHECKED_SAMPLES = 2**16
_FLOAT = 3  # format of floating-point samples
_ORDERS: Final = {b"RIFF": "<", b"RF64": "<", b"BW64": "<", b"RIFX": ">"}


@dataclass(frozen=True, slots=True)
class WavFile:
    """Content of a WAV file: samples (sample, channel), mapped into memory, at the full scale of their integer type."""

    # Bytes are unsigned. `notes` are contradictions in the file and their resolution; `chunks` has others up to 1 MiB.

    rate_hz: float
    samples: Samples
    valid_bits: int
    notes: tuple[str, ...]
    chunks: dict[str, bytes]


def read_wav(path: Path) -> WavFile:
    """Return the content of a WAV, RF64, BW64 or big-endian RIFX file."""
    content = _opened(path)
    chunks, form = read_chunks(content)
    view = content.view[chunks.start : chunks.start + chunks.n_bytes]
    samples = samples_of(view, form.n_channels, form.sample_bytes, form.kind, content.order)
    notes = [*chunks.notes, *lengths_notes(content, chunks, form), *_alignment_notes(samples, form)]
    return WavFile(float(form.rate_hz), samples, form.valid_bits, tuple(notes), chunks.metadata())


def _alignment_notes(samples: Samples, form: Form) -> list[str]:
    """Return a note if samples seem to fill the low bits of their container; they fill the high ones by definition."""
    unused = 8 * form.sample_bytes - form.valid_bits
    if form.kind != "i" or form.sample_bytes == 1 or not unused:
        return []
    first = samples[:_CHECKED_SAMPLES].astype(np.int64)
    first = first >> (8 * (samples.dtype.itemsize - form.sample_bytes))
    limit = 2 ** (form.valid_bits - 1)
    if not (first & (2**unused - 1)).any() or first.max() >= limit or first.min() < -limit:
        return []
    note = (
        f"all samples fit the low {form.valid_bits} of {8 * form.sample_bytes} bits, although the format puts them "
        f"into the high ones; if levels are {20 * math.log10(2) * unused:.0f} dB too low, multiply them by {2**unused}"
    )
    return [note]


def wav_bytes(rate_hz: float, samples: NDArray[np.float32]) -> bytes:
    """Return the bytes of a WAV file of one channel of 32-bit floating-point samples; its rate is in whole hertz."""
    rate, data = round(rate_hz), samples.astype("<f4").tobytes()
    header = struct.pack("<HHIIHHH", _FLOAT, 1, rate, 4 * rate, 4, 32, 0)
    fact = struct.pack("<I", len(samples))
    chunks = ((b"fmt ", header), (b"fact", fact), (b"data", data))
    body = b"".join(name + struct.pack("<I", len(content)) + content for name, content in chunks)
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WAVE" + body


def _opened(path: Path) -> Content:
    """Map a file into memory; refuse one that is not WAV."""
    try:
        with path.open("rb") as file:
            start = file.read(12)
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; choose a WAV file") from error
    if not start:
        raise DataError(f"{path} is empty; copy the file again, or leave it out")
    if start[:4] not in _ORDERS or start[8:] != b"WAVE":
        found = problem_of(path)
        if found:
            raise DataError(f"{path} {found}")
        raise DataError(
            f"{path} is not a WAV file: it begins with {start[:4]!r}; choose a WAV file, or HDF5 of Acoular (.h5)"
        )
    return Content(path, np.asarray(np.memmap(path, np.uint8, "r")), _ORDERS[start[:4]])
