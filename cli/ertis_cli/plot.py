"""``ertis plot``: a picture of a measurement."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.frames import Energyscape

__all__ = ["plot"]

_FORMATS = (".pdf", ".png", ".svg")


@click.command()
@options.input_file("IMG.h5|REC.h5")
@options.output("Picture to write: .png, .svg or .pdf; a .png beside the file by default.")
@options.sensor("Whose measurement; needed where the file holds several sensors.")
@options.measurement("Which one, counted from 0; the first by default.")
@click.option(
    "--dynamic-range", type=float, default=40.0, show_default=True, metavar="DB", help="Range of the colours."
)
@click.option("--theme", type=click.Choice(["dark", "light"]), default="dark", show_default=True, help="Colours.")
@click.option(
    "--peaks", "top", type=click.IntRange(min=0), default=5, show_default=True, metavar="N", help="Reflectors to mark."
)
@options.force
@options.quiet
@options.as_json
def plot(
    *,
    path: Path,
    target: Path | None,
    sensor: str | None,
    measurement: int | None,
    dynamic_range: float,
    theme: Literal["dark", "light"],
    top: int,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Draw a measurement.

    A recording is processed with its own settings first.
    """
    from ertis_numba import checks, figures
    from ertis_numba.stages.detect import find_peaks
    from ertis_numba.storage import check_target, replacing

    target = target or path.with_suffix(".png")
    checks.choice("picture format", target.suffix.lower(), _FORMATS)
    check_target(target, overwrite=force)
    image = _image(path, sensor, measurement or 0, quiet=quiet)
    found = find_peaks(image, top=top) if top else []
    figure = figures.plot(image, dynamic_range_db=dynamic_range, theme=theme, peaks=found)
    with replacing(target, overwrite=force) as part:
        figure.savefig(part, format=target.suffix.lower().lstrip("."))
    options.say(f"{target}: measurement {measurement or 0} of {path}", quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), "sensor": image.stamp.sensor, "measurement": measurement or 0})


def _image(path: Path, sensor: str | None, index: int, *, quiet: bool) -> "Energyscape":
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording

    if file_kind(path) == "energyscape":
        with open_energyscapes(path, sensor=sensor) as images:
            return images[options.place(index, len(images))]
    with open_recording(path, sensor=sensor) as recording:
        measurement = recording[options.place(index, len(recording))]
    return options.pipeline(measurement.settings, quiet=quiet).process(measurement)
