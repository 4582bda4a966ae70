"""Residuals of pairs of echoes between two groups, for a trial displacement of the platform."""

import copy
import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.motion.echoes import GroupEchoes

__all__ = ["EchoFlow", "EchoPairs", "twist_of"]

Floats = NDArray[np.float64]

_MAX_LEVEL_CHANGE: Final = math.log(4.0)  # of amplitudes, 12 dB
_STEP: Final = 1e-6
_TRIALS: Final = _STEP * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])


class EchoPairs(NamedTuple):
    """Echoes of both groups that may come from the same reflector."""

    before: NDArray[np.int64]
    after: NDArray[np.int64]


def twist_of(displacement: Floats, time_s: float | Floats) -> Floats:
    """Return the constant twists, forward, left and yaw per second, that produce displacements: (..., 3)."""
    x, y, yaw = np.moveaxis(displacement, -1, 0)
    half = yaw / 2
    # Inverse of the chord of an arc, turned back by half of the angle.
    grow = 1 / np.sinc(half / math.pi)
    c, s = np.cos(half) * grow, np.sin(half) * grow
    return np.stack([c * x + s * y, c * y - s * x, yaw], axis=-1) / time_s


def _predicted(
    displacement: Floats, before: GroupEchoes, offset_m: Floats, first: Floats, second: Floats
) -> tuple[Floats, Floats]:
    """Return range and azimuth of echoes after trial displacements (trial, 3): two (trial, echo)."""
    from_sensor_m = before.position_m - offset_m
    x_m, y_m = _turned(from_sensor_m[:, 0], from_sensor_m[:, 1], first[:, 2:] * before.arrival_s)
    way_x_m, way_y_m = _way_m(x_m, y_m, first, offset_m, before.range_m, before.delay_s, before.arrival_s)
    x_m, y_m = x_m + way_x_m + offset_m[:, 0], y_m + way_y_m + offset_m[:, 1]
    x_m, y_m = _turned(x_m - displacement[:, :1], y_m - displacement[:, 1:2], -displacement[:, 2:])
    x_m, y_m = x_m - offset_m[:, 0], y_m - offset_m[:, 1]
    square_z_m2 = from_sensor_m[:, 2] ** 2
    range_m = np.sqrt(x_m**2 + y_m**2 + square_z_m2)
    later_s = (range_m - before.range_m) / before.sound_speed_m_s
    delay_s, arrival_s = before.delay_s + later_s, before.arrival_s + 2 * later_s
    way_x_m, way_y_m = _way_m(x_m, y_m, second, offset_m, range_m, delay_s, arrival_s)
    x_m, y_m = x_m - way_x_m, y_m - way_y_m
    return np.sqrt(x_m**2 + y_m**2 + square_z_m2), np.arctan2(y_m, x_m) - second[:, 2:] * arrival_s


def _way_m(
    x_m: Floats, y_m: Floats, twist: Floats, offset_m: Floats, range_m: Floats, delay_s: Floats, arrival_s: Floats
) -> tuple[Floats, Floats]:
    """Return the way of the sensors until the range and the direction of each echo apply: two (trial, echo) float64."""
    x_m_s, y_m_s = twist[:, :1] - twist[:, 2:] * offset_m[:, 1], twist[:, 1:2] + twist[:, 2:] * offset_m[:, 0]
    along = (x_m * x_m_s + y_m * y_m_s) / range_m**2 * (delay_s - arrival_s)
    return arrival_s * x_m_s + along * x_m, arrival_s * y_m_s + along * y_m


def _turned(x_m: Floats, y_m: Floats, angle_rad: Floats) -> tuple[Floats, Floats]:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return c * x_m - s * y_m, s * x_m + c * y_m


class EchoFlow:
    """Residuals of pairs of echoes, in standard deviations."""

    def __init__(
        self,
        before: GroupEchoes,
        after: GroupEchoes,
        sensors: tuple[MountedSensor, ...],
        time_s: float,
        twists: tuple[Floats | None, Floats | None],
    ) -> None:
        self.before, self.after, self._time_s, self._sensors = before, after, time_s, sensors
        self._offset_m = np.array([sensor.translation_m for sensor in sensors])[before.sensor]
        self._twists = [None if twist is None else twist[None] for twist in twists]

    def behind(self, chosen: NDArray[np.int64]) -> "EchoFlow":
        """Return the flow if echoes of some sensors that may be behind their arrays are there; pairs stay the same."""
        found = copy.copy(self)
        found.before, found.after = (each.behind(self._sensors, chosen) for each in (self.before, self.after))
        return found

    def pairs(self, reach_m: float, reach_rad: float) -> EchoPairs:
        """Return the pairs of the same sensor whose range, azimuth and level differ little."""
        before, after = self.before, self.after
        near = before.sensor[:, None] == after.sensor
        near &= np.abs(before.range_m[:, None] - after.range_m) < reach_m
        near &= np.abs(_turn(before.azimuth_rad[:, None] - after.azimuth_rad)) < reach_rad
        near &= np.abs(before.level[:, None] - after.level) < _MAX_LEVEL_CHANGE
        return EchoPairs(*np.nonzero(near))

    def linear(self, displacement: Floats, pairs: EchoPairs) -> tuple[Floats, Floats]:
        """Return observed minus predicted ranges and azimuths (2, pair), and slopes of predictions (2, pair, 3)."""
        range_m, azimuth_rad = self._predicted(displacement + _TRIALS)
        residual = np.stack(
            [
                self.after.range_m[pairs.after] - range_m[0, pairs.before],
                _turn(self.after.azimuth_rad[pairs.after] - azimuth_rad[0, pairs.before]),
            ]
        )
        slopes = np.stack([range_m[1:4] - range_m[4:], _turn(azimuth_rad[1:4] - azimuth_rad[4:])]) / (2 * _STEP)
        return residual, np.ascontiguousarray(slopes.transpose(0, 2, 1)[:, pairs.before])

    def _predicted(self, displacement: Floats) -> tuple[Floats, Floats]:
        constant = twist_of(displacement, self._time_s)
        first, second = (constant if twist is None else twist for twist in self._twists)
        return _predicted(displacement, self.before, self._offset_m, first, second)

    def strengths(self, pairs: EchoPairs) -> Floats:
        """Return the weights of pairs in a comparison of displacements: (pair,)."""
        # Echoes from behind a flat array are as many as others, but weaker, so the root of the amplitude counts.
        levels = [echoes.level - echoes.level.max() for echoes in (self.before, self.after)]
        return np.asarray(np.exp((levels[0][pairs.before] + levels[1][pairs.after]) / 4))

    def deviations(self, pairs: EchoPairs) -> Floats:
        """Return the standard deviations of residuals: (2, pair) float64."""
        before, after = self.before, self.after
        return np.stack(
            [
                np.hypot(before.range_sd_m[pairs.before], after.range_sd_m[pairs.after]),
                np.hypot(before.azimuth_sd_rad[pairs.before], after.azimuth_sd_rad[pairs.after]),
            ]
        )


def _turn(angle_rad: Floats) -> Floats:
    """Return angles between -π and π."""
    return np.asarray((angle_rad + math.pi) % (2 * math.pi) - math.pi)
