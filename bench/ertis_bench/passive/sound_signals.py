"""Signals of noise sources at a finite distance, exact up to the rounding of float32."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones, spherical_delays, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["N_BLOCK", "OWN_RMS", "SOURCES", "NoiseSource", "listening", "noise"]

N_BLOCK: Final = 256
"""Samples of a block, which Acoular requires to be a power of 2."""

_RATE_HZ: Final = 225e3
_N_SAMPLES: Final = 8192  # 36.4 ms, of which 63 blocks result.
_FOCUS_M: Final = 2.0


class NoiseSource(NamedTuple):
    """Source of white noise at the distance on which maps focus."""

    azimuth_deg: float
    elevation_deg: float
    rms: float


SOURCES: Final = (NoiseSource(20, 5, 0.1), NoiseSource(-35, -10, 0.05), NoiseSource(3, 30, 0.03))
"""Sources of the maps that are compared and timed."""

OWN_RMS: Final = 0.01
"""RMS value of the noise of a microphone in these maps."""


def listening(**changes: Any) -> Settings:
    """Return settings of 36.4 ms of float32 signals of the eRTIS, with changes; ``__`` in a name stands for a dot."""
    chosen = {
        "recording.encoding": "float32",
        "recording.sample_rate_hz": _RATE_HZ,
        "recording.n_samples": _N_SAMPLES,
        "passive.resolution_hz": _RATE_HZ / N_BLOCK,
        "passive.focus_m": _FOCUS_M,
    }
    return Settings().replace(**(chosen | {name.replace("__", "."): value for name, value in changes.items()}))


def noise(settings: Settings, sources: Sequence[NoiseSource], *, own_rms: float, seed: int) -> Measurement:
    """Return the sound of incoherent sources, with white noise of each microphone itself."""
    random, n_samples = np.random.default_rng(seed), settings.recording.n_samples
    places_m = microphones(settings.array).enabled_positions_m
    frequency_hz = np.fft.rfftfreq(n_samples, 1 / settings.recording.sample_rate_hz)
    heard = own_rms * random.standard_normal((len(places_m), n_samples))
    for azimuth_deg, elevation_deg, rms in sources:
        direction = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))
        delay_s = spherical_delays(
            places_m, direction, range_m=_FOCUS_M, sound_speed_m_s=sound_speed_m_s(settings.air)
        )[0]
        spectrum = np.fft.rfft(rms * random.standard_normal(n_samples))
        heard += np.fft.irfft(spectrum * np.exp(-2j * np.pi * delay_s[:, None] * frequency_hz), n_samples)
    return Measurement(np.ascontiguousarray(heard.T, np.float32), settings)
