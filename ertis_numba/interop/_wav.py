"""WAV files of many channels: what they say of themselves, and their numbers."""

import struct
import warnings
from pathlib import Path
from typing import Any, BinaryIO

from numpy.typing import NDArray

from ertis_numba.errors import DataError

__all__ = ["read_wav"]

_OPEN_END = {0, 2**32 - 1}  # sizes that programs write who do not know yet how long it will be
_WIDE = {b"RF64", b"BW64"}  # whose sizes are in a chunk of their own


def read_wav(path: Path) -> tuple[float, NDArray[Any]]:
    """Return the rate in hertz and the numbers, (sample, channel), which stay on the disk where they can.

    Raises
    ------
    DataError
        The file is no WAV, is cut short, or its header was never finished.
    """
    with path.open("rb") as file:
        _require_whole(path, file)
    from scipy.io import wavfile  # noqa: PLC0415  takes long to import, and few need it

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wavfile.WavFileWarning)  # of chunks that hold no samples
        try:
            try:
                rate_hz, numbers = wavfile.read(path, mmap=True)
            except ValueError:  # 24 bits are no number of the processor's, and have to be copied
                rate_hz, numbers = wavfile.read(path)
        except Exception as error:  # what a reader makes of a strange header may be anything
            raise DataError(f"{path} cannot be read ({error}); save it again as WAV") from error
    if not rate_hz or not numbers.size:
        raise DataError(f"{path} has {rate_hz} Hz and {numbers.size} numbers; save it again as WAV")
    return float(rate_hz), numbers if numbers.ndim > 1 else numbers[:, None]


def _require_whole(path: Path, file: BinaryIO) -> None:
    """Refuse what is no WAV, and a file that holds less than its header says."""
    kind, size, form = struct.unpack("<4sI4s", file.read(12).ljust(12, b"\0"))
    if kind not in {b"RIFF", b"RIFX", *_WIDE} or form != b"WAVE":
        raise DataError(f"{path} is no WAV file, it begins with {kind!r}; give WAV, or HDF5 of Acoular (.h5)")
    order = ">" if kind == b"RIFX" else "<"
    wide = 0
    n_bytes = file.seek(0, 2)
    place = 12
    while place + 8 <= n_bytes:
        file.seek(place)
        name, size = struct.unpack(f"{order}4sI", file.read(8))
        if name == b"ds64":
            wide = struct.unpack("<8xQ", file.read(16).ljust(16, b"\0"))[0]
        if name == b"data":
            size = wide if kind in _WIDE and size in _OPEN_END else size
            there = n_bytes - place - 8
            if size in _OPEN_END:
                raise DataError(
                    f"{path} has a header that was never finished, as of a recording that was cut off; "
                    "let a program that ignores its lengths save it again"
                )
            if size > there:
                raise DataError(
                    f"{path} is cut short: it has {there} bytes of samples, its header says {size}; copy it again"
                )
            return
        place += 8 + size + size % 2
    raise DataError(f"{path} has no samples; save it again as WAV")
