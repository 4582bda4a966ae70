"""Recordings to process, and the names of their output files."""

import glob
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.storage import is_map, sensor_names

__all__ = ["RESULT_SUFFIXES", "RecordingFile", "ResultKind", "find_recordings", "known_sensors", "output_paths"]

ResultKind = Literal["energyscape", "acoustic_map"]

RESULT_SUFFIXES: Final[dict[ResultKind, str]] = {"energyscape": ".energy.h5", "acoustic_map": ".acoustic.h5"}
"""Suffixes of result files, which replace ``.h5`` of the recording."""


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """File to process.

    Attributes
    ----------
    path : Path
    named : bool
        True for a file given by name, by default True. Files found by a pattern or in a folder may be results of
        processing, which are skipped.
    """

    path: Path
    named: bool = True


def find_recordings(given: Iterable[str | Path]) -> list[RecordingFile]:
    """Return the files to process, each once, in the given order.

    A file is preferred to links to it, whose target may change. Broken links are returned as well: opening them reports
    the error.

    Parameters
    ----------
    given : iterable of str or Path
        Files, folders and patterns. A folder stands for its ``*.h5`` files. In a pattern, ``**`` matches any folders.

    Raises
    ------
    DataError
        A folder contains no ``*.h5``, or no file matches a pattern.
    """
    found: dict[str, RecordingFile] = {}
    for each in given:
        for one in _expand(str(each)):
            real = os.path.realpath(one.path)  # resolve() refuses circular links.
            known = found.setdefault(real, one)
            found[real] = RecordingFile(
                one.path if known.path.is_symlink() and not one.path.is_symlink() else known.path,
                named=known.named or one.named,
            )
    return list(found.values())


def _expand(text: str) -> Sequence[RecordingFile]:
    path = Path(text)
    if path.is_dir():
        paths = sorted(each for each in path.glob("*.h5") if _is_candidate(each))
        if not paths:
            raise DataError(f"folder {path} contains no *.h5; choose a folder with recordings, or a pattern")
    elif path.exists() or not glob.has_magic(text):
        return [RecordingFile(path)]
    else:
        every = map(Path, glob.glob(text, recursive=True))  # noqa: PTH207
        paths = sorted(each for each in every if _is_candidate(each))
        if not paths:
            raise DataError(f"no file matches {text}; choose another pattern")
    return [RecordingFile(each, named=False) for each in paths]


def _is_candidate(path: Path) -> bool:
    """Return True for a file, or a broken link to one. Maps are left out: `ertis map` writes them beside recordings."""
    return (path.is_file() and not is_map(path)) or not path.exists()


def known_sensors(recordings: Iterable[RecordingFile]) -> set[str]:
    """Return the names of the sensors in all recordings that can be read; processing reports the others."""
    names: set[str] = set()
    for found in recordings:
        with suppress(ErtisError, OSError):
            names.update(sensor_names(found.path))
    return names


def output_paths(recordings: Sequence[RecordingFile], folder: Path, kind: ResultKind = "energyscape") -> list[Path]:
    """Return the result file in ``folder`` for each recording."""
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(f"output {folder} is a file, but several recordings need a folder; choose another name")
    if not folder.parent.is_dir():
        raise ArgumentError(f"output {folder}: folder {folder.parent} does not exist; create it or choose another")
    # Files found by patterns may be results of processing.
    named = {os.path.realpath(found.path) for found in recordings if found.named}
    taken: dict[str, Path] = {}
    targets = []
    for found in recordings:
        target = folder / found.path.with_suffix(RESULT_SUFFIXES[kind]).name
        name = os.path.normcase(target)
        if name in taken:
            raise ArgumentError(
                f"{taken[name]} and {found.path} would both become {target}; process them into separate folders"
            )
        if os.path.realpath(target) in named:
            raise ArgumentError(
                f"{found.path} would become {target}, which is itself to be processed; choose another folder"
            )
        taken[name] = found.path
        targets.append(target)
    return targets
