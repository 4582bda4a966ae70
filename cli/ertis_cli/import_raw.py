"""``ertis import``: raw words to a recording."""

from pathlib import Path

import click

from ertis_cli import options

__all__ = ["import_raw"]


@click.command("import")
@click.argument("raw", metavar="RAW.bin...", nargs=-1, required=True, type=click.Path(path_type=Path))
@options.output("Recording to write; RAW.h5 beside the first file by default.")
@click.option("--layout", metavar="NAME", required=True, help="Array: eRTIS_v3D1 and others, or a .toml or .csv file.")
@click.option("--preset", metavar="NAME", required=True, help="short_, default_ or long_ with 20_80 or 25_50.")
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
    layout: str,
    preset: str,
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
    """
    from ertis_numba.interop import open_raw
    from ertis_numba.settings import Air, Array, Settings
    from ertis_numba.storage import check_target, write_recording

    given = {"temperature_c": temperature, "humidity_percent": humidity}
    air = Air(**{name: value for name, value in given.items() if value is not None})
    settings = Settings.from_preset(preset, array=Array(layout=layout), air=air)
    measurements = open_raw(raw, settings, sensor=sensor)
    target = target or raw[0].with_suffix(".h5")
    check_target(target, overwrite=force, sources=raw)
    with options.progress(measurements, length=len(measurements), label="importing", quiet=quiet) as shown:
        write_recording(target, shown, overwrite=force, source=", ".join(path.name for path in raw))
    options.say(f"{target}: {options.counted(len(measurements), 'measurement')}", quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), "measurements": len(measurements)})
