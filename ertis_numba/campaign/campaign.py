"""Course of a campaign: order of the work, and the result of each recording."""

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from ertis_numba.base import checks
from ertis_numba.base.errors import ErtisError
from ertis_numba.base.forks import usable_cores
from ertis_numba.campaign.echo_measurements import count_images, no_images, passive_note, require_images
from ertis_numba.campaign.existing_output import difference
from ertis_numba.campaign.folder import clear_parts, exclusive_folder
from ertis_numba.campaign.plans import Plans
from ertis_numba.campaign.recordings import RecordingFile, known_sensors, output_paths
from ertis_numba.campaign.tasks import (
    MAX_WAITING_BYTES,
    TASK_OPTIONS,
    CampaignOptions,
    Task,
    TaskAction,
    TaskUpdate,
    WorkerPool,
)
from ertis_numba.geometry import self_contained
from ertis_numba.settings import Accuracy, Settings

__all__ = ["Campaign", "Event", "RecordingEnded", "RecordingProgress", "RecordingStarted"]

_WAIT_S: Final = 0.5
_N_INSPECTED_AHEAD: Final = 2  # Recordings inspected in advance, so that no worker waits.


Outcome = Literal["made", "kept", "skipped", "failed"]


@dataclass(frozen=True, slots=True)
class RecordingStarted:
    """Processing of a recording has begun."""

    recording: Path
    measurements: int


@dataclass(frozen=True, slots=True)
class RecordingProgress:
    """Number of processed measurements of a recording."""

    recording: Path
    done: int


@dataclass(frozen=True, slots=True)
class RecordingEnded:
    """Result of a recording.

    Attributes
    ----------
    recording, output : Path
        Recording, and its energyscape file or file of acoustic maps.
    outcome : {"made", "kept", "skipped", "failed"}
        ``kept`` means that the output exists, made with the same settings and versions. ``skipped`` means a
        result of processing, or a recording without images, that was not given by name.
    error : str
        Reason of a failure in one line; empty otherwise.
    made : dict
        Measurements, times and other results of a processed recording; results of the checks for an existing output.
    """

    recording: Path
    output: Path
    outcome: Outcome
    error: str = ""
    made: dict[str, Any] = field(default_factory=dict)


Event = RecordingStarted | RecordingProgress | RecordingEnded


@dataclass(slots=True, eq=False)
class _RecordingState:
    """Recording in progress."""

    found: RecordingFile
    target: Path
    measurements: int = 0
    wanted: dict[str, Settings] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    is_kept: bool = False

    def ended(self, outcome: Outcome, **more: Any) -> RecordingEnded:
        return RecordingEnded(self.found.path, self.target, outcome, **more)


class Campaign:
    """Processing of many recordings to energyscape files, or files of acoustic maps, in a folder.

    A recording whose measurements are all passive has no images. It fails if it was given by name, and is skipped
    otherwise. If only some are passive, the others become images.

    The files do not depend on the number of workers or threads: only the date in them differs. A plan is chosen once
    for all recordings with the same settings. An existing file is kept if it was made from the same recording with the
    same settings and versions.

    Parameters
    ----------
    recordings : sequence of RecordingFile
        Recordings to process, as `find_recordings` returns them.
    folder : str or Path
        Output folder. It is created if it does not exist.
    options : CampaignOptions, optional
        Options for each recording.
    workers : int or str, optional
        Number of processes on this machine. By default, there is one for a GPU. On CPUs, there are as many as the cores
        allow with ``options.threads`` threads each, or with 1 if it is None. The address of a dask scheduler, as in
        ``"tcp://127.0.0.1:8786"``, uses its workers instead.

    Raises
    ------
    ArgumentError
        Two recordings have the same output file, the folder cannot be created, or channels are excluded of a sensor
        that is in no recording.
    """

    def __init__(
        self,
        recordings: Sequence[RecordingFile],
        folder: str | Path,
        options: CampaignOptions | None = None,
        *,
        workers: int | str | None = None,
    ) -> None:
        self._scheduler = checks.scheduler("workers", workers) if isinstance(workers, str) else None
        self._workers = None if isinstance(workers, str | None) else checks.integer("workers", workers, 1)
        self.folder, self._options = Path(folder), options or CampaignOptions()
        targets = output_paths(recordings, self.folder, self._options.result)
        self._names = {target.name for target in targets}
        self._n_recordings = len(recordings)
        self._waiting = deque(map(_RecordingState, recordings, targets))
        if self._options.without.of_sensor:
            self._options.without.require_known(known_sensors(recordings))
        self._plans = Plans()
        self._unplanned: deque[_RecordingState] = deque()
        self._ready: deque[_RecordingState] = deque()
        self._submitted: dict[int, tuple[Task, _RecordingState]] = {}
        self._n_tasks = 0

    @property
    def workers(self) -> int:
        """Number of processes on this machine: at most one per recording."""
        cores = usable_cores()
        chosen = self._workers or (1 if self._options.device == "cuda" else cores // (self._options.threads or 1))
        return max(1, min(chosen, self._n_recordings))

    def run(self) -> Generator[Event]:
        """Process the recordings, and yield events; close the iterator to cancel all work.

        Raises
        ------
        ArgumentError
            Another campaign writes into the folder.
        DeviceError
            No process can be started, or dask.distributed is missing.
        NetworkError
            The scheduler does not answer, or the connection to it is lost.
        """
        with exclusive_folder(self.folder):
            clear_parts(self.folder, self._names)
            try:
                with closing(self._pool()) as pool:
                    while self._submit_tasks(pool):
                        for news in pool.wait(_WAIT_S):
                            yield from self._handle_update(pool, news)
            finally:
                clear_parts(self.folder, self._names)

    def _pool(self) -> WorkerPool:
        if self._scheduler is not None:
            from ertis_numba.campaign.dask_workers import DaskWorkerPool  # noqa: PLC0415  it loads dask

            return DaskWorkerPool(self._scheduler)
        from ertis_numba.campaign.process_pool import ProcessPool  # noqa: PLC0415

        return ProcessPool(self.workers)

    def _submit_tasks(self, pool: WorkerPool) -> bool:
        """Give tasks to free workers; return True if any task is in progress."""
        while pool.free > 0 and (pair := self._next(pool)) is not None:
            self._submitted[pair[0].number] = pair
            pool.submit(pair[0])
        return bool(self._submitted)

    def _next(self, pool: WorkerPool) -> tuple[Task, _RecordingState] | None:
        """Return the next task; recordings that are nearest to their end come first."""
        if self._ready:
            case = self._ready.popleft()
            return self._new_task("check" if case.is_kept else "make", self._pending_output(case, pool.size)), case
        if (planned := self._to_plan(pool.size)) is not None:
            return planned
        in_hand = len(self._submitted) + len(self._unplanned)
        if self._waiting and in_hand < pool.size + _N_INSPECTED_AHEAD:
            case = self._waiting.popleft()
            return self._new_task("look", self._inspection(case)), case
        return None

    def _to_plan(self, n_workers: int) -> tuple[Task, _RecordingState] | None:
        """Return a planning task, unless all planning has to wait."""
        for case in self._unplanned:
            settings = next(each for each in case.wanted.values() if self._plans.get(each) is None)
            if (kernels := self._plans.begin(settings)) is not None:
                self._unplanned.remove(case)
                arguments = {
                    "kind": self._options.result,
                    "settings": settings.to_toml(),
                    "warm": kernels == "new",
                    **self._shares(n_workers),
                }
                return self._new_task("plan", arguments), case
        return None

    def _new_task(self, action: TaskAction, arguments: dict[str, Any]) -> Task:
        self._n_tasks += 1
        return Task(self._n_tasks, action, arguments)

    def _inspection(self, case: _RecordingState) -> dict[str, Any]:
        return {
            "path": self._path(case.found.path),
            "target": self._path(case.target),
            "kind": self._options.result,
            "named": case.found.named,
            "dtype": self._options.dtype,
            "sensor": self._options.sensor,
        }

    def _path(self, path: Path) -> str:
        """Return a path for workers; those of a scheduler may have another current folder."""
        return str(path if self._scheduler is None else path.absolute())

    def _shares(self, n_workers: int) -> dict[str, Any]:
        share = 1 if self._scheduler is not None else n_workers
        options = self._options
        return {"device": options.device, "plan": options.plan, "threads": options.threads, "share": share}

    def _pending_output(self, case: _RecordingState, n_workers: int) -> dict[str, Any]:
        options = self._options
        planned = {}
        for name, settings in case.wanted.items():
            plan = self._plans.get(settings)
            if isinstance(plan, Accuracy):
                planned[name] = settings.replace(accuracy=plan).to_toml()
        return {
            "kind": options.result,
            "path": self._path(case.found.path),
            "target": self._path(case.target),
            **self._shares(n_workers),
            **{name: getattr(options, name) for name in TASK_OPTIONS},
            "sensors": planned,
            "max_bytes": MAX_WAITING_BYTES / n_workers,
            # Dask repeats the task of a lost worker, even if only the message about its result was missing.
            "overwrite": options.overwrite or self._scheduler is not None,
        }

    def _handle_update(self, pool: WorkerPool, news: TaskUpdate) -> Iterator[Event]:
        if news.number not in self._submitted:
            return
        task, case = self._submitted[news.number]
        if news.result is None:
            if news.done:
                yield RecordingProgress(case.found.path, news.done)
            return
        del self._submitted[news.number]
        if task.action == "plan":
            settings = Settings.from_toml(task.arguments["settings"], "settings")
            self._plans.finish(settings, news.result)
            if "by_chance" not in news.result:
                yield from self._planned(pool, case, news.result)
                return
        if "error" in news.result:
            if task.action == "make" and "by_chance" in news.result:
                clear_parts(self.folder, {case.target.name})  # A killed worker may have left them.
            yield case.ended("failed", error=news.result["error"])
        elif task.action == "look":
            yield from self._handle_inspection(case, news.result)
        else:
            warnings = [*case.notes, *news.result["warnings"]]
            yield case.ended("kept" if case.is_kept else "made", made=news.result | {"warnings": warnings})

    def _handle_inspection(self, case: _RecordingState, reported: dict[str, Any]) -> Iterator[Event]:
        if reported.get("skipped"):
            yield case.ended("skipped")
            return
        try:
            self._choose_results(case, reported)
            if not case.measurements and not case.found.named:
                yield case.ended("skipped", made={"warnings": [no_images(case.found.path)]})
                return
            require_images(case.found.path, case.measurements)
            made = reported["made"]
            differs = "" if made is None else difference(made, case.wanted, self._options.mounting)
        except (ErtisError, OSError) as error:
            yield case.ended("failed", error=" ".join(str(error).split()))
            return
        if made is not None and not differs:
            yield from self._handle_existing(case, made["sensors"])
        elif made is not None and (made.get("recording") or not self._options.overwrite):
            remedy = "choose another folder" + (
                "" if made.get("recording") else ", or replace the output (overwrite=True)"
            )
            yield case.ended("failed", error=f"output {case.target} exists and {differs}; {remedy}")
        else:
            yield from self._advance(case)

    def _choose_results(self, case: _RecordingState, reported: dict[str, Any]) -> None:
        """Set the settings of each sensor that has results, and the number of measurements."""
        path, behaviours = case.found.path, reported["behaviours"]
        wanted = {
            name: self._options.settings_of(name, Settings.from_toml(text, f"{path}: settings"))
            for name, text in reported["sensors"].items()
        }
        wanted = {name: self_contained(_absolute(settings)) for name, settings in wanted.items()}
        if self._options.result == "acoustic_map":
            case.wanted = wanted
            case.measurements = sum(sum(counts.values()) for counts in behaviours.values())
            return
        n_images = {name: count_images(settings, behaviours[name]) for name, settings in wanted.items()}
        case.measurements = sum(n_images.values())
        for name, settings in wanted.items():
            if n_images[name]:  # Otherwise, the sensor has no measurement that a worker could report.
                case.wanted[name] = settings
            else:
                case.notes.append(passive_note(path, name, 0, sum(behaviours[name].values())))

    def _handle_existing(self, case: _RecordingState, sensors: dict[str, Any]) -> Iterator[Event]:
        """Report an existing output, or examine its processing first if the options request that."""
        if not self._options.examines_existing:
            yield case.ended("kept")
            return
        case.is_kept = True
        case.wanted = {name: Settings.from_toml(held["settings"], "settings") for name, held in sensors.items()}
        yield from self._advance(case)

    def _planned(self, pool: WorkerPool, case: _RecordingState, reported: dict[str, Any]) -> Iterator[Event]:
        if reported.get("device") == "cuda" and self._workers is None and self._scheduler is None:
            pool.limit(1)  # A GPU processes recordings faster one at a time.
        cases = [case, *self._unplanned]
        self._unplanned.clear()
        for each in cases:
            yield from self._advance(each)

    def _advance(self, case: _RecordingState) -> Iterator[Event]:
        """Queue a recording for processing if its plans are known, otherwise for planning."""
        plans = [self._plans.get(settings) for settings in case.wanted.values()]
        failed = [plan for plan in plans if isinstance(plan, str)]
        if failed:
            yield case.ended("failed", error=f"{case.found.path}: {failed[0]}")
        elif None in plans:
            self._unplanned.append(case)
        else:
            self._ready.append(case)
            if not case.is_kept:
                yield RecordingStarted(case.found.path, case.measurements)


def _absolute(settings: Settings) -> Settings:
    """Return settings with an absolute path to the file of directions, if they name one."""
    directions = settings.processing.directions
    if not isinstance(directions, str) or not directions.lower().endswith(".csv"):
        return settings
    return settings.replace(processing=settings.processing.replace(directions=str(Path(directions).absolute())))
