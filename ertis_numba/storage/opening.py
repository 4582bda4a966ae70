"""Opening of HDF5 files, and errors that name their cause."""

import errno
import glob
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import BinaryIO, Final, TypeAlias

import h5py

from ertis_numba.base.errors import ArgumentError, DamagedError, DataError, SettingsError
from ertis_numba.base.file_kinds import HDF5_PLACES, HDF5_SIGNATURE, problem_of, quoted

__all__ = ["RESULT_OR_RECORDING", "Source", "open_binary", "open_file", "reading"]

Source: TypeAlias = str | PathLike[str] | BinaryIO
RESULT_OR_RECORDING: Final = "a recording, an energyscape file or a file of acoustic maps"
# Errors of h5py for damaged files, and for types and values that this package does not expect.
_DAMAGED = (OSError, RuntimeError, LookupError)
_UNEXPECTED = (AttributeError, TypeError, ValueError)
_SYSTEM_ERROR = re.compile(r"errno = (\d+), error message = '(.*?)'")  # Part of HDF5's own message.
# Other errors may result from damaged addresses.
_TRANSIENT_ERRNOS = (errno.EIO, errno.ENXIO, errno.ENODEV, errno.ENOMEM, errno.ETIMEDOUT)
_STORED_END = re.compile(r"stored_eof = (\d+)")
_FLAGS, _IS_OPEN = 11, 1  # byte of the superblock, and its bit for a file that is open for writing


@contextmanager
def reading(file: h5py.File, path: Path) -> Iterator[None]:
    """Name the file in errors, and report errors of h5py as damage."""
    try:
        yield
    except DataError as error:
        named = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
        raise type(error)(named) from error
    except SettingsError as error:
        raise DataError(str(error)) from error
    except ArgumentError:
        raise
    except _DAMAGED as error:
        if not file:
            raise DataError(f"{path} is closed; open it again") from error
        if isinstance(error, OSError) and error.errno is not None:  # raised by a file object, not by HDF5
            raise DataError(f"{path} cannot be read ({error.strerror or error}); check its connection") from error
        reported = _SYSTEM_ERROR.search(str(error))
        if reported and int(reported[1]) in _TRANSIENT_ERRNOS:
            raise DataError(f"{path} cannot be read ({reported[2]}); check the disk") from error
        raise DamagedError(f"{path} is damaged or cut short ({_reason(error)}); copy it again") from error
    except _UNEXPECTED as error:
        if not file:
            raise DataError(f"{path} is closed; open it again") from error
        raise DamagedError(
            f"{path} has content that this version cannot read ({_reason(error)}); copy it again, or undo the changes "
            "of another program"
        ) from error


def _n_bytes(path: Path, wanted: str) -> int:
    """Return the size of a file that can be read at any place."""
    try:
        with path.open("rb") as file:
            return file.seek(0, 2)
    except io.UnsupportedOperation as error:
        raise DataError(f"{path} is a pipe; write its content to a file, and use that file") from error
    except PermissionError as error:
        raise DataError(f"{path}: {error.strerror}; ask its owner for permission to read it") from error
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}; choose {wanted}{_such_as(path)}") from error


def _such_as(pattern: Path) -> str:
    """Return the first file that matches a pattern, as an example."""
    matching = sorted(glob.glob(str(pattern))) if glob.has_magic(str(pattern)) else ()  # noqa: PTH207
    return f", such as {matching[0]}" if matching else ""


def open_file(path: Path, wanted: str = RESULT_OR_RECORDING) -> h5py.File:
    """Open an HDF5 file for reading; errors name the kind of file that is wanted."""
    if path.is_dir():
        raise DataError(f"{path} is a folder; choose {wanted}{_such_as(path / '*.h5')}")
    n_bytes = _n_bytes(path, wanted)
    if n_bytes == 0:
        raise DataError(f"{path} is empty; choose {wanted}")
    if not h5py.is_hdf5(path):
        found = problem_of(path, wanted)
        if found:
            raise DataError(f"{path} {found}")
        remedy = f"choose {wanted}" + ", or import raw words first" * ("recording" in wanted)
        raise DataError(f"{path} is not an HDF5 file; {remedy}")
    try:
        return h5py.File(path, "r")
    except BlockingIOError as error:
        raise DataError(f"{path} is open for writing in another program; close it there first") from error
    except OSError as error:
        if _is_left_open(path):
            raise DataError(
                f"{path} was not closed: its writer was killed, or still has it open; close it there, or if no "
                f"program uses it, run 'h5clear -s {quoted(path)}' (part of the HDF5 tools: package "
                "hdf5-tools, hdf5 in conda and Homebrew)"
            ) from error
        stored = _STORED_END.search(str(error))
        amount = f" of {stored[1]}" if stored else ""
        raise DataError(f"{path} is cut short or damaged: it has {n_bytes}{amount} bytes; copy it again") from error


def open_binary(file: BinaryIO, path: Path, wanted: str) -> h5py.File:
    """Open an HDF5 file through a binary file object, such as one of fsspec; ``path`` names it in errors."""
    if not hasattr(file, "seekable"):
        raise ArgumentError(f"path is {type(file).__name__}; pass a path or a binary file object")
    if file.closed:
        raise DataError(f"{path} is closed; open it again")
    if not (file.seekable() and file.readable() and isinstance(file.read(0), bytes)):
        raise DataError(f"{path} is not a binary file that can be read at any place; open a seekable one, mode 'rb'")
    try:
        return h5py.File(file, "r")
    except OSError as error:
        if error.errno is not None:
            raise DataError(f"{path} cannot be read ({error.strerror or error}); check its connection") from error
        raise DataError(f"{path} is not {wanted}, or is cut short ({_reason(error)}); copy it again") from error


def _is_left_open(path: Path) -> bool:
    """Return True if the superblock of a file marks it as open for writing."""
    with path.open("rb") as file:
        for start in HDF5_PLACES:
            file.seek(start)
            block = file.read(_FLAGS + 1)
            if block.startswith(HDF5_SIGNATURE) and len(block) > _FLAGS:
                return block[len(HDF5_SIGNATURE)] >= 3 and bool(block[_FLAGS] & _IS_OPEN)
    return False


def _reason(error: BaseException) -> str:
    text = str(error.args[0]) if error.args else ""  # str() of a KeyError adds quotes.
    return text.partition("\n")[0] or type(error).__name__
