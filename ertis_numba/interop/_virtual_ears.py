"""Virtual ears: a beam of each half of an array, as in the experiment with an eRTIS sensor of BatSLAM 2.0.

Each half is a delay-and-sum beamformer of the unfiltered signals with a Gaussian taper, which is steered to its own
side. Its beam is narrower at high frequencies, as that of a bat's ear.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.signals import signals_of
from ertis_numba.frames import Measurement
from ertis_numba.geometry import far_field_delays, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Settings

__all__ = ["BinauralSignals", "VirtualEars"]

Floats = NDArray[np.float64]

_MIN_BASELINE_M: Final = 1e-4


class BinauralSignals(NamedTuple):
    """Signals of both ears, (sample,), with a full scale of 1."""

    left: Floats
    right: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _HalfArray:
    """Microphones of an ear, as indices of the enabled ones, and their weights and delays."""

    mics: NDArray[np.intp]
    weights: Floats
    delays_s: Floats


class VirtualEars:
    """Beamformer of both ears.

    The left ear is steered to ``azimuth_deg``, the right one to its negative. The signals hold echoes up to
    ``max_range_m`` completely. Sample n is n / rate_hz after the start of the call. ``baseline_m`` is the lateral
    distance between the centroids of both halves. ``call`` has the same rate.
    """

    def __init__(self, settings: Settings, azimuth_deg: float) -> None:
        self.settings = settings
        self.rate_hz = settings.signal_rate_hz
        self._speed_m_s = sound_speed_m_s(settings.air)
        self.call = call_samples(settings.call, rate_hz=self.rate_hz)
        record_m = self._speed_m_s * (settings.recording.duration_s - settings.call.end_s) / 2
        self.max_range_m = min(settings.processing.range_m[1], record_m)
        layout = microphones(settings.array)
        self._position_m, self._own_s = layout.enabled_positions_m, layout.delay_s[layout.enabled]
        left, right = _sides(self._position_m)
        self.baseline_m = float(np.mean(self._position_m[left, 1]) - np.mean(self._position_m[right, 1]))
        if self.baseline_m < _MIN_BASELINE_M:
            raise ArgumentError(
                f"array.layout is {layout.name!r}, whose microphones lie on one vertical line; virtual ears need an "
                "array with microphones on the left and on the right"
            )
        self._halves = self._half(left, azimuth_deg), self._half(right, -azimuth_deg)
        largest_s = max(float(np.max(np.abs(half.delays_s))) for half in self._halves)
        longest_s = 2 * self.max_range_m / self._speed_m_s + settings.call.end_s
        self.n_samples = min(
            math.ceil((longest_s + largest_s) * self.rate_hz) + 1,
            -(-settings.recording.n_samples // settings.decimation),
        )
        # The padding keeps the ends of delayed signals apart.
        padding = math.ceil(largest_s * self.rate_hz) + 1
        self._n_fft = scipy.fft.next_fast_len(self.n_samples + 2 * padding, real=True)
        frequency_hz = np.fft.rfftfreq(self._n_fft, 1 / self.rate_hz)
        self._steering = [
            half.weights[:, None] * np.exp(2j * math.pi * np.outer(half.delays_s, frequency_hz))
            for half in self._halves
        ]

    def _half(self, mics: NDArray[np.intp], azimuth_deg: float) -> _HalfArray:
        position_m = self._position_m[mics]
        direction = unit_vectors(np.array([math.radians(azimuth_deg)]), np.zeros(1))
        waves_s = far_field_delays(position_m, direction, sound_speed_m_s=self._speed_m_s)[0]
        from_centroid_m = np.linalg.norm(position_m - position_m.mean(axis=0), axis=1)
        rms_m = math.sqrt(float(np.mean(from_centroid_m**2)))
        weights = np.exp(-0.5 * (from_centroid_m / rms_m) ** 2) if rms_m else np.ones(len(mics))
        return _HalfArray(mics, weights / weights.sum(), waves_s + self._own_s[mics])

    def __call__(self, measurement: Measurement) -> BinauralSignals:
        """Return the signals of both ears."""
        settings = self.settings
        signals = signals_of(measurement, settings=settings, max_samples=self.n_samples * settings.decimation)
        spectra = np.fft.rfft(signals[:, : self.n_samples], self._n_fft, axis=1)
        left, right = (
            np.fft.irfft(np.einsum("mf,mf->f", spectra[half.mics], steering), self._n_fft)[: self.n_samples]
            for half, steering in zip(self._halves, self._steering, strict=True)
        )
        return BinauralSignals(left, right)


def _sides(position_m: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the microphones of the left and of the right half; the middle one of an odd number belongs to neither."""
    half = len(position_m) // 2
    if not half:
        raise ArgumentError("the array has one enabled microphone; virtual ears need at least 2")
    order = np.argsort(-position_m[:, 1], kind="stable")
    return np.sort(order[:half]), np.sort(order[-half:])
