"""Tables of numbers in CSV files, and arrays in NPY files."""

import tokenize
from pathlib import Path
from typing import IO, Any

import numpy as np

from ertis_numba.base.errors import ArgumentError

__all__ = ["csv_rows", "npy_content"]


def csv_rows(source: str, text: str) -> list[list[float]]:
    """Return rows of comma-separated numbers, which may be empty; ``source`` is their name in errors, # a comment."""
    rows = (line.split("#", 1)[0].strip() for line in text.splitlines())
    try:
        return [[float(cell) for cell in row.split(",")] for row in rows if row]
    except ValueError as error:
        raise ArgumentError(
            f"{source}: {error}; pass rows of numbers separated by commas, and comments after #"
        ) from error


def npy_content(file: Path | IO[bytes]) -> Any:
    """Return the content of an NPY or NPZ file, as ``numpy.load`` does; raise OSError, or ValueError for all damage."""
    try:
        return np.load(file, allow_pickle=False)
    except (EOFError, SyntaxError, tokenize.TokenError) as error:
        raise ValueError("it is empty, or its header is damaged") from error
