"""Report about acoustic maps, and its tables."""

import importlib.metadata
import importlib.util
from collections.abc import Callable
from typing import Any

from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.passive import agreement, times
from ertis_bench.passive._acoular import PACKAGE

__all__ = ["form", "run"]


def run(*, count: int, seed: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Compare acoustic maps with those of Acoular, and time both.

    Parameters
    ----------
    count : int
        Maps of each method by Acoular.
    seed : int
        Seed of the signals.
    say : callable
        Function that reports progress.

    Raises
    ------
    DataError
        A map differs from that of Acoular.
    """
    installed = importlib.util.find_spec(PACKAGE) is not None
    return {
        "machine": machine.describe(),
        "count": count,
        "seed": seed,
        "acoular": importlib.metadata.version(PACKAGE) if installed else None,
        "differences": agreement.compare(seed=seed, say=say) if installed else [],
        "times": times.measure(count=count, seed=seed, with_acoular=installed, say=say),
        "parts": times.times_of_parts(count=10 * count, seed=seed),
    }


def form(report: dict[str, Any]) -> str:
    """Return the report as Markdown."""
    parts = [_differences(report), _times(report), _parts(report)]
    return "\n\n".join([*parts, f"Measured on {sentence(report['machine'])}"])


def _differences(report: dict[str, Any]) -> str:
    if report["acoular"] is None:
        return "Acoular is not installed (`pip install 'ertis-numba[peers]'`)."
    rows = [
        [
            row["name"],
            f"{row['limit_db']:g}",
            f"{row['largest_db']:.3f}",
            f"{row['median_db']:.4f}",
            f"{row['levels']:,}",
        ]
        for row in report["differences"]
    ]
    head = ["method", "limit, dB", "largest difference, dB", "median, dB", "levels"]
    return (
        f"{table(head, rows)}\n\nDifferences of levels from those of Acoular {report['acoular']}, for the signals of "
        "three incoherent sources at 2 m with levels of −20, −26 and −30 dB, and noise of each microphone at −40 dB "
        f"(seed {report['seed']}). Levels are those of 400 directions in each bin, down to {agreement.WITHIN_DB:g} dB "
        "below the maximum of the bin. CLEAN-SC is compared in each twelfth bin."
    )


def _times(report: dict[str, Any]) -> str:
    rows = []
    for row in report["times"]:
        ours, other = row["ours"], row.get("acoular")
        cells = [f"{ours['wall_ms']:.1f}", f"{ours['processor_ms']:.1f}"]
        if other:
            cells += [f"{other['wall_ms']:.0f}", f"{other['processor_ms']:.0f}"]
            cells += [f"{other[key] / ours[key]:.0f}×" for key in ("wall_ms", "processor_ms")]
        rows.append([row["name"], *cells])
    head = ["method", "time, ms", "processor time, ms"]
    if report["acoular"]:
        head += ["Acoular, ms", "Acoular's processor time, ms", "ratio", "ratio of processor times"]
    first = report["times"][0]
    return (
        f"{table(head, rows)}\n\nTime of a map of {times.DIRECTIONS} directions × {first['bands']} third octaves, from "
        f"36.4 ms of float32 signals of 32 microphones, with {first['bins']} bins and 63 blocks. Each is the least of "
        f"{report['count']} maps by Acoular, and of nine times as many by this package in between, after one round "
        "that is not counted. Processor times are sums over all cores, which other programs disturb less. Tables of "
        "directions exist before. The time of Acoular's CLEAN-SC is extrapolated from four bins."
    )


def _parts(report: dict[str, Any]) -> str:
    rows = [
        [name, f"{taken['wall_ms']:.2f}", f"{taken['processor_ms']:.2f}"] for name, taken in report["parts"].items()
    ]
    return table(["part of delay-and-sum", "time, ms", "processor time, ms"], rows)
