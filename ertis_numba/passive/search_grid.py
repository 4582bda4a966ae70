"""Grids of directions that are fine enough to find the bearings of sources."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import direction_grid, microphones, spacing_rad, unit_vectors
from ertis_numba.passive.heard_signals import heard_bands
from ertis_numba.passive.scan_extent import is_level
from ertis_numba.settings import Processing, Settings

__all__ = ["search_changes", "search_warning"]

_LOSS: Final = 0.5  # Amplitude of a source between directions, relative to one in a direction: 6 dB.
_LINE: Final = 1e-6  # Width of an array relative to its length, below which it is a line.
_STEP: Final = 1.02
_HALF_SPACE: Final[dict[str, object]] = {
    "processing.azimuth_limits_deg": (-90.0, 90.0),
    "processing.elevation_limits_deg": (-90.0, 90.0),
}


def search_changes(settings: Settings) -> dict[str, object]:
    """Return the changes of settings with which directions suit the search for bearings.

    Parameters
    ----------
    settings : Settings

    Returns
    -------
    dict of str to value
        Empty if `search_warning` has no objection. Otherwise, a grid over the half-space ahead; for an array on a
        horizontal line, a grid in one plane.

    Raises
    ------
    ArgumentError
        The settings have no band, or their directions cannot be used.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> from ertis_numba.passive.search_grid import search_changes
    >>> search_changes(ertis.Settings())["processing.directions"].startswith("3d:")
    True
    """
    if search_warning(settings) is None:
        return {}
    wide = settings.replace(**_HALF_SPACE)
    return _HALF_SPACE | {"processing.directions": _sufficient(wide, _bands_hz(settings))}


def search_warning(settings: Settings) -> str | None:
    """Return a warning if sources between or beside the directions yield wrong bearings, or none.

    A source in the middle between directions may lose 6 dB at the mean square frequency of its band. An array that is
    not a horizontal line resolves elevations, so its directions need several.

    Parameters
    ----------
    settings : Settings
        Their directions, array, and bands are compared.

    Returns
    -------
    str or None
        None if the directions suffice in all bands.

    Raises
    ------
    ArgumentError
        The settings have no band, or their directions cannot be used.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> from ertis_numba.passive.search_grid import search_warning
    >>> settings = ertis.Settings().replace("passive.bands_hz", ((20e3, 30e3),))
    >>> search_warning(settings.replace("processing.directions", "3d:100")).split("; ")[-1]
    'search at least 3d:200 directions'
    >>> search_warning(settings.replace("processing.directions", "3d:200")) is None
    True
    """
    bands_hz = _bands_hz(settings)
    grid = direction_grid(settings.processing)
    directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    is_planar = is_level(directions)
    if is_planar and not _is_line(settings):
        elevation_deg = math.degrees(grid.elevation_rad[0])
        return (
            f"directions lie at one elevation, {elevation_deg:g}°, so a source above or below has a wrong azimuth and "
            f"level; search at least {_sufficient(settings, bands_hz)} directions"
        )
    apart_rad = spacing_rad(directions)
    for band_hz in bands_hz:
        if apart_rad > _largest_spacing_rad(settings, band_hz, is_planar=is_planar):
            return (
                f"directions are {math.degrees(apart_rad):.1f}° apart; above {band_hz[0] / 1e3:.1f} kHz, sources "
                f"between them may have wrong bearings; search at least {_sufficient(settings, bands_hz)} directions"
            )
    return None


def _bands_hz(settings: Settings) -> NDArray[np.float64]:
    """Return the edges of the bands from low to high frequencies: (band, 2) float64."""
    return np.sort(heard_bands(settings), axis=0)  # They do not overlap.


def _sufficient(settings: Settings, bands_hz: NDArray[np.float64]) -> str:
    """Return the name of a grid within the limits of settings that suffices in all bands."""
    processing, is_line = settings.processing, _is_line(settings)
    largest_rad = _largest_spacing_rad(settings, bands_hz[-1], is_planar=is_line)
    width_rad = float(np.ptp(processing.azimuth_limits_rad))
    if is_line:
        return f"2d:{_tens(width_rad / largest_rad + 1)}"
    area = width_rad * float(np.ptp(np.sin(processing.elevation_limits_rad)))
    if not area:
        return _sufficient(settings.replace(**_HALF_SPACE), bands_hz)
    n_directions = _tens(area / largest_rad**2)
    while _spacing_of(processing, f"3d:{n_directions}") > largest_rad:
        n_directions = _tens(n_directions * _STEP)
    return f"3d:{n_directions}"


def _tens(count: float) -> int:
    return 10 * max(1, math.ceil(count / 10))


def _spacing_of(processing: Processing, directions: str) -> float:
    """Return the spacing of a grid in radians."""
    grid = direction_grid(processing.replace(directions=directions))
    return spacing_rad(unit_vectors(grid.azimuth_rad, grid.elevation_rad))


def _is_line(settings: Settings) -> bool:
    """Return True if microphones lie on a horizontal line, which resolves one angle."""
    sizes, _ = _axes(settings)
    height_m = float(np.ptp(microphones(settings.array).enabled_positions_m[:, 2]))
    return bool(max(sizes[1], height_m) <= _LINE * sizes[0])


def _axes(settings: Settings) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sizes of the array along its axes, largest first, and the places along the longest axis in metres."""
    places_m = microphones(settings.array).enabled_positions_m
    places_m = places_m - places_m.mean(axis=0)
    _, sizes, axes = np.linalg.svd(np.concatenate([places_m, np.zeros((3, 3))]), full_matrices=False)
    return sizes, places_m @ axes[0]


def _largest_spacing_rad(settings: Settings, band_hz: NDArray[np.float64], *, is_planar: bool) -> float:
    """Return the spacing of directions in radians at which a source in their middle has the least permitted level."""
    _, places_m = _axes(settings)
    # The mean square frequency of a band.
    frequency_hz = math.sqrt(float((band_hz**2).sum() + band_hz.prod()) / 3)
    phase_per_rad = 2 * math.pi * frequency_hz / sound_speed_m_s(settings.air) * places_m
    away_rad = np.linspace(0.0, math.pi / 2, 4001)[1:]
    amplitude = np.abs(np.exp(1j * away_rad[:, None] * phase_per_rad).mean(axis=1))
    is_low = amplitude < _LOSS
    largest_rad = float(away_rad[int(is_low.argmax())]) if is_low.any() else math.pi / 2
    # The middle of a square is farther from its corners than that of a line from its ends.
    return 2 * largest_rad if is_planar else math.sqrt(2) * largest_rad
