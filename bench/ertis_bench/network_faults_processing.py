"""What goes wrong where images are made: workers that die, more work than can be done, applications that are slow."""

import os
import random
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.network_faults_kills import judged, tracebacks
from ertis_bench.network_oracle import Sent, read_diaries
from ertis_bench.network_processes import Process, central, survivors, until
from ertis_bench.network_receiver import STEP, Look, Received, read_received
from ertis_bench.network_sender import SMALL, Job
from ertis_numba.frames import Measurement
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import Group
from ertis_numba.network.status import Status
from ertis_numba.network.subscriber import Subscriber
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings

__all__ = [
    "Serve",
    "accounts",
    "expected_of",
    "groups",
    "overload",
    "percentile",
    "some_words",
    "subscribers",
    "workers",
]

_KINDS: Final = 5  # different measurements
_DIRECTIONS: Final = "2d:9"
_WHILE_STARTING: Final = 0.1  # share of the workers that are killed before they can do anything
_PAPER: Final = ("--method", "paper", "--directions", "1850")
"""What takes long enough that a sender can ask for twice as much."""

Found = dict[str, Any]


def some_words(settings: Settings, path: Path, *, seed: int) -> Path:
    """Write the words of some measurements of noise into a file."""
    shape = (_KINDS, settings.recording.n_samples)
    np.save(path, np.random.default_rng(seed).integers(0, 2**32, shape, dtype=np.uint32))
    return path


def expected_of(settings: Settings, words: NDArray[np.uint32], path: Path) -> Path:
    """Write some values of the image of each measurement into a file, computed here and now."""
    pipeline = Pipeline(settings)
    images = [pipeline.process(Measurement(each, settings)).energy for each in words]
    n_values = images[0].size // STEP - 1
    values = np.stack([image.reshape(-1)[number % STEP :: STEP][:n_values] for number, image in enumerate(images)])
    np.savez(path, values=values, shape=images[0].shape)
    return path


def percentile(times_ms: Sequence[float], share: float) -> float:
    """Return a percentile, 0 of nothing."""
    ordered = sorted(times_ms)
    return round(ordered[round(share * (len(ordered) - 1))], 2) if ordered else 0.0


@dataclass(slots=True)
class Serve:
    """``ertis serve``, and what it says of itself meanwhile; use it in a ``with`` statement of `running`.

    Attributes
    ----------
    node : Process
    listen, publish : str
    mark : str
    unbalanced : int
        How often a status came in which what was received is not what was published, dropped and is under way.
    latest : Status or None
    """

    node: Process
    listen: str
    publish: str
    mark: str
    watcher: "Subscriber[Status]"
    unbalanced: int = 0
    latest: Status | None = None
    pids: set[int] = field(default_factory=set)

    @classmethod
    @contextmanager
    def running(cls, folder: Path, *options: str, keys: ClientKeys | None = None) -> "Iterator[Serve]":
        """Start it and yield it."""
        mark = f"serve{os.getpid()}{time.monotonic_ns()}"
        with central("serve", folder, "--publish", "tcp://127.0.0.1:*", *options, mark=mark) as node:
            listening = node.wait_for("listening")
            with Subscriber(listening["publish"], products=("status",), keys=keys) as watcher:
                yield cls(node, listening["address"], listening["publish"], mark, watcher)

    def look(self, *, timeout_s: float = 5.0) -> Status | None:
        """Return the next status, None if none comes."""
        status = self.watcher.receive(timeout_s)
        if status is not None:
            self.latest = status
            self.unbalanced += any(
                each.received != each.published + sum(each.dropped.values()) + each.in_flight
                for each in status.sensors.values()
            )
        return status

    def settle(self, n_sent: int, *, timeout_s: float = 30.0) -> bool:
        """Wait until all that was sent has become something, and return whether it has."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            status = self.look()
            sensors = [] if status is None else list(status.sensors.values())
            if sum(each.received for each in sensors) >= n_sent and not any(each.in_flight for each in sensors):
                return True
        return False


def accounts(serve: Serve, sent: Sent, received: Received) -> Found:
    """Add up what became of all measurements.

    Returns
    -------
    dict
        ``received``, ``published`` and ``dropped`` as the central node says; ``images`` that an application has, and
        those that were ``skipped`` for it. Then what ought to be 0: ``unbalanced``, see `Serve`; ``uncounted``,
        measurements that the central node does not count; ``untold``, images that neither came nor were told to be
        skipped; and images that came ``twice``, ``disordered`` or ``wrong``, or of what was never sent (``foreign``).
    """
    sensors = [] if serve.latest is None else list(serve.latest.sensors.values())
    dropped: dict[str, int] = {}
    for each in sensors:
        for reason, count in each.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
    published, n_received = sum(each.published for each in sensors), sum(each.received for each in sensors)
    return {
        "sent": len(sent.kept),
        "received": n_received,
        "published": published,
        "dropped": dropped,
        "images": len(received.numbers),
        "skipped": received.dropped,
        "unbalanced": serve.unbalanced + (n_received != published + sum(dropped.values())),
        "uncounted": abs(len(sent.kept) - n_received),
        "untold": abs(published - len(received.numbers) - received.dropped) + received.untold,
        "twice": received.twice,
        "disordered": received.disordered,
        "wrong": received.wrong,
        "foreign": len(received.times_ms.keys() - sent.offered.keys()),
    }


def workers(folder: Path, *, seed: int, count: int) -> Found:
    """Kill workers at random moments, while a central node stores and makes images of what two sensors send."""
    rng = random.Random(seed)  # noqa: S311  a seed is to give the same moments again
    archive, diary, images = folder / "recordings", folder / "sender.ndjson", folder / "images.ndjson"
    archive.mkdir()
    words = some_words(SMALL, folder / "words.npy", seed=seed)
    expected = expected_of(SMALL, np.load(words), folder / "expected.npz")
    killed = 0
    options = ("--record", str(archive), "--directions", _DIRECTIONS, "--range", "0.3:1.0", "--workers", "2")
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, *options))
        receiver = stack.enter_context(Look(address=serve.publish, diary=str(images), expected=str(expected)).start())
        receiver.wait_for("subscribed")
        job = Job(address=serve.listen, diary=str(diary), sensors=("left", "right"), rate_hz=25.0, words=str(words))
        sender = stack.enter_context(job.start())
        until(lambda: images.exists() and bool(read_received(images).numbers))
        seen: set[int] = set()
        while killed < count:
            status = serve.look()
            processing = None if status is None else status.processing
            fresh = [
                each.pid
                for each in (processing.workers if processing else ())
                if each.pid not in seen and (each.state != "starting" or rng.random() < _WHILE_STARTING)
            ]
            for pid in fresh[:1]:  # the other one goes on
                seen.add(pid)
                time.sleep(rng.uniform(0.0, 0.1))
                os.kill(pid, signal.SIGKILL)
                killed += 1
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent")["flushed"]
        sent = read_diaries([diary])
        settled = serve.settle(len(sent.kept))
        time.sleep(0.5)  # for the last image to be written down
        receiver.signal(signal.SIGTERM)
        receiver.wait()
        found = accounts(serve, sent, read_received(images))
        processing = None if serve.latest is None else serve.latest.processing
        if processing is not None:
            found |= {"respawned": processing.respawned, "retried": processing.retried}
        serve.node.stop()
        until(lambda: not survivors(serve.mark))
    stored = judged(folder, archive, [diary])
    return (
        {"kills": killed, "flushed": flushed, "settled": settled, "orphans": len(survivors(serve.mark))}
        | found
        | {name: stored[name] for name in ("stored", "lost", "missing", "silent", "left_over", "tracebacks")}
        | {"wrong": found["wrong"] + stored["wrong"], "twice": found["twice"] + stored["twice"]}
        | {"slowest ack, ms": round(max(sent.ack_times_ms(), default=0.0), 1)}
    )


def overload(folder: Path, *, seed: int, duration_s: float) -> Found:
    """Send twice as much as can be processed, after finding out how much that is."""
    words = some_words(SMALL, folder / "words.npy", seed=seed)
    job = Job(address="", diary="", sensors=("a", "b", "c", "d"), seed=seed, words=str(words))
    rate_hz = _published(folder / "calibration", job.replace(rate_hz=100.0), duration_s=5.0)["images per s"]
    found = _published(folder / "overload", job.replace(rate_hz=2.0 * rate_hz / 4), duration_s=duration_s)
    return {"capacity per s": rate_hz} | found


def _published(folder: Path, job: Job, *, duration_s: float) -> Found:
    """Send for a while, and add up what became of it."""
    folder.mkdir()
    diary, warm, images = folder / "sender.ndjson", folder / "warm.ndjson", folder / "images.ndjson"
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, *_PAPER, "--range", "0.3:1.0"))
        receiver = stack.enter_context(Look(address=serve.publish, diary=str(images), credit=8).start())
        receiver.wait_for("subscribed")
        with job.replace(address=serve.listen, diary=str(warm), rate_hz=1.0, count=2).start() as first:
            first.wait_for("sent")  # pipelines are made before it counts
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
        settled = serve.settle(len(sent.kept))
        time.sleep(0.5)
        receiver.signal(signal.SIGTERM)
        receiver.wait()
        received = read_received(images)
        found = accounts(serve, sent, received)
        serve.node.stop()
    measured = read_diaries([diary]).offered
    times_ms = [time_ms for key, time_ms in received.times_ms.items() if key in measured]
    return {"settled": settled, "images per s": round(per_s, 1)} | found | {
        "p50, ms": percentile(times_ms, 0.5),
        "p99, ms": percentile(times_ms, 0.99),
        "slowest, ms": percentile(times_ms, 1.0),
        "memory, MB": round(memory_bytes / 1e6),
        "tracebacks": tracebacks(folder),
    }  # fmt: skip


def subscribers(folder: Path, *, seed: int, duration_s: float) -> Found:
    """See whether an application notices that others are slow, or stand still.

    Each quarter of the time without them is followed by one with them, as a machine is never the same for long.
    """
    words = some_words(SMALL, folder / "words.npy", seed=seed)
    times_ms: dict[bool, list[float]] = {False: [], True: []}
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, "--directions", "90", "--range", "0.3:1.0"))
        look = Look(address=serve.publish, diary=str(folder / "images.ndjson"))
        receiver = stack.enter_context(look.start())
        receiver.wait_for("subscribed")
        job = Job(address=serve.listen, diary=str(folder / "sender.ndjson"), sensors=("left", "right"), rate_hz=20.0)
        sender = stack.enter_context(job.replace(words=str(words), seed=seed).start())
        until(lambda: bool(read_received(folder / "images.ndjson").numbers))
        time.sleep(1.0)
        slow: list[Process] = []
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
        settled = serve.settle(len(sent.kept))
        time.sleep(0.5)
        receiver.signal(signal.SIGTERM)
        receiver.wait()
        found = accounts(serve, sent, read_received(folder / "images.ndjson"))
        serve.node.stop()
    alone, beside = (percentile(times_ms[each], 0.99) for each in (False, True))
    return {"settled": settled, "p99 alone, ms": alone, "p99 beside, ms": beside} | found | {
        "grew, %": round(100 * (beside / alone - 1), 1) if alone else 0.0,
        "tracebacks": tracebacks(folder),
    }  # fmt: skip


def groups(folder: Path, *, seed: int, count: int) -> Found:
    """Let a sensor miss a pulse, another see one twice, and the clock of a third be an hour wrong from a pulse on."""
    at = {"lost": count // 4, "double": count // 2, "clock": 3 * count // 4}
    begins_ns, start_s = time.time_ns(), time.monotonic() + 4.0
    job = Job(address="", diary="", rate_hz=10.0, count=count, seed=seed, begins_ns=begins_ns)
    jobs = {
        "steady": job.replace(first_pulse=1000),
        "loses": job.replace(first_pulse=5, lost_pulse=at["lost"]),
        "doubles": job.replace(first_pulse=77, double_pulse=at["double"]),
        "steps": job.replace(first_pulse=1000, clock_step=(at["clock"], 3600.0)),
    }
    came: list[Group] = []
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, "--directions", _DIRECTIONS, "--range", "0.3:1.0"))
        listener = stack.enter_context(Subscriber(serve.publish, products=("group",), credit=64))
        senders = [
            stack.enter_context(
                each.replace(
                    address=serve.listen, diary=str(folder / f"{name}.ndjson"), sensors=(name,), start_s=start_s
                ).start()
            )
            for name, each in jobs.items()
        ]
        while any(each.running for each in senders):
            group = listener.receive(0.5)
            if group is not None:
                came.append(group)
        while (group := listener.receive(3.0)) is not None:
            came.append(group)
        serve.node.stop()
    pulse_of = {
        (name, each.sequence_of(pulse)): pulse
        for name, each in jobs.items()
        for pulse in range(count)
        if pulse != each.lost_pulse
    }
    return _grouped(came, pulse_of, at, n_sensors=len(jobs), count=count) | {"tracebacks": tracebacks(folder)}


def _grouped(
    came: list[Group], pulse_of: dict[tuple[str, int], int], at: dict[str, int], *, n_sensors: int, count: int
) -> Found:
    """Compare groups with the pulses that measurements were made at."""
    pulses = [{pulse_of[sensor, sequence] for sensor, _, sequence in group.members} for group in came]
    whole = {
        min(each): group.flags
        for group, each in zip(came, pulses, strict=True)
        if len(each) == 1 and len(group.members) == n_sensors
    }
    return {
        "pulses": count,
        "groups": len(came),
        "complete": len(whole),
        "mixed": sum(len(each) > 1 for each in pulses),
        "flagged before": sum(bool(flags) for pulse, flags in whole.items() if pulse < at["lost"]),
        "pulse flags": sum("pulse" in group.flags for group in came),
        "flagged pulses": sorted(
            {min(each) for group, each in zip(came, pulses, strict=True) if "pulse" in group.flags}
        ),
        "clock flags before": sum("clock" in flags for pulse, flags in whole.items() if pulse < at["clock"]),
        "clock flags after": sum("clock" in flags for pulse, flags in whole.items() if pulse >= at["clock"]),
        "complete after": sum(pulse >= at["clock"] for pulse in whole),
    }
