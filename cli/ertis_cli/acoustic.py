"""``ertis acoustic``: process recordings into acoustic maps."""

from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _image_options, _mountings, _process_many, options
from ertis_cli._help_sections import SectionedCommand
from ertis_cli._parameter_types import ranged
from ertis_numba.settings.limits import AVERAGES, FOCUS_M
from ertis_numba.settings.map_methods import MAP_METHODS

if TYPE_CHECKING:
    from ertis_numba.campaign import CampaignOptions
    from ertis_numba.settings import ExcludedChannels, Settings

__all__ = ["acoustic"]

_PREFIX = "passive_"


class _Bands(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "BANDS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in ("third_octaves", "octaves"):
            return value
        with suppress(ValueError):
            bands = tuple(tuple(float(edge) for edge in band.split(":")) for band in str(value).split(","))
            if all(len(band) == 2 for band in bands):
                return bands
        return self.fail(
            f"{value!r} is not a list of bands; use third_octaves, octaves, or edges in Hz, as in "
            "20000:30000,30000:40000",
            param,
            ctx,
        )


@click.command(cls=SectionedCommand)
@click.argument("paths", metavar="REC.h5...", nargs=-1, required=True, type=options.TEXT_PATH)
@click.option(
    "--output",
    "-o",
    "target",
    type=options.TEXT_PATH,
    metavar="FILE|DIR",
    help="File to write, by default REC.acoustic.h5 beside the recording; a folder for several recordings.",
)
@options.sensor("Process this sensor only; all sensors by default.")
@options.without("Channels to exclude, such as those of faulty microphones")
@_image_options.grid_options
@click.option(
    "--bands", "passive_bands_hz", type=_Bands(), help="Frequency bands: third_octaves, octaves, or A:B,... in Hz."
)
@click.option("--method", "passive_method", type=click.Choice([*MAP_METHODS]), help="Method of the maps.")
@click.option(
    "--average",
    "passive_averages",
    type=ranged(AVERAGES),
    metavar="N",
    help="Number of measurements in a map.",
)
@click.option(
    "--focus",
    "passive_focus_m",
    type=ranged(FOCUS_M),
    metavar="M",
    help="Distance of the sources in m.",
)
@options.settings_file
@_process_many.processing
@_mountings.mounting
@options.force
@options.quiet
@options.as_json
def acoustic(
    *,
    paths: tuple[str, ...],
    target: str | None,
    sensor: str | None,
    without: "ExcludedChannels",
    settings_file: Path | None,
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
    """Process recordings of sound into acoustic maps.

    A map shows the sound power from each direction, in bands of frequencies. All measurements become maps. If the
    sensor emitted its call, the time of the call is left out, but its echoes remain. The file also contains the
    sources that are found in each map: 'ertis peaks' lists them.

    The settings file overrides the settings of the recording, and options override both. All sensors of a recording go
    into one file.

    Several recordings, a pattern in quotes or a folder are processed on all cores into the folder given with -o, one
    file per recording. Existing results of the same recording and settings are kept. A failed recording does not stop
    the others. --json then prints one object per recording as it ends, and a summary at the end.
    """
    keys = {name.removeprefix(_PREFIX): other.pop(name) for name in [*other] if name.startswith(_PREFIX)}
    given = {name: value for name, value in keys.items() if value is not None}

    def changed(recorded: "Settings") -> "Settings":
        settings = _image_options.with_given(recorded, settings_file=settings_file, preset=None, given=other)
        return settings.replace(passive=settings.passive.replace(**given))

    from ertis_numba.campaign import CampaignOptions

    wanted = CampaignOptions(
        settings=changed,
        without=without,
        sensor=sensor,
        device=device,
        threads=threads,
        strict=strict,
        overwrite=force,
        mounting=_mountings.mountings(mounting, None if sensor is None else [sensor]),
        result="acoustic_map",
    )
    if _process_many.are_meant(paths, target):
        _process_many.process_many(paths, target, wanted, workers=workers, quiet=quiet, as_json=as_json)
        return
    _process_many.require_options_of_one()
    path = Path(paths[0])
    maps_file = Path(target) if target else path.with_suffix(".acoustic.h5")
    _write_maps(path, maps_file, wanted, quiet=quiet, as_json=as_json)


def _write_maps(path: Path, target: Path, wanted: "CampaignOptions", *, quiet: bool, as_json: bool) -> None:
    """Write the acoustic maps of a recording."""
    sensors = options.sensors_of(path, wanted.sensor, "a recording")
    with ExitStack() as stack:
        with options.note_when_slow(options.PREPARING, quiet=quiet):
            from ertis_numba.campaign import prepare_maps

            work = stack.enter_context(prepare_maps(path, target, wanted, sensors=sensors, warn=options.warn))
        steps = stack.enter_context(closing(work.run()))
        shown = stack.enter_context(options.progress(steps, length=work.measurements, label="processing", quiet=quiet))
        for _ in shown:
            pass
    report = work.report()
    for line in _process_many.summary(target, report):
        options.say(line, quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), **report})
