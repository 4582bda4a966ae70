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
    """Echoes in the image of one sensor.

    Attributes
    ----------
    emitters : (emitter,) int64
        Sensors whose calls may have caused the echoes.
    direction : (echo, axis) float64
        Unit vectors from the receiver, in the frame of the platform.
    path_m : (echo, emitter) float64
        Length of the path of the sound if the emitter's call caused the echo.
    path_sd_m, angle_sd_rad : (echo,) float64
        Standard deviations of path and direction.
    power : (echo,) float64
    share : (echo, emitter) float64
        Share of each emitter according to the attribution of the images.
    is_clear : (echo,) bool
        Echoes that noise hardly causes, even if its level changes within a record.
    is_faint : (echo,) bool
        Echoes that only confirm reflectors that others show.
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
    """Echoes in the images of all sensors.

    Attributes
    ----------
    receiver : (echo,) int64
    path_m, share : (echo, emitter) float64
        As in `SensorEchoes`; NaN and 0 for emitters that the receiver does not hear.
    direction : (echo, axis) float64
    axes : (echo, 3, axis) float64
        Direction, and two unit vectors across.
    deviation : (echo, 2) float64
        Standard deviations of path in metres and direction in radians.
    gate_rad : (echo,) float64
        That of the direction in the search for echoes of the same reflector.
    power : (echo,) float64
    is_clear, is_faint : (echo,) bool
    has_image : (emitter,) bool
        Only foreign echoes show the calls of sensors without an image.
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
        return kernels.HeardEchoes(self.receiver, self.direction, self.path_m, self.gate_rad**2, gate_m2, self.power)
