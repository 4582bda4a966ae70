"""What workers do: look at a recording, plan how to process it, and make its energyscapes.

Each takes and returns what JSON can hold, so that it runs in any process of any machine that sees the files.
"""

import importlib
import statistics
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from ertis_numba import kernels
from ertis_numba.campaign.made import look_at
from ertis_numba.campaign.sensor_run import SensorRun, faults_of
from ertis_numba.errors import DataError, ErtisError
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings
from ertis_numba.stages import planner
from ertis_numba.storage import EnergyscapeWriter, file_kind, open_recording, sensor_names

__all__ = ["follow"]

Tell = Callable[[int], None]
_Key = tuple[str, str, int | None]

_turn = threading.Lock()
_kept: dict[_Key, Pipeline] = {}  # that nobody uses at present


def follow(do: str, about: Mapping[str, Any], tell: Tell = lambda _: None) -> dict[str, Any]:
    """Follow an order, and return what came of it; what is expected to fail is told as ``error``.

    Parameters
    ----------
    do : {"look", "plan", "make"}
    about : mapping
    tell : callable
        Called with the number of measurements that are done; what it raises ends the work.
    """
    try:
        return _ORDERS[do](about, tell)
    except ErtisError as error:
        return {"error": " ".join(str(error).split())}
    except (OSError, MemoryError) as error:  # they need not come another time
        return {"error": " ".join(str(error).split()) or type(error).__name__, "by_chance": True}


def _look(about: Mapping[str, Any], _: Tell) -> dict[str, Any]:
    """Say what a recording holds, and what of it is made already."""
    path = Path(about["path"])
    if not about["named"] and file_kind(path) == "energyscape":
        return {"passed_over": True}
    names = sensor_names(path) if about["sensor"] is None else (about["sensor"],)
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(path, sensor=name)) for name in names]
        return {
            "sensors": {recording.sensor: recording.settings.to_toml() for recording in recordings},
            "measurements": sum(map(len, recordings)),
            "made": look_at(Path(about["target"]), recordings[0], about["dtype"]),
        }


def _plan(about: Mapping[str, Any], _: Tell) -> dict[str, Any]:
    """Settle what settings leave open; ``warm`` also compiles what it takes, which whoever comes later finds."""
    settings = Settings.from_toml(about["settings"], "settings")
    threads = _threads(about, settings)
    if not about["warm"]:
        loaded = kernels.load(about["device"])
        planned = planner.complete(settings, loaded, threads=loaded.max_threads)
        return {"settings": planned.to_toml(), "device": loaded.device}
    with _pipelines([settings], about["device"], threads) as (pipeline,):
        planned, device = pipeline.settings, pipeline.device
    with _turn:  # it is asked for by its plan from now on
        if (made := _kept.pop((settings.to_toml(), about["device"], threads), None)) is not None:
            _kept[planned.to_toml(), about["device"], threads] = made
    return {"settings": planned.to_toml(), "device": device}


def _make(about: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """Make the energyscape file of a recording."""
    path, target = Path(about["path"]), Path(about["target"])
    settings = [Settings.from_toml(text, f"settings of {name}") for name, text in about["sensors"].items()]
    threads = _threads(about, settings[0])
    warnings: list[str] = []
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(path, sensor=name)) for name in about["sensors"]]
        writer = EnergyscapeWriter(target, recording=recordings, dtype=about["dtype"], overwrite=about["overwrite"])
        pipelines = stack.enter_context(_pipelines(settings, about["device"], threads))
        runs = [SensorRun(each, batch=about["batch"], most_bytes=about["most_bytes"]) for each in pipelines]
        for run, recording in zip(runs, recordings, strict=True):
            first = run.known(recording[0])
            faults = faults_of(f"{path}: sensor {recording.sensor}", first)
            if faults and about["strict"]:
                raise DataError(faults)
            warnings += [faults] if faults else []
            if about["examine"]:
                run.told = _named(about["examine"])(run.pipeline, first, threads=threads, **about["examine_with"])
        done = 0
        with writer:
            for run, recording in zip(runs, recordings, strict=True):
                for _ in run.write(recording, writer):
                    done += 1
                    tell(done)
    times_ms = [time_ms for run in runs for time_ms in run.times_ms]
    return {
        "measurements": len(times_ms),
        "device": runs[0].pipeline.device,
        "median_ms": round(statistics.median(times_ms), 3),
        "sensors": [{"sensor": name, **run.report()} for name, run in zip(about["sensors"], runs, strict=True)],
        "warnings": warnings,
    }


def _threads(about: Mapping[str, Any], settings: Settings) -> int | None:
    """Return how many threads a measurement may have, where workers share the cores of a machine."""
    if about["threads"] is not None or settings.processing.method == "paper":
        return None if about["threads"] is None else int(about["threads"])
    most = kernels.load(about["device"]).max_threads
    return max(1, min(most // int(about["share"]), int(about.get("at_most", most))))


@contextmanager
def _pipelines(settings: Sequence[Settings], device: str, threads: int | None) -> Iterator[list[Pipeline]]:
    """Yield a pipeline for each of the settings, those of the recording before where they are the same.

    Who uses one has it for itself. No more are kept than were used last, so that memory does not grow with the number
    of recordings.
    """
    keys: list[_Key] = [(each.to_toml(), device, threads) for each in settings]
    with _turn:
        found = {key: _kept.pop(key) for key in keys if key in _kept}
        spare = list(_kept.values())
        _kept.clear()
    for each in spare:  # first, as there may be no room for both
        each.close()
    try:
        for key, given in zip(keys, settings, strict=True):
            if key not in found:  # sensors that are alike share theirs
                found[key] = Pipeline(given, device=device, threads=threads)
        yield [found[key] for key in keys]
    finally:
        with _turn:
            _kept.update(found)


def _named(name: str) -> Callable[..., dict[str, Any]]:
    module, _, function = name.partition(":")
    found: Callable[..., dict[str, Any]] = getattr(importlib.import_module(module), function)
    return found


_ORDERS: Final[dict[str, Callable[[Mapping[str, Any], Tell], dict[str, Any]]]] = {
    "look": _look,
    "plan": _plan,
    "make": _make,
}
