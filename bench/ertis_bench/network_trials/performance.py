"""Performance of a central node on this machine with encryption: storage, image processing and overload."""

import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from ertis_bench import machine
from ertis_bench.network.imaging import processing
from ertis_bench.network.processes import central, survivors, until
from ertis_bench.network.processor_time import ProcessorTime
from ertis_bench.network.sender import SETTINGS, SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import create_keys, percentile
from ertis_bench.network_trials import live_fusion, live_maps
from ertis_bench.network_trials.oracle import judged
from ertis_bench.network_trials.table import network
from ertis_numba.base.errors import DataError
from ertis_numba.processes import cluster

__all__ = ["FORMS", "PARTS", "run", "storage"]

_STORAGE_S: Final = 300.0
_OTHERS_S: Final = 60.0
_CALIBRATION_S: Final = 8.0
_CLUSTER_WORKERS: Final = 2
_SENDERS: Final = 2  # Sensor-node processes, among which the sensors are divided.
_BYTES: Final = 4 * SETTINGS.recording.n_samples
Found = dict[str, Any]


def run(
    *,
    say: Callable[[str], None],
    duration_s: float | None = None,
    seed: int = 1,
    only: Sequence[str] = (),
    folder: Path | None = None,
) -> dict[str, Any]:
    """Run all measurements, or only some of `PARTS`, and return the report."""
    rows = []
    for name, (about, part) in PARTS.items():
        if only and name not in only:
            continue
        say(about)
        with tempfile.TemporaryDirectory(prefix="ertis-", dir=folder) as place:
            lasts_s = duration_s or (_STORAGE_S if name == "storage" else _OTHERS_S)
            rows.append(part(Path(place), lasts_s, seed) | {"duration_s": lasts_s})
    return {"machine": machine.describe(), "seed": seed, "only": list(only), "rows": rows}


def _shared(sensors: Sequence[str], n_senders: int) -> list[tuple[str, ...]]:
    return [tuple(sensors[first::n_senders]) for first in range(min(n_senders, len(sensors)))]


def storage(
    folder: Path, duration_s: float, seed: int, *, n_sensors: int = 8, rate_hz: float = 20.0, n_senders: int = _SENDERS
) -> Found:
    """Store the measurements of sensors, and read them all again."""
    sensors = [f"sensor-{number + 1}" for number in range(n_sensors)]
    options, given, _ = create_keys(folder, sensors)
    archive, mark = folder / "recordings", f"storage{time.monotonic_ns()}"
    archive.mkdir()
    count, start_s = round(duration_s * rate_hz), time.monotonic() + 3.0
    with ExitStack() as stack:
        node = stack.enter_context(central("record", folder, "-o", str(archive), *options, mark=mark))
        address = node.wait_for("listening")["address"]
        jobs = [
            SenderJob(
                address=address,
                diary=str(folder / f"sender-{number}.ndjson"),
                sensors=share,
                rate_hz=rate_hz,
                count=count,
                seed=seed + number,
                small=False,
                keys=given,
                start_s=start_s,
                patience_s=120.0,
            )
            for number, share in enumerate(_shared(sensors, n_senders))
        ]
        senders = [stack.enter_context(job.start()) for job in jobs]
        for sender in senders:
            sender.wait_for("begun")
        time.sleep(max(0.0, start_s - time.monotonic()))
        load = ProcessorTime({"central node": [node.node_pid], "sensor nodes": [each.pid for each in senders]})
        time.sleep(max(0.0, start_s + duration_s - 1.0 - time.monotonic()))
        cpu_percent = load.percent()
        for sender in senders:
            if not sender.wait_for("sent", timeout_s=duration_s + 180.0)["flushed"]:
                raise DataError(f"some measurements were not acknowledged; {sender.last_words()}")
        node.stop(timeout_s=900.0)
        until(lambda: not survivors(mark))
    diaries = [Path(job.diary) for job in jobs]
    sent = read_diaries(diaries)
    times_ms = sent.ack_times_ms()
    lasted_s = (max(sent.arrived_ns.values()) - min(sent.arrived_ns.values())) / 1e9
    return {
        "part": "storage",
        "sensors": n_sensors,
        "rate_hz": rate_hz,
        "megabytes_per_s": n_sensors * rate_hz * _BYTES / 1e6,
        "rate_reached_hz": (count - 1) / lasted_s,
        "p50_ms": percentile(times_ms, 0.5),
        "p99_ms": percentile(times_ms, 0.99),
        "slowest_ms": percentile(times_ms, 1.0),
        "cpu_percent": cpu_percent,
    } | judged(folder, archive, diaries)


def _overload(folder: Path, duration_s: float, seed: int) -> Found:
    """Measure the rate of images under full load, then send twice that rate."""
    (folder / "calibration").mkdir()
    (folder / "overload").mkdir()
    goal = "received = published + dropped; latency bounded"
    options: dict[str, Any] = {"directions": "3000", "n_sensors": 4, "goal": goal, "part": "overload 2×", "credit": 8}
    largest = processing(folder / "calibration", _CALIBRATION_S, seed, rate_hz=40.0, **options)
    rate_hz = round(2 * 40.0 * largest["published"] / max(1, largest["sent"]), 1)
    return processing(folder / "overload", duration_s, seed, rate_hz=rate_hz, **options)


def _cluster(folder: Path, duration_s: float, seed: int) -> Found:
    """Compute the same images with workers of `ertis serve` and with a cluster, then measure the maximum rate of each.

    The processor time of the cluster's scheduler and workers is not counted, because they do not belong to the node.
    """
    options: dict[str, Any] = {
        "directions": "90",
        "n_sensors": 4,
        "goal": "report added latency and maximum rate",
    }
    options["part"] = f"dask cluster on this machine, {_CLUSTER_WORKERS} workers"
    found: dict[str, Found] = {}
    with cluster.local_cluster(_CLUSTER_WORKERS) as scheduler:  # The cluster idles while the node's own workers run.
        for name, where in (("here", None), ("there", scheduler)):
            for pace, lasts_s, rate_hz in (("paced", duration_s, 10.0), ("most", _CALIBRATION_S, 40.0)):
                place = folder / f"{name}-{pace}"
                place.mkdir()
                found[place.name] = processing(place, lasts_s, seed, rate_hz=rate_hz, scheduler=where, **options)
    here, there = found["here-paced"], found["there-paced"]
    return there | {
        "added_p50_ms": there["p50_ms"] - here["p50_ms"],
        "added_p99_ms": there["p99_ms"] - here["p99_ms"],
        "offered_hz": found["there-most"]["sent"] / _CALIBRATION_S,
        "max_hz": found["there-most"]["published"] / _CALIBRATION_S,
        "max_here_hz": found["here-most"]["published"] / _CALIBRATION_S,
    }


PARTS: dict[str, tuple[str, Callable[[Path, float, int], Found]]] = {
    "storage": ("storage of 8 sensors × 20 Hz", storage),
    "processing": (
        "90 directions, 4 sensors × 10 Hz",
        lambda folder, duration_s, seed: processing(
            folder,
            duration_s,
            seed,
            directions="90",
            n_sensors=4,
            rate_hz=10.0,
            goal="0 dropped; p50 < 40 ms, p99 < 120 ms",
        ),
    ),
    "images": (
        "3000 directions, 1 sensor × 20 Hz",
        lambda folder, duration_s, seed: processing(
            folder, duration_s, seed, directions="3000", n_sensors=1, rate_hz=20.0, goal="0 dropped (the paper: 10 Hz)"
        ),
    ),
    "fusion": ("fused image of 4 sensors × 10 Hz, 90 directions each", live_fusion.measure),
    "maps": ("acoustic maps of 4 passive sensors × 10 Hz in a live view", live_maps.measure),
    "overload": ("twice the capacity", _overload),
    "cluster": ("90 directions, 4 sensors × 10 Hz, with own workers and on a dask cluster", _cluster),
}
"""Measurements by name, each with its progress message and its function."""


FORMS = {"network": network}
"""Forms of the table, by the name in its markers."""
