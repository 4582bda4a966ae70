"""Acoustic maps of passive sensors in a live view."""

import signal
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from ertis_bench.network.processes import JsonLinesProcess
from ertis_bench.network.processor_time import ProcessorTime
from ertis_bench.network.sender import SETTINGS, SenderJob
from ertis_bench.network.sent import read_diaries
from ertis_bench.network.serving import Serve, create_keys, some_words
from ertis_bench.network_trials.map_viewer import MapViewerJob

__all__ = ["measure"]

GOAL: Final = "0 dropped"
_N_SENSORS: Final = 4
_RATE_HZ: Final = 10.0
_SETTLING_S: Final = 120.0
_LOOK_S: Final = 0.1
_WARM_UP: Final = 30  # Measurements of each sensor, for which the view compiles kernels and makes cameras.
Found = dict[str, Any]


def measure(folder: Path, duration_s: float, seed: int) -> Found:
    """Show the acoustic maps of four sensors that emit no calls, in a view without a browser."""
    sensors = [f"sensor-{number + 1}" for number in range(_N_SENSORS)]
    options, given, boss = create_keys(folder, sensors)
    words = some_words(SETTINGS, folder / "words.npy", seed=seed)
    diaries = folder / "warm.ndjson", folder / "sender.ndjson"
    with ExitStack() as stack:
        serve = stack.enter_context(Serve.running(folder, *options, keys=boss))
        job = SenderJob(
            address=serve.listen,
            diary=str(diaries[0]),
            sensors=tuple(sensors),
            rate_hz=_RATE_HZ,
            count=_WARM_UP,
            words=str(words),
            small=False,
            keys=given,
            passive=True,
        )
        look = MapViewerJob(
            address=serve.publish,
            keys=(str(folder / "keys" / "boss.secret.toml"), boss.server),
            words=str(words),
            stated=str(folder / "view.txt"),
        )
        viewer = stack.enter_context(look.start())
        viewer.wait_for("subscribed")
        with job.start() as first:
            first.wait_for("sent", timeout_s=120.0)
        n_before = len(read_diaries(diaries[:1]).kept)
        serve.settle(n_before)
        published, dropped = _published(serve), _dropped(serve)
        begun = _await_maps(viewer, published)
        sender = stack.enter_context(job.replace(diary=str(diaries[1]), count=round(duration_s * _RATE_HZ)).start())
        sender.wait_for("begun")
        load = ProcessorTime(serve.processes() | {"sensor nodes": [sender.pid], "view": [viewer.pid]})
        sender.wait_for("sent", timeout_s=duration_s + 60.0)
        n_sent = len(read_diaries(diaries).kept)
        serve.settle(n_sent)
        dropped = _dropped(serve) - dropped
        before, published = published, _published(serve)
        cpu_percent, cpu_ms = load.percent(), load.rows(max(1, n_sent))
        _await_maps(viewer, published)
        viewer.signal(signal.SIGTERM)
        end = viewer.wait_for("shown", timeout_s=60.0)
        serve.node.stop()
    return {
        "part": "acoustic maps",
        "directions": SETTINGS.processing.directions,
        "sensors": _N_SENSORS,
        "rate_hz": _RATE_HZ,
        "goal": GOAL,
        "sent": n_sent - n_before,
        "published": published - before,
        "dropped": dict(dropped),
        **_since(begun, end),
        "cpu_percent": cpu_percent,
        "cpu_ms": cpu_ms,
    }


def _since(begun: Found, end: Found) -> Found:
    """Return the counts of the view without those of the warm-up, except for the checks of maps."""
    since = {name: end[name] - begun[name] for name in ("received", "dropped", "replaced", "frames")}
    return {
        "maps": since["received"],
        "maps_dropped": since["dropped"],
        "start_dropped": begun["dropped"],
        "replaced": since["replaced"],
        "frames": since["frames"],
        "checked": end["checked"],
        "wrong": end["wrong"],
    }


def _published(serve: Serve) -> int:
    """Return the number of published measurements without a call."""
    return 0 if serve.latest is None else sum(each.passive for each in serve.latest.sensors.values())


def _dropped(serve: Serve) -> Counter[str]:
    """Return the number of measurements that the central node dropped, by reason."""
    counts = () if serve.latest is None else (Counter(each.dropped) for each in serve.latest.sensors.values())
    return sum(counts, Counter[str]())


def _await_maps(viewer: JsonLinesProcess, n_published: int) -> Found:
    """Return the counts of the view once all measurements have become maps or were dropped, or after a timeout."""
    end_s = time.monotonic() + _SETTLING_S
    while True:
        n_events = len(viewer.events)
        viewer.signal(signal.SIGUSR1)
        counts = viewer.wait_for("counts", since=n_events)
        if counts["received"] + counts["dropped"] >= n_published or time.monotonic() > end_s:
            return counts
        time.sleep(_LOOK_S)
