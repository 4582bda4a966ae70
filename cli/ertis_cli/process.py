"""``ertis process``: a recording to energyscapes."""

import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import click

from ertis_cli import options

__all__ = ["process"]


@click.command()
@options.input_file("REC.h5")
@options.output("Energyscape file to write; REC.energy.h5 beside the recording by default.")
@click.option("--directions", metavar="GRID", help="90, 1850, 3000, 2d:N, 3d:N, or a CSV of azimuth, elevation in °.")
@click.option("--azimuth", type=options.INTERVAL, help="Limits of 2d:N and 3d:N in °.")
@click.option("--elevation", type=options.INTERVAL, help="Limits of 3d:N in °.")
@click.option("--range", "range_m", type=options.INTERVAL, help="First and last range in m.")
@click.option("--method", type=click.Choice(["fast", "paper"]), help="The recording's own choice by default.")
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
@options.device
@options.threads
@options.force
@options.quiet
@options.as_json
def process(
    *,
    path: Path,
    target: Path | None,
    directions: str | None,
    azimuth: tuple[float, float] | None,
    elevation: tuple[float, float] | None,
    range_m: tuple[float, float] | None,
    method: str | None,
    settings_file: Path | None,
    dtype: Literal["float32", "float16"],
    device: str,
    threads: int | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Turn a recording into energyscapes.

    Settings come from the recording, then from the settings file, then from the options. The same
    recording gives the same energies, bit by bit, whatever the number of threads.
    """
    from ertis_numba.storage import EnergyscapeWriter, open_recording

    target = target or path.with_suffix(".energy.h5")
    with open_recording(path) as recording:
        settings = options.settings_with(
            recording.settings,
            settings_file=settings_file,
            directions=directions,
            azimuth_limits_deg=azimuth,
            elevation_limits_deg=elevation,
            range_m=range_m,
            method=method,
        )
        writer = EnergyscapeWriter(target, recording=recording, dtype=dtype, overwrite=force)
        pipeline = options.pipeline(settings, device=device, threads=threads, quiet=quiet)
        times_ms = []
        with writer, options.progress(recording, length=len(recording), label="processing", quiet=quiet) as shown:
            for measurement in shown:
                if settings.air == recording.settings.air:
                    options.require_same_air(measurement, settings)
                # A settings file may know better than the recording what array, call or air it was.
                known = replace(measurement, settings=settings)
                start_s = time.perf_counter()
                image = pipeline.process(known)
                times_ms.append(1000 * (time.perf_counter() - start_s))
                writer.write(image)
    median_ms = statistics.median(times_ms)
    report = {
        "output": str(target),
        "measurements": len(times_ms),
        "directions": len(pipeline.grid),
        "ranges": len(pipeline.range_m),
        "device": pipeline.device,
        "median_ms": round(median_ms, 3),
    }
    options.say(
        f"{target}: {options.counted(len(times_ms), 'measurement')}, "
        f"{options.counted(len(pipeline.grid), 'direction')} × {options.counted(len(pipeline.range_m), 'range')} "
        f"on {pipeline.device}, {median_ms:.1f} ms each (median)",
        quiet=quiet,
    )
    if as_json:
        options.print_json(report)
