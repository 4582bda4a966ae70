"""Kernels of points in plain NumPy, as a reference for the compiled ones, and where none can be compiled."""

import math

import numpy as np

from ertis_numba.kernels._contract.points import (
    ABSENT,
    ALIKE,
    CONVERGED,
    DARK,
    MAX_SHIFT,
    BeamErrors,
    Complexes,
    Doubles,
    Places,
    PointKernels,
    Pulse,
    Quadrics,
    Singles,
)

__all__ = ["KERNELS"]


def spread_amplitudes(pulse: Pulse, direction_offset: Doubles, offset_m: Doubles, scale: float, out: Doubles) -> None:
    """Compute the amplitudes of the image of a reflector, relative to that at its place."""
    out[:] = _amplitudes(pulse, direction_offset, offset_m, scale)


def find_tops(quadrics: Quadrics, fit: Places, rises: Doubles, out: Doubles) -> None:
    """Find the maxima of quadrics."""
    slope_x, slope_y, xx, xy, yy = np.einsum("pcn,pn->cp", quadrics.inverse[fit], rises)
    xx, yy = 2 * xx, np.where(quadrics.n_axes[fit] == 2, 2 * yy, -1.0)
    determinant = xx * yy - xy * xy
    is_top = (xx < 0) & (determinant > 0)
    scale = np.divide(1.0, determinant, out=np.zeros_like(determinant), where=is_top)
    x, y = (xy * slope_y - yy * slope_x) * scale, (xy * slope_x - xx * slope_y) * scale
    is_near = np.hypot(x, y) <= quadrics.reach[fit]
    x, y = np.where(is_near, x, 0.0), np.where(is_near, y, 0.0)
    out[:, :3] = x[:, None] * quadrics.axes[fit, 0] + y[:, None] * quadrics.axes[fit, 1]
    out[:, 3] = 0.5 * (slope_x * x + slope_y * y)


def interpolate_tops(
    pulse: Pulse,
    quadrics: Quadrics,
    beams: BeamErrors,
    row: Places,
    fit: Places,
    logs: Doubles,
    offset_m: Doubles,
    step_m: float,
    scale: float,
    n_rounds: int,
    out: Doubles,
) -> None:
    """Interpolate the maxima of the logarithm of an image, and subtract the error of this interpolation."""
    first = _interpolated(quadrics, fit, logs)
    found, active, last = first.copy(), np.arange(len(first)), np.full(len(first), np.inf)
    for _ in range(n_rounds):
        here = found[active]
        predicted = _predicted(pulse, beams, row[active], offset_m[active] - step_m * here[:, :1], scale, here)
        difference = logs[active] - predicted
        is_alike = np.abs(difference - difference[:, 1:2]).max(axis=1, initial=0.0) < ALIKE
        correction = first[active] - _interpolated(quadrics, fit[active], predicted)
        size = np.abs(correction).max(axis=1)
        is_smaller = size < last[active]  # The corrections of noise need not converge.
        corrected = np.where(is_smaller[:, None], here + correction, here)
        found[active] = np.where(is_alike[:, None], corrected, first[active])
        last[active] = size
        active = active[is_alike & is_smaller & (size > CONVERGED)]
    change = np.abs(found - first)
    is_small = (change[:, 0] <= MAX_SHIFT) & (change[:, 4] <= MAX_SHIFT)
    out[:] = np.where(is_small[:, None], found, first)


def _interpolated(quadrics: Quadrics, fit: Places, logs: Doubles) -> Doubles:
    """Return the maxima of parabolas through logarithms: (place, 5) float64."""
    logs = np.where(logs > ABSENT, logs, logs[:, 1:2] - math.log(2))
    before, level, after = logs[:, 0], logs[:, 1], logs[:, 2]
    curvature = before - 2 * level + after
    shift = np.divide(0.5 * (before - after), curvature, out=np.zeros_like(curvature), where=curvature < 0)
    found = np.empty((len(logs), 4))
    find_tops(quadrics, fit, logs[:, 3:] - level[:, None], found)
    return np.column_stack([shift, found[:, :3], level + 0.25 * (after - before) * shift + found[:, 3]])


def _predicted(pulse: Pulse, beams: BeamErrors, row: Places, away_m: Doubles, scale: float, found: Doubles) -> Doubles:
    """Return predicted logarithms of the samples of reflectors: (place, sample) float64."""
    top = beams.directions[row[:, 0]] + found[:, 1:4]
    away = beams.directions[row] - (top / np.linalg.norm(top, axis=1)[:, None])[:, None]
    errors = (beams.gain[row.ravel()], beams.slope_s[row.ravel()]) if len(beams.gain) else None
    amplitude = _amplitudes(pulse, away.reshape(-1, 3), away_m.ravel(), scale, errors)
    return np.asarray(np.log(np.maximum(amplitude.reshape(row.shape), DARK)) + found[:, 4:])


def _amplitudes(
    pulse: Pulse, away: Doubles, away_m: Doubles, scale: float, errors: tuple[Singles, Singles] | None = None
) -> Doubles:
    """Return amplitudes of a reflector's image, (place,) float64, with gains and slopes of beams, (place, mic)."""
    path_m = scale * (2 * away_m[:, None] - away @ pulse.positions_m.T)
    value = _at(pulse, path_m, pulse.table)
    if errors is not None:
        gain, slope_s = errors
        value = value * gain + slope_s * _at(pulse, path_m, pulse.tilted_hz)
    return np.asarray(np.abs((value * np.exp(1j * pulse.carrier_1_m * path_m) * pulse.weights).mean(axis=1)))


def _at(pulse: Pulse, path_m: Doubles, table: Complexes) -> Complexes:
    """Return values of a table at differences of paths: (place, mic) complex128."""
    # They are evenly spaced; `numpy.interp` would search for the place of each.
    place = np.minimum(np.abs(path_m) / pulse.step_m, len(table) - 1.0)
    before = np.minimum(place.astype(np.intp), len(table) - 2)
    found = table[before]
    found += (place - before) * (table[before + 1] - found)
    found.imag[path_m < 0] *= -1
    return np.asarray(found)


KERNELS = PointKernels(spread_amplitudes=spread_amplitudes, find_tops=find_tops, interpolate_tops=interpolate_tops)
