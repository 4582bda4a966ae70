"""Reflectors of planar images above or below the sensors: places and uncertainties at unknown elevations."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.locating import OUTLIER, LocatedReflector
from ertis_numba.fusion.sensor_echoes import PulseEchoes

__all__ = ["at_any_height"]

Floats = NDArray[np.float64]

_LEVEL: Final = 0.25  # Probability that a reflector shows the height of the sensors, as posts and walls do.
_SD_RAD: Final = math.radians(6.0)  # Standard deviation of the elevations of others, …
_ELEVATION_RAD: Final = np.radians(np.append(0.0, np.linspace(-12.0, 12.0, 41)))  # … which are tried after elevation 0.
_UNLIKELY: Final = 0.2  # Probability of elevation 0, below which the place is that of the mean.
_LEAST: Final = 0.02  # Moment across a direction relative to that of the array, from which azimuths are accurate.
_ROUNDS: Final = 3
_INFORMATION_1_M2: Final = 1 / 10.0**2


def at_any_height(
    found: Sequence[LocatedReflector], echoes: PulseEchoes, sensor_m: Floats, axes_m2: Mapping[int, Floats]
) -> tuple[Floats, Floats]:
    """Return positions and covariances of reflectors that may be above or below the sensors.

    An elevation lengthens the paths and turns the directions of all echoes of a reflector. For each one of a grid,
    least squares locate the reflector again, and their residuals weight its prior probability. ``axes_m2`` (sensor,
    axis, axis) are the second moments of microphone positions in the platform frame. Images show the azimuth whose wave
    fits best at the microphones, so that they determine the component ``axes_m2 @ left`` of the direction.
    """
    position_m = np.array([each.place_m for each in found])
    covariance_m2 = np.array([each.covariance_m2 for each in found])
    count = [len(each.echo) for each in found]
    number, begin = np.repeat(np.arange(len(found)), count), np.cumsum([0, *count[:-1]])
    echo, emitter, deviation = (np.concatenate(each) for each in zip(*(one[3:] for one in found), strict=True))
    receiver = echoes.receiver[echo]
    height_m = np.hypot(*position_m[number, :2].T)[:, None] * np.tan(_ELEVATION_RAD)
    left = echoes.axes[echo, 1]
    moments_m2 = np.array([axes_m2[each] for each in receiver.tolist()])
    shown = np.einsum("eij,ej->ei", moments_m2, left)
    least_m2 = _LEAST * np.trace(moments_m2, axis1=1, axis2=2)  # Along an array, azimuths are unknown.
    shown /= np.maximum(least_m2, np.einsum("ei,ei->e", shown, left))[:, None]
    turned = np.einsum("ei,ei->e", shown, echoes.direction[echo])[:, None]
    away_m, back_m = position_m[number] - sensor_m[emitter], position_m[number] - sensor_m[receiver]

    def residuals(x_m: Floats, y_m: Floats) -> Floats:
        """Return the residuals (2 × echo, elevation) of paths and directions at shifted places."""
        (from_m, _), (to_m, across_m) = (
            _seen(each, shown, x_m[number], y_m[number], height_m) for each in (away_m, back_m)
        )
        late_m = echoes.path_m[echo, emitter][:, None] - from_m - to_m
        return np.asarray(np.concatenate([late_m, turned - across_m / to_m]) / deviation.T.reshape(-1, 1))

    from_m, to_m = (np.linalg.norm(each, axis=1)[:, None] for each in (away_m, back_m))
    across = np.einsum("ei,ei->e", shown, back_m)[:, None] / to_m
    slope = np.concatenate([away_m / from_m + back_m / to_m, (shown - across * back_m / to_m) / to_m])[:, :2]
    shift_m, misfit = _fitted(residuals, slope / deviation.T.reshape(-1, 1), begin)
    prior = np.exp(-0.5 * (_ELEVATION_RAD / _SD_RAD) ** 2)
    prior[1:] *= (1 - _LEVEL) / prior[1:].sum()
    prior[0] = _LEVEL
    weight = prior * np.exp(misfit.min(axis=1, keepdims=True) - misfit)
    weight /= weight.sum(axis=1, keepdims=True)
    mean_m = np.einsum("rk,rki->ri", weight, shift_m) * (weight[:, :1] < _UNLIKELY)
    apart_m = shift_m - mean_m[:, None]
    between_m = np.gradient(shift_m[:, 1:], axis=1) / math.sqrt(12)
    for spread, each in ((weight, apart_m), (weight[:, 1:], between_m)):
        covariance_m2[:, :2, :2] += np.einsum("rk,rki,rkj->rij", spread, each, each)
    position_m[:, :2] += mean_m
    return position_m, covariance_m2


def _seen(offset_m: Floats, shown: Floats, x_m: Floats, y_m: Floats, height_m: Floats) -> tuple[Floats, Floats]:
    """Return distances and components across (echo, elevation) of shifted places."""
    x_m, y_m, z_m = (each + at for each, at in zip((x_m, y_m, height_m), offset_m.T[..., None], strict=True))
    x, y, z = shown.T[..., None]
    return np.sqrt(x_m * x_m + y_m * y_m + z_m * z_m), x * x_m + y * y_m + z * z_m


def _fitted(
    residuals: Callable[[Floats, Floats], Floats], slope: Floats, begin: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Return shifts (reflector, elevation, axis) that fit residuals best, and their misfits.

    Weights are those of `kernels.LocateReflector`.
    """
    n_echoes = len(slope) // 2

    def summed(each: Floats) -> Floats:
        return np.asarray(np.add.reduceat(each[:n_echoes] + each[n_echoes:], begin, axis=0))

    (x, y), n_elevations = slope.T[..., None], len(_ELEVATION_RAD)
    shift_x, shift_y = np.zeros((2, len(begin), n_elevations))
    rest = residuals(shift_x, shift_y)
    weight = np.ones_like(rest)
    for _ in range(_ROUNDS):
        xx, xy, yy = (summed(weight * each) for each in (x * x, x * y, y * y))
        xx, yy = xx + _INFORMATION_1_M2, yy + _INFORMATION_1_M2
        right_x, right_y = summed(weight * x * rest), summed(weight * y * rest)
        determinant = xx * yy - xy * xy
        shift_x += (yy * right_x - xy * right_y) / determinant
        shift_y += (xx * right_y - xy * right_x) / determinant
        rest = residuals(shift_x, shift_y)
        weight = 1 / (1 + (rest / OUTLIER) ** 2)
    misfit = summed(OUTLIER**2 / 2 * np.log1p((rest / OUTLIER) ** 2))
    return np.stack([shift_x, shift_y], axis=-1), misfit
