"""Measurements of sensors that a central node processes, and their images in an application."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_bench.network.processes import until
from ertis_bench.network.processor_time import ProcessorTime
from ertis_bench.network.receiver import ReceiverJob, read_received
from ertis_bench.network.sender import SETTINGS, SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import Serve, accounts, create_keys, expected_of, percentile, some_words
from ertis_numba.settings import Settings

__all__ = ["processing"]

_WARM_UP_S: Final = 3.0
Found = dict[str, Any]


def processing(
    folder: Path,
    duration_s: float,
    seed: int,
    *,
    directions: str,
    n_sensors: int,
    rate_hz: float,
    goal: str,
    part: str = "processing",
    credit: int = 2,
    scheduler: str | None = None,
    archive: Path | None = None,
) -> Found:
    """Process the measurements of sensors here or on a dask cluster, and check the images in an application.

    With ``archive``, the central node also stores the measurements in this folder.
    """
    sensors = [f"sensor-{number + 1}" for number in range(n_sensors)]
    options, given, boss = create_keys(folder, sensors)
    if scheduler is not None:
        options += ["--workers", scheduler]
    if archive is not None:
        archive.mkdir()
        options += ["--record", str(archive)]
    settings = _settings(directions)
    words = some_words(SETTINGS, folder / "words.npy", seed=seed)
    expected = expected_of(settings, np.load(words), folder / "expected.npz")
    diary, warm, images = folder / "sender.ndjson", folder / "warm.ndjson", folder / "images.ndjson"
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, "--directions", directions, *options, keys=boss))
        boss_keys = (str(folder / "keys" / "boss.secret.toml"), boss.server)
        look = ReceiverJob(
            address=serve.publish, diary=str(images), expected=str(expected), keys=boss_keys, credit=credit
        )
        receiver = stack.enter_context(look.start())
        receiver.wait_for("subscribed")
        job = SenderJob(address=serve.listen, diary=str(warm), sensors=tuple(sensors), rate_hz=5.0, words=str(words))
        job = job.replace(small=False, keys=given, seed=seed)
        # Pipelines are created before the measurement starts.
        with job.replace(count=round(5.0 * _WARM_UP_S)).start() as first:
            first.wait_for("sent", timeout_s=120.0)
        until(lambda: bool(read_received(images).numbers), timeout_s=120.0)
        time.sleep(_WARM_UP_S)
        before = read_diaries([warm])
        serve.settle(len(before.kept))
        begun = accounts(serve, before, read_received(images))
        sender = stack.enter_context(
            job.replace(diary=str(diary), rate_hz=rate_hz, count=round(duration_s * rate_hz)).start()
        )
        sender.wait_for("begun")
        load = ProcessorTime(serve.processes() | {"sensor nodes": [sender.pid], "application": [receiver.pid]})
        n_images = _images_within(duration_s - 1.0, serve, images)
        cpu_percent, cpu_ms = load.percent(), load.rows(n_images)
        sender.wait_for("sent", timeout_s=duration_s + 60.0)
        sent = read_diaries([warm, diary])
        serve.settle(len(sent.kept))
        serve.deliver(images)
        receiver.signal(15)
        receiver.wait()
        received = read_received(images)
        found = _since(begun, accounts(serve, sent, received))
        status = serve.latest
        serve.node.stop()
    measured = read_diaries([diary]).offered
    choice = "" if status is None or status.processing is None else status.processing.choice
    return found | {
        "part": part,
        "directions": directions,
        "sensors": n_sensors,
        "rate_hz": rate_hz,
        "goal": goal,
        "choice": choice,
        **_latencies([time_ms for key, time_ms in received.times_ms.items() if key in measured]),
        "cpu_percent": cpu_percent,
        "cpu_ms": cpu_ms,
        "cpu_total_ms": sum(time_ms for *_, time_ms in cpu_ms),
    }


def _images_within(duration_s: float, serve: Serve, images: Path) -> int:
    """Return the number of images that an application receives within a time."""
    n_before = len(read_received(images).numbers)
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        serve.look(timeout_s=1.0)
    return len(read_received(images).numbers) - n_before


def _latencies(times_ms: list[float]) -> Found:
    shares = {"p50_ms": 0.5, "p90_ms": 0.9, "p99_ms": 0.99, "slowest_ms": 1.0}
    return {name: percentile(times_ms, share) for name, share in shares.items()}


def _since(begun: Found, found: Found) -> Found:
    """Return counts without those from the time before pipelines were created.

    Counts of faults include that time.
    """
    since = {name: found[name] - begun[name] for name in ("sent", "received", "published", "images", "skipped")}
    dropped = {name: count - begun["dropped"].get(name, 0) for name, count in found["dropped"].items()}
    return found | since | {"dropped": {name: count for name, count in dropped.items() if count}}


def _settings(directions: str) -> Settings:
    return SETTINGS.replace(processing=SETTINGS.processing.replace(directions=directions))
