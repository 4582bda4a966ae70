"""``ertis import``: raw words to a recording."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.interop import RawReader
    from ertis_numba.settings import Air

__all__ = ["import_raw"]


@click.command("import")
@click.argument("raw", metavar="RAW.bin...", nargs=-1, required=True, type=click.Path(path_type=Path))
@options.output("Recording to write; RAW.h5 beside the first file or the folder by default.")
@click.option(
    "--layout",
    metavar="NAME",
    help="Array: eRTIS_v3D1 and others, or a .toml or .csv file; not needed where a folder names it.",
)
@click.option(
    "--preset",
    metavar="NAME",
    help="short_, default_ or long_ with 20_80 or 25_50; not needed where a folder holds the settings.",
)
@click.option("--sensor", metavar="NAME", default="sensor", show_default=True, help="Name of the sensor.")
@click.option("--temperature", type=float, metavar="C", help="Air temperature in °C; 20 by default.")
@click.option("--humidity", type=float, metavar="PCT", help="Relative humidity in percent; 50 by default.")
@options.force
@options.quiet
@options.as_json
def import_raw(
    *,
    raw: tuple[Path, ...],
    target: Path | None,
    layout: str | None,
    preset: str | None,
    sensor: str,
    temperature: float | None,
    humidity: float | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Turn raw eRTIS words into a recording.

    RAW.bin holds little-endian words without a header, one measurement after the other. Array and
    preset say what the file does not; a preset is the length of a measurement and the band of the
    call in kHz. The recording then holds all of it.

    In place of files, a folder may be given that a program on RTIS Dev has saved to: NAME<number>.bin
    for each measurement, and the settings of recording and processing as JSON.
    """
    from ertis_numba.settings import Air
    from ertis_numba.storage import check_target, write_recording

    given = {"temperature_c": temperature, "humidity_percent": humidity}
    air = Air(**{name: value for name, value in given.items() if value is not None})
    folder = raw[0] if len(raw) == 1 and raw[0].is_dir() else None
    measurements = _opened(raw, folder, layout, preset, air, sensor)
    if target is None:
        target = raw[0].with_suffix(".h5") if folder is None else Path(f"{folder.resolve()}.h5")
    check_target(target, overwrite=force, sources=raw)
    source = ", ".join(path.name for path in raw)
    with options.progress(measurements, length=len(measurements), label="importing", quiet=quiet) as shown:
        write_recording(target, shown, overwrite=force, source=source)
    options.say(f"{target}: {options.counted(len(measurements), 'measurement')}", quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), "measurements": len(measurements)})


def _opened(
    raw: tuple[Path, ...], folder: Path | None, layout: str | None, preset: str | None, air: "Air", sensor: str
) -> "RawReader":
    from ertis_numba.interop import open_raw, open_rtis_folder
    from ertis_numba.settings import Array, Settings

    if folder is not None:
        return open_rtis_folder(folder, layout=layout, preset=preset, air=air, sensor=sensor)
    if layout is None or preset is None:
        option = "--layout" if layout is None else "--preset"
        context = click.get_current_context()
        raise click.MissingParameter(ctx=context, param_hint=f"'{option}'", param_type="option")
    return open_raw(raw, Settings.from_preset(preset, array=Array(layout=layout), air=air), sensor=sensor)
