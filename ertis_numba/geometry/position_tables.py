"""Microphone positions in text tables with any usual separators, header and unit."""

import csv
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry.position_headings import AXES, ColumnHeading, heading, unit_in_comment, unit_named
from ertis_numba.settings import LENGTH_UNITS_M

__all__ = ["HEADER_EXAMPLES", "PositionTable", "read_position_table", "require_no_count"]

HEADER_EXAMPLES: Final = "x_m,y_m,z_m or y_mm,z_mm"
_DECIMAL_COMMA: Final = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_SEPARATE_NUMBERS: Final = re.compile(r"\d[ \t]+[-+.\d]")
_ORDINALS: Final = ("first", "second", "third", "fourth")
_MIN_COUNTED: Final = 3  # Fewer rows can have positions of 0 and 1 by chance.

_Rows = Sequence[tuple[int, list[str]]]
"""Number and cells of each line."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionTable:
    """Positions (channel, axis) in the unit that a file states, empty for none; x is 0 if the file has none."""

    positions: NDArray[np.float64]
    unit: str
    notes: tuple[str, ...] = ()


def read_position_table(source: str, text: str) -> PositionTable:
    """Return the positions in a table with one row per channel, in the order of the bits."""
    # Without a header or comment with names, columns are `y, z` or `x, y, z` after names or numbers.
    lines, comments = _without_comments(text)
    rows = list(_cells(lines))
    header = _header(rows)
    if header is not None:
        rows = rows[1:]
        if rows and _are_units(rows[0][1], len(header)):
            header = [f"{name} {unit}" for name, unit in zip(header, rows[0][1], strict=True)]
            rows = rows[1:]
    if not rows:
        raise ArgumentError(f"{source}: no positions; write one row per channel, y, z or x, y, z")
    _require_widths(source, rows)
    headings = _headings(source, header, comments, rows)
    places = _places(source, headings)
    positions = np.zeros((len(rows), len(AXES)))
    for axis, place in places.items():
        positions[:, AXES.index(axis)] = [_number(source, line, axis, cells[place]) for line, cells in rows]
    unread = []
    for place, column in enumerate(headings):
        labels = [(line, float(cells[place])) for line, cells in rows if _is_number(cells[place])]
        if place not in places.values() and labels:
            if column.is_label and len(labels) == len(rows):
                _require_order(source, column, labels)
            elif not column.is_label:
                unread.append(column.text)
    unit = next((headings[place].unit for place in places.values() if headings[place].unit), "")
    notes = (f"these columns were ignored: {', '.join(unread)}",) if unread else ()
    return PositionTable(positions, unit or unit_in_comment("\n".join(comments)), notes)


def _without_comments(text: str) -> tuple[list[tuple[int, str]], list[str]]:
    """Return the lines with content and their numbers, and the comments above the first of them."""
    lines: list[tuple[int, str]] = []
    comments: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        content, *comment = re.split(r"#+|%+|//+", line, maxsplit=1)
        if content.strip():
            if lines or not content.lower().startswith("sep="):  # as spreadsheets name the separator
                lines.append((number, content))
        elif not lines:
            comments.append("".join(comment).strip())
    return lines, comments


def _cells(lines: Sequence[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the cells of each line, with decimal points; empty cells at its end are left out."""
    delimiter = _delimiter([line for _, line in lines])
    for number, line in lines:
        (cells,) = csv.reader([_spaced(line) if delimiter == " " else line], delimiter=delimiter, skipinitialspace=True)
        cells = [cell.strip().replace("\N{MINUS SIGN}", "-") for cell in cells]
        if delimiter != ",":
            cells = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
        while len(cells) > 1 and not cells[-1]:
            cells.pop()
        yield number, cells


def _delimiter(lines: Sequence[str]) -> str:
    """Return the character that separates cells."""
    if any(";" in line for line in lines):
        return ";"
    commas_are_decimal = all(
        "," not in cell or _DECIMAL_COMMA.fullmatch(cell) for line in lines for cell in line.split()
    )
    if any("\t" in line.strip() for line in lines) and commas_are_decimal:
        return "\t"
    by_space = commas_are_decimal and any(_SEPARATE_NUMBERS.search(line) for line in lines)
    return "," if any("," in line for line in lines) and not by_space else " "


def _spaced(line: str) -> str:
    """Return a line with single spaces between cells, and none before the unit of a heading in brackets."""
    return re.sub(r"\s+", " ", re.sub(r"\s+(?=[\[(])", "", line.strip()))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _header(rows: _Rows) -> list[str] | None:
    """Return the cells of the header; None if the first row contains positions."""
    if not rows:
        return None
    first = rows[0][1]
    if not first[0] and first[1:] == _counted(len(first) - 1):  # as pandas numbers columns without names
        return [""] * len(first)
    is_header = not any(map(_is_number, first)) or any(heading(cell).axis for cell in first)
    return first if is_header else None


def _are_units(cells: Sequence[str], width: int) -> bool:
    """Return True for a row of units below the header."""
    return len(cells) == width and any(map(unit_named, cells)) and not any(map(_is_number, cells))


def _counted(count: int, start: int = 0) -> list[str]:
    return [str(number) for number in range(start, start + count)]


def _require_widths(source: str, rows: _Rows) -> None:
    first, width = rows[0][0], len(rows[0][1])
    for line, cells in rows:
        if len(cells) != width:
            raise ArgumentError(
                f"{source}, line {line} has {len(cells)} cells, but line {first} has {width}; write the same cells in "
                "every row"
            )


def _headings(source: str, header: list[str] | None, comments: Sequence[str], rows: _Rows) -> list[ColumnHeading]:
    """Return the headings: those of the header, those in a comment above the positions, or the usual ones."""
    width = len(rows[0][1])
    if header is None or not any(header):
        return _in_comments(comments, width) or _usual(source, rows, has_index=header is not None)
    if len(header) == width - 1:  # R leaves out the heading of row names.
        header = ["", *header]
    headings = [heading(name) for name in header]
    if not any(each.axis for each in headings):
        raise ArgumentError(
            f"{source}: the header ({', '.join(header):.60}) names no column x, y or z; name the columns, as in "
            f"{HEADER_EXAMPLES}"
        )
    if len(header) > width and not any(each.axis for each in headings[width:]):
        return headings[:width]
    if len(header) != width:
        raise ArgumentError(
            f"{source}, line {rows[0][0]} has {width} cells, but the header has {len(header)}; write one cell for each "
            "column"
        )
    return headings


def _in_comments(comments: Sequence[str], width: int) -> list[ColumnHeading]:
    """Return the headings in the last comment that has one for each column; none if there is no such comment."""
    for comment in reversed(comments):
        for cells in (re.split(r"[,;\t]", comment), _spaced(comment).split(" ")):
            headings = [heading(cell.strip()) for cell in cells]
            known = all(each.axis or each.is_label for each in headings)
            if len(headings) == width and known and any(each.axis for each in headings):
                return headings
    return []


def _usual(source: str, rows: _Rows, *, has_index: bool) -> list[ColumnHeading]:
    """Return the headings of a table without a header: names or numbers of the channels, then y, z or x, y, z."""
    width, first = len(rows[0][1]), [cells[0] for _, cells in rows]
    has_labels = has_index or not any(map(_is_number, first)) or (width == len(AXES) + 1 and _counts(first))
    n_axes = width - has_labels
    if n_axes not in {2, 3}:
        raise ArgumentError(
            f"{source}, line {rows[0][0]} has {width} cells; write rows of y, z or x, y, z, or add a header, such as "
            f"{HEADER_EXAMPLES}"
        )
    if rows[0][1] == _counted(width) and all("." in cell for _, cells in rows[1:] for cell in cells) and rows[1:]:
        raise ArgumentError(
            f"{source}, line {rows[0][0]}: {', '.join(rows[0][1])} may be column numbers or a position; replace the "
            f"line by a header, such as {HEADER_EXAMPLES}, or write the position with decimal points"
        )
    columns = list(zip(*(cells for _, cells in rows), strict=True))[has_labels:]
    if all(_is_number(cell) and math.isfinite(float(cell)) for column in columns for cell in column):
        for place, (column, axis) in enumerate(zip(columns, AXES[-n_axes:], strict=True), int(has_labels)):
            require_no_count(source, column, place, axis)
    return [ColumnHeading()] * has_labels + [ColumnHeading(axis, axis) for axis in AXES[-n_axes:]]


def require_no_count(source: str, column: Sequence[str], place: int, axis: str) -> None:
    """Refuse a column of a table without a header that may number the channels."""
    if len(column) >= _MIN_COUNTED and _counts(column):
        raise ArgumentError(
            f"{source}: the {_ORDINALS[place]} column may be channel numbers or positions along {axis}; "
            f"{'save a .csv file with' if source.endswith('.npy') else 'add'} the header channel,y_mm,z_mm or "
            "x_mm,y_mm,z_mm"
        )


def _counts(column: Sequence[str]) -> bool:
    """Return True for the numbers from 0 or 1 on, one per row, also with decimals."""
    numbers = [float(cell) if _is_number(cell) else math.nan for cell in column]
    return numbers[0] in {0.0, 1.0} and numbers == [numbers[0] + row for row in range(len(numbers))]


def _places(source: str, headings: Sequence[ColumnHeading]) -> dict[str, int]:
    """Return the column of each axis."""
    places: dict[str, int] = {}
    for place, column in enumerate(headings):
        if column.axis and places.setdefault(column.axis, place) != place:
            raise ArgumentError(f"{source}: two columns are named {column.axis}; rename or remove one of them")
        if column.unit and column.unit not in LENGTH_UNITS_M:
            raise ArgumentError(
                f"{source}: column {column.text!r} has the unit {column.unit}; use {', '.join(LENGTH_UNITS_M)}"
            )
    if {*places} not in ({"y", "z"}, {"x", "y", "z"}):
        raise ArgumentError(
            f"{source}: the header names only {' and '.join(sorted(places))}, but x is forward, y left and z up; name "
            "the columns of a flat array y and z, or add the missing column"
        )
    units = {headings[place].unit for place in places.values()} - {""}
    if len(units) > 1:
        raise ArgumentError(f"{source}: the columns have the units {', '.join(sorted(units))}; use only one unit")
    return places


def _require_order(source: str, column: ColumnHeading, labels: Sequence[tuple[int, float]]) -> None:
    """Refuse rows that are not in the order of their numbers, or that leave out a channel."""
    for (_, before), (line, number) in itertools.pairwise(labels):
        if number <= before or (column.numbers_channels and number != before + 1):
            raise ArgumentError(
                f"{source}, line {line}: {column.text or 'row'} {number:g} follows {before:g}; sort the rows by "
                "channel, and add missing channels"
            )


def _number(source: str, line: int, axis: str, cell: str) -> float:
    """Return the number in a cell."""
    if not _is_number(cell):
        raise ArgumentError(f"{source}, line {line}: {axis} is {cell!r:.40}; use a number")
    if not np.isfinite(float(cell)):
        raise ArgumentError(f"{source}, line {line}: {axis} is {cell}; use a finite number")
    return float(cell)
