"""Echoes that overlap with those of other reflectors or calls, and their errors."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels

__all__ = ["Overlap", "PredictedEchoes", "overlap", "summed_m2"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

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
    """Return how much the echoes of reflectors disturb others, as `kernels.OverlapEchoes` computes it.

    ``path_m`` (echo, emitter) is NaN for silent emitters, and ``is_other`` (echo, reflector, emitter) False for the
    prediction that is the echo. ``pulse_m`` (sensor,) is a path, and ``beam`` a difference of unit vectors.
    """
    out = np.empty((3, len(receiver), len(predicted.path_m)))
    paths_m, powers, directions = (np.ascontiguousarray(each) for each in predicted)
    path_m, direction, ahead = (np.ascontiguousarray(each) for each in (path_m, direction, ahead))
    kernels.load_fusion().overlap_echoes(
        paths_m, powers, directions, receiver, path_m, direction, power, is_other, ahead, pulse_m, beam, out
    )
    return Overlap(*out)


def summed_m2(late_m: Floats, ratio: Floats, width_m: Floats) -> Floats:
    """Return the variances of the paths of echoes (echo,) that are sums of the calls of several emitters.

    Their maxima are not between those of the calls if these cancel each other, so that errors reach half of the width.
    ``late_m`` and ``ratio`` (echo, emitter) are differences of paths and powers relative to the attributed echo.
    """
    here = np.minimum(ratio * np.exp(-2 * (late_m / (_SEPARATE * width_m)) ** 4), 1.0)
    here[here < kernels.DISTURBING] = 0.0
    return np.asarray(np.sum(here * np.minimum(late_m, _SUMMED * width_m) ** 2, axis=1))
