"""Largest number of sensors, or rate of a platform, that a central node on this machine sustains without a loss."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from ertis_bench import machine
from ertis_bench.markdown import table
from ertis_bench.network.imaging import processing
from ertis_bench.network_trials import live_fusion
from ertis_bench.network_trials.performance import storage
from ertis_bench.network_trials.table import as_list

__all__ = ["FORMS", "largest", "run"]

_RATE_HZ: Final = 10.0
_LATEST_MS: Final = 500.0  # Largest p99; beyond, a queue grows.
_TRIAL_S: Final = 8.0
_NEAR: Final = 0.1  # The search ends when the least failure is this share above the largest success.
_CREDIT: Final = 64  # Images under way to the application, so that bursts of all sensors fit.
Found = dict[str, Any]
Trial = Callable[[Path, float, int, int], Found]


def _stored(folder: Path, duration_s: float, seed: int, count: int) -> Found:
    found = storage(folder, duration_s, seed, n_sensors=count, rate_hz=_RATE_HZ)
    faults = {name: found[name] for name in ("lost", "missing", "wrong", "twice") if found[name]}
    return found | {"faults": faults | ({} if found["rate_reached_hz"] > 0.98 * _RATE_HZ else {"too slow": 1})}


def _imaged(folder: Path, duration_s: float, seed: int, count: int, *, directions: str) -> Found:
    found = processing(
        folder, duration_s, seed, directions=directions, n_sensors=count, rate_hz=_RATE_HZ, goal="", credit=_CREDIT
    )
    faults = dict(found["dropped"]) | {name: found[name] for name in ("skipped", "wrong") if found[name]}
    return found | {"faults": faults}


def _fused(folder: Path, duration_s: float, seed: int, count: int) -> Found:
    found = live_fusion.measure(folder, duration_s + live_fusion.START_S, seed, rate_hz=float(count))
    names = ("images_dropped", "skipped", "incomplete", "wrong")
    return found | {"faults": dict(found["dropped"]) | {name: found[name] for name in names if found[name]}}


_PARTS: dict[str, tuple[str, int, int, Trial]] = {
    "stored": (f"sensors × {_RATE_HZ:g} Hz, stored", 8, 256, _stored),
    "90": (f"sensors × {_RATE_HZ:g} Hz, images of 90 directions", 4, 256, partial(_imaged, directions="90")),
    "3000": (f"sensors × {_RATE_HZ:g} Hz, images of 3000 directions", 2, 256, partial(_imaged, directions="3000")),
    "fused": ("Hz of a platform of four sensors, fused", 10, 40, _fused),
}
"""Searches by name: a description, the first number to try, the largest one, and the function that tries a number."""


def largest(first: int, limit: int, succeeds: Callable[[int], bool]) -> int:
    """Return the largest number up to a limit that succeeds, to within a tenth; 0 if none does."""
    good, bad, tried = 0, limit + 1, first
    while True:
        if succeeds(tried):
            good = tried
        else:
            bad = tried
        if bad - good <= max(1, round(_NEAR * good)):
            return good
        tried = min(2 * good, limit) if bad > limit else (good + bad) // 2


def run(*, say: Callable[[str], None], duration_s: float = 60.0, seed: int = 1, folder: Path | None = None) -> Found:
    """Search each largest number with short trials, confirm it with a long one, and return the report."""
    rows = [_searched(part, say, duration_s, seed, folder) for part in _PARTS]
    return {"machine": machine.describe(), "seed": seed, "duration_s": duration_s, "rows": rows}


def _searched(part: str, say: Callable[[str], None], duration_s: float, seed: int, folder: Path | None) -> Found:
    about, first, limit, trial = _PARTS[part]
    failures: dict[int, Found] = {}

    def at(count: int, lasts_s: float) -> Found:
        with tempfile.TemporaryDirectory(prefix="ertis-", dir=folder) as place:
            found = trial(Path(place), lasts_s, seed, count)
        faults = found["faults"] | ({"late": 1} if found["p99_ms"] > _LATEST_MS else {})
        say(f"{count} {about}, {lasts_s:g} s: {as_list(faults) if faults else 'no loss'}")
        if faults:
            failures[count] = faults
        return found | {"faults": faults}

    count = largest(first, limit, lambda tried: not at(tried, _TRIAL_S)["faults"])
    found: Found = {}
    while count and (found := at(count, duration_s))["faults"]:
        count = min(count - 1, round((1 - _NEAR) * count))
    beyond = min(failures, default=None)
    row = {"part": part, "about": about, "count": count, "beyond": beyond, "faults": failures.get(beyond or 0, {})}
    return row | ({key: found[key] for key in ("p50_ms", "p99_ms", "cpu_percent")} if count else {})


def capacity(report: Found) -> str:
    """Return the table of the largest numbers, the faults beyond them, and the processor time."""
    head = ("", "largest", "p50 / p99, ms", "processor time, % of one core", "beyond")
    cells = []
    for row in report["rows"]:
        beyond = "not reached" if row["beyond"] is None else f"{row['beyond']}: {as_list(row['faults'])}"
        times = f"{row['p50_ms']:.0f} / {row['p99_ms']:.0f}" if row["count"] else "–"
        cpu = "; ".join(f"{name} {share:.0f}" for name, share in row.get("cpu_percent", {}).items()) or "–"
        cells.append((row["about"], f"{row['count']}", times, cpu, beyond))
    conditions = (
        f"Largest numbers that lasted {report['duration_s']:g} s without a loss, with p99 below {_LATEST_MS:g} ms, to "
        f"within a tenth; trials of {_TRIAL_S:g} s found them. Measurements have 655 kB. All sensors measure at the "
        "same time. Measurements are late if p99 exceeds the limit, and superseded if a newer one of the same sensor "
        "arrives before a worker is free. Times are those from the last "
        "byte at the sensor node to its acknowledgement, or to the image in an application. CURVE encryption over "
        "loopback: programs that stand for sensors, the central node and an application that checks every image share "
        "the cores, so a central node with its own cores sustains more."
    )
    rows = table(head, cells, numbers=False)
    return "\n\n".join([rows, f"Measured on {machine.sentence(report['machine'])}", conditions])


FORMS = {"capacity": capacity}
"""Table of the command, by the name in its markers."""
