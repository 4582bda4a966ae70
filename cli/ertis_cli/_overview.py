"""One line for each of several files, for ``ertis info``."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from ertis_cli import _output, _tables, options
from ertis_cli._naming import with_options

__all__ = ["files_of", "overview"]

_Sections = tuple[dict[str, Any], Sequence[dict[str, Any]]]
_COUNTS = ("maps", "measurements", "pulses")


def files_of(paths: Iterable[Path]) -> Iterator[Path]:
    """Yield the given files, and the HDF5 files below the given folders, in natural order."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.interop.pcm_files import natural_order

    for path in paths:
        if not path.is_dir():
            yield path
            continue
        names = sorted((str(each) for each in path.rglob("*.h5") if each.is_file()), key=natural_order)
        if not names:
            raise DataError(f"{path}: no file in this folder ends in .h5; choose a folder with recordings or results")
        _output.escape_names(names)
        yield from map(Path, names)


def overview(paths: Iterable[Path], read: Callable[[Path], _Sections], *, as_json: bool) -> int:
    """Print a line for each file, and the errors of files that cannot be read; return the exit code."""
    from ertis_numba.base.errors import ErtisError

    reported: list[dict[str, Any]] = []
    for path in paths:
        try:
            about, sections = read(path)
        except (ErtisError, OSError) as error:
            click.echo(f"ertis: error: {with_options(str(error))}", err=True)
            reported.append({"file": str(path), "error": with_options(str(error))})
        else:
            reported.append({**about, "sensors": list(sections)})
    if as_json:
        options.print_json({"files": reported})
    else:
        columns: dict[str, _tables.Side] = {"file": "left", "kind": "left", "sensors": "left", "content": "left"}
        columns |= {"first": "left", "last": "left", "MB": "right"}
        rows = [_row(each) for each in reported if "error" not in each]
        if rows:
            _tables.TextTable(columns, rows).print()
    return int(any("error" in each for each in reported))


def _row(report: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells of a file."""
    sections = report["sensors"] or [report]
    names = [section["sensor"] for section in report["sensors"]]
    unit = next((unit for unit in _COUNTS if unit in sections[0]), "")
    count = options.counted(sum(section.get(unit, 0) for section in sections), unit.removesuffix("s")) if unit else ""
    first, last = ([section[end] for section in sections if section.get(end)] for end in ("first", "last"))
    return (
        report["file"],
        report["kind"],
        " ".join(names),
        count,
        _second(min(first, default="")),
        _second(max(last, default="")),
        f"{report['bytes'] / 1e6:.1f}",
    )


def _second(time: str) -> str:
    """Return a time in ISO format as date and time in UTC to the second."""
    return time[:19].replace("T", " ")
