"""Actions of workers: inspect a recording, plan its processing, process it, or check an existing output.

Arguments and results can be represented in JSON, so that an action runs in any process with access to the files.
"""

import functools
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_numba import kernels
from ertis_numba.base.atomic_files import remedy
from ertis_numba.base.errors import ErtisError
from ertis_numba.campaign.existing_output import inspect_output
from ertis_numba.campaign.folder import final_name
from ertis_numba.campaign.map_job import MapJob, check_maps, prepare_maps
from ertis_numba.campaign.recording_job import Pipelines, RecordingJob, check_recording, prepare_recording
from ertis_numba.campaign.tasks import TASK_OPTIONS, CampaignOptions
from ertis_numba.chain import planner
from ertis_numba.chain.costs import PlanCosts
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.passive import AcousticCamera
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Settings
from ertis_numba.storage import file_kind, open_recording, sensor_names

__all__ = ["run_task"]

ReportProgress = Callable[[int], None]
_Key = tuple[str, str, int | None]

_idle_lock = threading.Lock()
_idle_pipelines: dict[_Key, Pipeline] = {}  # Pipelines that are not in use.


def run_task(action: str, arguments: Mapping[str, Any], notify: ReportProgress = lambda _: None) -> dict[str, Any]:
    """Run a task, and return its result; expected errors are returned as ``error``, and those of ``notify`` end it."""
    try:
        return _ACTIONS[action](arguments, notify)
    except ErtisError as error:
        return {"error": " ".join(str(error).split())}
    except (OSError, MemoryError) as error:  # These errors may be temporary.
        return {"error": _one_line(error), "by_chance": True}


def _one_line(error: OSError | MemoryError) -> str:
    """Return an error of the system in one line, with the final name of the file and a remedy."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{final_name(os.fsdecode(error.filename))}: {error.strerror}; {remedy(error)}"
    return " ".join(str(error).split()) or type(error).__name__


def _inspect(arguments: Mapping[str, Any], _: ReportProgress) -> dict[str, Any]:
    """Return sensors, settings and measurements by behaviour of a recording, and existing outputs by kind of result."""
    path = Path(arguments["path"])
    if not arguments["named"] and file_kind(path) != "recording":
        return {"skipped": True}
    names = sensor_names(path) if arguments["sensor"] is None else (arguments["sensor"],)
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(path, sensor=name)) for name in names]
        return {
            "sensors": {recording.sensor: recording.settings.to_toml() for recording in recordings},
            "behaviours": {
                recording.sensor: Counter(stamp.behaviour for stamp in recording.stamps()) for recording in recordings
            },
            "made": inspect_output(Path(arguments["target"]), recordings[0], arguments["kind"], arguments["dtype"]),
        }


def _plan(arguments: Mapping[str, Any], _: ReportProgress) -> dict[str, Any]:
    """Complete open settings; ``warm`` also compiles the kernels for later use."""
    settings = Settings.from_toml(arguments["settings"], "settings")
    threads = _threads(arguments, settings)
    if arguments["kind"] == "acoustic_map":
        return _plan_maps(settings, arguments["device"], threads, warm=arguments["warm"])
    if not arguments["warm"]:
        loaded = kernels.load(arguments["device"])
        planned = planner.complete(settings, loaded, threads=loaded.max_threads, plan=arguments["plan"])
        return {"settings": planned.to_toml(), "device": loaded.device}
    with _pipelines([settings], arguments["device"], threads, arguments["plan"]) as (pipeline,):
        planned, device = pipeline.settings, pipeline.device
    with _idle_lock:
        made = _idle_pipelines.pop((settings.to_toml(), arguments["device"], threads), None)
    if made is not None:  # Later tasks have the settings with the plan.
        _store_idle({(planned.to_toml(), arguments["device"], threads): made})
    return {"settings": planned.to_toml(), "device": device}


def _plan_maps(settings: Settings, device: str, threads: int | None, *, warm: bool) -> dict[str, Any]:
    """Return the settings of acoustic maps as they are; ``warm`` compiles the kernels with a map of silence."""
    with AcousticCamera(settings, device, threads, check=False) as camera:
        if warm:
            words = sample_format(settings)
            camera.process(Measurement(np.zeros(words.shape, words.dtype), camera.settings))
        return {"settings": settings.to_toml(), "device": camera.device}


def _make(arguments: Mapping[str, Any], notify: ReportProgress) -> dict[str, Any]:
    """Write the energyscape file, or the file of acoustic maps, of a recording."""
    options, settings, pipelines = _processing_arguments(arguments)
    warnings: list[str] = []
    paths = Path(arguments["path"]), Path(arguments["target"])
    shared: dict[str, Any] = {"sensors": list(settings), "settings": settings, "warn": warnings.append}
    prepared: AbstractContextManager[MapJob | RecordingJob]
    if arguments["kind"] == "acoustic_map":
        prepared = prepare_maps(*paths, options, **shared)
    else:
        prepared = prepare_recording(*paths, options, **shared, pipelines=pipelines, max_bytes=arguments["max_bytes"])
    with prepared as work:
        with closing(work.run()) as steps:
            for done in steps:
                notify(done)
        return {**work.report(), "warnings": warnings}


def _check(arguments: Mapping[str, Any], _: ReportProgress) -> dict[str, Any]:
    """Return the warnings and results that processing would give, for a recording with an existing output."""
    options, settings, pipelines = _processing_arguments(arguments)
    warnings: list[str] = []
    path, found = Path(arguments["path"]), {}
    if arguments["kind"] == "acoustic_map":
        check_maps(path, options, settings=settings, warn=warnings.append)
    else:
        found = check_recording(path, options, settings=settings, pipelines=pipelines, warn=warnings.append)
    return {**found, "warnings": warnings}


def _processing_arguments(arguments: Mapping[str, Any]) -> tuple[CampaignOptions, dict[str, Settings], Pipelines]:
    """Return the options, the settings of each sensor and the source of pipelines."""
    settings = {name: Settings.from_toml(text, f"settings of {name}") for name, text in arguments["sensors"].items()}
    threads = _threads(arguments, next(iter(settings.values())))
    shared = {name: arguments[name] for name in (*TASK_OPTIONS, "device")}
    options = CampaignOptions(**shared, threads=threads)
    return options, settings, functools.partial(_pipelines, device=arguments["device"], threads=threads)


def _threads(arguments: Mapping[str, Any], settings: Settings) -> int | None:
    """Return the number of threads per measurement, if workers share the cores of a machine."""
    if arguments["threads"] is not None or settings.processing.method == "paper":
        return None if arguments["threads"] is None else int(arguments["threads"])
    largest = kernels.load(arguments["device"]).max_threads
    return max(1, min(largest // int(arguments["share"]), int(arguments.get("at_most", largest))))


@contextmanager
def _pipelines(
    settings: Sequence[Settings], device: str, threads: int | None, plan: PlanCosts = "nominal"
) -> Iterator[list[Pipeline]]:
    """Yield pipelines for settings, reusing those of the last recording only, so that the memory does not grow."""
    keys: list[_Key] = [(each.to_toml(), device, threads) for each in settings]
    with _idle_lock:
        found = {key: _idle_pipelines.pop(key) for key in keys if key in _idle_pipelines}
        spare = list(_idle_pipelines.values())
        _idle_pipelines.clear()
    for each in spare:  # Close them first: memory may not suffice for both.
        each.close()
    try:
        for key, given in zip(keys, settings, strict=True):
            if key not in found:  # Sensors with the same settings share a pipeline.
                found[key] = Pipeline(given, device=device, threads=threads, predict=False, plan=plan)
        yield [found[key] for key in keys]
    finally:
        _store_idle(found)


def _store_idle(pipelines: Mapping[_Key, Pipeline]) -> None:
    """Keep pipelines for later requests, replacing those of the same settings."""
    with _idle_lock:
        spare = [_idle_pipelines.pop(key) for key in pipelines if key in _idle_pipelines]
        _idle_pipelines.update(pipelines)
    for each in spare:
        each.close()


_ACTIONS: Final[dict[str, Callable[[Mapping[str, Any], ReportProgress], dict[str, Any]]]] = {
    "look": _inspect,
    "plan": _plan,
    "make": _make,
    "check": _check,
}
