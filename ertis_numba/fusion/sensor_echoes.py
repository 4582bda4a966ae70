"""Echoes in the images of all sensors, which reflectors must explain."""

import math
from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.sight import tangents

__all__ = ["PulseEchoes", "SensorEchoes"]

Flags = NDArray[np.bool_]
Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_MOUNTED_M: Final = 1.7e-3  # Standard deviations of paths and directions that errors of mountings and of the air add to
_MOUNTED_RAD: Final = math.radians(0.22)  # the search for echoes of the same reflector.


class SensorEchoes(NamedTuple):
    """Echoes (echo,) in the image of one sensor, which the calls of ``emitters`` may have caused.

    Unit vectors from the receiver are in the frame of the platform; ``path_m`` (echo, emitter) is that of each
    emitter's call, and ``share`` (echo, emitter) that of the attribution of the images. Noise hardly causes clear
    echoes, even if its level changes within a record; faint ones only confirm reflectors that others show.
    """

    receiver: int
    emitters: Numbers
    direction: Floats
    path_m: Floats
    path_sd_m: Floats
    angle_sd_rad: Floats
    power: Floats
    share: Floats
    is_clear: NDArray[np.bool_]
    is_faint: NDArray[np.bool_]

    def without(self, emitters: Collection[int]) -> "SensorEchoes":
        """Return the echoes as those of other emitters only."""
        if not emitters:
            return self
        kept = ~np.isin(self.emitters, [*emitters])
        return self._replace(emitters=self.emitters[kept], path_m=self.path_m[:, kept], share=self.share[:, kept])


class PulseEchoes(NamedTuple):
    """Echoes (echo,) in the images of all sensors; path and share are NaN and 0 for emitters that are not heard.

    ``axes`` (echo, 3, axis) are the direction and two unit vectors across, ``deviation`` (echo, 2) those of path in m
    and direction in rad, and ``gate_rad`` that of the direction in the search for echoes of the same reflector. Only
    foreign echoes show calls of sensors that are not ``has_image`` (emitter,).
    """

    receiver: Numbers
    path_m: Floats
    share: Floats
    direction: Floats
    axes: Floats
    deviation: Floats
    gate_rad: Floats
    power: Floats
    is_clear: Flags
    is_faint: Flags
    has_image: Flags

    @classmethod
    def joined(cls, echoes: Sequence[SensorEchoes], n_sensors: int) -> "PulseEchoes":
        """Return the echoes of some of the sensors of a platform."""
        receiver = np.concatenate([np.full(len(each.power), each.receiver) for each in echoes])
        path_m, share = np.full((len(receiver), n_sensors), np.nan), np.zeros((len(receiver), n_sensors))
        begin = 0
        for each in echoes:
            rows = slice(begin, begin := begin + len(each.power))
            path_m[rows, each.emitters], share[rows, each.emitters] = each.path_m, each.share
        direction = np.concatenate([each.direction for each in echoes]).reshape(-1, 3)
        angle_sd_rad = np.concatenate([each.angle_sd_rad for each in echoes])
        return cls(
            receiver,
            path_m,
            share,
            direction,
            np.stack([direction, *tangents(direction)], axis=1),
            np.stack([np.concatenate([each.path_sd_m for each in echoes]), angle_sd_rad], axis=1),
            np.hypot(angle_sd_rad, _MOUNTED_RAD),
            np.concatenate([each.power for each in echoes]),
            np.concatenate([each.is_clear for each in echoes]),
            np.concatenate([each.is_faint for each in echoes]),
            np.isin(np.arange(n_sensors), [each.receiver for each in echoes]),
        )

    @property
    def is_incomplete(self) -> bool:
        """True if calls of sensors without an image are heard."""
        return bool(np.isfinite(self.path_m[:, ~self.has_image]).any())

    def matched(self) -> kernels.HeardEchoes:
        """Return the echoes as `kernels.MatchEchoes` takes them."""
        gate_m2 = self.deviation[:, 0] ** 2 + _MOUNTED_M**2
        return kernels.HeardEchoes(
            self.receiver, self.path_m, self.axes, self.deviation, self.gate_rad**2, gate_m2, self.power
        )
