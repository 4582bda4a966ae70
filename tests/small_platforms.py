"""Sensors on a platform and point reflectors around it, rendered by sums of delayed calls instead of the simulator.

Sound travels from each emitter to each reflector and on to each microphone. It spreads spherically, and the air absorbs
it. Emitters are circular pistons in a baffle, or omnidirectional. Samples are PCM.
"""

import math

import numpy as np
import scipy

import ertis_numba as ertis
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Processing, Recording, Settings

__all__ = ["HEIGHT_M", "LEVEL", "RATE_HZ", "images_of", "mounted", "random_reflectors", "rendered", "settings_of"]

RATE_HZ = 200_000.0
HEIGHT_M = 0.4
NOISE = 2.5e-4
_N_SAMPLES = 6400
_N_FFT = 8192
_BAND_HZ = 22e3, 55e3
LEVEL = 10 ** (-24 / 20)
_YAWS_DEG = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
_RADIUS_M = 0.2


def settings_of(directions="90", *, diameter_m=None, encoding="float32", **processing):
    """Settings of a PCM sensor whose layout may state the diameter of its emitter."""
    array = Settings().array.replace(emitter_diameter_m=diameter_m)
    return Settings(
        array=array,
        recording=Recording(sample_rate_hz=RATE_HZ, n_samples=_N_SAMPLES, encoding=encoding),
        processing=Processing(directions=directions, range_m=(0.3, 4.0), range_decimation=4, **processing),
    )


def mounted(count=4):
    """Mountings of up to four sensors that face outwards."""
    found = {}
    for name, yaw_deg in [*_YAWS_DEG.items()][:count]:
        yaw_rad = math.radians(yaw_deg)
        place_m = (_RADIUS_M * math.cos(yaw_rad), _RADIUS_M * math.sin(yaw_rad), HEIGHT_M)
        found[name] = place_m, (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))
    return found


def random_reflectors(seed, count=10):
    """Places and strengths in dB of reflectors at least 40 cm apart: (reflector, axis) and (reflector,) float64."""
    random = np.random.default_rng(seed)
    places, strengths_db = [], []
    while len(places) < count:
        range_m, turn_rad = random.uniform(0.9, 3.2), random.uniform(-np.pi, np.pi)
        place = np.array([range_m * np.cos(turn_rad), range_m * np.sin(turn_rad), HEIGHT_M])
        if all(np.linalg.norm(place - other) > 0.4 for other in places):
            places.append(place)
            strengths_db.append(random.uniform(-8, 0) + 6 * np.log2(range_m))
    return np.array(places), np.array(strengths_db)


def rendered(mountings, settings, places_m, strength_db, *, diameter_m, random, noise=NOISE, dead=()):
    """Signals of all sensors, by name: (sample, mic) float32. Dead emitters radiate nothing."""
    frequency_hz = np.fft.rfftfreq(_N_FFT, 1 / RATE_HZ)
    inside = (frequency_hz > _BAND_HZ[0]) & (frequency_hz < _BAND_HZ[1])
    frequency_hz = frequency_hz[inside]
    wave_1_m = 2 * math.pi * frequency_hz / sound_speed_m_s(settings.air)
    lost_1_m = math.log(10) / 20 * absorption_db_m(settings.air, frequency_hz)
    call = np.fft.rfft(call_at(settings.call, np.arange(_N_FFT) / RATE_HZ))[inside]
    places_m = np.reshape(places_m, (-1, 3))
    lit = np.zeros((len(places_m), len(frequency_hz)), complex)
    for name, (place_m, turn) in mountings.items():
        offset_m = places_m - place_m
        range_m = np.linalg.norm(offset_m, axis=1)[:, None]
        cosine = (offset_m @ _rotation(turn)[:, 0])[:, None] / range_m
        if name not in dead:
            lit += _radiated(diameter_m, wave_1_m, cosine) * np.exp(-(lost_1_m + 1j * wave_1_m) * range_m) / range_m
    lit *= LEVEL * call * 10 ** (np.reshape(strength_db, (-1, 1)) / 20)
    mics_m = np.asarray(microphones(settings.array).positions_m, np.float64)
    return {
        name: _heard(lit, places_m, np.asarray(place_m) + mics_m @ _rotation(turn).T, inside, wave_1_m, lost_1_m)
        + noise * random.standard_normal((_N_SAMPLES, len(mics_m))).astype(np.float32)
        for name, (place_m, turn) in mountings.items()
    }


def images_of(signals, settings, number=0):
    """Images of all sensors, by name."""
    found = {}
    with ertis.Pipeline(settings, predict=False) as pipeline:
        for name, signal in signals.items():
            stamp = ertis.Stamp(
                sensor=name, sequence=number, sync_count=number, timestamp_ns=10**18 + 100_000_000 * number
            )
            found[name] = pipeline.process(ertis.Measurement(signal, settings, stamp))
    return found


def _radiated(diameter_m, wave_1_m, cosine):
    """Amplitude that an emitter radiates, relative to that ahead; nothing behind a piston's baffle."""
    if not diameter_m:
        return 1.0
    argument = np.maximum(1e-9, diameter_m / 2 * wave_1_m * np.sqrt(np.maximum(0.0, 1 - cosine**2)))
    return np.where(cosine > 0, 2 * scipy.special.j1(argument) / argument, 0.0)


def _heard(lit, places_m, mics_m, inside, wave_1_m, lost_1_m):
    spectrum = np.zeros((len(inside), len(mics_m)), np.complex64)
    for place_m, each in zip(places_m, lit, strict=True):
        range_m = np.linalg.norm(place_m - mics_m, axis=1)
        turn = (wave_1_m[:, None] * range_m).astype(np.float32)
        spread = (each * np.exp(-lost_1_m * range_m.mean()))[:, None].astype(np.complex64) / range_m.astype(np.float32)
        spectrum[inside] += spread * (np.cos(turn) - 1j * np.sin(turn))
    return np.fft.irfft(spectrum, _N_FFT, axis=0)[:_N_SAMPLES].astype(np.float32)


def _rotation(turn):
    return scipy.spatial.transform.Rotation.from_quat(turn).as_matrix()
