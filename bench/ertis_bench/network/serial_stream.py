"""Time from the last byte of a block to its image, with and without a stream: `ertis bench latency`.

The sender runs in a process of its own, so that it shares no interpreter lock with the receiver.
"""

import json
import os
import select
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_bench.network.processes import JsonLinesProcess
from ertis_bench.network.serving import percentile, some_words
from ertis_numba.base.errors import DataError
from ertis_numba.devices.blocks import encode_block
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator.terminal import Terminal
from ertis_numba.devices.setup import Setup
from ertis_numba.frames import Measurement
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings

__all__ = ["BYTES_PER_S", "measure"]

BYTES_PER_S: Final = 20e6
"""Rate of the emulated line. The words of a block take as long as their sound."""

_SKIPPED: Final = 4  # First blocks, whose counters are not known yet.
_PATIENCE_S: Final = 30.0
_BEGIN: Final = signal.SIGUSR1


@dataclass(frozen=True, slots=True)
class _SenderJob:
    words: str
    count: int
    rate_hz: float


def measure(*, duration_s: float, seed: int, rate_hz: float = 10.0, directions: str = "90") -> dict[str, Any]:
    """Receive blocks, every other one with a stream, and compare all images with those of whole measurements."""
    settings = Settings()
    settings = settings.replace(processing=settings.processing.replace(directions=directions))
    count = _SKIPPED + max(2, round(duration_s * rate_hz))
    with tempfile.TemporaryDirectory(prefix="ertis-") as place, Pipeline(settings, "cpu", predict=False) as pipeline:
        path = some_words(settings, Path(place) / "words.npy", seed=seed)
        measurements = [Measurement(words, settings) for words in np.load(path)]
        expected = [pipeline.process(each).amplitude for each in measurements]
        job = _SenderJob(str(path), count, rate_hz)
        command = [sys.executable, "-m", "ertis_bench.network.serial_stream", json.dumps(asdict(job))]
        with JsonLinesProcess(command, stated=Path(place) / "sender.txt") as sender:
            port = sender.wait_for("ready")["port"]
            ready_ns = _received(pipeline, settings, port, expected, count, begin=lambda: sender.signal(_BEGIN))
            sender.wait_for("done")
            sent_ns = {each["counter"]: each["last_ns"] for each in sender.events if each["event"] == "sent"}
    found: dict[str, Any] = {"bytes_per_s": BYTES_PER_S, "directions": directions, "blocks": len(ready_ns)}
    for name, streams in (("streamed", 0), ("whole", 1)):
        times_ms = [
            (time_ns - sent_ns[counter]) / 1e6
            for counter, time_ns in ready_ns.items()
            if counter >= _SKIPPED and counter % 2 == streams
        ]
        found[name] = {"p50_ms": percentile(times_ms, 0.5), "p99_ms": percentile(times_ms, 0.99)}
    return found


def _received(
    pipeline: Pipeline, settings: Settings, port: str, expected: list[Any], count: int, *, begin: Callable[[], None]
) -> dict[int, int]:
    """Return the time of each image by the counter of its block; ``begin`` is called when the port is open."""
    stream, ready_ns, begun = pipeline.stream(), dict[int, int](), [-1]
    image = np.empty_like(expected[0])

    def on_words(first: int, words: Any) -> None:
        begun[0] += first == 0
        if begun[0] % 2 == 0:
            stream.add(first, words)

    with SonarDriver.open(port, listen_only=True) as sonar:
        sonar.configure(Setup.of(settings), on_words=on_words)
        begin()
        for block in sonar.listen(stop=lambda: len(ready_ns) == count, timeout_s=_PATIENCE_S):
            pipeline.process(Measurement(block.data, settings), image, stream=stream)
            ready_ns[block.counter] = time.monotonic_ns()
            if not np.array_equal(image, expected[block.counter % len(expected)]):
                raise DataError(f"the image of block {block.counter} has other bits than that of its measurement")
    return ready_ns


def _send(job: _SenderJob) -> None:
    """Send blocks at the rate of the line, and print the time of the last byte of each.

    That is the time before it is written: on a busy machine, the image can be ready before this process runs again.
    The first block is sent after the signal that the receiver has opened the terminal.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {_BEGIN})  # It stays pending until sigwait.
    words, terminal = np.load(job.words), Terminal()
    _emit_event(event="ready", port=terminal.port)
    signal.sigwait({_BEGIN})
    start_s = time.monotonic()
    for counter in range(job.count):
        block = memoryview(encode_block(counter, words[counter % len(words)]))
        begin_s = start_s + counter / job.rate_hz
        time.sleep(max(0.0, begin_s - time.monotonic()))
        begin_s, n_sent = time.monotonic(), 0
        while n_sent < len(block):
            allowed = int((time.monotonic() - begin_s) * BYTES_PER_S) - n_sent
            if allowed < 1:
                time.sleep(2e-4)
                continue
            last_ns = time.monotonic_ns()
            n_written = terminal.write(block[n_sent : n_sent + allowed])
            if not n_written:
                select.select([], [terminal.master], [], 1.0)
            n_sent += n_written
        _emit_event(event="sent", counter=counter, last_ns=last_ns)
    _emit_event(event="done")
    time.sleep(_PATIENCE_S)  # The receiver ends this process; the end of the terminal would unplug the sensor.


def _emit_event(**event: object) -> None:
    os.write(1, f"{json.dumps(event)}\n".encode())


if __name__ == "__main__":
    _send(_SenderJob(**json.loads(sys.argv[1])))
