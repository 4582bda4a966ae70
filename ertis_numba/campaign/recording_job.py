"""Processing of one recording to its energyscape file, the same in any process."""

import itertools
import statistics
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from ertis_numba import kernels
from ertis_numba.analysis.call_match import CallMatch, first_call_match
from ertis_numba.analysis.direction_spacing import spacing_warning
from ertis_numba.analysis.emission_time import describe_start, emissions_of
from ertis_numba.analysis.health import health
from ertis_numba.analysis.layout_match import LayoutMatch, first_layout_match
from ertis_numba.base.errors import DataError
from ertis_numba.campaign.attitudes import unlevelled_image
from ertis_numba.campaign.echo_measurements import EchoMeasurements, require_images
from ertis_numba.campaign.sensor_processing import SensorProcessing, describe_faults
from ertis_numba.campaign.tasks import CampaignOptions
from ertis_numba.chain.planner import Planner
from ertis_numba.chain.wavefronts import plane_wave_error_db
from ertis_numba.frames import Measurement
from ertis_numba.frames.level_codes import ROUNDING_DB
from ertis_numba.geometry import observable_angles
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.pipeline import Pipeline
from ertis_numba.pipeline.prediction import planner_of, predict
from ertis_numba.settings import Settings
from ertis_numba.storage import EnergyscapeWriter, open_recording, sensor_names

__all__ = ["Pipelines", "RecordingJob", "check_recording", "prepare_recording"]

Pipelines = Callable[[Sequence[Settings]], AbstractContextManager[Sequence[Pipeline]]]
_Show = Callable[[str, dict[str, Any]], None]
_Checks = tuple[str, str, CallMatch, LayoutMatch | None]


class RecordingJob:
    """A recording that is ready to be processed; nothing is written yet."""

    def __init__(
        self,
        recordings: Sequence[EchoMeasurements],
        runs: Sequence[SensorProcessing],
        writer: EnergyscapeWriter,
        warn: Callable[[str], None],
    ) -> None:
        self._recordings, self._runs, self._writer, self._warn = recordings, runs, writer, warn
        self.measurements = sum(map(len, recordings))
        """Number of measurements."""

    def run(self) -> Generator[int]:
        """Write the file, and yield the number of processed measurements; closed early, it leaves no file."""
        done = 0
        with self._writer:
            for run, recording in zip(self._runs, self._recordings, strict=True):
                for _ in run.write(recording, self._writer):
                    done += 1
                    yield done
                if run.samples_warning and not run.is_first_only:
                    self._warn(f"{recording.path}: sensor {recording.sensor}: {run.samples_warning}")

    def report(self) -> dict[str, Any]:
        """Return the report of ``--json``; entries of a single sensor are repeated at the top level."""
        rows = [
            {"sensor": recording.sensor, **run.report()}
            for recording, run in zip(self._recordings, self._runs, strict=True)
        ]
        times_ms = [time_ms for run in self._runs for time_ms in run.times_ms]
        outside = ("directions", "ranges", *self._runs[0].reported) if len(rows) == 1 else ()
        return {
            "measurements": len(times_ms),
            **{name: rows[0][name] for name in outside},
            "device": self._runs[0].pipeline.device,
            "median_ms": round(statistics.median(times_ms), 3),
            "sensors": rows,
        }


@contextmanager
def prepare_recording(
    path: Path,
    target: Path,
    options: CampaignOptions,
    *,
    sensors: Sequence[str],
    settings: Mapping[str, Settings] | None = None,
    pipelines: Pipelines,
    max_bytes: float | None = None,
    warn: Callable[[str], None] = lambda _: None,
    show: _Show = lambda *_: None,
) -> Iterator[RecordingJob]:
    """Open a recording and check every sensor, so that errors are reported before any processing."""
    # `warn` gets a line for each doubt. Raises DataError for faulty microphones with `options.strict`, an exceeded
    # budget with `options.verify`, and without active measurements.
    with ExitStack() as stack:
        if settings is None:
            options.without.require_known(sensor_names(path))
        readers = [stack.enter_context(open_recording(path, sensor=name)) for name in sensors]
        every = {
            name: options.settings_of(name, reader.settings) if settings is None else settings[name]
            for name, reader in zip(sensors, readers, strict=True)
        }
        recordings, chosen = _with_echoes(
            [EchoMeasurements(reader, every[reader.sensor]) for reader in readers], every, warn
        )
        imaged = [recording.sensor for recording in recordings]
        mounting = {name: place for name, place in (options.mounting or {}).items() if name in imaged}
        writer = EnergyscapeWriter(
            target,
            recording=[recording.recording for recording in recordings],
            mounting=mounting,
            dtype=options.dtype,
            overwrite=options.overwrite,
        )
        levelled = [
            recording.attitudes(options.mounting) if each.processing.level_directions else None
            for recording, each in zip(recordings, chosen, strict=True)
        ]
        for recording, attitudes in zip(recordings, levelled, strict=True):
            if attitudes is not None and attitudes.note:
                warn(f"{path}: sensor {recording.sensor}: {attitudes.note}")
        checks = _begin_checks(stack, recordings, chosen)
        runs = [
            SensorProcessing(pipeline, batch=options.batch, max_bytes=max_bytes, attitudes=attitudes)
            for pipeline, attitudes in zip(stack.enter_context(pipelines(chosen)), levelled, strict=True)
        ]
        for run, recording, check in zip(runs, recordings, checks, strict=True):
            _check_sensor(run, recording, check.result(), options, warn, show)
            if run.prediction is not None:
                writer.note_error(recording.sensor, **run.prediction.as_dict())
            writer.note_call(recording.sensor, run.call_warning)
            writer.note_start(recording.sensor, run.start_warning)
            writer.note_layout(recording.sensor, run.layout_warning)
            writer.note_wavefront(recording.sensor, run.reported.get("wavefront_error_db"))
        yield RecordingJob(recordings, runs, writer, warn)


def check_recording(
    path: Path,
    options: CampaignOptions,
    *,
    settings: Mapping[str, Settings],
    pipelines: Pipelines,
    warn: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Check a recording as `prepare_recording` does, with the settings of its images; return results about plans."""
    with ExitStack() as stack:
        recordings = [
            EchoMeasurements(stack.enter_context(open_recording(path, sensor=name)), each)
            for name, each in settings.items()
        ]
        checks = _begin_checks(stack, recordings, list(settings.values()))
        runs = [
            SensorProcessing(pipeline, batch=1) for pipeline in stack.enter_context(pipelines(list(settings.values())))
        ]
        for run, recording, check in zip(runs, recordings, checks, strict=True):
            _check_sensor(run, recording, check.result(), options, warn, lambda *_: None)
        rows = [{"sensor": recording.sensor, **run.reported} for recording, run in zip(recordings, runs, strict=True)]
        return {**(runs[0].reported if len(runs) == 1 else {}), "sensors": rows}


def _with_echoes(
    several: Sequence[EchoMeasurements], settings: Mapping[str, Settings], warn: Callable[[str], None]
) -> tuple[list[EchoMeasurements], list[Settings]]:
    """Return the sensors that have images, and their settings; report measurements that are left out."""
    require_images(several[0].path, sum(map(len, several)))
    for each in several:
        if each.note:
            warn(each.note)
    kept = [each for each in several if len(each)]
    return kept, [settings[each.sensor] for each in kept]


def _wavefront(planner: Planner, recording: EchoMeasurements, show: _Show) -> dict[str, float]:
    """Return, and report, the error of plane wavefronts at the first range if it exceeds the budget."""
    settings = planner.settings
    if settings.processing.wavefront != "plane":
        return {}
    error_db = round(plane_wave_error_db(planner.model, settings, settings.processing.range_m[0]), 1)
    if error_db <= settings.accuracy.max_error_db:
        return {}
    reported = {"wavefront_error_db": error_db, "wavefront_error_range_m": settings.processing.range_m[0]}
    show(recording.sensor, reported)
    return reported


def _begin_checks(
    stack: ExitStack, recordings: Sequence[EchoMeasurements], settings: Sequence[Settings]
) -> list[Future[_Checks]]:
    """Start the checks of all sensors' signals in a thread, in parallel with planning and loading of pipelines."""
    thread = ThreadPoolExecutor(1, thread_name_prefix="ertis-checks")
    stack.callback(thread.shutdown, cancel_futures=True)  # Ctrl-C does not wait for the other sensors.
    several = len(recordings) > 1
    return [thread.submit(_check, *each, several=several) for each in zip(recordings, settings, strict=True)]


def _check(recording: EchoMeasurements, settings: Settings, *, several: bool) -> _Checks:
    """Return the faults of a sensor's microphones, the shift of its records, and the match of its call and layout."""
    first = recording[0]
    report = health(replace(first, settings=settings))
    sensor = recording.sensor if several else ""
    faults = describe_faults(f"{recording.path}: sensor {recording.sensor}", report, sensor)

    def heard() -> Iterator[Measurement]:
        others = (recording[index] for index in range(1, len(recording)))
        return (replace(each, settings=settings) for each in itertools.chain([first], others))

    call = first_call_match(heard())
    if call.verdict == "differs":  # The filter of another call does not find the times of arrival.
        return faults, "", call, None
    some = (replace(recording[index], settings=settings) for index in {0, len(recording) // 2, len(recording) - 1})
    speed_m_s, delay_s = sound_speed_m_s(settings.air), settings.call.delay_s
    shift = describe_start(map(emissions_of, some), speed_m_s, delay_s=delay_s)
    layout = LayoutMatch.of_report(report, settings) or first_layout_match(heard())
    return faults, "; ".join(shift or ()), call, layout


def _call_notes(run: SensorProcessing, recording: EchoMeasurements) -> Iterator[str]:
    """Yield the ends of lines on another call than that of the settings, and on measurements without one."""
    for text in filter(None, (run.call_warning, recording.warning)):
        yield f": {text}"


def _grid_notes(pipeline: Pipeline) -> Iterator[str]:
    """Yield the ends of lines on angles that the array does not observe, and on directions that are too far apart."""
    unknown = observable_angles(pipeline.settings.array, pipeline.grid).note
    if unknown is not None:
        yield f" {unknown}"
    if coarse := spacing_warning(pipeline.settings, pipeline.grid):
        yield f": {coarse}"


def _check_sensor(
    run: SensorProcessing,
    recording: EchoMeasurements,
    checks: _Checks,
    options: CampaignOptions,
    warn: Callable[[str], None],
    show: _Show,
) -> None:
    first = run.with_pipeline_settings(recording[0])
    faults, run.start_warning, match, layout = checks
    place = f"{recording.path}: sensor {recording.sensor}"
    shift = run.start_warning and f"{place}: {run.start_warning}"
    run.layout_warning = layout.warning if layout is not None else ""
    other_layout = run.layout_warning and f"{place}: {run.layout_warning}"
    for text in filter(None, (faults, shift, other_layout)):
        if options.strict:
            raise DataError(text)
        warn(text)
    run.call_warning = match.warning
    for text in (*_call_notes(run, recording), *_grid_notes(run.pipeline)):
        warn(f"{place}{text}")
    heard = None
    kernel_set = kernels.load(run.pipeline.device)
    threads = kernel_set.max_threads if options.threads is None else options.threads
    image = unlevelled_image(run.pipeline, first)
    if image.settings.processing.method == "paper":  # It has no plan, but its wavefronts have the same error.
        alike = image.settings.processing.replace(method="fast")
        image = image.replace(settings=image.settings.replace(processing=alike))
        run.reported |= _wavefront(planner_of(image, first, kernel_set, threads=threads), recording, show)
    else:
        heard = planner_of(image, first, kernel_set, threads=threads)
        run.prediction = predict(heard, image)
        run.reported |= _wavefront(heard, recording, show)
        if run.prediction.warning:
            remedy = "use a lower max_error_db"
            if not options.verify:
                remedy = f"measure the error (verify=True), or {remedy}"
            warn(f"{place}: {run.prediction.warning}{f'; {remedy}' if run.prediction.has_echoes else ''}")
    budget_db = run.pipeline.settings.accuracy.max_error_db
    if options.dtype == "uint8" and budget_db < ROUNDING_DB:
        warn(
            f"{place}: uint8 rounds levels with an error of {ROUNDING_DB:.1f} dB, but accuracy.max_error_db is "
            f"{budget_db:g} dB; use dtype float16 or float32"
        )
    if not (options.explain or options.verify):
        return
    from ertis_numba.campaign.examination import examine  # noqa: PLC0415  slow to import and rarely used

    parts = examine(
        run.pipeline, first, threads=options.threads, explain=options.explain, verify=options.verify, heard=heard
    )
    for name, part in parts:
        run.reported[name] = part
        show(recording.sensor, {name: part})
