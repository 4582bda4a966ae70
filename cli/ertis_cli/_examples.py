"""Scenes, recordings and scripts that the package ships: their names, descriptions and contents."""

import ast
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import PurePath
from typing import Final

from ertis_cli._config import instead

__all__ = ["description", "examples", "named"]

_FOLDERS: Final = (("ertis_examples", ()), ("ertis_examples.synthetic", ()), ("ertis_examples.synthetic", ("scenes",)))
"""Packages, and folders in them, with files to copy."""

_SUFFIXES: Final = {".toml", ".h5", ".py"}
_TOOLS: Final = {"__init__.py", "build.py", "gallery.py"}
"""Files of these packages that are not examples."""


def examples() -> dict[str, Traversable]:
    """Return the files by their names, in alphabetical order."""
    found = {}
    for package, parts in _FOLDERS:
        for item in resources.files(package).joinpath(*parts).iterdir():
            if PurePath(item.name).suffix in _SUFFIXES and item.name not in _TOOLS:
                found[item.name] = item
    return dict(sorted(found.items()))


def named(name: str) -> dict[str, Traversable]:
    """Return the file of a name, or without a suffix all files of that name.

    Raises
    ------
    ArgumentError
        No example has this name.
    """
    from ertis_numba.errors import ArgumentError

    every = examples()
    found = {file: item for file, item in every.items() if name in {file, PurePath(file).stem}}
    if not found:
        raise ArgumentError(
            f"example {name!r} does not exist; {instead(name, {PurePath(file).stem for file in every})}"
        )
    return found


def description(name: str, item: Traversable) -> str:
    """Return the first sentence of a file's own description."""
    suffix = PurePath(name).suffix
    if suffix == ".h5":
        return f"Recording simulated from {PurePath(name).stem}.toml."
    text = item.read_text("utf-8")
    if suffix == ".py":
        text = ast.get_docstring(ast.parse(text)) or ""
    else:
        lines = text.splitlines()
        count = next((place for place, line in enumerate(lines) if not line.startswith("#")), len(lines))
        text = " ".join(line.removeprefix("#").strip() for line in lines[:count])
    return f"{' '.join(text.split()).partition('. ')[0].rstrip('.')}."
