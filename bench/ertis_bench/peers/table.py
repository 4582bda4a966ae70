"""Table of the comparison with other libraries."""

from typing import Any

from ertis_bench import accuracy
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.peers.comparison import OURS, PAPER
from ertis_bench.peers.problem import N_PHASES

__all__ = ["better", "peers"]

_NOT_INSTALLED = "not installed (`pip install 'ertis-numba[peers]'`)"

Rows = dict[tuple[str, int], dict[str, Any]]


def peers(report: dict[str, Any]) -> str:
    """Return times, errors, the results in which another implementation is better, and the conditions."""
    rows: Rows = {(row["name"], row["directions"]): row for row in report["rows"]}
    directions = list(dict.fromkeys(row["directions"] for row in report["rows"]))
    versions, last = report["versions"], directions[-1]
    times, others = [], []
    for name, version in versions.items():
        if version is None:
            times.append([name, _NOT_INSTALLED, *[""] * (len(directions) - 1)])
            continue
        mine = [rows[name, n] for n in directions]
        times.append([f"{name} ({version})", *(_time(row, rows[OURS, row["directions"]]) for row in mine)])
        errors = [f"{row['error_db']:.1f}" for row in mine]
        points = mine[-1]["points_per_s"]
        rate = "–" if points is None else f"{points / 1e6:.1f}"
        others.append([name, f"{mine[-1]['threads']}", *errors, f"{mine[-1]['first_s']:.2f}", rate])
    columns = [f"{n} directions" for n in directions]
    return "\n\n".join(
        [
            table(["ms, median (time / time of this package)", *columns], times),
            table(
                ["", "threads", *(f"error, dB, {text}" for text in columns), "first image, s", "million points/s"],
                others,
            ),
            better(rows, directions),
            f"Measured on {sentence(report['machine'])}",
            _conditions(report, last),
        ]
    )


def _time(row: dict[str, Any], ours: dict[str, Any]) -> str:
    ratio = row["median_ms"] / ours["median_ms"]
    return f"{row['median_ms']:.2f}" if row is ours else f"{row['median_ms']:.2f} ({ratio:.1f}×)"


def better(rows: Rows, directions: list[int]) -> str:
    """Return a sentence about all results of other implementations that are better than those of this package."""
    last = directions[-1]
    measures = [(f"time of {n} directions", "median_ms", n) for n in directions]
    measures += [(f"error of {n} directions", "error_db", n) for n in directions]
    measures += [("first image", "first_s", last), ("delay-and-sum alone", "points_per_s", last)]
    found = []
    for text, key, n in measures:
        ours = rows[OURS, n][key]
        sign = -1 if key == "points_per_s" else 1
        values = {name: row[key] for (name, of), row in rows.items() if of == n and row[key] is not None}
        names = [name for name, value in values.items() if sign * value < sign * ours]
        if names:
            found.append(f"{text}: {', '.join(names)}")
    if not found:
        return "No other implementation has a better result in any column."
    return f"Better results than those of this package: {'; '.join(found)}."


def _conditions(report: dict[str, Any], last: int) -> str:
    first_m, last_m = report["range_m"]
    return (
        f"- **Measurement**: {report['words']:,} words of 32 microphones ({report['source']}), to an energyscape of "
        f"{first_m:g}–{last_m:g} m.\n"
        f"- **Runs**: {report['count']} in one process, in turns of {accuracy.TURN} per implementation, and a tenth "
        f"of that for slow ones ({'; '.join(report['slow'])}).\n"
        "- **Times** start with the words in memory and end with the image in memory. They exclude reading the "
        "file, imports, tables, compilation, and warm-up calls before each turn.\n"
        f"- **First image**: {last} directions, with tables and compilation. The kernels of this package and of "
        "Acoular were compiled before, and are loaded from Numba's cache.\n"
        "- **Errors** are relative to the exact image (float64, fractional delays) in all directions and ranges. "
        "They and the place of the strongest reflector were checked before the times were measured.\n"
        f"- **Points per second**: directions × ranges, for {last} directions. Only delay-and-sum and the envelope "
        "are timed, from the signals after each matched filter.\n"
        f"- **{PAPER}**, processes the whole record with delays of whole samples.\n"
        "- **NumPy, PyTorch and JAX** process the same part of the record as this package, in float32, with "
        f"{N_PHASES} samples per range. Delays are whole samples, with the phase of the carrier corrected. Fewer "
        "samples would exceed -35 dB, the default error budget of this package.\n"
        "- **JAX** compiles with `jit`. **PyTorch** runs without `torch.compile`, which needs a C++ compiler.\n"
        "- **Acoular's** `BeamformerTime` interpolates the same samples linearly, in float64, after a front end in "
        "NumPy.\n"
        "- **Images** are written to one array. Acoular and JAX return a new array instead.\n"
        "- **This package** uses its default plan.\n"
        "- GPUs and batches are left out."
    )
