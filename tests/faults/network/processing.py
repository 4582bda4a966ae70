"""Trials of image processing with dying workers, lost pulses and wrong clocks."""

import os
import random
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
from ertis_bench.network.processes import survivors, until
from ertis_bench.network.receiver import ReceiverJob, read_received
from ertis_bench.network.sender import SMALL, SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import Serve, accounts, expected_of, some_words
from ertis_bench.network_trials.oracle import judged, tracebacks

from ertis_numba.network.messages import Group
from ertis_numba.network.subscriber import Subscriber
from tests.faults.network.receiver_thread import ReceiverThread
from tests.faults.network.sender_thread import SenderThread

__all__ = ["grouped", "groups", "workers"]

_DIRECTIONS: Final = "2d:9"
_N_ON_THE_WAY: Final = 4  # images that may have been made before a kill and arrive after it
_SHARE_WHILE_STARTING: Final = 0.1  # share of workers that are killed while they start

Found = dict[str, Any]


def workers(folder: Path, *, seed: int, count: int) -> Found:
    """Kill workers at random times, while a central node stores and processes the measurements of two sensors."""
    rng = random.Random(seed)
    archive, diary, images = folder / "recordings", folder / "sender.ndjson", folder / "images.ndjson"
    archive.mkdir()
    words = some_words(SMALL, folder / "words.npy", seed=seed)
    expected = expected_of(SMALL, np.load(words), folder / "expected.npz")
    killed = 0
    options = ("--record", str(archive), "--directions", _DIRECTIONS, "--range", "0.3:1.0", "--workers", "2")
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, *options))
        receiver = stack.enter_context(
            ReceiverThread(ReceiverJob(address=serve.publish, diary=str(images), expected=str(expected)))
        )
        job = SenderJob(
            address=serve.listen, diary=str(diary), sensors=("left", "right"), rate_hz=25.0, words=str(words)
        )
        sender = stack.enter_context(SenderThread(job))
        until(lambda: images.exists() and bool(read_received(images).numbers))
        seen: set[int] = set()
        while killed < count:
            status = serve.look()
            processing = None if status is None else status.processing
            fresh = [
                each.pid
                for each in (processing.workers if processing else ())
                if each.pid not in seen and (each.state != "starting" or rng.random() < _SHARE_WHILE_STARTING)
            ]
            for pid in fresh[:1]:  # The other worker continues.
                seen.add(pid)
                time.sleep(rng.uniform(0.0, 0.1))
                os.kill(pid, signal.SIGKILL)
                killed += 1
        n_images = len(read_received(images).numbers)
        until(lambda: len(read_received(images).numbers) > n_images + 2 * _N_ON_THE_WAY)
        n_after = len(read_received(images).numbers) - n_images
        sender.signal(signal.SIGTERM)
        flushed = sender.wait_for("sent")["flushed"]
        sent = read_diaries([diary])
        acked_through = serve.settle(len(sent.kept))
        serve.deliver(images)
        receiver.stop()
        found = accounts(serve, sent, read_received(images))
        processing = None if serve.latest is None else serve.latest.processing
        if processing is not None:
            found |= {"respawned": processing.respawned, "retried": processing.retried}
        serve.node.stop()
        until(lambda: not survivors(serve.mark))
    stored = judged(folder, archive, [diary])
    return (
        {"kills": killed, "flushed": flushed, "acked_through": acked_through, "orphans": len(survivors(serve.mark))}
        | found
        | {name: stored[name] for name in ("stored", "lost", "missing", "silent", "left_over", "tracebacks")}
        | {"wrong": found["wrong"] + stored["wrong"], "twice": found["twice"] + stored["twice"]}
        | {"images after the kills": n_after, "slowest ack, ms": round(max(sent.ack_times_ms(), default=0.0), 1)}
    )


def groups(folder: Path, *, seed: int, count: int) -> Found:
    """Run three sensors in a SYNC chain with faults.

    One sensor misses a pulse, one counts a pulse twice, and the clock of one is wrong by an hour from a pulse on.
    """
    at = {"lost": count // 4, "double": count // 2, "clock": 3 * count // 4}
    begins_ns, start_s = time.time_ns(), time.monotonic() + 4.0
    job = SenderJob(address="", diary="", rate_hz=10.0, count=count, seed=seed, begins_ns=begins_ns)
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
    return grouped(came, pulse_of, at, n_sensors=len(jobs), count=count) | {"tracebacks": tracebacks(folder)}


def grouped(
    came: list[Group], pulse_of: dict[tuple[str, int], int], at: dict[str, int], *, n_sensors: int, count: int
) -> Found:
    """Compare groups with the pulses at which their measurements were captured."""
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
