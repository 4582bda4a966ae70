"""Speed-up of processing many recordings with more workers, on this machine and on a dask cluster."""

import itertools
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_bench import checks, input_measurements, machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table as _table
from ertis_numba.base.errors import DataError
from ertis_numba.campaign import Campaign, CampaignOptions, RecordingEnded, RecordingStarted, find_recordings
from ertis_numba.frames import Measurement
from ertis_numba.processes import cluster
from ertis_numba.storage import open_energyscapes, open_recording, write_recording

__all__ = ["FORMS", "form", "run"]

_MEASUREMENTS: Final = 20  # per recording
# Fixed creation time of all files, without which their bytes would differ.
_CREATED_S: Final = "1700000000"


def run(*, count: int, rounds: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Process the same recordings with each configuration in turns, compare all files, and return the report."""
    before = os.environ.get("SOURCE_DATE_EPOCH")
    os.environ["SOURCE_DATE_EPOCH"] = _CREATED_S
    try:
        with tempfile.TemporaryDirectory(prefix="ertis-") as place, ExitStack() as stack:
            say(f"writing {count} recordings")
            folder, source = _recordings(Path(place) / "runs", count)
            address = stack.enter_context(cluster.local_cluster(_cores()))
            times_s = _measured(folder, Path(place) / "out", _crews(address), rounds, say)
            size_bytes = sum(path.stat().st_size for path in folder.iterdir())
    finally:
        if before is None:
            del os.environ["SOURCE_DATE_EPOCH"]
        else:
            os.environ["SOURCE_DATE_EPOCH"] = before
    return {
        "machine": machine.describe(),
        "recordings": count,
        "measurements": _MEASUREMENTS,
        "rounds": rounds,
        "source": source,
        "bytes": size_bytes,
        "rows": [_row(name, times_s) for name in times_s],
    }


def _cores() -> int:
    cores: int = machine.describe()["cores"]
    return cores


def _crews(address: str) -> dict[str, dict[str, Any]]:
    """Return the compared configurations by name, as arguments of a campaign."""
    cores = _cores()
    crews: dict[str, dict[str, Any]] = {"1 worker of 1 thread": {"workers": 1, "threads": 1}}
    if cores > 1:
        crews |= {
            f"1 worker of {cores} threads": {"workers": 1, "threads": cores},
            f"{cores} workers of 1 thread": {"workers": cores, "threads": 1},
            f"{cores} workers of {cores} threads": {"workers": cores, "threads": cores},
        }
    return crews | {f"dask's LocalCluster, {cores} workers of 1 thread": {"workers": address}}


def _recordings(folder: Path, count: int) -> tuple[Path, str]:
    """Write recordings of measurements derived from a simulated one. Return their folder and a description."""
    folder.mkdir()
    first, source = input_measurements.measurement()
    for number in range(count):
        write_recording(folder / f"{number:03}.h5", _measurements(first, number))
    return folder, source


def _measurements(first: Measurement, number: int) -> Iterator[Measurement]:
    """Yield copies of a measurement, each a little later in its record than the one before."""
    for index in range(_MEASUREMENTS):
        stamp = replace(first.stamp, sequence=index, sync_count=index, timestamp_ns=50_000_000 * index)
        yield replace(first, data=np.roll(first.data, number * _MEASUREMENTS + index), stamp=stamp)


def _measured(
    folder: Path, out: Path, crews: dict[str, dict[str, Any]], rounds: int, say: Callable[[str], None]
) -> dict[str, list[tuple[float, float]]]:
    """Return the times of each configuration in each round, in seconds.

    Each entry has the total time, and the time from the start of the first recording.
    """
    times_s: dict[str, list[tuple[float, float]]] = {name: [] for name in crews}
    wanted: dict[str, bytes] = {}
    for turn, (name, chosen) in itertools.product(range(rounds + 1), crews.items()):
        say(f"round {turn} of {rounds}: {name}" if turn else f"warm-up: {name}")
        with tempfile.TemporaryDirectory(dir=out.parent) as target:
            took_s = _timed(folder, Path(target), **chosen)
            files = {path.name: path.read_bytes() for path in sorted(Path(target).iterdir())}
            if not wanted:
                _require_exact(folder, Path(target))
                wanted = files
        if files != wanted:
            others = ", ".join(_differences(files, wanted))
            raise DataError(f"files of {name} differ from those of 1 worker of 1 thread ({others}); do not use it")
        if turn:  # From the second round on, files and kernels are cached.
            times_s[name].append(took_s)
    return times_s


def _differences(files: dict[str, bytes], wanted: dict[str, bytes]) -> Iterator[str]:
    """Yield the difference of each unequal file, as a starting point for a diagnosis."""
    for name in sorted(files | wanted):
        one, other = (np.frombuffer(each.get(name, b""), np.uint8) for each in (files, wanted))
        if len(one) != len(other):
            yield f"{name}: {len(one)} bytes instead of {len(other)}"
        elif (places := np.flatnonzero(one != other)).size:
            yield f"{name}: {places.size} of {len(one)} bytes differ, from {places[0]} to {places[-1]}"


def _timed(folder: Path, target: Path, *, threads: int | None = None, **pool: Any) -> tuple[float, float]:
    begin_s = first_s = time.perf_counter()
    for event in Campaign(find_recordings([folder]), target, CampaignOptions(threads=threads), **pool).run():
        if isinstance(event, RecordingStarted) and first_s == begin_s:
            first_s = time.perf_counter()
        if isinstance(event, RecordingEnded) and event.outcome != "made":
            raise DataError(f"{event.recording} is {event.outcome} ({event.error}), so it is not timed")
    end_s = time.perf_counter()
    return end_s - begin_s, end_s - first_s


def _require_exact(folder: Path, target: Path) -> None:
    path = min(folder.iterdir())
    with open_recording(path) as recording, open_energyscapes(target / f"{path.stem}.energy.h5") as images:
        image = images[1]
        checks.require_exact(image, replace(recording[1], settings=image.settings))


def _row(name: str, times_s: dict[str, list[tuple[float, float]]]) -> dict[str, Any]:
    """Return median times, and medians of the ratios per round.

    Both times of a ratio come from the same round, so that a drift of the machine's speed cancels.
    """
    base = next(iter(times_s.values()))
    ratios = [(one[0] / mine[0], one[1] / mine[1]) for one, mine in zip(base, times_s[name], strict=True)]
    return {
        "crew": name,
        "seconds": round(statistics.median(took[0] for took in times_s[name]), 2),
        "working_s": round(statistics.median(took[1] for took in times_s[name]), 2),
        "times_faster": round(statistics.median(ratio[0] for ratio in ratios), 2),
        "working_times_faster": round(statistics.median(ratio[1] for ratio in ratios), 2),
    }


def form(report: dict[str, Any]) -> str:
    """Return the times and ratios, and the conditions of the measurement."""
    each = report["recordings"] * report["measurements"]
    head = ["configuration", "time, s", "speed-up", "time without the start, s", "speed-up", "measurements/s"]
    rows = [
        [
            row["crew"],
            f"{row['seconds']:.1f}",
            f"{row['times_faster']:.2f}×",
            f"{row['working_s']:.1f}",
            f"{row['working_times_faster']:.2f}×",
            f"{each / row['working_s']:.0f}",
        ]
        for row in report["rows"]
    ]
    conditions = (
        f"{report['recordings']} recordings of {report['measurements']} measurements of {report['source']}, "
        f"{report['bytes'] / 1e6:.0f} MB in total. Each measurement is a little later in its record than the one "
        f"before. Times are medians of {report['rounds']} rounds, in which the configurations take turns. Each ratio "
        "is relative to the first line in the same round. Times include starting processes, reading and checking, "
        "planning, computing images, writing them and reading them back. The start is the time before the first "
        "recording is begun. Neither time includes the start of the LocalCluster itself. The files of all "
        "configurations were equal, byte by byte, and an image was compared with the exact one."
    )
    return "\n\n".join([_table(head, rows), f"Measured on {sentence(report['machine'])}", conditions])


FORMS = {"many": form}
"""Forms of the table, by the name in its markers."""
