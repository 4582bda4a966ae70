"""Trials with more work than the machine can do, and with slow or stopped applications."""

import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import JsonLinesProcess, until
from ertis_bench.network.receiver import ReceiverJob, read_received
from ertis_bench.network.sender import SMALL, SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import Serve, accounts, percentile, some_words
from ertis_bench.network_trials.oracle import tracebacks

__all__ = ["overload", "subscribers"]

_PAPER: Final = ("--method", "paper", "--device", "numpy", "--directions", "1850")
"""Options that make images slow to compute, so that a sender can easily send twice the possible rate."""

Found = dict[str, Any]


def overload(folder: Path, *, seed: int, duration_s: float) -> Found:
    """Measure the capacity of image processing, then send twice as much."""
    words = some_words(SMALL, folder / "words.npy", seed=seed)
    job = SenderJob(address="", diary="", sensors=("a", "b", "c", "d"), seed=seed, words=str(words))
    rate_hz = _published(folder / "calibration", job.replace(rate_hz=100.0), duration_s=5.0)["images per s"]
    found = _published(folder / "overload", job.replace(rate_hz=2.0 * rate_hz / 4), duration_s=duration_s)
    return {"capacity per s": rate_hz} | found


def _published(folder: Path, job: SenderJob, *, duration_s: float) -> Found:
    """Send for a while, and summarise the results."""
    folder.mkdir()
    diary, warm, images = folder / "sender.ndjson", folder / "warm.ndjson", folder / "images.ndjson"
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, *_PAPER, "--range", "0.3:1.0"))
        receiver = stack.enter_context(ReceiverJob(address=serve.publish, diary=str(images), credit=8).start())
        receiver.wait_for("subscribed")
        with job.replace(address=serve.listen, diary=str(warm), rate_hz=1.0, count=2).start() as first:
            first.wait_for("sent")  # Pipelines are created before the measurement starts.
            until(lambda: len(read_received(images).numbers) > 0)
        sender = stack.enter_context(job.replace(address=serve.listen, diary=str(diary)).start())
        sender.wait_for("begun")
        before, begun_s = len(read_received(images).numbers), time.monotonic()
        memory_bytes = 0
        while time.monotonic() < begun_s + duration_s:
            serve.look()
            memory_bytes = max(memory_bytes, serve.node.memory_bytes)
        per_s = (len(read_received(images).numbers) - before) / (time.monotonic() - begun_s)
        sender.signal(signal.SIGTERM)
        sender.wait_for("sent")
        sent = read_diaries([warm, diary])
        acked_through = serve.settle(len(sent.kept))
        serve.deliver(images)
        receiver.signal(signal.SIGTERM)
        receiver.wait()
        received = read_received(images)
        found = accounts(serve, sent, received)
        serve.node.stop()
    measured = read_diaries([diary]).offered
    times_ms = [time_ms for key, time_ms in received.times_ms.items() if key in measured]
    return {"acked_through": acked_through, "images per s": round(per_s, 1)} | found | {
        "p50, ms": percentile(times_ms, 0.5),
        "p99, ms": percentile(times_ms, 0.99),
        "slowest, ms": percentile(times_ms, 1.0),
        "memory, MB": round(memory_bytes / 1e6),
        "tracebacks": tracebacks(folder),
    }  # fmt: skip


def subscribers(folder: Path, *, seed: int, duration_s: float) -> Found:
    """Measure the effect of slow and stopped applications on another application.

    Each quarter of the time without them is followed by a quarter with them, because the speed of a machine drifts.
    """
    words = some_words(SMALL, folder / "words.npy", seed=seed)
    times_ms: dict[bool, list[float]] = {False: [], True: []}
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, "--directions", "90", "--range", "0.3:1.0"))
        look = ReceiverJob(address=serve.publish, diary=str(folder / "images.ndjson"))
        receiver = stack.enter_context(look.start())
        receiver.wait_for("subscribed")
        job = SenderJob(
            address=serve.listen, diary=str(folder / "sender.ndjson"), sensors=("left", "right"), rate_hz=20.0
        )
        sender = stack.enter_context(job.replace(words=str(words), seed=seed).start())
        until(lambda: bool(read_received(folder / "images.ndjson").numbers))
        time.sleep(1.0)
        slow: list[JsonLinesProcess] = []
        for turn in range(8):
            if turn % 2:
                for name, waits_s in (("slow", 0.5), ("dead", 0.0)):
                    other = look.replace(diary=str(folder / f"{name}-{turn}.ndjson"), waits_s=waits_s).start()
                    slow.append(stack.enter_context(other))
                    other.wait_for("subscribed")
                time.sleep(0.5)
                slow[-1].signal(signal.SIGSTOP)
            before = len(read_received(folder / "images.ndjson").times_ms)
            time.sleep(duration_s / 8)
            times_ms[bool(turn % 2)] += list(read_received(folder / "images.ndjson").times_ms.values())[before:]
            for other in slow:
                other.kill()
            slow.clear()
            time.sleep(0.3)
        sender.signal(signal.SIGTERM)
        sender.wait_for("sent")
        sent = read_diaries([folder / "sender.ndjson"])
        acked_through = serve.settle(len(sent.kept))
        serve.deliver(folder / "images.ndjson")
        receiver.signal(signal.SIGTERM)
        receiver.wait()
        found = accounts(serve, sent, read_received(folder / "images.ndjson"))
        serve.node.stop()
    alone, beside = (percentile(times_ms[each], 0.99) for each in (False, True))
    return {"acked_through": acked_through, "p99 alone, ms": alone, "p99 beside, ms": beside} | found | {
        "grew, %": round(100 * (beside / alone - 1), 1) if alone else 0.0,
        "tracebacks": tracebacks(folder),
    }  # fmt: skip
