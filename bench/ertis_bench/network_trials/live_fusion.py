"""Fused images of a platform in an application, from the last byte at the sensor nodes."""

from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_bench.network.processes import until
from ertis_bench.network.processor_time import ProcessorTime
from ertis_bench.network.sender import SETTINGS, SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import Serve, create_keys, percentile
from ertis_bench.network_trials.fused_receiver import FusedPulse, FusedReceiverJob, read_fused
from ertis_bench.platform_trials.platform_scenes import EMITTERS_M, platform_scene, random_reflectors
from ertis_numba.base.errors import DataError
from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Scene
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.render import Simulator

__all__ = ["START_S", "measure"]

GOAL: Final = "0 dropped, 0 skipped; p99 < 150 ms"
_RATE_HZ: Final = 10.0
_N_MEASUREMENTS: Final = 3  # number of different measurements of each sensor
_WARM_UP: Final = 10  # Pulses before the application starts.
START_S: Final = 5.0  # Time of the application's start, which has percentiles of its own.
_TRIES: Final = 20
_DIRECTIONS: Final = "90"
Found = dict[str, Any]


def measure(folder: Path, duration_s: float, seed: int, rate_hz: float = _RATE_HZ) -> Found:
    """Fuse the images of four sensors in an application that starts while the central node serves.

    Its pipelines exist before; the kernels and tables of the fusion do not.
    """
    scene = platform_scene(seed, random_reflectors(seed), EMITTERS_M[0])
    scene = scene.replace(sensors=tuple(each.replace(processing=SETTINGS.processing) for each in scene.sensors))
    sensors = [each.name for each in scene.sensors]
    options, given, boss = create_keys(folder, sensors)
    words, expected = _rendered(scene, folder)
    count = round(duration_s * rate_hz)
    diaries = folder / "warm.ndjson", folder / "sender.ndjson", folder / "fused.ndjson"
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, "--directions", _DIRECTIONS, *options, keys=boss))
        job = SenderJob(
            address=serve.listen,
            diary=str(diaries[0]),
            sensors=tuple(sensors),
            rate_hz=rate_hz,
            count=_WARM_UP,
            words=str(words),
            small=False,
            keys=given,
            mountings={each.name: (each.position_m or (), each.quaternion().tolist()) for each in scene.sensors},
        )
        _warm_up(serve, job)
        before = _counts(serve)
        look = FusedReceiverJob(
            address=serve.publish,
            diary=str(diaries[2]),
            keys=(str(folder / "keys" / "boss.secret.toml"), boss.server),
            expected=str(expected),
            mountings=job.mountings,
        )
        receiver = stack.enter_context(look.start())
        receiver.wait_for("subscribed")
        sender = stack.enter_context(job.replace(diary=str(diaries[1]), count=count).start())
        sender.wait_for("begun")
        load = ProcessorTime(serve.processes() | {"sensor nodes": [sender.pid], "application": [receiver.pid]})
        sender.wait_for("sent", timeout_s=duration_s + 60.0)
        serve.settle(len(read_diaries(diaries[:2]).kept))
        until(lambda: len(read_fused(diaries[2])) >= count, timeout_s=10.0)
        cpu_percent, cpu_ms = load.percent(), load.rows(max(1, len(read_fused(diaries[2]))))
        receiver.signal(15)
        end = receiver.wait_for("received")
        pulses = read_fused(diaries[2])
        after = _counts(serve)
        serve.node.stop()
    return _summary(pulses) | {
        "part": "fused image",
        "directions": _DIRECTIONS,
        "sensors": len(sensors),
        "rate_hz": rate_hz,
        "goal": GOAL,
        "pulses": count,
        "published": after[0] - before[0],
        "dropped": dict(after[1] - before[1]),
        "images_dropped": end["dropped"],
        "skipped": end["skipped"],
        "checked": end["checked"],
        "wrong": end["wrong"],
        "cpu_percent": cpu_percent,
        "cpu_ms": cpu_ms,
    }


def _rendered(scene: Scene, folder: Path) -> tuple[Path, Path]:
    """Write the words of some measurements of each sensor, and their images, and return the files."""
    words: list[Any] = []
    images: dict[str, Any] = {}
    plan = make_plan(scene)
    for sensor in scene.sensors:
        simulator = Simulator(scene, sensor=sensor.name, plan=plan)
        measurements = [simulator.render(number) for number in range(_N_MEASUREMENTS)]
        settings = SETTINGS.replace(processing=SETTINGS.processing.replace(directions=_DIRECTIONS))
        with Pipeline(settings) as pipeline:
            made = [pipeline.process(replace(each, settings=settings)).amplitude for each in measurements]
        images[sensor.name] = np.stack(made)
        words.append([each.data for each in measurements])
    np.save(folder / "words.npy", np.array(words))
    np.savez(folder / "expected.npz", **images)
    return folder / "words.npy", folder / "expected.npz"


def _warm_up(serve: Serve, job: SenderJob) -> None:
    """Let the central node create its pipelines: send measurements until it publishes images."""
    for _ in range(_TRIES):
        with job.start() as sender:
            sender.wait_for("sent", timeout_s=120.0)
        serve.settle(len(read_diaries([Path(job.diary)]).kept))
        if _counts(serve)[0]:
            return
    raise DataError(f"the central node published no image of {_TRIES} × {job.count} measurements of each sensor")


def _counts(serve: Serve) -> tuple[int, Counter[str]]:
    """Return the published images, and the dropped measurements by reason."""
    sensors = [] if serve.latest is None else list(serve.latest.sensors.values())
    dropped = sum((Counter(each.dropped) for each in sensors), Counter())
    return sum(each.published for each in sensors), dropped


def _summary(pulses: list[FusedPulse]) -> Found:
    """Return the counts and times of pulses; those of the application's start are separate."""
    begun_ns = min((each.first_ns for each in pulses), default=0)
    later = [each for each in pulses if each.first_ns - begun_ns >= 1e9 * START_S]
    later_ms = [(each.ready_ns - each.first_ns) / 1e6 for each in later]
    located_ms = [(each.located_ns - each.first_ns) / 1e6 for each in later]
    start_ms = [(each.ready_ns - each.first_ns) / 1e6 for each in pulses if each not in later]
    return {
        "fused": len(pulses),
        "incomplete": sum(each.n_images < 4 for each in pulses),
        "p50_ms": percentile(later_ms, 0.5),
        "p99_ms": percentile(later_ms, 0.99),
        "slowest_ms": percentile(later_ms, 1.0),
        "points_p50_ms": percentile(located_ms, 0.5),
        "points_p99_ms": percentile(located_ms, 0.99),
        "start_s": START_S,
        "start_slowest_ms": percentile(start_ms, 1.0),
    }
