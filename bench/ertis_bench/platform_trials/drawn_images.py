"""Images of moving platforms in drawn scenes, computed from spectra of echoes without the simulator of the library.

Each echo adds a phase per frequency and microphone. Beams are summed in bands, and the inverse Fourier transform of
their spectra yields ranges. Ranges and directions apply at the instants that `ertis.compensate_motion` describes.
"""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Processing
from ertis_numba.simulation import Sensor

__all__ = ["DrawnImager", "DrawnMounting", "DrawnPath", "DrawnReflectors", "DrawnScene", "DrawnWall"]

Floats = NDArray[np.float64]

_RANGE_M: Final = 0.4, 4.0
_N_DIRECTIONS: Final = 90
_BAND_HZ: Final = 25e3, 50e3
_N_BANDS: Final = 24
_N_FREQUENCIES: Final = 720
_N_FFT: Final = 2048
_TAPER: Final = 72  # Frequencies at each end of the band
_MIDDLE_HZ: Final = 37e3
_NEAREST_M: Final = 0.3
_FARTHEST_M: Final = 4.3
_SIDE_LOBE: Final = 0.1  # Least amplitude of a piston ahead
_BACK_LOBE: Final = 10 ** (-30 / 20)
_STEP_S: Final = 5e-4  # of paths
_TURNS: Final = 3  # Iterations for the instant at which sound meets a moving reflector
_NS: Final = 1_000_000_000


class DrawnMounting(NamedTuple):
    """Place and heading of a sensor on a platform, and the error of its clock."""

    x_m: float
    y_m: float
    yaw_rad: float
    clock_s: float = 0.0


class DrawnReflectors(NamedTuple):
    """Point reflectors: places and velocities in the world, and strengths."""

    place_m: Floats
    velocity_m_s: Floats
    strength_db: Floats

    def joined(self, *others: "DrawnReflectors") -> "DrawnReflectors":
        """Return these and other reflectors."""
        return DrawnReflectors(*(np.concatenate(columns) for columns in zip(self, *others, strict=True)))


class DrawnWall(NamedTuple):
    """Smooth wall: places at a distance from the origin along a normal, between two limits along the wall."""

    normal: tuple[float, float]
    distance_m: float
    along_m: tuple[float, float]
    strength_db: float


class DrawnPath:
    """Path whose velocity changes linearly between knots.

    Parameters
    ----------
    time_s : (knot,) sequence of float
    twist : (knot, 3) sequence
        Velocity forward and to the left in m/s, and yaw rate in rad/s.
    """

    def __init__(self, time_s: Floats, twist: Floats) -> None:
        self._time_s = np.arange(0.0, float(time_s[-1]) + _STEP_S, _STEP_S)
        forward, left, rate = (np.interp(self._time_s, time_s, column) for column in np.transpose(twist))
        yaw = _integral(rate)
        turn = np.exp(1j * yaw)
        place = _integral((forward + 1j * left) * turn)
        self._pose = np.stack([place.real, place.imag, yaw])

    def at(self, time_s: Floats) -> Floats:
        """Return x, y and yaw: (3, ...) float64."""
        return np.stack([np.interp(time_s, self._time_s, row) for row in self._pose])


def _integral(values: NDArray[np.inexact]) -> NDArray[np.inexact]:
    return np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2)]) * _STEP_S


class DrawnScene(NamedTuple):
    """Platform in a scene.

    Attributes
    ----------
    mountings : mapping of str to DrawnMounting
        All sensors, which emit together.
    names : tuple of str
        Sensors with images.
    reflectors : DrawnReflectors
    walls : tuple of DrawnWall
    path : DrawnPath
    pulses_s : (pulse,) float64
        Times of emission.
    noise : float
        Standard deviation of the noise of microphones, relative to the amplitude at 1 m.
    diameter_m : float
        Diameter of emitters; 0 for omnidirectional ones.
    """

    mountings: Mapping[str, DrawnMounting]
    names: tuple[str, ...]
    reflectors: DrawnReflectors
    walls: tuple[DrawnWall, ...]
    path: DrawnPath
    pulses_s: Floats
    noise: float
    diameter_m: float

    @property
    def platform(self) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
        """Mountings as `ertis.Odometry` accepts them, of the sensors with images."""
        return {
            name: ((each.x_m, each.y_m, 0.0), (0.0, 0.0, math.sin(each.yaw_rad / 2), math.cos(each.yaw_rad / 2)))
            for name, each in self.mountings.items()
            if name in self.names
        }

    def sensor_at(self, name: str, time_s: Floats) -> tuple[NDArray[np.complex128], Floats]:
        """Return place (as a complex number) and heading of a sensor: two (...) arrays."""
        x_m, y_m, yaw_rad = self.path.at(time_s)
        mounting = self.mountings[name]
        place = x_m + 1j * y_m + complex(mounting.x_m, mounting.y_m) * np.exp(1j * yaw_rad)
        return place, yaw_rad + mounting.yaw_rad


class DrawnImager:
    """Renderer of the images of a scene."""

    def __init__(self) -> None:
        low_m, high_m = _RANGE_M
        processing = Processing(range_m=(low_m, high_m), directions=str(_N_DIRECTIONS))
        self._settings = Sensor(name="front", processing=processing).settings()
        call = self._settings.call
        self._speed_m_s = sound_speed_m_s(self._settings.air)
        self._early_s = call.duration_s / (call.start_frequency_hz / call.stop_frequency_hz - 1)
        self._middle_s = call.duration_s / 2
        self._left_m = microphones(self._settings.array).positions_m[:, 1]
        self._azimuth_rad = np.linspace(-math.pi / 2, math.pi / 2, _N_DIRECTIONS)
        frequency_hz = np.linspace(*_BAND_HZ, _N_FREQUENCIES)
        count = np.arange(_N_FREQUENCIES)
        weight = np.minimum(1.0, np.minimum(count + 1, _N_FREQUENCIES - count) / _TAPER) / frequency_hz**2
        self._weight = weight / weight.sum()
        range_m = np.arange(_N_FFT) * self._speed_m_s / 2 / (_N_FFT * (frequency_hz[1] - frequency_hz[0]))
        self._kept = (range_m >= low_m) & (range_m <= high_m)
        self._range_m = range_m[self._kept]
        self._bands_hz = frequency_hz.reshape(_N_BANDS, -1)

    def __call__(self, scene: DrawnScene, pulse: int, draws: np.random.Generator) -> list[Energyscape]:
        """Return the images of a pulse."""
        found = []
        array = self._settings.array.replace(emitter_diameter_m=scene.diameter_m)
        settings = self._settings.replace(array=array)
        for name in scene.names:
            time_s = float(scene.pulses_s[pulse])
            clock_ns = round((time_s + scene.mountings[name].clock_s) * _NS)
            stamp = Stamp(
                sensor=name, sequence=pulse, sync_count=pulse, timestamp_ns=_NS + clock_ns, behaviour="active"
            )
            amplitude = self._amplitude(*self._echoes(scene, name, time_s), scene.noise, draws)
            elevation_rad = np.zeros(_N_DIRECTIONS)
            found.append(Energyscape(amplitude, self._azimuth_rad, elevation_rad, self._range_m, settings, stamp))
        return found

    def _amplitude(
        self, range_m: Floats, azimuth_rad: Floats, amplitude: Floats, noise: float, draws: np.random.Generator
    ) -> NDArray[np.float32]:
        spectra = np.zeros((_N_DIRECTIONS, _N_FREQUENCIES), complex)
        for band, frequency_hz in enumerate(self._bands_hz):
            wave = 2j * math.pi * frequency_hz.mean() / self._speed_m_s
            beams = np.exp(wave * np.sin(self._azimuth_rad)[:, None] * self._left_m) / len(self._left_m)
            shape = len(self._left_m), len(frequency_hz)
            signals = noise * (draws.normal(size=shape) + 1j * draws.normal(size=shape))
            arrivals = np.exp(-wave * self._left_m[:, None] * np.sin(azimuth_rad)) * amplitude
            signals += arrivals @ np.exp(-4j * math.pi * frequency_hz / self._speed_m_s * range_m[:, None])
            spectra[:, band * len(frequency_hz) : (band + 1) * len(frequency_hz)] = beams @ signals
        image = np.abs(np.fft.ifft(spectra * self._weight, _N_FFT, axis=1)) * _N_FFT
        return np.ascontiguousarray(image[:, self._kept].astype(np.float32))

    def _echoes(self, scene: DrawnScene, name: str, time_s: float) -> tuple[Floats, Floats, Floats]:
        """Return ranges, azimuths and amplitudes of all echoes at a sensor, of all calls."""
        parts = [np.zeros((3, 0))]
        for emitter in scene.mountings:
            parts.append(self._of_reflectors(scene, name, emitter, time_s))
            parts += [self._of_wall(scene, wall, name, emitter, time_s) for wall in scene.walls]
        range_m, azimuth_rad, amplitude = np.concatenate(parts, axis=1)
        return range_m, azimuth_rad, amplitude

    def _of_reflectors(self, scene: DrawnScene, name: str, emitter: str, time_s: float) -> Floats:
        start, way, strength_db = scene.reflectors
        start, way = start @ [1, 1j], way @ [1, 1j]
        range_m = np.full(len(start), 2.0)
        for _ in range(_TURNS):
            met_s = time_s + range_m / self._speed_m_s - self._early_s
            place = start + way * met_s
            (here, _), (source, heading) = scene.sensor_at(name, met_s), scene.sensor_at(emitter, met_s)
            out_m, back_m = np.abs(place - source), np.abs(place - here)
            range_m = (out_m + back_m) / 2
        heard_s = time_s + 2 * range_m / self._speed_m_s + self._middle_s
        here, facing = scene.sensor_at(name, heard_s)
        azimuth_rad = _azimuth(start + way * heard_s - here, facing)
        cosine = ((place - source) * np.exp(-1j * heading)).real / out_m
        amplitude = 10 ** (strength_db / 20) * self._piston(cosine, scene.diameter_m) / (out_m * back_m)
        is_heard = (np.minimum(out_m, back_m) > _NEAREST_M) & (range_m < _FARTHEST_M)
        return np.stack([range_m, azimuth_rad, amplitude])[:, is_heard]

    def _of_wall(self, scene: DrawnScene, wall: DrawnWall, name: str, emitter: str, time_s: float) -> Floats:
        """Return the echo of the mirror image of an emitter."""
        normal = complex(*wall.normal)
        range_m = np.array(2.0)
        for _ in range(_TURNS):
            met_s = time_s + range_m / self._speed_m_s - self._early_s
            (here, _), (source, heading) = scene.sensor_at(name, met_s), scene.sensor_at(emitter, met_s)
            image = _mirrored(source, wall)
            range_m = np.abs(here - image) / 2
        before, beyond = (wall.distance_m - (np.conj(normal) * each).real for each in (here, image))
        hit = here + (image - here) * before / (before - beyond)
        along_m = (np.conj(normal * 1j) * hit).real
        if range_m > _FARTHEST_M or not wall.along_m[0] < along_m < wall.along_m[1]:
            return np.zeros((3, 0))
        heard_s = time_s + 2 * range_m / self._speed_m_s + self._middle_s
        here, facing = scene.sensor_at(name, heard_s)
        azimuth_rad = _azimuth(_mirrored(scene.sensor_at(emitter, heard_s)[0], wall) - here, facing)
        cosine = ((hit - source) * np.exp(-1j * heading)).real / np.abs(hit - source)
        amplitude = 10 ** (wall.strength_db / 20) * self._piston(cosine, scene.diameter_m) / (2 * range_m)
        return np.stack([range_m, azimuth_rad, amplitude])[:, None]

    def _piston(self, cosine: Floats, diameter_m: float) -> Floats:
        """Return the directivity of a piston in a baffle at the middle frequency."""
        if not diameter_m:
            return np.ones_like(cosine)
        sine = np.sqrt(1 - np.minimum(1.0, cosine**2))
        phase = np.maximum(1e-9, math.pi * diameter_m * _MIDDLE_HZ / self._speed_m_s * sine)
        ahead = np.maximum(np.abs(2 * scipy.special.j1(phase) / phase), _SIDE_LOBE)
        return np.asarray(np.where(cosine > 0, ahead, _BACK_LOBE))


def _azimuth(way: NDArray[np.complex128], facing: Floats) -> Floats:
    """Return azimuths at a flat array, which shows sound from behind ahead."""
    local = way * np.exp(-1j * facing)
    return np.asarray(np.arctan2(local.imag, np.abs(local.real)))


def _mirrored(place: NDArray[np.complex128], wall: DrawnWall) -> NDArray[np.complex128]:
    normal = complex(*wall.normal)
    return np.asarray(place + 2 * (wall.distance_m - (np.conj(normal) * place).real) * normal)
