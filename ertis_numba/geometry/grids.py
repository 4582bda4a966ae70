"""Direction grids."""

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.base.csv_numbers import csv_rows
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Processing

__all__ = ["MAX_DIRECTIONS", "PAPER_GRIDS", "Grid", "direction_grid", "grid_count", "named_grid"]

MAX_DIRECTIONS = 1_000_000
"""Maximum number of directions of a grid."""

_WHOLE_DEG = 5.0  # Limits of grids are multiples of this, as a rule.
_ROUNDED = 2e-3

PAPER_GRIDS = {
    "90": ("2d:90", (-90.0, 90.0), (0.0, 0.0)),
    "1850": ("3d:1850", (-45.0, 45.0), (-45.0, 45.0)),
    "3000": ("3d:3000", (-90.0, 90.0), (-90.0, 90.0)),
}
"""Kind, azimuth limits and elevation limits in degrees of the paper's three grids."""


@dataclass(frozen=True, slots=True, eq=False)
class Grid(DegreesFromRadians):
    """Directions of an image, (direction,); ``azimuth_deg`` and ``elevation_deg`` are the same angles in degrees."""

    azimuth_rad: NDArray[np.float64]
    elevation_rad: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.azimuth_rad)


def grid_count(name: str | tuple[tuple[float, float], ...]) -> int | None:
    """Return the number of directions of `Processing.directions`; None for the path of a file."""
    if not isinstance(name, str):
        return len(name)
    head, colon, count = PAPER_GRIDS.get(name, (name,))[0].partition(":")
    if head not in {"2d", "3d"} or not colon:
        return None
    if not (count.isascii() and count.isdecimal()):
        raise ArgumentError(f"directions {name[:80]!r} has no count; use a number after the colon, such as {head}:181")
    if len(count.lstrip("0")) > len(str(MAX_DIRECTIONS)):  # Python does not convert several thousand digits
        raise ArgumentError(
            f"directions {name[:80]!r} has a count of {len(count)} digits; use at most {MAX_DIRECTIONS} directions"
        )
    return checks.integer(f"count of directions {name!r}", int(count), 1, MAX_DIRECTIONS)


def named_grid(processing: Processing) -> tuple[str, tuple[float, float], tuple[float, float]] | None:
    """Return the kind of a named grid, 2d or 3d, and its azimuth and elevation limits in degrees; None for others."""
    name = processing.directions
    if not isinstance(name, str) or grid_count(name) is None:
        return None
    own = name, processing.azimuth_limits_deg, processing.elevation_limits_deg
    kind, azimuth_deg, elevation_deg = PAPER_GRIDS.get(name, own)
    return kind[:2], azimuth_deg, elevation_deg


def direction_grid(processing: Processing) -> Grid:
    """Return the directions that ``processing.directions`` names, or those of a list or a CSV file in degrees."""
    # `2d:N` is N azimuths at one elevation, `3d:N` N cells of equal area; 90, 1850 and 3000 are the paper's grids.
    name = processing.directions
    if not isinstance(name, str):
        _require_degrees("processing.directions", np.asarray(name, dtype=np.float64))
        angles_rad = np.radians(np.asarray(name, dtype=np.float64))
        return Grid(angles_rad[:, 0].copy(), angles_rad[:, 1].copy())
    n_directions, named = grid_count(name), named_grid(processing)
    if n_directions is None or named is None:
        return _csv_grid(name)
    kind, azimuth_deg, elevation_deg = named
    if kind == "2d":
        return _level_grid(n_directions, azimuth_deg, 0.0 if name in PAPER_GRIDS else processing.elevation_deg)
    return _equal_area_grid(n_directions, azimuth_deg, elevation_deg)


def _level_grid(n_directions: int, limits_deg: tuple[float, float], elevation_deg: float) -> Grid:
    """Return directions of one elevation."""
    if n_directions == 1:
        limits_deg = (sum(limits_deg) / 2,) * 2
    azimuth_rad = np.radians(np.linspace(*limits_deg, n_directions))
    return Grid(azimuth_rad, np.full(n_directions, math.radians(elevation_deg)))


def _equal_area_grid(
    n_directions: int, azimuth_limits_deg: tuple[float, float], elevation_limits_deg: tuple[float, float]
) -> Grid:
    """Return rows of equal elevation, each split into cells of equal area, after Leopardi's zonal partition."""
    # P. Leopardi, A partition of the unit sphere into regions of equal area and small diameter, ETNA 25 (2006).
    west, east = np.radians(azimuth_limits_deg)
    low, high = np.sin(np.radians(elevation_limits_deg))
    side_rad = math.sqrt((east - west) * (high - low) / n_directions) or 1.0
    span_rad = math.radians(elevation_limits_deg[1] - elevation_limits_deg[0])
    n_rows = min(n_directions, max(1, round(span_rad / side_rad))) if east > west else n_directions
    ideal = np.sin(np.radians(np.linspace(*elevation_limits_deg, n_rows + 1)))
    share = (ideal - low) / (high - low) if high > low else np.linspace(0.0, 1.0, n_rows + 1)
    edges = np.rint(share * n_directions).astype(int)  # whole cells below each row's edge
    azimuth_rad, elevation_rad = [], []
    for below, above in itertools.pairwise(edges):
        in_row = above - below
        if not in_row:
            continue
        middle = low + (high - low) * (below + above) / 2 / n_directions
        azimuth_rad.append(west + (east - west) * (np.arange(in_row) + 0.5) / in_row)
        elevation_rad.append(np.full(in_row, math.asin(min(1.0, max(-1.0, middle)))))
    return Grid(np.concatenate(azimuth_rad), np.concatenate(elevation_rad))


def _require_degrees(name: str, angles: NDArray[np.float64]) -> None:
    """Refuse directions (direction, 2) whose limits are multiples of 5° only if they are read as radians."""
    limits = np.abs([angles.min(axis=0), angles.max(axis=0)]).ravel()
    limits = limits[limits > 0]
    is_whole = np.abs(np.degrees(limits) / _WHOLE_DEG - np.round(np.degrees(limits) / _WHOLE_DEG)) < _ROUNDED
    is_odd = np.abs(100 * limits - np.round(100 * limits)) > _ROUNDED  # more than two decimals
    if len(limits) and limits.max() < 2 * np.pi + _ROUNDED and (is_whole & is_odd).all():
        raise ArgumentError(
            f"{name}: angles up to {limits.max():.5g} are {np.degrees(limits.max()):.0f} degrees as radians; write "
            "azimuth, elevation in degrees"
        )


def _csv_grid(path: str) -> Grid:
    if Path(path).suffix.lower() != ".csv":
        raise ArgumentError(
            f"directions {path!r} is not a grid; use {', '.join(PAPER_GRIDS)}, 2d:N, 3d:N or a .csv file"
        )
    try:
        text = Path(path).read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = checks.reason_unreadable(error)
        raise ArgumentError(
            f"directions {path}: {reason}; choose a readable CSV of azimuth, elevation in degrees"
        ) from error
    rows = csv_rows(f"directions {path}", text)
    if not rows or any(len(row) != 2 for row in rows):
        raise ArgumentError(
            f"directions {path} does not have two numbers in every row; write azimuth, elevation in degrees"
        )
    angles_rad = np.radians(np.asarray(rows))
    checks.finite_array(f"directions {path}", angles_rad)
    _require_degrees(f"directions {path}", np.asarray(rows))
    for row, (azimuth_deg, elevation_deg) in enumerate(rows):
        checks.between(f"directions {path}: azimuth in row {row}", azimuth_deg, -360.0, 360.0)
        checks.between(f"directions {path}: elevation in row {row}", elevation_deg, -90.0, 90.0)
    return Grid(angles_rad[:, 0].copy(), angles_rad[:, 1].copy())
