"""Refusal of named pipes: commands read files at any place, and would wait for a program that writes."""

import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

__all__ = ["require_no_pipes"]


def require_no_pipes(options: Mapping[str, Any]) -> None:
    """Raise ArgumentError if an option or argument is a named pipe; those of a shell, such as ``<(…)``, are allowed."""
    for path in _paths(list(options.values())):
        try:
            is_pipe = stat.S_ISFIFO(path.stat().st_mode)
        except (OSError, ValueError):  # missing, or no path at all
            continue
        if is_pipe and path.parts[:2] not in {("/", "dev"), ("/", "proc")}:
            from ertis_numba.base.errors import ArgumentError

            raise ArgumentError(f"{path} is a named pipe; write its content to a file, and use the file")


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, list | tuple):
        for each in value:
            yield from _paths(each)
    elif isinstance(value, str | Path) and str(value):
        yield Path(value)
