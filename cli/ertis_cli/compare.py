"""``ertis compare``: compare an energyscape file with the ground truth."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _tables, options

if TYPE_CHECKING:
    from ertis_numba.analysis.compare import Errors

__all__ = ["compare"]

_NUMBERS = (
    "measurements",
    "matched",
    "missed",
    "spurious",
    "angle_rms_deg",
    "range_bias_m",
    "range_rms_m",
    "level_rms_db",
)


@click.command()
@options.input_file("IMG.h5")
@options.sensor("Compare this sensor only; all sensors by default.")
@options.min_level("Ignore reflectors and peaks below this level, relative to the strongest.")
@options.as_json
def compare(*, path: Path, sensor: str | None, min_level: float, as_json: bool) -> None:
    """Compare an energyscape file with the scene's ground truth.

    The file must come from a simulated recording, which contains the ground truth. Only reflectors that the image can
    show count: on its range axis, and within half of the array's main lobe from its directions. A reflector is matched
    if a peak lies within 0.1 m and 1.5 main lobes of it. A peak is spurious if no reflector explains it. The exit code
    is 0 even if nothing is matched.
    """
    from ertis_numba.analysis.compare import errors_of

    names = options.sensors_of(path, sensor, "an energyscape file")
    compared = {name: [comparison for _, comparison in options.comparisons(path, name, min_level)] for name in names}
    options.note_unlisted_directions(path, names)
    sensors = {name: errors_of(given) for name, given in compared.items()}
    whole = errors_of(comparison for given in compared.values() for comparison in given)
    if as_json:
        rows = [{"sensor": name, **_rounded(errors)} for name, errors in sensors.items()]
        options.print_json({**_rounded(whole), "sensors": rows})
        return
    columns: dict[str, _tables.Side] = {"sensor": "left", **dict.fromkeys(_NUMBERS, "right")}
    cells = [(name, _rounded(errors)) for name, errors in (*sensors.items(), ("all", whole))]
    _tables.TextTable(columns, [(name, *(_cell(of[number]) for number in _NUMBERS)) for name, of in cells]).print()


def _rounded(errors: "Errors") -> dict[str, Any]:
    return {name: round(value, 6) if isinstance(value, float) else value for name, value in asdict(errors).items()}


def _cell(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.5f}"
