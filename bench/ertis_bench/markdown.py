"""Markdown tables, and the places for them in pages."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["around", "or_dash", "place", "table", "update"]


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = True) -> str:
    """Return a table whose first column contains text.

    The other columns contain numbers, or text if ``numbers`` is False.
    """
    rule = ["---", *["---:" if numbers else "---"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *rows))


def or_dash(value: float | None, digits: int) -> str:
    """Return a number with this many decimals, or a dash for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def update(path: Path, marker: str, text: str) -> None:
    """Replace the text between ``<!-- MARKER -->`` and ``<!-- /MARKER -->`` in a file."""
    head, tail = around(path, marker)
    path.write_text(f"{head}\n{text.strip()}\n{tail}", encoding="utf-8")


def around(path: Path, marker: str) -> tuple[str, str]:
    """Return a file's text up to the end of the first marker, and from the second marker on."""
    begin, end = f"<!-- {marker} -->", f"<!-- /{marker} -->"
    try:
        content = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ArgumentError(f"{path}: {checks.reason_unreadable(error)}; choose a readable Markdown file") from error
    head, found, rest = content.partition(begin)
    _, closed, tail = rest.partition(end)
    if not (found and closed):
        raise ArgumentError(f"{path} has no place for this table; choose a file with the lines {begin} and {end}")
    return head + begin, end + tail


def place(path: Path, program: str, forms: Iterable[str], parts: Sequence[str] = ()) -> tuple[str, str]:
    """Return the form of a table for which a file has markers, and the marker: program, form and parts.

    Selected parts of a benchmark have their own markers, ``PROGRAM FORM --only PART``, so that they never replace the
    table of all parts.
    """
    markers = {form: " ".join([program, form, *(f"--only {part}" for part in parts)]) for form in forms}
    first, *others = markers
    for form in others:
        with suppress(ArgumentError):
            around(path, markers[form])
            return form, markers[form]
    around(path, markers[first])
    return first, markers[first]
