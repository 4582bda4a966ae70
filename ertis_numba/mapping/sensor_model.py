"""Inverse sensor model of a sonar: evidence for free and for occupied space from the points of one pulse."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from ertis_numba import kernels
from ertis_numba.mapping.cell_grid import Window
from ertis_numba.mapping.coverage import Coverage
from ertis_numba.mapping.echoes import CLEAR, LocatedEchoes, View

__all__ = ["MAX_LOG_ODDS", "TRUST", "Trust", "add_evidence"]

Floats = NDArray[np.float64]
Places = NDArray[np.int64]
Singles = NDArray[np.float32]
Flags = NDArray[np.bool_]

MAX_LOG_ODDS: Final = 4.0
"""Limit of log-odds, which keeps the map able to change (K. M. Wurm et al., OctoMap, 2010)."""
_FREE: Final = 0.6  # Log-odds of a cell in front of the first clear echo, near the platform.
_FREE_M: Final = 1.0  # Free range in directions without any clear echo.
_IN_FRONT_M: Final = 0.05  # Space in front of an echo that is not free yet.
_BEHIND_M: Final = 0.3  # Distance behind an obstacle within the beam from which it hides echoes.
_DEPTH_M: Final = 0.05  # The same for a wall of the map in the direction of the echo: the thickness of its cells.
_WALL: Final = 1.5  # Log-odds from which a cell hides those behind it.
_OPEN: Final = -0.5  # Log-odds below which a cell lets sound pass.
_CERTAIN: Final = 0.9975  # Highest probability, which is the share of reflectors among the strongest points.
# Angles between the middles of directions; the quarters of a degree make room for rounding.
_HALF_BEAM_RAD: Final = math.radians(5.25)  # Directions beside an echo in which it may hide others.
_HALF_RAY_RAD: Final = math.radians(1.25)  # The same beside a wall of the map, whose directions are known.
_REACH_SD: Final = 3.0  # Standard deviations within which an echo counts.
_POSE_SD: Final = 2.0  # Distance of free space from echoes, in standard deviations of the pose.
_TOUCHED: Final = 0.1  # Evidence of an echo above which a cell does not become free.


class Trust(NamedTuple):
    """Trust in echoes, in log-odds."""

    # They come from a logistic regression of simulated reflectors and ghosts.

    clear: float  # of an unobstructed echo ahead of a sensor, besides its amplitude
    strength: float  # factor of the log-odds of the amplitude
    hidden: float  # reduction, multiplied by the hidden share of an echo
    beside: float  # reduction for each unit of coverage below 0.4
    cell: float  # of a cell relative to the echo in it: reflectors repeat, ghosts seldom do
    total: float  # of a certain echo, shared among the cells that may contain it
    unconfirmed: float  # reduction for points that the fusion does not confirm
    repeats: float  # evidence of all pulses from one viewpoint, relative to one
    missed: float  # loss of an occupied cell ahead of a sensor in a pulse without an echo there

    @property
    def most(self) -> float:
        """Largest log-odds that one echo adds to a cell."""
        return self.cell * float(self.log_odds(np.ones(1), np.ones(1), np.ones(1), np.ones(1, np.bool_))[0])

    def log_odds(self, strength: Floats, visible: Floats, coverage: Floats, is_confirmed: Flags) -> Floats:
        """Return the log-odds of echoes, negative infinity for those that no sensor can hear: (point,) float64."""
        found = self.clear + self.strength * logit(np.clip(strength, 1 - _CERTAIN, _CERTAIN))
        found -= self.hidden * (1 - visible) + self.beside * np.maximum(_AHEAD - coverage, 0.0)
        found -= np.where(is_confirmed, 0.0, self.unconfirmed)
        return np.asarray(np.where((coverage > 0) & (visible > 0), found, -np.inf))


TRUST: Final = {
    2: Trust(
        clear=0.0,
        strength=1.0,
        hidden=3.7,
        beside=0.0,
        cell=0.18,
        total=10.0,
        unconfirmed=2.6,
        repeats=1.0,
        missed=0.14,
    ),
    3: Trust(
        clear=1.5, strength=0.0, hidden=1.6, beside=5.6, cell=0.6, total=15.0, unconfirmed=1.0, repeats=2.0, missed=0.03
    ),
}
"""Trust in echoes by number of dimensions. Echoes in space overlap more often, so their amplitude does not count."""
_AHEAD: Final = 0.4  # Coverage above which echoes are equally reliable.


def add_evidence(window: Window, view: View, echoes: LocatedEchoes, coverage: Coverage, *, near_m: float) -> None:
    """Add the evidence of one pulse to a map; within near_m, the platform's own place is free."""
    grid, kernel = coverage.grid, kernels.load_mapping()
    ahead = np.asarray(grid.directions @ view.rotation.T)
    # Cosines between the direction of each echo and all directions.
    cosine = grid.directions[_direction(coverage, echoes)] @ grid.directions.T
    first_m = _first_clear_m(echoes, cosine)
    wall_m = _wall_m(window, view, coverage, ahead)
    seen_m = np.where(np.isfinite(first_m), first_m, _FREE_M + _IN_FRONT_M)
    is_open = _log_odds(window, view, ahead * seen_m[:, None]) < _OPEN
    hiding_m = np.minimum(np.where(is_open, np.inf, first_m), wall_m)
    visible = _visible(echoes, cosine, np.cos(grid.elevations_rad), hiding_m, wall_m)
    trust = TRUST[2 if window.is_planar else 3]
    log_odds = trust.log_odds(echoes.strength, visible, coverage.at(echoes.offset_m), echoes.is_confirmed)
    position_sd_m, rotation_sd_rad = view.sd
    end_m = np.minimum(_end_m(echoes, cosine, first_m, position_sd_m, rotation_sd_rad), wall_m)
    is_free = grid.range_m < end_m[:, None]
    is_ahead = grid.range_m < (hiding_m + _BEHIND_M)[:, None]
    # If the pose is uncertain, the echo of a cell may appear in another cell.
    missed = trust.missed / (1 + (position_sd_m**2 + (rotation_sd_rad * grid.range_m) ** 2) / window.cell_m**2)
    free = (coverage.silence * np.where(is_free, _FREE, np.where(is_ahead, -missed, 0.0))).astype(np.float32)
    occupied = _occupied(window, view, echoes, log_odds, trust)
    np.maximum(window.shown, occupied, out=window.shown)
    kernel.add_evidence(
        occupied,
        np.float32(_TOUCHED),
        np.float32(trust.most),
        free.reshape(-1, grid.n_azimuths, grid.n_ranges),
        window.cells_of(view.place_m),
        np.ascontiguousarray(view.rotation),
        grid.step_m / window.cell_m,
        max(0.0, near_m - _POSE_SD * position_sd_m) / window.cell_m,
        np.float32(_FREE),
        np.float32(MAX_LOG_ODDS),
        window.log_odds,
    )
    # Pulses from one viewpoint are one observation. They may occupy a cell that was free, as objects that arrive do.
    most = np.maximum(window.before, 0.0) + np.float32(trust.repeats) * window.shown
    np.minimum(window.log_odds, most, out=window.log_odds)


def _direction(coverage: Coverage, echoes: LocatedEchoes) -> Places:
    """Return the direction of each echo: (point,) int64."""
    unit = echoes.offset_m / np.maximum(echoes.range_m, 1e-9)[:, None]
    return np.asarray(coverage.grid.cell_of(unit * coverage.grid.step_m / 2) // coverage.grid.n_ranges)


def _first_clear_m(echoes: LocatedEchoes, cosine: Floats) -> Floats:
    """Return the range of the first clear echo in each direction, infinite without one: (direction,) float64."""
    is_clear = echoes.strength > CLEAR
    is_near = cosine[is_clear] > math.cos(_HALF_BEAM_RAD)
    return np.asarray(np.where(is_near, echoes.range_m[is_clear, None], np.inf).min(axis=0, initial=np.inf))


def _end_m(
    echoes: LocatedEchoes, cosine: Floats, first_m: Floats, position_sd_m: float, rotation_sd_rad: float
) -> Floats:
    """Return the end of free space in each direction: (direction,)."""
    end_m = np.where(np.isfinite(first_m), first_m - _IN_FRONT_M, _FREE_M)
    if not position_sd_m and not rotation_sd_rad:
        return np.asarray(end_m)
    end_m -= _POSE_SD * position_sd_m
    is_clear = echoes.strength > CLEAR
    range_m = echoes.range_m[is_clear]
    across_rad = _POSE_SD * (position_sd_m / np.maximum(range_m, _IN_FRONT_M) + rotation_sd_rad)
    is_near = cosine[is_clear] > np.cos(np.minimum(_HALF_BEAM_RAD + across_rad, math.pi))[:, None]
    nearest_m = np.where(is_near, range_m[:, None], np.inf).min(axis=0, initial=np.inf)
    return np.asarray(np.minimum(end_m, nearest_m - _IN_FRONT_M - _POSE_SD * position_sd_m))


def _visible(echoes: LocatedEchoes, cosine: Floats, weight: Floats, hiding_m: Floats, wall_m: Floats) -> Floats:
    """Return the share of the amplitude that passes the obstacles in front of echoes: (point,)."""
    # The open share of directions passes twice. Obstacles count from `hiding_m`, and a wall at `wall_m` hides all.
    passed = []
    for first_m, angle_rad, behind_m in ((hiding_m, _HALF_BEAM_RAD, _BEHIND_M), (wall_m, _HALF_RAY_RAD, _DEPTH_M)):
        is_near = cosine > math.cos(angle_rad)
        is_open = is_near & (first_m + behind_m >= echoes.range_m[:, None])
        passed.append((is_open @ weight) / (is_near @ weight))
    return np.asarray(np.minimum(*passed) ** 2)


def _wall_m(window: Window, view: View, coverage: Coverage, ahead: Floats) -> Floats:
    """Return the range behind the first cell that earlier pulses have found occupied: (direction,) float64."""
    grid = coverage.grid
    n_before = np.empty(grid.n_directions, np.int64)
    kernels.load_mapping().find_walls(
        window.log_odds,
        window.cells_of(view.place_m),
        ahead,
        grid.step_m / window.cell_m,
        np.float32(_WALL),
        grid.n_ranges,
        n_before,
    )
    behind_m = (n_before + 0.5) * grid.step_m + window.cell_m
    return np.asarray(np.where(n_before < grid.n_ranges, behind_m, np.inf))


def _log_odds(window: Window, view: View, offset_m: Floats) -> Singles:
    """Return the log-odds of a map at places relative to that of a view, in the world: (point,) float32."""
    cells = np.rint(window.cells_of(view.place_m + offset_m)).astype(np.int64)[:, ::-1]
    return np.asarray(window.log_odds[tuple(cells.clip(0, np.array(window.log_odds.shape) - 1).T)])


def _occupied(window: Window, view: View, echoes: LocatedEchoes, log_odds: Floats, trust: Trust) -> Singles:
    """Return the evidence for occupied cells: (layer, row, column)."""
    n_axes = 2 if window.is_planar else 3
    offset_m = echoes.offset_m @ view.rotation.T
    # Places within a cell are uniformly distributed.
    sharp = view.rotation @ echoes.covariance_m2 @ view.rotation.T / window.cell_m**2 + np.eye(3) / 12
    covariance = sharp + view.covariance_at_m2(offset_m) / window.cell_m**2
    for each in (sharp, covariance):
        each[:, n_axes:], each[:, :, n_axes:] = 0.0, 0.0
        each[:, range(n_axes, 3), range(n_axes, 3)] = 1.0
    volume = np.sqrt(np.linalg.det(covariance))
    found = np.zeros_like(window.log_odds)
    kernels.load_mapping().spread_echoes(
        window.cells_of(view.place_m + offset_m),
        np.asarray(np.linalg.inv(covariance), np.float64),
        _REACH_SD * np.sqrt(np.einsum("pii->pi", covariance)),
        trust.total * expit(log_odds) * (2 * math.pi) ** (-n_axes / 2) / volume,
        trust.cell * np.maximum(log_odds, 0.0) * np.sqrt(np.linalg.det(sharp)) / volume,
        found,
    )
    return found
