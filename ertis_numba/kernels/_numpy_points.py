"""Kernels of points in plain NumPy, as a reference for the compiled ones, and where none can be compiled."""

import math

import numpy as np

from ertis_numba.kernels._contract.points import ABSENT, Doubles, Places, PointKernels, Pulse, Quadrics
from ertis_numba.kernels._numpy_echo_fits import fit_echoes, pulse_at

__all__ = ["KERNELS"]


def spread_amplitudes(pulse: Pulse, path_m: Doubles, out: Doubles) -> None:
    """Compute the amplitudes of the image of a reflector, relative to that at its place."""
    value = pulse_at(pulse, path_m, pulse.table) * np.exp(1j * pulse.carrier_1_m * path_m)
    out[:] = np.abs((value * pulse.weights).mean(axis=1))


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


def interpolate_tops(quadrics: Quadrics, fit: Places, logs: Doubles, out: Doubles) -> None:
    """Interpolate the maxima of the logarithm of an image by parabolas."""
    logs = np.where(logs > ABSENT, logs, logs[:, 1:2] - math.log(2))
    before, level, after = logs[:, 0], logs[:, 1], logs[:, 2]
    curvature = before - 2 * level + after
    shift = np.divide(0.5 * (before - after), curvature, out=np.zeros_like(curvature), where=curvature < 0)
    found = np.empty((len(logs), 4))
    find_tops(quadrics, fit, logs[:, 3:] - level[:, None], found)
    out[:] = np.column_stack([shift, found[:, :3], level + 0.25 * (after - before) * shift + found[:, 3]])


KERNELS = PointKernels(
    spread_amplitudes=spread_amplitudes,
    find_tops=find_tops,
    interpolate_tops=interpolate_tops,
    fit_echoes=fit_echoes,
)
