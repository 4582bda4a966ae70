"""Detection of broken emitters by an observer that knows all posts, as a limit for detection from images.

Amplitudes of echoes follow from the places and strengths of posts, from the call and from the emitters. A rendered
post determines their scale.
"""

import functools
import math
from typing import Final, NamedTuple

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ertis_bench.platform_trials.emitter_rooms import EmitterRoom
from ertis_bench.platform_trials.rendered_rooms import RATE_HZ, Room, images_of, mounted, rendered, settings_of
from ertis_numba.analysis.noise import echo_floor
from ertis_numba.frames import Energyscape
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.geometry.waveform import call_at

__all__ = ["silence_ratio"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_FALSE_ALARM: Final = 1e-5
_SIDE_LOBES: Final = 10 ** (-17 / 20)  # Amplitude relative to the strongest echo of any direction at a similar range.
_SHOWN: Final = 10 ** (-20 / 20)  # Amplitude relative to the strongest echo, from which echoes show a post.
_VISIBLE: Final = 10 ** (8 / 20)  # Amplitude of an expected echo relative to noise and side lobes, …
_DISTURBED: Final = 10 ** (-8 / 10)  # … power of other echoes relative to it, from which they may hide it, …
_LOST: Final = 10 ** (-5 / 20)  # … and amplitude relative to it, below which it is missed.
_NEAR_M: Final = 0.008
_BESIDE_M: Final = 0.03
_NEAR_RAD: Final = math.radians(4.0)
_PULSE_M: Final = 0.02  # Difference of paths, …
_BEAM: Final = 0.14  # … and of the sines of directions, at which echoes overlap.
_WIDEST_RAD: Final = math.radians(85.0)
_N_OTHERS: Final = 2  # Echoes of other calls that show a post.
_MISSED: Final = 0.5 * math.log(0.67 / 0.02)  # As in fusion; half of the echoes are independent.
_HEARD: Final = 0.5 * math.log(0.33 / 0.98)


class _Echoes(NamedTuple):
    """Echoes (post, emitter, receiver) of all calls, and directions (post, receiver) in the images."""

    amplitude: Floats
    range_m: Floats
    azimuth_rad: Floats


def silence_ratio(drawn: EmitterRoom, images: list[Energyscape], diameter_m: float, pulse: int, dead: str) -> Floats:
    """Return the logarithm of how much better the silence of each emitter explains a pulse: (emitter,)."""
    # Posts count if two or more echoes of other calls show them, which noise, side lobes and other posts hardly reach.
    echoes = _echoes(drawn, diameter_m, pulse)
    names = [*drawn.mountings]
    sent = np.where(np.isin(names, [dead])[:, None], 0.0, echoes.amplitude)
    parts = [_heard(echoes, sent, image, names.index(image.stamp.sensor)) for image in images]
    shows, counts, is_loud = (np.stack(each, axis=-1) for each in zip(*parts, strict=True))
    found = np.zeros(len(names))
    for number in range(len(names)):
        known = np.delete(shows, number, axis=1).sum(axis=(1, 2)) >= _N_OTHERS
        here, loud = counts[known, number], is_loud[known, number]
        found[number] = (here & ~loud).sum() * _MISSED + (here & loud).sum() * _HEARD
    return found


def _heard(echoes: _Echoes, sent: Floats, image: Energyscape, receiver: int) -> tuple[Flags, Flags, Flags]:
    """Return the echoes (post, emitter) that show a post, those that count for a call, and those that are heard."""
    amplitude, range_m, azimuth_rad = echoes.amplitude[..., receiver], echoes.range_m[..., receiver], echoes.azimuth_rad
    highest, noise = image.amplitude.max(axis=0), echo_floor(image, _FALSE_ALARM).lasting
    shows, counts, is_loud = np.zeros((3, *amplitude.shape), np.bool_)
    late = np.exp(-(((range_m[..., None, None] - range_m) * 2 / _PULSE_M) ** 2))
    sine = np.sin(azimuth_rad[:, receiver])
    beam = np.exp(-(((sine[:, None] - sine) / _BEAM) ** 2))
    for post, emitter in np.ndindex(*amplitude.shape):
        at_m, turn_rad = range_m[post, emitter], azimuth_rad[post, receiver]
        is_inside = image.range_m[0] + _BESIDE_M < at_m < image.range_m[-1] - _BESIDE_M
        if not is_inside or abs(turn_rad) > _WIDEST_RAD:
            continue
        side = _SIDE_LOBES * highest[np.abs(image.range_m - at_m) < _BESIDE_M].max()
        least = max(noise, side)
        shows[post, emitter] = sent[post, emitter, receiver] > max(least, _SHOWN * highest.max())
        others = (sent[..., receiver] ** 2 * late[post, emitter] * beam[post][:, None]).copy()
        others[post, emitter] = 0.0
        expected = amplitude[post, emitter]
        counts[post, emitter] = expected > _VISIBLE * least and others.sum() < _DISTURBED * expected**2
        near = np.ix_(np.abs(image.azimuth_rad - turn_rad) < _NEAR_RAD, np.abs(image.range_m - at_m) < _NEAR_M)
        is_loud[post, emitter] = image.amplitude[near].max(initial=0.0) > _LOST * expected
    return shows, counts, is_loud


def _echoes(drawn: EmitterRoom, diameter_m: float, pulse: int) -> _Echoes:
    """Return the echoes of the posts without walls."""
    posts_m = drawn.room.posts_m - drawn.step_m * pulse
    sensor_m = np.array([place_m[:2] for place_m, _ in drawn.mountings.values()])
    yaw_rad = np.array([2 * math.atan2(turn[2], turn[3]) for _, turn in drawn.mountings.values()])
    offset_m = posts_m[:, None] - sensor_m
    away_m = np.linalg.norm(offset_m, axis=2)
    turn_rad = np.arctan2(offset_m[..., 1], offset_m[..., 0]) - yaw_rad
    sent = np.array([_radiated(math.cos(each), diameter_m) for each in turn_rad.flat]).reshape(turn_rad.shape)
    path_m = away_m[:, :, None] + away_m[:, None]
    spread = _arrived(path_m) / (away_m[:, :, None] * away_m[:, None])
    strength = 10 ** (drawn.room.strength_db / 20)[:, None, None]
    # A flat array shows sound from behind in front.
    return _Echoes(_scale() * strength * sent[:, :, None] * spread, path_m / 2, np.arcsin(np.sin(turn_rad)))


@functools.cache
def _spectrum() -> tuple[Floats, Floats]:
    """Return frequencies in hertz, and their shares of the energy of the call."""
    n_fft = 4096
    frequency_hz = np.fft.rfftfreq(n_fft, 1 / RATE_HZ)
    power = np.abs(np.fft.rfft(call_at(settings_of().call, np.arange(n_fft) / RATE_HZ))) ** 2
    return np.asarray(frequency_hz, np.float64), np.asarray(power / power.sum(), np.float64)


def _radiated(cosine: float, diameter_m: float) -> float:
    """Return the amplitude that a piston in a baffle radiates, relative to ahead."""
    if not diameter_m or cosine <= 0:
        return float(not diameter_m)
    frequency_hz, share = _spectrum()
    wave_1_m = 2 * np.pi * frequency_hz / sound_speed_m_s(settings_of().air)
    argument = np.maximum(wave_1_m * diameter_m / 2 * math.sqrt(max(0.0, 1 - cosine**2)), 1e-6)
    return abs(float(share @ (2 * scipy.special.j1(argument) / argument)))


def _arrived(path_m: Floats) -> Floats:
    """Return the amplitude that absorption by the air leaves."""
    frequency_hz, share = _spectrum()
    lost_1_m = math.log(10) / 20 * absorption_db_m(settings_of().air, frequency_hz)
    return np.asarray(np.exp(-lost_1_m * path_m[..., None]) @ share)


@functools.cache
def _scale() -> float:
    """Return the amplitude of an echo of a post of 0 dB in an image, relative to that of the model."""
    settings, range_m = settings_of(), 1.5
    room = Room(np.array([[range_m, 0.0]]), np.zeros(1))
    alone = mounted({"front": (0.0, 0.0, 0.0)})
    signals = rendered(alone, settings, room, diameter_m=0.0, random=np.random.default_rng(0), noise=0.0)
    highest = float(images_of(signals, settings)["front"].amplitude.max())
    return highest * range_m**2 / float(_arrived(np.array(2 * range_m)))
