"""Comparison of fused images and of occupancy maps with the scene's ground truth."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from ertis_cli import _tables, options

if TYPE_CHECKING:
    from ertis_numba.analysis.compare_places import PlaceErrors

__all__ = ["compare_fused", "compare_map"]


def compare_fused(path: Path, min_level_db: float, *, as_json: bool) -> None:
    """Print the errors of the points of fused images."""
    from ertis_numba.analysis.compare_places import compare_points, errors_of_places
    from ertis_numba.base.errors import DataError
    from ertis_numba.fusion import PLATFORM
    from ertis_numba.storage import open_energyscapes
    from ertis_numba.storage.placed_truth import surfaces_at

    with open_energyscapes(path, sensor=PLATFORM) as images:
        truth = images.truth
        if truth is None or not truth.frames:
            raise DataError(
                f"{path} contains no ground truth; fuse simulated recordings of one scene with 'ertis fuse'"
            )
        if images.points_note is not None:
            raise DataError(images.points_note)
        found = []
        for row, image in enumerate(images):
            if image.points is None:
                continue
            surfaces = surfaces_at(truth, row, image.stamp.timestamp_ns)
            found.append(
                compare_points(
                    image.points,
                    truth.reflectors[row],
                    surfaces,
                    is_planar=image.is_planar,
                    min_level_db=min_level_db,
                )
            )
    _print(errors_of_places(found), "points", as_json=as_json)


def compare_map(path: Path, min_level_db: float, *, as_json: bool) -> None:
    """Print the errors of the occupied cells of a map."""
    from ertis_numba.analysis.compare_places import compare_map as compared, errors_of_places, joined
    from ertis_numba.base.errors import DataError
    from ertis_numba.storage import read_map, read_map_truth
    from ertis_numba.storage.placed_truth import surfaces_at

    occupancy, truth = read_map(path), read_map_truth(path)
    if truth is None or not truth.frames:
        raise DataError(
            f"{path} contains no ground truth; map simulated recordings of one scene with 'ertis map', as .h5"
        )
    reflectors = joined(each for row in truth.reflectors for each in row)
    surfaces = surfaces_at(truth, -1, occupancy.time_ns)
    found = compared(occupancy, reflectors, surfaces, min_level_db=min_level_db)
    _print(errors_of_places([found], pulses=occupancy.n_groups), "occupied", as_json=as_json)


def _print(errors: "PlaceErrors", places: str, *, as_json: bool) -> None:
    """Print errors of points, or of occupied cells, as a table or as JSON."""
    row = {places if name == "found" else name: value for name, value in asdict(errors).items()}
    if places != "points":
        del row["spurious_confirmed"]
    if errors.error_cm is not None:
        row["error_cm"] = round(errors.error_cm, 2)
    if as_json:
        options.print_json(row)
        return
    cells = [
        "-" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()
    ]
    _tables.TextTable(dict.fromkeys(row, "right"), [cells]).print()
