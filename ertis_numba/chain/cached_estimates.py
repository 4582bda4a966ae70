"""Errors and sizes of interpolations that many plans share, cached because they dominate the time of a planner."""

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.interpolation_fit import DelayFit, Spectrum

__all__ = []

_MAX_APERTURES = 8  # Arrays with their directions.


_MAX_FITS = 288  # Four times the number of fits in one search.


class PlannedBeams(NamedTuple):
    """Determines a beam grid and its errors; equal if its elements are, arrays by identity."""

    aperture: Aperture
    spectrum: Spectrum
    n_taps: int
    density: float
    high_hz: float
    sound_speed_m_s: float
    nearest_m: float


@functools.lru_cache(maxsize=_MAX_FITS)
def fitted(spectrum: Spectrum, n_taps: int, step_s: float) -> tuple[DelayFit, NDArray[np.float64]]:
    """Return a fit and the magnitudes of its weights, cached because fits would dominate the time of a planner."""
    fit = DelayFit(n_taps, step_s, spectrum)
    return fit, np.abs(fit.weights(fit.fractions))


@functools.lru_cache(maxsize=_MAX_APERTURES)
def aperture_of(positions_m: bytes, directions: bytes, is_turned: bool) -> Aperture:  # noqa: FBT001  cached
    """Return the aperture, as the same object for the same positions and directions, so its errors can be cached."""
    given = (np.frombuffer(values).reshape(-1, 3) for values in (positions_m, directions))
    return Aperture.of(*given, is_turned=is_turned)


@functools.lru_cache(maxsize=_MAX_FITS)
def grid_points(beams: PlannedBeams) -> int:
    """Return the number of beam-grid points, cached because it is the same for many pipelines."""
    aperture = beams.aperture
    spacing = aperture.spacing(beams.density, high_hz=beams.high_hz, sound_speed_m_s=beams.sound_speed_m_s)
    return aperture.count_grid_points(spacing, beams.n_taps)


@functools.lru_cache(maxsize=_MAX_FITS)
def estimated_errors(beams: PlannedBeams) -> tuple[NDArray[np.float64], float]:
    """Return the errors and the squares of a beam grid, cached because they dominate the time of a planner."""
    nodes = estimated(beams)
    return nodes.errors, nodes.squares


def estimated(beams: PlannedBeams) -> BeamGrid:
    return BeamGrid(
        beams.aperture,
        beams.spectrum,
        n_taps=beams.n_taps,
        density=beams.density,
        high_hz=beams.high_hz,
        sound_speed_m_s=beams.sound_speed_m_s,
        estimate=True,
        nearest_m=beams.nearest_m,
    )
