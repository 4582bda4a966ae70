"""Checks of arguments, whose errors name the argument, its value and the accepted values."""

import difflib
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError

__all__ = [
    "between",
    "choice",
    "file_ending",
    "finite",
    "finite_array",
    "instance",
    "integer",
    "interval",
    "items",
    "length",
    "positive",
    "reason_unreadable",
    "scheduler",
    "sensor_name",
    "shape",
    "unknown_choice",
]

_ItemType = TypeVar("_ItemType")
_SENSOR_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]{0,254}")


def finite(name: str, value: float) -> float:
    """Return ``value`` as a float; refuse NaN, infinities and values that are no numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ArgumentError(f"{name} is {value!r}; use a number")
    try:
        number = float(value)
    except OverflowError:  # an integer with hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise ArgumentError(f"{name} is {number}; use a finite number")
    return number


def positive(name: str, value: float) -> float:
    """Return ``value`` if it is finite and above zero."""
    if finite(name, value) <= 0:
        raise ArgumentError(f"{name} is {value:g}; use a number above 0")
    return float(value)


def between(name: str, value: float, low: float, high: float) -> float:
    """Return ``value`` if it lies in ``[low, high]``."""
    if not low <= finite(name, value) <= high:
        raise ArgumentError(f"{name} is {value:g}; use a number from {low:g} to {high:g}")
    return float(value)


def interval(name: str, value: tuple[float, float], low: float, high: float) -> None:
    """Refuse an interval that is not ``low <= first <= last <= high``."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise ArgumentError(f"{name} is {value!r:.80}; use two numbers, the smaller one first")
    first, last = (between(name, edge, low, high) for edge in value)
    if first > last:
        raise ArgumentError(f"{name} runs from {first:g} to {last:g}; use the smaller number first")


def integer(name: str, value: int, low: int, high: int | None = None) -> int:
    """Return ``value`` if it is a whole number in ``[low, high]``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ArgumentError(f"{name} is {value!r}; use a whole number")
    if value < low or (high is not None and value > high):
        wanted = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise ArgumentError(f"{name} is {value}; use a whole number {wanted}")
    return int(value)


def scheduler(name: str, value: str) -> str:
    """Check the address of a dask scheduler."""
    if "://" not in value:
        raise ArgumentError(
            f"{name} is {value!r}; pass a number of processes, or the address of a dask scheduler, as in "
            "'tcp://127.0.0.1:8786'"
        )
    return value


def length(name: str, value: str, largest: int) -> None:
    """Refuse a text of more than ``largest`` characters."""
    if len(value) > largest:
        raise ArgumentError(f"{name} has {len(value)} characters; the limit is {largest}")


def choice(name: str, value: object, known: Iterable[object]) -> None:
    """Refuse a ``value`` that is not among ``known``; the error names the most similar one."""
    names = [str(item) for item in known]
    if str(value) not in names:
        raise ArgumentError(unknown_choice(name, str(value), names))


def unknown_choice(name: str, value: str, known: Sequence[str]) -> str:
    """Return the message of an error about a ``value`` that is not among ``known``; it names the most similar one."""
    near = difflib.get_close_matches(value, known, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return f"{name} {value!r} is unknown{hint}; known are {', '.join(known)}"


def file_ending(name: str, path: str | Path, known: Iterable[str]) -> str:
    """Return the ending of an output file in lower case; refuse folders, and an ending that is not among ``known``."""
    path, known = Path(path), [*dict.fromkeys(known)]
    ending = path.suffix.lower()
    if path.is_dir():
        raise ArgumentError(f"{name} {path} is a folder; name a file in it that ends in {', '.join(known)}")
    if ending not in known:
        found = f"ends in {ending!r}" if ending else "has no ending"
        raise ArgumentError(f"{name} {path} {found}; choose a name that ends in {', '.join(known)}")
    return ending


def finite_array(name: str, values: NDArray[np.floating]) -> None:
    """Refuse an array that contains NaN or infinities; the error names the first index."""
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        place = ", ".join(str(i) for i in bad[0])
        raise ArgumentError(f"{name} holds {values[tuple(bad[0])]} at [{place}]; pass finite numbers")


def shape(name: str, actual: tuple[int, ...], wanted: tuple[int, ...]) -> None:
    """Refuse an array whose shape is not ``wanted``."""
    if actual != wanted:
        raise ArgumentError(f"{name} has shape {actual}; pass shape {wanted}")


def instance(name: str, value: object, wanted: type, source: str) -> None:
    """Refuse a value of another type; ``source`` names its origin, such as "Pipeline.process returns"."""
    if not isinstance(value, wanted):
        raise ArgumentError(
            f"{name} is of type {type(value).__name__}; pass {_article(wanted.__name__)}, which {source}"
        )


def _article(noun: str) -> str:
    return f"{'an' if noun[0] in 'AEIOU' else 'a'} {noun}"


def items(name: str, values: Iterable[_ItemType], wanted: type, source: str) -> Iterator[_ItemType]:
    """Yield values and refuse those of another type; refuse an argument that is no iterable."""
    if not isinstance(values, Iterable):
        raise ArgumentError(f"{name} is of type {type(values).__name__}; pass a list of {wanted.__name__}")
    for index, value in enumerate(values):
        instance(f"{name}[{index}]", value, wanted, source)
        yield value


def sensor_name(name: str) -> str:
    """Return the name of a sensor if files can have a group of this name."""
    if not _SENSOR_NAME.fullmatch(name):
        raise ArgumentError(
            f"sensor name {name[:80]!r} cannot name a group in a file; use letters, digits and _, after the first "
            "also . @ + -; at most 255 characters"
        )
    return name


def reason_unreadable(error: OSError | UnicodeDecodeError) -> str:
    """Return why a text file cannot be read, in words."""
    if isinstance(error, UnicodeDecodeError):
        wrong = f"byte {error.object[error.start]:#04x} at position {error.start}"
        return f"it is not text in {error.encoding.upper()} ({wrong})"
    return error.strerror or str(error)
