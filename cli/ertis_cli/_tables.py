"""Tables, drawn on a terminal and printed as plain text elsewhere."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import click

from ertis_cli import _progress

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.table import Table as Drawn

__all__ = ["Side", "TextTable"]

Side = Literal["left", "right"]

_GAP = 2  # spaces between columns
_FOLDED = 16  # minimum width of a text column in a narrow terminal


@dataclass(frozen=True, slots=True)
class TextTable:
    """Rows of cells under headings, which rich can draw."""

    columns: Mapping[str, Side]  # headings, with the alignment of their cells
    rows: Sequence[Sequence[str]]
    styles: Mapping[str, str] = field(default_factory=dict)  # of cells by their text, as in {"failed": "red"}

    def print(self, *, err: bool = False) -> None:
        """Print the table, drawn on a terminal and as plain text elsewhere."""
        stream = sys.stderr if err else sys.stdout
        if not _progress.is_drawn_on(stream):
            for line in self.lines():
                click.echo(line, err=err)
            return
        from rich.console import Console

        console = Console(file=stream)
        # If the numbers alone are too wide, let the terminal wrap lines instead of cells.
        places = range(len(self.columns))
        console.width = max(console.width, sum(map(self._smallest, places)) + _GAP * (len(places) - 1))
        console.print(self)

    def lines(self) -> Iterator[str]:
        """Yield the lines of an aligned table of any width, which programs can read as well."""
        widths = [max(map(len, cells)) for cells in self._cells()]
        for row in (tuple(self.columns), *self.rows):
            cells = zip(row, widths, self.columns.values(), strict=True)
            aligned = (cell.rjust(width) if side == "right" else cell.ljust(width) for cell, width, side in cells)
            yield (" " * _GAP).join(aligned).rstrip()

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "Iterator[Drawn]":
        from rich.table import Table as Drawn
        from rich.text import Text

        widths = [max(map(len, cells)) for cells in self._cells()]
        is_tight = sum(widths) + _GAP * (len(widths) - 1) > options.max_width
        drawn = Drawn(box=None, pad_edge=False, header_style="bold")
        for place, (heading, side) in enumerate(self.columns.items()):
            # Text is folded and headings wrap between words, but numbers stay whole.
            width = self._smallest(place) if is_tight and side == "right" else None
            name = " ".join(_words(heading)) if is_tight else heading
            drawn.add_column(name, justify=side, overflow="fold", width=width)
        for row in self.rows:
            drawn.add_row(*(Text(cell, self.styles.get(cell, "")) for cell in row))
        yield drawn

    def _cells(self) -> list[tuple[str, ...]]:
        """Return the cells of each column, starting with its heading."""
        return list(zip(tuple(self.columns), *self.rows, strict=True))

    def _smallest(self, place: int) -> int:
        """Return the minimum width of a column."""
        heading, *cells = self._cells()[place]
        widest = max(map(len, (*_words(heading), *cells)), default=0)
        return widest if list(self.columns.values())[place] == "right" else min(widest, _FOLDED)


def _words(heading: str) -> list[str]:
    return heading.replace("_", " ").split()
