"""Kernels of points in plain NumPy, as a reference for the compiled ones, and where none can be compiled."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.points import ABSENT, Doubles, Places, PointKernels, Pulse, Quadrics
from ertis_numba.kernels._numpy_echo_fits import fit_echoes, pulse_at

__all__ = ["KERNELS"]

Floats = NDArray[np.float32]
_BLOCK = 2**15  # fits into the cache


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


def noise_around(
    amplitude: Floats,
    direction: Places,
    place: Places,
    first: Places,
    n_around: int,
    quantiles: Doubles,
    fallen: np.float32,
    out: Floats,
) -> None:
    """Compute the highest quantile of amplitudes in windows around bins."""
    last = amplitude.shape[1] - 1
    columns = np.abs(place[:, None] + first[:, None, None] + np.arange(n_around))
    around = amplitude[direction[:, None], (last - np.abs(last - columns)).clip(0)]
    middles = np.minimum(-first, n_around - 1)
    is_own = np.stack([_slopes(*each, fallen) for each in zip(around, middles, strict=True)])
    for quantile, row in zip(quantiles, out, strict=True):
        is_left_out = is_own & (quantile > 0.5)
        n_own = is_left_out.sum(axis=2)
        rank = np.minimum(n_own + (quantile * (n_around - n_own - 1)).astype(np.int64), n_around - 1)
        ordered = np.sort(np.where(is_left_out, -np.inf, around), axis=2)
        row[:] = np.maximum(np.take_along_axis(ordered, rank[..., None], axis=2)[..., 0], 0).max(axis=0)


def _slopes(around: Floats, middle: int, fallen: np.float32) -> NDArray[np.bool_]:
    """Return True for the middle column of rows, and for those beside it up to which amplitudes fall: (row, column)."""
    found = np.zeros(around.shape, np.bool_)
    found[:, middle] = True
    found[:, middle + 1 :] = np.logical_and.accumulate(np.diff(around[:, middle:]) <= 0, axis=1)
    found[:, :middle] = np.logical_and.accumulate(np.diff(around[:, middle::-1]) <= 0, axis=1)[:, ::-1]
    found[np.where(found, around, np.inf).min(axis=1) > fallen * around[:, middle]] = False
    return found


def encode_levels(bits: NDArray[np.int32], floor: np.float32, per_octave: np.float32, out: NDArray[np.uint8]) -> None:
    """Round levels to codes."""
    for first in range(0, len(out), _BLOCK):
        part = bits[first : first + _BLOCK]
        with np.errstate(divide="ignore", invalid="ignore"):
            code = (np.log2(part.view(np.float32)) - floor) * per_octave + np.float32(1.5)
        out[first : first + _BLOCK] = np.where((part < 0) | np.isnan(code), 255, code.clip(0, 255))


KERNELS = PointKernels(
    spread_amplitudes=spread_amplitudes,
    find_tops=find_tops,
    interpolate_tops=interpolate_tops,
    fit_echoes=fit_echoes,
    noise_around=noise_around,
    encode_levels=encode_levels,
)
