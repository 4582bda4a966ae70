"""``ertis peaks``: the reflectors in an energyscape file."""

from pathlib import Path

import click

from ertis_cli import options

__all__ = ["peaks"]

_ROW = "{measurement:11d}  {azimuth_deg:+11.2f}  {elevation_deg:+13.2f}  {range_m:7.3f}  {level_db:8.1f}"


@click.command()
@options.input_file("IMG.h5")
@click.option("--top", type=int, default=10, show_default=True, metavar="N", help="At most so many per measurement.")
@click.option(
    "--min-level", type=float, default=-30.0, show_default=True, metavar="DB", help="Leave out what is weaker."
)
@options.measurement("One measurement only, counted from 0.")
@options.as_json
def peaks(*, path: Path, top: int, min_level: float, measurement: int | None, as_json: bool) -> None:
    """List the reflectors in an energyscape file.

    One entry per reflector, the strongest of each measurement first; levels are in dB below it.
    """
    from ertis_numba.stages.detect import find_peaks
    from ertis_numba.storage import open_energyscapes

    with open_energyscapes(path) as images:
        chosen = range(len(images)) if measurement is None else [options.place(measurement, len(images))]
        rows = [
            {
                "measurement": index,
                "azimuth_deg": round(peak.azimuth_deg, 4),
                "elevation_deg": round(peak.elevation_deg, 4),
                "range_m": round(peak.range_m, 6),
                "level_db": round(peak.level_db, 4),
            }
            for index in chosen
            for peak in find_peaks(images[index], top=top, min_level_db=min_level)
        ]
    if as_json:
        options.print_json({"peaks": rows})
        return
    click.echo("measurement  azimuth_deg  elevation_deg  range_m  level_db")
    for row in rows:
        click.echo(_ROW.format(**row))
