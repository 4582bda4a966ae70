"""``ertis process``: a recording to energyscapes."""

import itertools
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ertis_cli import options, plans

if TYPE_CHECKING:
    from ertis_numba.frames import Energyscape, Measurement
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import Settings
    from ertis_numba.storage import EnergyscapeWriter, RecordingReader

__all__ = ["process"]

_BATCH_BYTES = 256e6  # of images that wait to be written


@click.command()
@options.input_file("REC.h5")
@options.output("Energyscape file to write; REC.energy.h5 beside the recording by default.")
@options.sensor("One sensor only; all of the recording by default.")
@click.option("--directions", metavar="GRID", help="90, 1850, 3000, 2d:N, 3d:N, or a CSV of azimuth, elevation in °.")
@click.option("--azimuth", type=options.INTERVAL, help="Limits of 2d:N and 3d:N in °.")
@click.option("--elevation", type=options.INTERVAL, help="Limits of 3d:N in °.")
@click.option("--range", "range_m", type=options.INTERVAL, help="First and last range in m.")
@click.option("--method", type=click.Choice(["fast", "paper"]), help="The recording's own choice by default.")
@click.option(
    "--beamformer",
    type=click.Choice(["delay_and_sum", "coherence_factor", "dmas", "capon"]),
    help="How microphones are combined; the recording's own choice by default.",
)
@click.option(
    "--wavefront",
    type=click.Choice(["plane", "spherical"]),
    help="What an echo looks like to the array; the recording's own choice by default.",
)
@click.option(
    "--max-error",
    "max_error_db",
    type=options.ERROR_BUDGET,
    metavar="DB|PRESET",
    help="Error that images may have, as in -40, or draft, standard, fine, exact; the settings' own by default.",
)
@click.option("--explain", is_flag=True, help="Tell the plan first: what it does, its predicted error and time.")
@click.option(
    "--verify",
    is_flag=True,
    help="Measure the error of each sensor's first measurement; write nothing if it is beyond --max-error.",
)
@click.option(
    "--settings",
    "settings_file",
    metavar="FILE.toml",
    type=click.Path(path_type=Path),
    help="TOML whose keys replace the recording's.",
)
@click.option(
    "--dtype",
    type=click.Choice(["float32", "float16"]),
    default="float32",
    show_default=True,
    help="float16 halves the file; it keeps three digits down to -84 dB of full scale, fewer below, and netCDF "
    "programs cannot read it.",
)
@click.option("--strict", is_flag=True, help="Refuse recordings with faulty microphones instead of warning.")
@options.device
@options.threads
@click.option(
    "--batch",
    type=click.IntRange(min=1),
    default=8,
    show_default=True,
    metavar="N",
    help="Measurements worked on at the same time, fewer where images are large; 1 is one after the other.",
)
@options.force
@options.quiet
@options.as_json
def process(
    *,
    path: Path,
    target: Path | None,
    sensor: str | None,
    directions: str | None,
    azimuth: tuple[float, float] | None,
    elevation: tuple[float, float] | None,
    range_m: tuple[float, float] | None,
    method: str | None,
    beamformer: str | None,
    wavefront: str | None,
    max_error_db: float | None,
    explain: bool,
    verify: bool,
    settings_file: Path | None,
    dtype: Literal["float32", "float16"],
    strict: bool,
    device: str,
    threads: int | None,
    batch: int,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Turn a recording into energyscapes.

    Settings come from the recording, then from the settings file, then from the options. The same
    recording gives the same energies, bit by bit, whatever the number of threads and the batch. All
    sensors of a recording go into one file, each with its own settings.

    The fast method plans how exact to be: it takes the fastest way whose predicted error keeps --max-error.
    The error is that of the image against the exact one, over all directions and ranges.
    """
    from ertis_numba.storage import EnergyscapeWriter, open_recording

    target = target or path.with_suffix(".energy.h5")
    with ExitStack() as stack:
        names = options.sensors_of(path, sensor)
        recordings = [stack.enter_context(open_recording(path, sensor=name)) for name in names]
        # Every sensor is looked at before the first one is processed, so that what cannot be done is told at once.
        settings = [
            options.settings_with(
                recording.settings,
                settings_file=settings_file,
                directions=directions,
                azimuth_limits_deg=azimuth,
                elevation_limits_deg=elevation,
                range_m=range_m,
                method=method,
                beamformer=beamformer,
                wavefront=wavefront,
                max_error_db=max_error_db,
            )
            for recording in recordings
        ]
        for given in settings:
            plans.require_plan(given, explain=explain, verify=verify, max_error_db=max_error_db)
        writer = EnergyscapeWriter(target, recording=recordings, dtype=dtype, overwrite=force)
        runs = [
            _Run(stack.enter_context(options.pipeline(given, device=device, threads=threads, quiet=quiet)))
            for given in settings
        ]
        for run, recording in zip(runs, recordings, strict=True):
            first = replace(recording[0], settings=run.pipeline.settings)
            _tell_faults(f"{path}: sensor {recording.sensor}", first, strict=strict)
            run.told = plans.tell(run.pipeline, first, threads=threads, explain=explain, verify=verify, silent=as_json)
        written = (
            None for run, recording in zip(runs, recordings, strict=True) for _ in run.write(recording, writer, batch)
        )
        length = sum(map(len, recordings))
        with writer, options.progress(written, length=length, label="processing", quiet=quiet) as shown:
            for _ in shown:
                pass
    rows = [{"sensor": name, **run.report()} for name, run in zip(names, runs, strict=True)]
    times_ms = [time_ms for run in runs for time_ms in run.times_ms]
    report = {
        "output": str(target),
        "measurements": len(times_ms),
        **({name: rows[0][name] for name in ("directions", "ranges", *runs[0].told)} if len(rows) == 1 else {}),
        "device": runs[0].pipeline.device,
        "median_ms": round(statistics.median(times_ms), 3),
        "sensors": rows,
    }
    for row in rows:
        of = f" of {row['sensor']}" if len(rows) > 1 else ""
        options.say(
            f"{target}: {options.counted(row['measurements'], 'measurement')}{of}, "
            f"{options.counted(row['directions'], 'direction')} × {options.counted(row['ranges'], 'range')} "
            f"on {report['device']}, {row['median_ms']:.1f} ms each (median)",
            quiet=quiet,
        )
    if as_json:
        options.print_json(report)


def _tell_faults(name: str, measurement: "Measurement", *, strict: bool) -> None:
    """Warn of faulty microphones, or refuse them."""
    from ertis_numba.errors import DataError
    from ertis_numba.stages.health import health

    report = health(measurement)
    if not report.faults:
        return
    every = all(channel.faults for channel in report.channels)
    remedy = "check its cable and supply" if every else "put them under 'disabled' in a layout file for --settings"
    text = f"{name} has faulty microphones ({report.verdict()}); {remedy}, or see 'ertis info --health'"
    if strict:
        raise DataError(text)
    click.echo(f"ertis: warning: {text}", err=True)


class _Run:
    """The pipeline of one sensor, what was said of its plan, and how long it took for each measurement."""

    def __init__(self, pipeline: "Pipeline") -> None:
        self.pipeline = pipeline
        self.times_ms: list[float] = []
        self.told: dict[str, Any] = {}

    def write(self, recording: "RecordingReader", writer: "EnergyscapeWriter", batch: int) -> Iterator[None]:
        """Process a recording and write its images; yield after each."""
        image_bytes = 4 * len(self.pipeline.grid) * len(self.pipeline.range_m)
        size = max(1, min(batch, int(_BATCH_BYTES / image_bytes)))
        measurements = iter(recording)
        while group := list(itertools.islice(measurements, size)):
            images = self._processed([self._known(measurement, recording.settings) for measurement in group])
            images.reverse()
            while images:  # none is kept: a GPU's images lie in memory that the next ones need
                writer.write(images.pop())
                yield

    def _known(self, measurement: "Measurement", recorded: "Settings") -> "Measurement":
        """Return a measurement as it is now known: a settings file may know better what array, call or air it was."""
        settings = self.pipeline.settings
        if settings.air == recorded.air:
            options.require_same_air(measurement, settings)
        return replace(measurement, settings=settings)

    def _processed(self, measurements: "Sequence[Measurement]") -> "list[Energyscape]":
        start_s = time.perf_counter()
        if len(measurements) == 1:
            images = [self.pipeline.process(measurements[0])]
        else:
            images = self.pipeline.process_batch(measurements)
        self.times_ms += [1000 * (time.perf_counter() - start_s) / len(images)] * len(images)
        return images

    def report(self) -> dict[str, Any]:
        return {
            "measurements": len(self.times_ms),
            "directions": len(self.pipeline.grid),
            "ranges": len(self.pipeline.range_m),
            "median_ms": round(statistics.median(self.times_ms), 3),
            **self.told,
        }
