"""Sequential trials, each in its own folder."""

import json
import secrets
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

from ertis_bench import machine

__all__ = ["Parts", "command", "try_parts"]

Extent = TypeVar("Extent")
Parts = Mapping[str, tuple[str, Callable[[Extent, Path, int], Any]]]
"""Progress message of each trial, and its function of extent, folder and seed."""


def try_parts(
    parts: "Parts[Any]",
    short: Any,
    long: Any,
    *,
    say: Callable[[str], None],
    fraction: float,
    seed: int | None,
    only: Sequence[str],
) -> dict[str, Any]:
    """Run all trials, or only some of them, and return the report.

    Parameters
    ----------
    parts : mapping of str to (str, callable)
    short, long : dataclass
        Extents of the short and the long form. Progress messages may refer to their fields.
    say : callable
        Called with a line of progress.
    fraction : float
        Numbers and durations as a fraction of those of the long form; 0 for the short form.
    seed : int, optional
        Random by default.
    only : sequence of str
        Names of trials; all trials if empty.
    """
    seed = secrets.randbits(31) if seed is None else seed
    say(f"seed {seed}")
    extent = _scaled(long, fraction) if fraction else short
    report: dict[str, Any] = {"machine": machine.describe(), "seed": seed, "long": fraction, "only": list(only)}
    for name, (about, part) in parts.items():
        if only and name not in only:
            continue
        say(about.format(**asdict(extent)))
        # An error while removing the folder must not hide an error of the trial.
        with tempfile.TemporaryDirectory(prefix="ertis-", ignore_cleanup_errors=True) as folder:
            report[name] = part(extent, Path(folder), seed)
        say(f"  {json.dumps(report[name], default=str)}")  # survives if the program ends hours later
    return report


def command(name: str, report: dict[str, Any]) -> str:
    """Return the command that repeats the trials of a report."""
    long = (
        [] if not report["long"] else ["--long"] if report["long"] == 1 else [f"--long --fraction {report['long']:g}"]
    )
    only = [f"--only {part}" for part in report["only"]]
    return " ".join(["python -m tests.faults", name, *long, *only, f"--seed {report['seed']}"])


def _scaled(extent: Any, fraction: float) -> Any:
    """Return an extent with smaller numbers and durations, but with the same rates."""
    values = asdict(extent)
    numbers = {name: max(1, round(value * fraction)) for name, value in values.items() if name.startswith("n_")}
    durations = {name: value * fraction for name, value in values.items() if name.endswith("_s")}
    return replace(extent, **numbers, **durations)
