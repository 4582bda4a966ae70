"""Sensors of a platform: places, orientations and emissions."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import microphones, mounting
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Call, Settings

__all__ = [
    "USUAL_DIAMETER_M",
    "Emitters",
    "MountedSensor",
    "Mountings",
    "emitter_diameter_m",
    "far_apart",
    "mounted_sensors",
    "require_common_reach",
]

Floats = NDArray[np.float64]
Mountings = Mapping[str, tuple[Sequence[float], Sequence[float]]]
"""Position x, y, z in m, and unit quaternion x, y, z, w from the sensor frame to the platform frame, by sensor."""

USUAL_DIAMETER_M: Final = 0.012
"""Diameter of an emitter whose settings and layout state none."""
_LARGEST_M: Final = 2.0  # Usual distances of sensors on a platform are shorter.
_N_FREQUENCIES = 12  # of the band, over which the power of an emitter is averaged
_NEAREST_M = kernels.SPREADING_M
_STRAY_DB = -20.0  # Power that an emitter radiates at least to its front, which no piston model predicts.
_BEHIND_DB = -30.0
_TOP_OF_PULSE = 10 ** (-0.2 / 20)
_FARTHEST_M = 0.03  # Paths beside the maximum of a pulse, over which its width is searched, …
_N_FARTHEST = 151  # … and their number.
_PATHS_M = np.linspace(0.0, kernels.LAST_PATH_M, 1025)  # of sound, for which the absorption is tabulated


class MountedSensor(NamedTuple):
    """Position of a sensor on its platform, and rotation (axis, axis) from its frame to that of the platform."""

    name: str
    translation_m: Floats
    rotation: Floats

    def local_m(self, position_m: Floats) -> Floats:
        """Return positions in the sensor frame: (point, axis) float64."""
        return np.asarray((position_m - self.translation_m) @ self.rotation)


def mounted_sensors(mountings: Mountings) -> tuple[MountedSensor, ...]:
    """Return mounted sensors, in the order of their mountings, of which there must be one."""
    if not isinstance(mountings, Mapping):
        raise ArgumentError(
            f"mountings is of type {type(mountings).__name__}; pass a dictionary with (translation_m, rotation_xyzw) "
            "for each sensor"
        )
    if not mountings:
        raise ArgumentError("mountings is empty; pass the mounting of each sensor on the platform")
    sensors = []
    for name, given in mountings.items():
        if not isinstance(given, Sequence) or len(given) != 2:
            raise ArgumentError(f"mounting of sensor {name!r} is {given!r:.80}; pass (translation_m, rotation_xyzw)")
        place = mounting(name, *given)
        sensors.append(
            MountedSensor(name, place["translation_m"], Rotation.from_quat(place["rotation_xyzw"]).as_matrix())
        )
    return tuple(sensors)


def far_apart(places_m: Mapping[str, Sequence[float]], last_m: float) -> tuple[str, str, float] | None:
    """Return two sensors and their distance if no reflector is within the range of both, nor of one and another."""
    if len(places_m) < 2:
        return None
    names, places = list(places_m), np.array(list(places_m.values()))
    apart_m = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(len(names), np.inf))
    number = int(apart_m.min(axis=1).argmax())
    nearest_m = float(apart_m[number].min())
    # A call that one sensor emits and another receives has travelled at least the distance between both.
    if nearest_m <= 2 * last_m:
        return None
    one, other = sorted((number, int(apart_m[number].argmin())))
    return names[one], names[other], nearest_m


def require_common_reach(sensors: Sequence[MountedSensor], last_m: float) -> None:
    """Raise ArgumentError if a sensor is so far from all others that no reflector is within the range of two."""
    found = far_apart({sensor.name: sensor.translation_m.tolist() for sensor in sensors}, last_m)
    if found is None:
        return
    one, other, apart_m = found
    unit, factor = ("centimetres", 100) if apart_m < _LARGEST_M * 100 else ("millimetres", 1000)
    likely = f"; if they are in {unit}, divide them by {factor}" if apart_m < _LARGEST_M * factor else ""
    raise ArgumentError(
        f"sensors {one!r} and {other!r} are mounted {round(apart_m, 2):g} m apart, but images reach {last_m:.3g} m, so "
        f"they observe no common reflector. Correct the positions of the mountings, in metres{likely}, or use sensors "
        "of one platform"
    )


def emitter_diameter_m(settings: Settings, given_m: float | None = None) -> float:
    """Return the diameter of an emitter: the given one, that of the settings or their layout, or else 0.012."""
    stated_m = _stated_diameter_m(settings.array) if given_m is None else given_m
    return USUAL_DIAMETER_M if stated_m is None else stated_m


@functools.cache
def _stated_diameter_m(array: Array) -> float | None:
    return microphones(array).emitter_diameter_m


class Emitters:
    """Model of the sound that a platform's emitters radiate: circular pistons in a baffle; diameter 0 is all around.

    ``patterns`` (emitter, cosine) are powers relative to ahead for cosines from -1 to 1. ``beside_m`` (emitter, cosine)
    are errors of the paths of echoes: beside its beam, a piston inverts high frequencies, which splits the pulse.
    ``lost`` (path,) is the logarithm of the power of echoes relative to a path of 2 m, without spreading, for paths
    from 0 to 256 m.
    """

    def __init__(self, settings: Settings, diameters_m: Sequence[float]) -> None:
        call = settings.call
        frequency_hz = _frequencies_of(call)
        self._loss_1_m = math.log(10) / 20 * absorption_db_m(settings.air, frequency_hz)
        self.lost = self._echo(np.ones(_N_FREQUENCIES), _PATHS_M[:, None])
        # The pattern is tabulated over the cosine, because a Bessel function of each cell takes long.
        self._cosine = np.linspace(-1.0, 1.0, 2049)
        sine = np.sqrt(1 - self._cosine**2)
        speed_m_s = sound_speed_m_s(settings.air)
        self._radiated: dict[float, Floats] = {}
        patterns, beside_m = {}, {}
        for diameter_m in {*diameters_m}:
            argument = np.maximum(1e-9, math.pi * diameter_m / speed_m_s * sine[:, None] * frequency_hz)
            self._radiated[diameter_m] = 2 * scipy.special.j1(argument) / argument
            power = np.mean(self._radiated[diameter_m] ** 2, axis=1)
            if diameter_m:
                power = np.where(self._cosine > 0, np.maximum(power, 10 ** (_STRAY_DB / 10)), 10 ** (_BEHIND_DB / 10))
            patterns[diameter_m] = power
            half_m = _half_widths_m(self._radiated[diameter_m], frequency_hz / speed_m_s)
            beside_m[diameter_m] = np.where(self._cosine > 0, half_m - half_m[-1], half_m.max() - half_m[-1])
        self.patterns, self.beside_m = (
            np.array([table[diameter_m] for diameter_m in diameters_m]) for table in (patterns, beside_m)
        )
        self._diameters_m = tuple(diameters_m)

    def power(self, cosine: Floats, emitter: int) -> Floats:
        """Return the power that an emitter radiates at the cosine of an angle to its axis, relative to that ahead."""
        return np.asarray(np.interp(cosine, self._cosine, self.patterns[emitter]))

    def spreading(self, to_point_m: Floats, from_point_m: Floats) -> Floats:
        """Return the power of an echo relative to that at 1 m: spherical spreading of both paths, and absorption."""
        there, back = np.maximum(to_point_m, _NEAREST_M), np.maximum(from_point_m, _NEAREST_M)
        return np.asarray(np.exp(np.interp(there + back, _PATHS_M, self.lost)) / (there * back) ** 2)

    def echo_powers(self, cosine: Floats, to_point_m: Floats, from_point_m: Floats) -> Floats:
        """Return the power of echoes in images, relative to that at 1 m ahead: (echo, emitter).

        Unlike `powers`, it follows the matched filter, which adds the amplitudes of all frequencies: an emitter
        radiates low frequencies to its side, which air absorbs less.
        """
        there, back = np.maximum(to_point_m, _NEAREST_M), np.maximum(from_point_m, _NEAREST_M)[:, None]
        place = np.rint((cosine + 1) / 2 * (len(self._cosine) - 1)).astype(np.int64)
        radiated = np.stack(
            [self._radiated[each][at] for each, at in zip(self._diameters_m, place.T, strict=True)], axis=1
        )
        exact = np.exp(self._echo(radiated, (there + back)[..., None]))
        least = np.exp(np.interp(there + back, _PATHS_M, self.lost)) * 10 ** (_STRAY_DB / 10)
        behind = (cosine <= 0) & (np.array(self._diameters_m) > 0)
        found = np.where(behind, least * 10 ** ((_BEHIND_DB - _STRAY_DB) / 10), np.maximum(exact, least))
        return np.asarray(found / (there * back) ** 2)

    def _echo(self, radiated: Floats, path_m: Floats) -> Floats:
        """Return the log of the power of echoes (...,) after the matched filter, without spreading."""
        amplitude = np.mean(radiated * np.exp(-self._loss_1_m * (path_m - 2.0)), axis=-1)
        return np.asarray(2 * np.log(np.maximum(np.abs(amplitude), np.finfo(np.float64).tiny)))


def _half_widths_m(radiated: Floats, wave_1_m: Floats) -> Floats:
    """Return the paths (direction,) up to which compressed pulses are within 0.2 dB of their maxima."""
    path_m = np.linspace(0.0, _FARTHEST_M, _N_FARTHEST)
    pulse = np.abs(radiated @ np.exp(2j * math.pi * wave_1_m[:, None] * path_m))
    is_high = pulse >= _TOP_OF_PULSE * pulse.max(axis=1, keepdims=True)
    return np.asarray(path_m[len(path_m) - 1 - is_high[:, ::-1].argmax(axis=1)])


def _frequencies_of(call: Call) -> Floats:
    """Return frequencies that divide the energy of a call equally: (`_N_FREQUENCIES`,) float64."""
    rate_hz = 4 * max(call.start_frequency_hz, call.stop_frequency_hz)
    samples = call_at(call, np.arange(math.ceil(call.duration_s * rate_hz)) / rate_hz + call.start_s)
    power = np.cumsum(np.abs(np.fft.rfft(samples)) ** 2)
    parts = (np.arange(_N_FREQUENCIES) + 0.5) / _N_FREQUENCIES
    return np.asarray(np.interp(parts, power / power[-1], np.fft.rfftfreq(len(samples), 1 / rate_hz)))
