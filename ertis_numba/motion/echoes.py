"""Echoes of the sensors of a platform: places, uncertainties and instants."""

import functools
import math
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.points import EchoPointExtractor
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion.rig import MountedSensor, emitter_diameter_m, require_common_reach
from ertis_numba.geometry import Grid, microphones, require_places
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Array, Call

__all__ = ["EchoExtractor", "GroupEchoes", "sweep_delay_s"]

Floats = NDArray[np.float64]

_TOP: Final = 96  # Points per image.
_MIN_LEVEL_DB: Final = -25.0
# Errors that noise does not explain: echoes of neighbouring reflectors overlap, and differently so in each image.
_RANGE_SD_M: Final = 1.5e-3
_ANGLE_SD_RAD: Final = math.radians(0.25)
# A flat array hardly resolves directions along its plane, and maxima at the edge of a grid move with the sensor.
_MAX_OFF_AXIS_RAD: Final = math.radians(55.0)
_NEAREST_M: Final = 0.05
# Largest differences between an echo of another sensor's call and its prediction. In simulated halls, most differences
# are below 6 mm and 2°, and 6 % to 15 % of the own echoes match a prediction by chance.
_FOREIGN_M: Final = 0.01
_FOREIGN_RAD: Final = math.radians(2.5)
_FOREIGN_LEVEL: Final = math.log(2.0)  # 6 dB


class GroupEchoes(NamedTuple):
    """Echoes of all sensors in one group of images; arrays are (echo,)."""

    sensor: NDArray[np.int64]  # index
    position_m: Floats  # (echo, axis) in the frame of the platform
    range_m: Floats  # from the sensor
    azimuth_rad: Floats  # from the sensor, along the axes of the platform
    range_sd_m: Floats
    azimuth_sd_rad: Floats
    level: Floats  # natural logarithm of the amplitude
    delay_s: Floats  # after the emission, when the platform was where the range applies
    arrival_s: Floats  # after the emission, when the platform was where the azimuth applies
    sound_speed_m_s: Floats
    may_be_behind: NDArray[np.bool_]  # a flat array may show the reflector ahead

    def behind(self, sensors: tuple[MountedSensor, ...], chosen: NDArray[np.int64]) -> "GroupEchoes":
        """Return the echoes of which those of some sensors that may be behind their arrays are there."""
        axes = np.array([sensor.rotation[:, 0] for sensor in sensors])[self.sensor]
        offset_m = self.position_m - np.array([sensor.translation_m for sensor in sensors])[self.sensor]
        is_behind = self.may_be_behind & np.isin(self.sensor, chosen)
        back_m = 2 * np.where(is_behind, np.sum(offset_m * axes, axis=1), 0.0)[:, None] * axes
        offset_m = offset_m - back_m
        return self._replace(
            position_m=self.position_m - back_m, azimuth_rad=np.arctan2(offset_m[:, 1], offset_m[:, 0])
        )


class EchoExtractor:
    """Extractor of the echoes of images or point clouds, with tables computed once for each sensor."""

    # Echoes of other sensors' calls, up to half of all, are discarded if those sensors show the reflectors. `alone` is
    # True if no other sensor emits, and none backwards; the default assumes this of a single piston.

    def __init__(self, sensors: tuple[MountedSensor, ...], *, alone: bool | None = None) -> None:
        self._mounted = sensors
        self._is_ahead, self._is_alone = alone is True, alone is None and _is_platform(sensors)
        self._sensors = {sensor.name: (number, sensor) for number, sensor in enumerate(sensors)}
        self._extractors: dict[str, tuple[tuple[int, ...], EchoPointExtractor]] = {}

    def __call__(self, group: Mapping[str, Energyscape | PointCloud]) -> GroupEchoes:
        """Return the echoes of a group of images or point clouds, by sensor."""
        require_common_reach(self._mounted, max(item.settings.processing.range_m[1] for item in group.values()))
        parts = [self._echoes(item, group.keys()) for item in group.values()]
        echoes = GroupEchoes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        is_foreign = np.zeros(len(echoes.level), dtype=np.bool_)
        calls = {self._sensors[item.stamp.sensor][0]: item.settings.call for item in group.values()}
        for item in group.values():
            number, _ = self._sensors[item.stamp.sensor]
            is_foreign |= _foreign(echoes, number, self._mounted, calls, is_flat=_is_flat(item.settings.array))
        return GroupEchoes._make(column[~is_foreign] for column in echoes)

    def _echoes(self, item: Energyscape | PointCloud, others: Collection[str]) -> GroupEchoes:
        cloud = self._cloud(item) if isinstance(item, Energyscape) else item
        if item.stamp.sensor not in self._sensors:
            raise ArgumentError(
                f"sensor {item.stamp.sensor!r} has no mounting; add its mounting, or use one of "
                f"{', '.join(self._sensors)}"
            )
        require_places(item.settings.array, item.stamp.sensor, is_planar=not np.any(item.elevation_rad))
        number, mounted = self._sensors[item.stamp.sensor]
        local_m = cloud.position_m.astype(np.float64)
        off_axis = _off_axis_rad(local_m)
        is_sharp = off_axis < _MAX_OFF_AXIS_RAD
        cloud = cloud.replace(
            position_m=cloud.position_m[is_sharp],
            amplitude=cloud.amplitude[is_sharp],
            uncertainty_m=None if cloud.uncertainty_m is None else cloud.uncertainty_m[is_sharp],
        )
        local_m, off_axis = local_m[is_sharp], off_axis[is_sharp]
        range_m = np.maximum(_NEAREST_M, np.linalg.norm(local_m, axis=1))
        from_sensor_m = local_m @ mounted.rotation.T
        range_sd_m, across_sd_m = _deviations(cloud).T
        speed_m_s, start_s = sound_speed_m_s(cloud.settings.air), cloud.settings.call.start_s
        return GroupEchoes(
            np.full(len(cloud), number),
            from_sensor_m + mounted.translation_m,
            range_m,
            np.arctan2(from_sensor_m[:, 1], from_sensor_m[:, 0]),
            np.hypot(range_sd_m, _RANGE_SD_M),
            np.hypot(across_sd_m / range_m, _ANGLE_SD_RAD / np.cos(off_axis)),
            np.log(np.maximum(cloud.amplitude.astype(np.float64), np.finfo(np.float32).tiny)),
            start_s + range_m / speed_m_s - sweep_delay_s(cloud.settings.call),
            start_s + 2 * range_m / speed_m_s + cloud.settings.call.duration_s / 2,
            np.full(len(cloud), speed_m_s),
            self._may_be_behind(item, mounted, local_m, others),
        )

    def _may_be_behind(
        self, item: Energyscape | PointCloud, mounted: MountedSensor, local_m: Floats, others: Collection[str]
    ) -> NDArray[np.bool_]:
        """Return True for echoes whose reflectors no other sensor would show if they were behind the array: (echo,)."""
        may_be = np.full(len(local_m), _is_flat(item.settings.array))
        if self._is_ahead or (self._is_alone and emitter_diameter_m(item.settings)):
            return may_be & False
        behind_m = (local_m * [-1.0, 1.0, 1.0]) @ mounted.rotation.T + mounted.translation_m
        for name in others:
            other_m = self._sensors[name][1].local_m(behind_m)
            may_be &= (name == mounted.name) | (_off_axis_rad(other_m) > _MAX_OFF_AXIS_RAD)
        return may_be

    def _cloud(self, image: Energyscape) -> PointCloud:
        known = self._extractors.get(image.stamp.sensor)
        if known is None or known[0] != image.amplitude.shape:
            grid = Grid(image.azimuth_rad, image.elevation_rad)
            made = EchoPointExtractor(image.settings, grid, top=_TOP, min_level_db=_MIN_LEVEL_DB)
            known = self._extractors[image.stamp.sensor] = image.amplitude.shape, made
        return known[1](image)


def _is_platform(sensors: tuple[MountedSensor, ...]) -> bool:
    """Return True for a single sensor with the origin and the heading of the platform."""
    (first, *others) = sensors
    return not others and not first.translation_m[:2].any() and first.rotation[0, 0] == 1.0


def _off_axis_rad(local_m: Floats) -> Floats:
    return np.asarray(np.arctan2(np.hypot(local_m[:, 1], local_m[:, 2]), local_m[:, 0]))


@functools.cache
def _is_flat(array: Array) -> bool:
    return microphones(array).is_flat


def _foreign(
    echoes: GroupEchoes,
    number: int,
    sensors: tuple[MountedSensor, ...],
    calls: Mapping[int, Call],
    *,
    is_flat: bool,
) -> NDArray[np.bool_]:
    """Return True for echoes of sensor ``number`` that the calls of other sensors explain: (echo,)."""
    # The range of such an echo is the mean of the distances of the reflector from both sensors. Reflectors behind a
    # flat array appear ahead of it, and calls that differ do not count.
    places_m = np.array([sensor.translation_m for sensor in sensors])[echoes.sensor]
    axes = np.array([sensor.rotation[:, 0] for sensor in sensors])[echoes.sensor]
    local_m = sensors[number].local_m(echoes.position_m)
    distance_m = np.linalg.norm(local_m, axis=1)
    cosine = np.sum((echoes.position_m - places_m) * axes, axis=1) / echoes.range_m
    is_own = echoes.sensor == number
    alike = [other for other, call in calls.items() if other != number and call.sounds_like(calls[number])]
    is_source = np.isin(echoes.sensor, alike) & (local_m[:, 0] < cosine * distance_m) & (is_flat | (local_m[:, 0] > 0))
    late_s = np.zeros(len(sensors))
    late_s[alike] = [calls[other].start_s - calls[number].start_s for other in alike]
    late_m = late_s[echoes.sensor] * echoes.sound_speed_m_s
    range_m = (echoes.range_m + distance_m + late_m)[is_source] / 2
    ahead_m = np.column_stack([np.abs(local_m[:, 0]), local_m[:, 1:]])[is_source] @ sensors[number].rotation.T
    turn_rad = echoes.azimuth_rad[is_own][:, None] - np.arctan2(ahead_m[:, 1], ahead_m[:, 0])
    agrees = np.abs(echoes.range_m[is_own][:, None] - range_m) < _FOREIGN_M
    agrees &= np.abs(np.remainder(turn_rad + math.pi, 2 * math.pi) - math.pi) < _FOREIGN_RAD
    agrees &= echoes.level[is_own][:, None] - echoes.level[is_source] < _FOREIGN_LEVEL
    is_foreign = np.zeros(len(is_own), dtype=np.bool_)
    is_foreign[is_own] = agrees.any(axis=1)
    return is_foreign


def _deviations(cloud: PointCloud) -> Floats:
    """Return standard deviations along and across the range, 0 where they are unknown: (point, 2) float64."""
    if cloud.uncertainty_m is None:
        return np.zeros((len(cloud), 2))
    given_m = cloud.uncertainty_m.astype(np.float64)
    return np.asarray(np.where(np.isfinite(given_m), given_m, 0.0))


def sweep_delay_s(call: Call) -> float:
    """Return the Doppler coupling of a sweep: how long before the reflection the measured range applies.

    It is ``D / (f_start / f_stop - 1)`` for the duration D. A hyperbolic sweep that motion stretches is the same sweep
    at another time. For a linear sweep, this holds in the mean over its frequencies. The coupling of own waveforms is
    unknown, and counts as 0.
    """
    if call.waveform is not None or call.start_frequency_hz == call.stop_frequency_hz:
        return 0.0
    return call.duration_s / (call.start_frequency_hz / call.stop_frequency_hz - 1)
