"""``ertis process``: process recordings into energyscapes."""

import functools
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ertis_cli import _image_options, _mountings, _plans, _process_many, _results, options
from ertis_cli._help_sections import SectionedCommand
from ertis_numba.base.constants import IMAGE_DTYPES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ertis_numba.base.constants import ImageDtype
    from ertis_numba.campaign import CampaignOptions
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import ExcludedChannels, Settings

__all__ = ["process"]

_PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg")


@click.command(cls=SectionedCommand)
@click.argument("paths", metavar="REC.h5...", nargs=-1, required=True, type=options.TEXT_PATH)
@click.option(
    "--output",
    "-o",
    "target",
    type=options.TEXT_PATH,
    metavar="FILE|DIR",
    help="File to write, by default REC.energy.h5 beside the recording; a folder for several recordings; FILE.npz for "
    "signals or beams.",
)
@options.sensor("Process this sensor only; all sensors by default.")
@options.without("Channels to exclude, such as those of faulty microphones")
@_image_options.processing_preset
@_image_options.image_options
@click.option(
    "--level/--no-level",
    default=None,
    help="Turn directions by the roll and pitch of the poses, so that they refer to the horizontal plane.",
)
@click.option(
    "--last-stage",
    type=click.Choice(["demodulation", "matched_filter", "beams", "envelope"]),
    help="Last step of processing; all but envelope need -o FILE.npz.",
)
@options.plan
@click.option("--explain", is_flag=True, help="First print the plan with its predicted error and time.")
@click.option(
    "--verify",
    is_flag=True,
    help="Measure the error of each sensor's first measurement; write nothing if it exceeds --max-error.",
)
@options.settings_file
@click.option(
    "--dtype",
    type=click.Choice(IMAGE_DTYPES),
    default="float32",
    show_default=True,
    help="Data type of images. float16 halves the file; it keeps three digits down to -84 dBFS and fewer below, and "
    "netCDF programs cannot read it. uint8 quarters the file; it stores levels from -122 to 5 dBFS in steps of 0.5 dB.",
)
@_process_many.processing
@_mountings.mounting
@options.force
@options.quiet
@options.as_json
def process(
    *,
    paths: tuple[str, ...],
    target: str | None,
    sensor: str | None,
    without: "ExcludedChannels",
    preset: str | None,
    plan: Literal["nominal", "measured"],
    explain: bool,
    verify: bool,
    settings_file: Path | None,
    dtype: "ImageDtype",
    strict: bool,
    device: str,
    threads: int | None,
    workers: int | str | None,
    mounting: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    **other: Any,
) -> None:
    """Process recordings into energyscapes.

    Measurements without a call are left out; 'ertis acoustic' makes maps of their sound.

    The settings file overrides the settings of the recording, the preset overrides both, and other options override
    all of them. The same recording gives the same amplitudes, bit by bit, for any number of threads. All sensors of a
    recording go into one file, each with its own settings.

    Several recordings, a pattern in quotes or a folder are processed on all cores into the folder given with -o, one
    file per recording. Existing results of the same recording and settings are kept. A failed recording does not stop
    the others. --json then prints one object per recording as it ends, and a summary at the end.

    The fast method chooses the fastest plan whose predicted error meets --max-error. The error is relative to the exact
    image, over all directions and ranges.
    """
    level = other.pop("level")

    def changed(recorded: "Settings") -> "Settings":
        given = {**other, "level_directions": level}
        settings = _image_options.with_given(recorded, settings_file=settings_file, preset=preset, given=given)
        if not _results.is_results_file(target):
            _results.require_image(settings)
        _plans.require_plan(settings.processing.method)
        return settings

    from ertis_numba.campaign import CampaignOptions

    wanted = CampaignOptions(
        settings=changed,
        without=without,
        sensor=sensor,
        dtype=dtype,
        device=device,
        plan=plan,
        threads=threads,
        strict=strict,
        overwrite=force,
        mounting=_mountings.mountings(mounting, None if sensor is None else [sensor]),
        explain=explain,
        verify=verify,
    )
    if _process_many.are_meant(paths, target):
        _process_many.process_many(paths, target, wanted, workers=workers, quiet=quiet, as_json=as_json)
        return
    _require_options_of_one(target)
    _write_one(Path(paths[0]), target, wanted, quiet=quiet, as_json=as_json)


def _write_one(path: Path, target: str | None, wanted: "CampaignOptions", *, quiet: bool, as_json: bool) -> None:
    """Write the signals or images of one recording."""
    if target is not None and _results.is_results_file(target):
        _results.write_results(
            path,
            Path(target),
            wanted.settings,
            without=wanted.without,
            sensor=wanted.sensor,
            force=wanted.overwrite,
            quiet=quiet,
            as_json=as_json,
            device=wanted.device,
            threads=wanted.threads,
            plan=wanted.plan,
        )
        return
    target_file = Path(target) if target else path.with_suffix(".energy.h5")
    report = _process_one(path, target_file, wanted, quiet=quiet, as_json=as_json)
    _note_mountings(target_file, quiet=quiet)
    for line in _process_many.summary(Path(report["output"]), report):
        options.say(line, quiet=quiet)
    if as_json:
        options.print_json(report)


def _require_options_of_one(target: str | None) -> None:
    """Refuse options for several recordings, and pictures."""
    _process_many.require_options_of_one()
    if target is not None and Path(target).suffix.lower() in _PICTURES:
        raise click.UsageError(
            f"-o {target} is a picture, but process writes energyscapes; choose a .h5 file and plot it with 'ertis "
            "plot'",
            click.get_current_context(),
        )


def _note_mountings(path: Path, *, quiet: bool) -> None:
    from ertis_numba.storage import open_energyscapes, sensor_names

    names, unknown = sensor_names(path), []
    for name in names if len(names) > 1 else ():  # A single image can remain in the frame of its sensor.
        with open_energyscapes(path, sensor=name) as images:
            if images.translation_m is None:
                unknown.append(name)
    _mountings.note_unknown(
        unknown, "images use the frame of their sensor; add --mounting FILE for the frame of the platform", quiet=quiet
    )


def _process_one(path: Path, target: Path, wanted: "CampaignOptions", *, quiet: bool, as_json: bool) -> dict[str, Any]:
    """Process one recording in this process, and return the report."""
    from ertis_numba.campaign import prepare_recording

    @contextmanager
    def pipelines(several: "Sequence[Settings]") -> "Iterator[list[Pipeline]]":
        with ExitStack() as stack:
            wait = functools.partial(
                options.pipeline, device=wanted.device, plan=wanted.plan, threads=wanted.threads, quiet=quiet
            )
            yield [stack.enter_context(wait(settings)) for settings in several]

    def show(sensor: str, reported: dict[str, Any]) -> None:
        for line in () if as_json or quiet else _plans.report_lines(sensor, reported):
            click.echo(line, err=True)

    with prepare_recording(
        path,
        target,
        wanted,
        sensors=options.sensors_of(path, wanted.sensor, "a recording"),
        pipelines=pipelines,
        warn=options.warn,
        show=show,
    ) as work:
        with (
            closing(work.run()) as steps,
            options.progress(steps, length=work.measurements, label="processing", quiet=quiet) as shown,
        ):
            for _ in shown:
                pass
        return {"output": str(target), **work.report()}
