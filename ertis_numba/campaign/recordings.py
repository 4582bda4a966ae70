"""Which recordings there are, and what they are to become."""

import glob
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ertis_numba.errors import ArgumentError, DataError

__all__ = ["SUFFIX", "Found", "find", "outputs"]

SUFFIX = ".energy.h5"
"""Of the energyscape file of a recording."""


@dataclass(frozen=True, slots=True)
class Found:
    """A file that is to be processed.

    Attributes
    ----------
    path : Path
    named : bool
        Whether somebody named it; what a pattern or a folder brought along may be an energyscape file, which is passed
        over.
    """

    path: Path
    named: bool = True


def find(given: Iterable[str | Path]) -> list[Found]:
    """Return the files that are meant, each once, in the order given.

    Parameters
    ----------
    given : iterable of str or Path
        Files, folders, which stand for the ``*.h5`` in them, and patterns, where ``**`` stands for any folders.

    Raises
    ------
    DataError
        A folder or a pattern stands for nothing.
    """
    found: dict[Path, Found] = {}
    for each in given:
        for one in _meant(str(each)):
            found.setdefault(one.path.resolve(), one)
    return list(found.values())


def _meant(text: str) -> Sequence[Found]:
    path = Path(text)
    if path.is_dir():
        paths = sorted(each for each in path.glob("*.h5") if each.is_file())
        if not paths:
            raise DataError(f"folder {path} has no *.h5 in it; give a folder with recordings, or a pattern")
    elif path.exists() or not glob.has_magic(text):
        return [Found(path)]
    else:
        paths = sorted(each for each in map(Path, glob.glob(text, recursive=True)) if each.is_file())  # noqa: PTH207
        if not paths:
            raise DataError(f"no file is named like {text}; give another pattern")
    return [Found(each, named=False) for each in paths]


def outputs(recordings: Sequence[Found], folder: Path) -> list[Path]:
    """Return the file in ``folder`` that each recording is to become.

    Raises
    ------
    ArgumentError
        Two would become the same, or one would replace another recording; there can be no such folder.
    """
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(f"output {folder} is a file, and several recordings need a folder; give another name")
    if not folder.parent.is_dir():
        raise ArgumentError(f"output {folder}: there is no folder {folder.parent}; make it or give another")
    named = {found.path.resolve() for found in recordings if found.named}  # others may be energyscape files
    taken: dict[str, Path] = {}
    targets = []
    for found in recordings:
        target = folder / found.path.with_suffix(SUFFIX).name
        name = os.path.normcase(target)
        if name in taken:
            raise ArgumentError(
                f"{taken[name]} and {found.path} would both become {target}; process them into folders of their own"
            )
        if target.resolve() in named:
            raise ArgumentError(
                f"{found.path} would become {target}, which is to be processed itself; give another folder"
            )
        taken[name] = found.path
        targets.append(target)
    return targets
