"""``ertis compare``: compare energyscapes, fused images and maps with the ground truth."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _compare_places, _tables, options

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
@options.input_file("IMG.h5|MAP.h5")
@options.sensor("Compare this sensor only; all sensors by default.")
@options.min_level("Ignore reflectors, and peaks of images, below this level, relative to the strongest.")
@options.as_json
def compare(*, path: Path, sensor: str | None, min_level: float, as_json: bool) -> None:
    """Compare an energyscape file or a map with the ground truth.

    The file must come from a simulated recording, which contains the ground truth. Only reflectors that the image can
    show count: on its range axis, and within half of the array's main lobe from its directions. A reflector is matched
    if a peak lies within 0.1 m and 1.5 main lobes of it. A peak is spurious if no reflector explains it. The exit code
    is 0 even if nothing is matched.

    For fused images, points take the place of peaks, and match within 0.1 m. They are spurious if they are farther than
    this from all reflectors, spheres and walls. Reflections of reflectors in walls are spurious as well. For occupancy
    maps (.map.h5), occupied cells match within 5 cm and half a cell.
    """
    from ertis_numba.analysis.compare import errors_of
    from ertis_numba.fusion import PLATFORM
    from ertis_numba.storage import is_map

    if is_map(path):
        if sensor is not None:
            raise click.UsageError(f"--sensor does not apply to the map {path}; remove it", click.get_current_context())
        _compare_places.compare_map(path, min_level, as_json=as_json)
        return
    names = options.sensors_of(path, sensor, "an energyscape file or an occupancy map")
    if PLATFORM in names:
        if len(names) > 1:
            raise click.UsageError(
                f"{path} has fused images and images of sensors; choose one of {', '.join(names)} with --sensor",
                click.get_current_context(),
            )
        _compare_places.compare_fused(path, min_level, as_json=as_json)
        return
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
