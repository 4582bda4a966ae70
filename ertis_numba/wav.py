"""WAV files: checks of the header, reading and writing of samples."""

import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import DataError

__all__ = ["read_wav", "wav_bytes"]

_UNFINISHED_SIZES = {0, 2**32 - 1}  # sizes that programs write before the length is known
_FLOAT = 3  # format of floating-point samples
_RF64 = b"RF64"  # The sizes are in a separate chunk.


def read_wav(path: Path) -> tuple[float, NDArray[Any]]:
    """Return the sample rate in hertz and the samples, (sample, channel), memory-mapped if possible.

    Raises
    ------
    DataError
        The file is not WAV, has no samples, is truncated, or its header was never finished.
    """
    with path.open("rb") as file:
        _require_complete(path, file)
    from scipy.io import wavfile  # noqa: PLC0415  takes long to import, and few need it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # about chunks without samples
        try:
            try:
                rate_hz, numbers = wavfile.read(path, mmap=True)
            except ValueError:  # samples of 24 bits cannot be mapped
                rate_hz, numbers = wavfile.read(path)
        except Exception as error:  # the reader raises any exception for a malformed header
            raise DataError(f"{path} cannot be read ({error}); save it again as WAV") from error
    if not rate_hz or not numbers.size:
        raise DataError(f"{path} has {rate_hz} Hz and {numbers.size} numbers; save it again as WAV")
    return float(rate_hz), numbers if numbers.ndim > 1 else numbers[:, None]


def wav_bytes(rate_hz: float, samples: NDArray[np.float32]) -> bytes:
    """Return a WAV file of one channel of 32-bit floating-point samples, in bytes.

    Parameters
    ----------
    rate_hz : float
        Sample rate, which the file holds in whole hertz.
    samples : (sample,) float32
    """
    rate, data = round(rate_hz), samples.astype("<f4").tobytes()
    header = struct.pack("<HHIIHHH", _FLOAT, 1, rate, 4 * rate, 4, 32, 0)
    fact = struct.pack("<I", len(samples))
    chunks = ((b"fmt ", header), (b"fact", fact), (b"data", data))
    body = b"".join(name + struct.pack("<I", len(content)) + content for name, content in chunks)
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WAVE" + body


def _require_complete(path: Path, file: BinaryIO) -> None:
    """Refuse files that are not WAV, and files shorter than their header claims."""
    kind, _, form = struct.unpack("<4sI4s", file.read(12).ljust(12, b"\0"))
    if kind not in {b"RIFF", b"RIFX", _RF64} or form != b"WAVE":
        raise DataError(f"{path} is not a WAV file: it begins with {kind!r}; give WAV, or HDF5 of Acoular (.h5)")
    order = ">" if kind == b"RIFX" else "<"
    wide = frame_bytes = 0
    for name, size, there in _chunks(file, order):
        if name == b"ds64":
            wide = struct.unpack("<8xQ", file.read(16).ljust(16, b"\0"))[0]
        if name == b"fmt ":
            n_channels, frame_bytes = struct.unpack(f"{order}2xH8xH", file.read(14).ljust(14, b"\0"))
            if not n_channels:
                raise DataError(f"{path} cannot be read (it has 0 channels); save it again as WAV")
        if name == b"data" and there:
            stated = wide if kind == _RF64 and size in _UNFINISHED_SIZES else size
            _require_samples(path, stated, there, frame_bytes)
            return
    raise DataError(f"{path} has no samples; save it again as WAV")


def _chunks(file: BinaryIO, order: str) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, size and available bytes of each chunk, with the file positioned at its content."""
    n_bytes = file.seek(0, 2)
    place = 12
    while place + 8 <= n_bytes:
        file.seek(place)
        name, size = struct.unpack(f"{order}4sI", file.read(8))
        yield name, size, n_bytes - place - 8
        place += 8 + size + size % 2


def _require_samples(path: Path, size: int, there: int, frame_bytes: int) -> None:
    """Refuse samples of ``size`` bytes if the header is unfinished or only fewer bytes are ``there``."""
    if size in _UNFINISHED_SIZES:
        raise DataError(
            f"{path} has an unfinished header, such as that of an interrupted recording; save it again with a program "
            "that ignores the lengths in the header"
        )
    if size > there:
        raise DataError(
            f"{path} is truncated: it has {there} bytes of samples, but its header claims {size}; copy it again"
        )
    if frame_bytes and size % frame_bytes:
        raise DataError(
            f"{path} has {size} bytes of samples, not a multiple of its frame size, {frame_bytes} bytes; copy it again "
            "or save it again as WAV"
        )
