"""Comparison of the spacing of directions with the main lobe of the array."""

import math
from typing import Final

import numpy as np

from ertis_numba.analysis.detect import neighbours_of, spacing_of
from ertis_numba.analysis.point_spread import PointSpread
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import unit_vectors
from ertis_numba.settings import Settings

__all__ = ["spacing_warning"]

_MIN_AMPLITUDE: Final = math.sqrt(0.5)  # Relative to a reflector in a direction.
_N_TURNS: Final = 16  # Orientations of the line between two directions.
_FINER: Final = 0.97  # Factor by which each attempt reduces the spacing.


def spacing_warning(image: Energyscape) -> str | None:
    """Return a warning if a reflector between the directions of an image may lose half of its power.

    Parameters
    ----------
    image : Energyscape

    Returns
    -------
    str or None
        None for fine grids, and for grids of a single direction.

    Examples
    --------
    >>> import ertis_numba as ertis
    >>> from ertis_numba.analysis.direction_spacing import spacing_warning
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     spacing_warning(ertis.Pipeline(recording.settings).process(recording[0])) is None
    True
    """
    directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
    spacing_rad = float(np.median(spacing_of(directions, neighbours_of(directions))))
    if not math.isfinite(spacing_rad):
        return None
    amplitude = _amplitude_between(image.settings, spacing_rad, is_planar=image.is_planar)
    if amplitude >= _MIN_AMPLITUDE:
        return None
    finer = _FINER
    while _amplitude_between(image.settings, finer * spacing_rad, is_planar=image.is_planar) < _MIN_AMPLITUDE:
        finer *= _FINER
    kind, n_dimensions = ("2d", 1) if image.is_planar else ("3d", 2)
    n_directions = 10 * math.ceil(len(directions) / finer**n_dimensions / 10)
    return (
        f"directions are {math.degrees(spacing_rad):.1f}° apart, so a reflector between them appears up to "
        f"{-20 * math.log10(amplitude):.0f} dB too weak; process with at least {kind}:{n_directions} directions"
    )


def _amplitude_between(settings: Settings, spacing_rad: float, *, is_planar: bool) -> float:
    """Return the lowest relative amplitude of a reflector ahead of the array, midway between directions."""
    turn_rad = np.zeros(1) if is_planar else np.arange(_N_TURNS) * (math.pi / _N_TURNS)
    # The middle of a square is farther from its corners than that of a line from its ends.
    away_rad = spacing_rad / 2 * (1.0 if is_planar else math.sqrt(2))
    offsets = away_rad * np.stack([np.zeros(len(turn_rad)), np.cos(turn_rad), np.sin(turn_rad)], axis=1)
    return float(PointSpread(settings)(offsets, np.zeros(len(offsets))).min())
