"""Points of several sensors as one cloud: each reflector once, located by all echoes that it causes."""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.directional_noise import is_short, pulse_steps
from ertis_numba.analysis.noise import EchoFloor, echo_floor
from ertis_numba.analysis.points import EchoPointExtractor
from ertis_numba.base.forks import call_in_forks
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion.association import Reflectors
from ertis_numba.fusion.attribution import Shares
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import Receiver
from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.fusion.sensor_echoes import SensorEchoes
from ertis_numba.fusion.sight import tangents
from ertis_numba.geometry import Grid

__all__ = ["N_KEPT", "HeardImage", "PointFuser", "joined"]

Floats = NDArray[np.float64]

_TOP: Final = 128  # Points per image.
_FAINTEST: Final = 10 ** (-22.0 / 20)  # Amplitude in the fused image relative to that of the echoes: others contradict.
_MIN_LEVEL_DB: Final = -26.0  # Lowest level of echoes relative to the strongest of an image.
_FAINT: Final = 10 ** (-20.0 / 20)  # Amplitude relative to it, below which echoes only confirm reflectors.
_FALSE_ALARM: Final = 1e-5  # Probability that noise alone yields a point of an image.
_CLEAR: Final = 0.8  # Quantile of amplitudes around a lone echo that implies the noise, which the echo must exceed.
_RANGE_SD_M: Final = 0.5e-3  # Errors that noise does not explain, such as those of the array and of interpolation.
_ANGLE_SD_RAD: Final = math.radians(0.125)
_UNKNOWN_RANGE_SD_M: Final = 5e-3
_UNKNOWN_ANGLE_SD_RAD: Final = math.radians(1.0)
_NEAREST_M: Final = 0.05
N_KEPT: Final = 3
"""Images of a sensor that are heard once only: that of the fused pulse, and those that wait."""
_BESIDE: Final = np.arange(-1, 2)


class HeardImage(NamedTuple):
    """Detection threshold of an image, infinite for zeros, and its echoes above it, strongest first, of any call."""

    floor: EchoFloor
    echoes: "_ImageEchoes"


class _ImageEchoes(NamedTuple):
    """Echoes in an image, each field (echo,) but for ``direction``, (echo, axis), in the frame of the platform."""

    row: NDArray[np.int64]
    range_m: Floats
    direction: Floats
    path_sd_m: Floats
    angle_sd_rad: Floats
    power: Floats
    is_clear: NDArray[np.bool_]
    is_faint: NDArray[np.bool_]


class PointFuser:
    """Extractor of the points of one sensor, attributed to emitters; direct sound hides echoes at ``deaf`` steps."""

    def __init__(
        self,
        number: int,
        sensors: tuple[MountedSensor, ...],
        receiver: Receiver,
        image: Energyscape,
        deaf: NDArray[np.bool_],
    ) -> None:
        self._number, self._mounting, self._receiver = number, sensors[number], receiver
        self._is_deaf = deaf[(image.range_m / receiver.step_m).astype(np.int64)]
        self._n_pulse = pulse_steps(image)
        self._kept: dict[int, tuple[Energyscape, Future[HeardImage]]] = {}  # by identity of the image
        call_in_forks(self._forget)
        self._extract = EchoPointExtractor(
            image.settings, Grid(image.azimuth_rad, image.elevation_rad), top=_TOP, min_level_db=_MIN_LEVEL_DB
        )

    def heard(self, image: Energyscape) -> HeardImage:
        """Return threshold and echoes, found once for each of the latest images. Threads may call it."""
        return self.find(image).result()

    def find(self, image: Energyscape) -> "Future[HeardImage]":
        """Find threshold and echoes, unless another thread has begun to; return the result of either."""
        result: Future[HeardImage] = Future()
        try:
            # A lock could keep other threads from ending while a signal handler waits for them.
            _, known = self._kept.setdefault(id(image), (image, result))
            if known is not result:
                return known
            for earlier in [*self._kept][:-N_KEPT]:
                self._kept.pop(earlier, None)
            floor = _floor(image)
            result.set_result(HeardImage(floor, self._echoes(image, floor)))
        except BaseException as error:  # noqa: BLE001  Others may wait for it.
            self._kept.pop(id(image), None)
            result.set_exception(error)
        return result

    def _forget(self) -> None:
        """Forget results of threads that do not exist in a fork."""
        self._kept.clear()

    def echoes(self, image: Energyscape, shares: Shares, late_m: Mapping[int, float]) -> SensorEchoes:
        """Return the echoes of an image above its noise, strongest first; ``late_m`` is as in `pair_of`."""
        heard = self.heard(image).echoes
        emitters = [emitter for emitter, number in shares if number == self._number]
        # Rounded levels shift the echoes of all calls from a direction alike, so that their mean is not better.
        alike = math.sqrt(len(emitters)) if image.level_step_db else 1.0
        return SensorEchoes(
            receiver=self._number,
            emitters=np.array(emitters, dtype=np.int64),
            direction=heard.direction,
            path_m=2 * heard.range_m[:, None] - np.array([late_m[emitter] for emitter in emitters]),
            path_sd_m=alike * heard.path_sd_m,
            angle_sd_rad=alike * heard.angle_sd_rad,
            power=heard.power,
            share=self._shares(heard.row, heard.range_m, [shares[emitter, self._number] for emitter in emitters]),
            is_clear=heard.is_clear,
            is_faint=heard.is_faint,
        )

    def _echoes(self, image: Energyscape, floor: EchoFloor) -> _ImageEchoes:
        """Return the echoes of an image above its noise, strongest first, whatever call caused them."""
        if self._is_deaf.any():  # Points are found relative to the strongest one, which direct sound would be.
            image = image.replace(amplitude=np.where(self._is_deaf, np.float32(0), image.amplitude))
        cloud = self._extract(image)
        place_m = cloud.position_m.astype(np.float64)
        row = np.argmax(place_m @ self._receiver.directions.T, axis=1)
        range_m = np.linalg.norm(place_m, axis=1)
        column = np.rint(np.interp(range_m, image.range_m, np.arange(len(image.range_m)))).astype(np.int64)
        # Between directions of a coarse grid, interpolation may exceed all bins, also for noise. Bins are compared.
        near = image.amplitude[row[:, None], (column[:, None] + _BESIDE).clip(0, len(image.range_m) - 1)].max(axis=1)
        shown = np.minimum(near, cloud.amplitude)
        is_free, is_beyond_swells = shown > floor.at(image.amplitude, row, column, 0.5, _CLEAR)
        uncertainty_m = _uncertainties(cloud)
        every = _ImageEchoes(
            row=row,
            range_m=range_m,
            direction=place_m / range_m[:, None] @ self._mounting.rotation.T,
            path_sd_m=2 * np.hypot(uncertainty_m[:, 0], _RANGE_SD_M),
            angle_sd_rad=np.hypot(uncertainty_m[:, 1] / range_m, _ANGLE_SD_RAD),
            power=cloud.amplitude.astype(np.float64) ** 2,
            is_clear=is_beyond_swells & is_short(image, row, column, shown, self._n_pulse),
            is_faint=~is_free | (cloud.amplitude < _FAINT * cloud.amplitude.max(initial=0.0)),
        )
        return _ImageEchoes._make(each[shown > floor.by_direction[row]] for each in every)

    def _shares(self, row: NDArray[np.int64], range_m: Floats, shares: Sequence[NDArray[np.float32]]) -> Floats:
        """Return the highest share of each emitter within one step of each echo: (echo, emitter)."""
        receiver = self._receiver
        step = (range_m / receiver.step_m).astype(np.int64)[:, None] + np.arange(-1, 2)
        near = row[:, None] * receiver.n_steps + step.clip(0, receiver.n_steps - 1)
        found = np.zeros((len(range_m), len(shares)))
        for column, share in enumerate(shares):
            found[:, column] = share[near].max(axis=1, initial=0.0)
        return found


def _floor(image: Energyscape) -> EchoFloor:
    """Return the detection threshold of an image."""
    if image.amplitude.any():
        return echo_floor(image, _FALSE_ALARM)
    by_direction, by_range = (np.full(count, np.inf, np.float32) for count in image.amplitude.shape)
    return EchoFloor(by_direction, by_range, n_around=1, ratio=1.0, exponent=1.0)


def joined(reflectors: Reflectors, image: Energyscape, grid: PolarGrid) -> PointCloud:
    """Return a point for each reflector in the platform frame, strongest first; ``image`` limits unconfirmed ones."""
    position_m, covariance_m2 = reflectors.placed()
    amplitude = np.sqrt(reflectors.reflectivity)
    # Ghosts would grow with range, and with the correction of the emitter's directivity.
    cell = grid.cell_of(reflectors.position_m)
    shown = np.where(cell >= 0, _around(image.amplitude).reshape(-1).take(cell.clip(0)), np.float32(0))
    amplitude = np.where(reflectors.confirmed, amplitude, np.minimum(amplitude, shown)).astype(np.float32)
    order = np.argsort(-amplitude, kind="stable")
    order = order[shown[order] > _FAINTEST * np.sqrt(reflectors.reflectivity[order])]
    # Planar images do not show heights, whose errors are none of these.
    level_m = position_m * [1.0, 1.0, 0.0] if grid.is_planar else position_m
    uncertainty_m = _along_and_across(level_m, covariance_m2)
    return PointCloud(
        position_m[order].astype(np.float32),
        amplitude[order],
        image.settings,
        replace(image.stamp),
        translation_m=(0.0, 0.0, 0.0),
        rotation_xyzw=(0.0, 0.0, 0.0, 1.0),
        uncertainty_m=uncertainty_m[order].astype(np.float32),
        confirmed=reflectors.confirmed[order],
    )


def _uncertainties(cloud: PointCloud) -> Floats:
    """Return standard deviations along range and across, with defaults for unknown ones: (point, 2) float64."""
    range_m = np.maximum(np.linalg.norm(cloud.position_m, axis=1), _NEAREST_M)
    unknown_m = np.stack([np.full(len(cloud), _UNKNOWN_RANGE_SD_M), _UNKNOWN_ANGLE_SD_RAD * range_m], axis=1)
    given_m = unknown_m if cloud.uncertainty_m is None else cloud.uncertainty_m.astype(np.float64)
    return np.asarray(np.where(np.isfinite(given_m), given_m, unknown_m))


def _along_and_across(position_m: Floats, covariance_m2: Floats) -> Floats:
    """Return standard deviations along lines from the platform, and across in the horizontal plane: (reflector, 2)."""
    along = position_m / np.maximum(np.linalg.norm(position_m, axis=1), _NEAREST_M)[:, None]
    axes = np.stack([along, tangents(along)[0]], axis=1)
    return np.asarray(np.sqrt(np.einsum("rai,rij,raj->ra", axes, covariance_m2, axes)))


def _around(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the highest amplitude of each cell and the two beside it in range."""
    found = amplitude.copy()
    np.maximum(found[:, 1:], amplitude[:, :-1], out=found[:, 1:])
    np.maximum(found[:, :-1], amplitude[:, 1:], out=found[:, :-1])
    return found
