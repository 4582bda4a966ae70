"""Echoes that overlap with those of other reflectors or calls, and their errors."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Overlap", "PredictedEchoes", "overlap", "summed_m2"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_FAINT: Final = 1e-4  # Power relative to that of an echo, below which another one does not disturb it.
_GRAZING: Final = 0.1  # Least cosine of the angle to the axis of the array.
_SHIFT: Final = 0.28  # Error of a path or a direction relative to the distance of an equally strong echo.
_DECAY: Final = -1.75  # Compressed pulses are 26 dB down at six widths, and 40 dB at fourteen.
_SIDE_LOBES: Final = 10 ** (-21.0 / 10)  # Mean power of side lobes of sparse arrays, relative to the main lobe, …
_SPREAD: Final = 0.33  # … over a path relative to the pulse and to the change of direction in widths of the beam, …
_TILT: Final = 0.5  # … and the error of a direction by their slopes, relative to the width and to their amplitude.
_SUMMED: Final = 0.5  # Largest error of the path of a sum of two equal pulses of any phases, in widths of the pulse, …
_SEPARATE: Final = 2.0  # … and difference of their paths, in such widths, from which their maxima are separate.


class PredictedEchoes(NamedTuple):
    """Echoes (reflector, receiver, …) that reflectors cause, unit vectors in the platform frame; 0 if inaudible."""

    path_m: Floats
    power: Floats
    direction: Floats


class Overlap(NamedTuple):
    """Disturbance (echo, reflector) of echoes by others: relative power, variances of path and direction; they add up.

    Side lobes of echoes from other directions change path and direction, too, but are no part of the power.
    """

    power: Floats
    path_m2: Floats
    angle_rad2: Floats

    def by(self, kept: NDArray[np.bool_]) -> "Overlap":
        """Return the sums over some reflectors: (echo,) each."""
        return Overlap(*(each[:, kept].sum(axis=1) for each in self))


def overlap(
    predicted: PredictedEchoes,
    receiver: Numbers,
    path_m: Floats,
    direction: Floats,
    power: Floats,
    is_other: NDArray[np.bool_],
    *,
    ahead: Floats,
    pulse_m: Floats,
    beam: Floats,
) -> Overlap:
    """Return how much the echoes of reflectors disturb others.

    Two echoes within the width of the compressed pulse and of the beam have one maximum, or several at other places,
    depending on their phases. The error grows with the ratio of the amplitudes, and with the distance up to the width.
    ``path_m`` (echo, emitter) is NaN for silent emitters, and ``is_other`` (echo, reflector, emitter) False for the
    prediction that is the echo. ``pulse_m`` (sensor,) is a path, and ``beam`` a difference of unit vectors.
    """
    facing, width_m, width = ahead[receiver], pulse_m[receiver, None, None], beam[receiver, None]
    late_m = np.abs(path_m[:, None] - predicted.path_m.swapaxes(0, 1)[receiver])
    turned = direction[:, None] - predicted.direction.swapaxes(0, 1)[receiver]
    # A flat array observes directions in its plane, so its beam is wider to the side.
    along = np.einsum("eri,ei->er", turned, facing)
    across = np.sqrt(np.maximum(0.0, np.einsum("eri,eri->er", turned, turned) - along**2))
    pulse = (1 + (late_m / width_m) ** 2) ** _DECAY  # with side lobes
    near = pulse * np.exp(-((across / width) ** 2))[..., None]
    apart_m = np.maximum(0.0, late_m - _SPREAD * width_m * (across / width)[..., None])
    aside = _SIDE_LOBES * (1 + (apart_m / width_m) ** 2) ** _DECAY * (across > width)[..., None]
    strength = predicted.power.swapaxes(0, 1)[receiver] / power[:, None, None]
    ratio, side = (
        np.where(is_other & (each * strength > _FAINT), np.minimum(each * strength, 1.0), 0.0)  # False for NaN.
        for each in (near, aside)
    )
    is_any = ratio + side > 0
    path_m2 = np.where(is_any, (ratio + side) * np.minimum(_SHIFT * late_m, width_m) ** 2, 0.0).sum(axis=2)
    total, facing_to = ratio.sum(axis=2), np.maximum(np.einsum("ei,ei->e", direction, facing), _GRAZING)[:, None]
    angle_rad2 = total * (_SHIFT * np.minimum(across, width)) ** 2 + side.sum(axis=2) * (_TILT * width) ** 2
    return Overlap(total, path_m2, angle_rad2 / facing_to**2)


def summed_m2(late_m: Floats, ratio: Floats, width_m: Floats) -> Floats:
    """Return the variances of the paths of echoes (echo,) that are sums of the calls of several emitters.

    Their maxima are not between those of the calls if these cancel each other, so that errors reach half of the width.
    ``late_m`` and ``ratio`` (echo, emitter) are differences of paths and powers relative to the attributed echo.
    """
    here = np.minimum(ratio * np.exp(-2 * (late_m / (_SEPARATE * width_m)) ** 4), 1.0)
    here[here < _FAINT] = 0.0
    return np.asarray(np.sum(here * np.minimum(late_m, _SUMMED * width_m) ** 2, axis=1))
