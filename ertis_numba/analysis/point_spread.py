"""Point-spread function: image of a single reflector, computed from array and call."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.chain.plan_response import Deviation
from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.settings import Air, Settings

__all__ = ["PULSE_M", "PointSpread"]

PULSE_M = 0.04
"""Range offset, in metres, at which a compressed pulse of 25 kHz bandwidth is 26 dB down.

At 2.5 times this offset, it is 40 dB down.
"""

_STEPS_PER_WAVE = 512  # Table steps per wavelength at the band's edge: linear interpolation has an error of 5e-6.


class PointSpread:
    """Point-spread function of delay-and-sum with plane waves.

    The amplitude at a range offset Δr and a direction offset Δu is ``|Σ_f P(f) Σ_mic w exp(j k(f) (2 Δr − p·Δu))| /
    n_mics``, where P is the power spectrum of the call, and w are the array weights, whose mean is 1. Beyond
    ``reach_m``, the image ends: a side lobe is as long as the pulse, and its shift is half of the difference of two
    paths, at most the aperture's radius.
    """

    def __init__(self, settings: Settings) -> None:
        self._speed_m_s, rate_hz = sound_speed_m_s(settings.air), settings.signal_rate_hz
        self._positions_m = microphones(settings.array).enabled_positions_m
        self._weights = array_weights(settings)
        self.reach_m = float(np.max(np.linalg.norm(self._positions_m, axis=1))) + PULSE_M
        # The sum over bins has a period of speed / spacing. Paths differ by at most four times ``reach_m``.
        spacing_hz = self._speed_m_s / (6 * self.reach_m)
        n_fft = math.ceil(max(settings.call.end_s * rate_hz + 1, rate_hz / spacing_hz))
        matched = matched_filter_spectrum(settings, n_fft=n_fft)
        thinned = slice(None, None, max(1, math.floor(spacing_hz * n_fft / rate_hz)))
        bins = (matched.first_bin + np.arange(len(matched.values)))[thinned]
        wave_1_m = 2 * math.pi * bins * rate_hz / n_fft / self._speed_m_s
        power = matched.echo_power[thinned]
        self._carrier_1_m = float(wave_1_m[len(wave_1_m) // 2])
        # Wave numbers are evenly spaced, so the sum is a Fourier transform, with a period of six times ``reach_m``.
        period_m = 2 * math.pi / float(wave_1_m[1] - wave_1_m[0]) if len(wave_1_m) > 1 else 8 * self.reach_m
        count = 2 ** math.ceil(math.log2(len(wave_1_m) * _STEPS_PER_WAVE))
        path_m = np.arange(count) * (period_m / count)
        shares = power / power.sum()
        self._turn = np.exp(1j * (wave_1_m[0] - self._carrier_1_m) * path_m)
        self._shares, self._wave_1_m = shares, wave_1_m
        self.pulse = kernels.Pulse(
            self._table(shares),
            self._table(shares * (wave_1_m - self._carrier_1_m) * self._speed_m_s / (2 * math.pi)),
            float(path_m[1]),
            self._carrier_1_m,
            np.ascontiguousarray(self._positions_m),
            np.array(self._weights, np.float64),
            self._speed_m_s,
        )

    @property
    def spectrum(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Frequencies in Hz, evenly spaced, and their shares of the amplitude of an echo: (frequency,) each."""
        return self._wave_1_m * self._speed_m_s / (2 * math.pi), self._shares

    def __call__(
        self, direction_offset: NDArray[np.float64], range_offset_m: NDArray[np.float64], air: Air | None = None
    ) -> NDArray[np.float64]:
        """Return the amplitude (place,), 1 at zero offset, by differences of unit vectors and ranges, in any air."""
        found = np.empty(len(range_offset_m))
        offsets = np.ascontiguousarray(direction_offset), np.ascontiguousarray(range_offset_m)
        kernels.load_points().spread_amplitudes(self.pulse, *offsets, self.scale(air), found)
        return found

    def scale(self, air: Air | None) -> float:
        """Return the sound speed of the settings relative to that in some air."""
        return 1.0 if air is None else self._speed_m_s / sound_speed_m_s(air)

    def beams(self, directions: NDArray[np.float64], deviation: Deviation | None) -> kernels.BeamErrors:
        """Return directions with the errors of their beams."""
        if deviation is None:
            none = np.empty((0, len(self._weights)), np.complex64)
            return kernels.BeamErrors(directions, none, none)
        centre_hz = self._carrier_1_m * self._speed_m_s / (2 * math.pi) - deviation.centre_hz
        return kernels.BeamErrors(directions, 1 + deviation.mean + deviation.slope_s * centre_hz, deviation.slope_s)

    def _table(self, spectrum: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the pulse of a spectrum, relative to its carrier: (path,) complex128."""
        count = len(self._turn)
        return np.asarray(np.fft.ifft(spectrum, count) * count * self._turn)
