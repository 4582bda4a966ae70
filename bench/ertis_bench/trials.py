"""Things that are tried one after the other, each in a folder of its own."""

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
"""What to say of each, and how it is tried: with the extent, a folder and a seed."""


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
    """Try everything, or only some of the parts, and return the report.

    Parameters
    ----------
    parts : mapping of str to (str, callable)
    extent : dataclass
        How much is tried; what is said may name its fields.
    say : callable
        Called with lines about what happens.
    long : bool
        Noted in the report.
    seed : int, optional
        Drawn by default.
    only : sequence of str
        All if it is empty.
    say_found : bool
        Whether what a part finds is said at once: hours later something else may end the program.
    """
    seed = secrets.randbits(31) if seed is None else seed
    say(f"seed {seed}")
    report: dict[str, Any] = {"machine": machine.describe(), "seed": seed, "long": long, "only": list(only)}
    for name, (about, part) in parts.items():
        if only and name not in only:
            continue
        say(about.format(**asdict(extent)))
        # An error of a part is not to be hidden by that of clearing up after it.
        with tempfile.TemporaryDirectory(prefix="ertis-", ignore_cleanup_errors=True) as folder:
            report[name] = part(extent, Path(folder), seed)
        if say_found:
            say(f"  {json.dumps(report[name])}")
    return report
