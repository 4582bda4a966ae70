"""Sequential trials, each in its own folder."""

import json
import secrets
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from ertis_bench import machine

__all__ = ["Parts", "try_parts"]

Extent = TypeVar("Extent")
Parts = Mapping[str, tuple[str, Callable[[Extent, Path, int], Any]]]
"""Progress message of each trial, and its function of extent, folder and seed."""


def try_parts(
    parts: "Parts[Any]",
    extent: Any,
    *,
    say: Callable[[str], None],
    long: bool,
    seed: int | None,
    only: Sequence[str],
    say_found: bool = False,
) -> dict[str, Any]:
    """Run all trials, or only some of them, and return the report.

    Parameters
    ----------
    parts : mapping of str to (str, callable)
    extent : dataclass
        Extent of the trials. Progress messages may refer to its fields.
    say : callable
        Called with a line of progress.
    long : bool
        Stored in the report.
    seed : int, optional
        Random by default.
    only : sequence of str
        Names of trials; all trials if empty.
    say_found : bool
        If True, log the result of each trial at once, so that it survives if the program ends hours later.
    """
    seed = secrets.randbits(31) if seed is None else seed
    say(f"seed {seed}")
    report: dict[str, Any] = {"machine": machine.describe(), "seed": seed, "long": long, "only": list(only)}
    for name, (about, part) in parts.items():
        if only and name not in only:
            continue
        say(about.format(**asdict(extent)))
        # An error while removing the folder must not hide an error of the trial.
        with tempfile.TemporaryDirectory(prefix="ertis-", ignore_cleanup_errors=True) as folder:
            report[name] = part(extent, Path(folder), seed)
        if say_found:
            say(f"  {json.dumps(report[name])}")
    return report
