"""Time and processor time of each stage between the last byte at a sensor and the image in an application."""

import os
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from ertis_bench import machine
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_bench.network import imaging, serial_stream
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import percentile
from ertis_numba.network.trace import VARIABLE

__all__ = ["FORMS", "STAGES", "latency", "run"]

STAGES: Final = {
    "kept": ("sensor node", "spool"),
    "sent": ("sensor node", "CRC-32; link thread: header, frames to ZeroMQ"),
    "arrived": ("sensor node → central node", "CURVE, TCP, CURVE"),
    "checked": ("central node", "header, key, CRC-32"),
    "submitted": ("central node", "queue, copy into shared memory, order by pipe"),
    "image known": ("central node → worker → central node", "chain, two pipes"),
    "image fetched": ("central node → publisher", "pipe"),
    "published": ("publisher", "copy, frames to ZeroMQ"),
    "received": ("publisher → application", "CURVE, TCP, CURVE"),
    "taken": ("application", "image, queue between threads"),
}
"""Stages on the way to the application, in order: where each takes place, and its work."""

_Times = dict[tuple[str, int], int]  # Time in ns by sensor and number.
Stage = tuple[str, float, float, float]

_ACKS: Final = {
    "stored": ("central node, archive", "journal, fsync"),
    "acknowledged": ("central node → sensor node", "acknowledgement"),
}


def run(*, say: Callable[[str], None], duration_s: float = 30.0, seed: int = 1) -> dict[str, Any]:
    """Process measurements without and with storage, then from a serial line, and return the times of all stages."""
    cases = {}
    for name, stores in (("images", False), ("images and storage", True)):
        say(f"{name}: 90 directions, 4 sensors × 10 Hz")
        with tempfile.TemporaryDirectory(prefix="ertis-") as place:
            cases[name] = _case(Path(place), duration_s, seed, stores=stores)
    say("serial line: 90 directions, 10 Hz")
    serial = serial_stream.measure(duration_s=duration_s, seed=seed)
    return {"machine": machine.describe(), "seed": seed, "duration_s": duration_s, "cases": cases, "serial": serial}


def _case(folder: Path, duration_s: float, seed: int, *, stores: bool) -> dict[str, Any]:
    traces = folder / "traces"
    traces.mkdir()
    archive = folder / "recordings" if stores else None
    with _traced(traces):
        found = imaging.processing(
            folder, duration_s, seed, directions="90", n_sensors=4, rate_hz=10.0, goal="", archive=archive
        )
    arrived_ns = read_diaries([folder / "sender.ndjson"]).arrived_ns
    begun_ns = {(key.sensor, key.sequence): time_ns for key, time_ns in arrived_ns.items()}
    marks = _marks(traces, begun_ns)
    stages = _times(list(STAGES), marks, begun_ns, begun_ns)
    return found | {"stages": stages + _times(list(_ACKS), marks, marks.get("checked", {}), begun_ns)}


@contextmanager
def _traced(folder: Path) -> Iterator[None]:
    """Let processes that start meanwhile write traces."""
    before = os.environ.get(VARIABLE)
    os.environ[VARIABLE] = str(folder)
    try:
        yield
    finally:
        os.environ.pop(VARIABLE)
        if before is not None:
            os.environ[VARIABLE] = before


def _marks(folder: Path, begun: _Times) -> dict[str, _Times]:
    """Return the times of all measurements at each stage. Numbers repeat in the warm-up, which ended before."""
    found: dict[str, _Times] = defaultdict(dict)
    for path in folder.glob("*.trace"):
        for line in path.read_text("utf-8").splitlines():
            stage, sensor, sequence, time_ns = line.split("\t")
            key = sensor, int(sequence)
            if int(time_ns) >= begun.get(key, 2**63):
                found[stage].setdefault(key, int(time_ns))
    return found


def _times(stages: list[str], marks: dict[str, _Times], before: _Times, begun: _Times) -> list[Stage]:
    """Return the name of each traced stage, and percentiles of its own time and of the time since the last byte."""
    rows = []
    for stage in stages:
        here = marks.get(stage, {})
        own_ms = [(time_ns - before[key]) / 1e6 for key, time_ns in here.items() if key in before]
        since_ms = [(time_ns - begun[key]) / 1e6 for key, time_ns in here.items()]
        if own_ms:
            rows.append((stage, percentile(own_ms, 0.5), percentile(own_ms, 0.99), percentile(since_ms, 0.5)))
        before = here
    return rows


def latency(report: dict[str, Any]) -> str:
    """Return the tables of stages and of processor times, with their conditions."""
    parts = []
    for name, case in report["cases"].items():
        stages = [
            (*(STAGES | _ACKS)[stage], f"{p50_ms:.2f}", f"{p99_ms:.2f}", f"{since_ms:.2f}")
            for stage, p50_ms, p99_ms, since_ms in case["stages"]
        ]
        summary = (
            f"**{name[0].upper()}{name[1:]}**: last byte to application p50 {case['p50_ms']:.1f} ms, p99 "
            f"{case['p99_ms']:.1f} ms; {case['cpu_total_ms']:.2f} ms of processor time per measurement."
        )
        head = ("process", "work", "p50, ms", "p99, ms", "since the last byte, p50, ms")
        parts += [summary, table(head, stages, numbers=False)]
    names = list(report["cases"])
    threads: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    for name, case in report["cases"].items():
        for process, kind, time_ms in case["cpu_ms"]:
            threads[process, kind][name] = time_ms
    rows = [(*key, *(f"{times.get(name, 0.0):.2f}" for name in names)) for key, times in threads.items()]
    columns = ("process", "threads", *(f"{name}, ms per measurement" for name in names))
    serial = report["serial"]
    line = (
        f"**Serial line** of {serial['bytes_per_s'] / 1e6:.0f} MB/s, without a network: last byte of a block to its "
        f"image p50 {serial['streamed']['p50_ms']:.1f} ms, p99 {serial['streamed']['p99_ms']:.1f} ms if words are "
        f"processed as they arrive (`Pipeline.stream`), and p50 {serial['whole']['p50_ms']:.1f} ms, p99 "
        f"{serial['whole']['p99_ms']:.1f} ms otherwise. All images have the bits of those of whole measurements."
    )
    conditions = (
        f"90 directions, 4 sensors × 10 Hz for {report['duration_s']:g} s, CURVE over loopback. All sensors measure at "
        "the same time, so that four measurements wait for the same cores. Percentiles of stages do not add up. "
        "Processor time includes the checks of this benchmark: a CRC-32 and a diary at the sensor node, a diary and a "
        "comparison in the application."
    )
    return "\n\n".join(
        [*parts, table(columns, rows, numbers=False), line, f"Measured on {sentence(report['machine'])}", conditions]
    )


FORMS = {"latency": latency}
"""Table of the command, by the name in its markers."""
