"""Point-spread function: image of a single reflector, computed from array and call."""

import functools
import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import sound_speed_m_s
from ertis_numba.geometry import array_weights, microphones
from ertis_numba.settings import Air, Settings
from ertis_numba.stages.plan_response import Deviation
from ertis_numba.waveform import matched_filter_spectrum

__all__ = ["PULSE_M", "PointSpread"]

PULSE_M = 0.04
"""Range offset, in metres, at which a compressed pulse of 25 kHz bandwidth is 26 dB down.

At 2.5 times this offset, it is 40 dB down.
"""

_STEPS_PER_WAVE = 512  # Table steps per wavelength at the band's edge: linear interpolation has an error of 5e-6.


class PointSpread:
    """Point-spread function of delay-and-sum with plane waves.

    The amplitude at a range offset Δr and a direction offset Δu is

    ``|Σ_f P(f) Σ_mic w exp(j k(f) (2 Δr − p·Δu))| / n_mics``,

    where P is the power spectrum of the call, and w are the array weights, whose mean is 1.

    Parameters
    ----------
    settings : Settings

    Attributes
    ----------
    reach_m : float
        Range offset in metres beyond which the image of the reflector ends. A side lobe is as long as the pulse. Its
        shift is half of the difference of two paths, which is at most the aperture's radius.
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
        self._path_m = np.arange(count) * (period_m / count)
        shares = power / power.sum()
        self._turn = np.exp(1j * (wave_1_m[0] - self._carrier_1_m) * self._path_m)
        self._shares, self._wave_1_m, self._count = shares, wave_1_m, count
        self._pulse = np.fft.ifft(shares, count) * count * self._turn

    @property
    def spectrum(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Frequencies in Hz, evenly spaced, and their shares of the amplitude of an echo: (frequency,) each."""
        return self._wave_1_m * self._speed_m_s / (2 * math.pi), self._shares

    def __call__(
        self,
        direction_offset: NDArray[np.float64],
        range_offset_m: NDArray[np.float64],
        air: Air | None = None,
        *,
        deviation: Deviation | None = None,
    ) -> NDArray[np.float64]:
        """Return the amplitude, which is 1 at zero offset: (place,) float64.

        Parameters
        ----------
        direction_offset : (place, axis) float64
            Difference of the unit vectors.
        range_offset_m : (place,) float64
            Difference of the ranges in metres.
        air : Air, optional
            Air of the image; by default, that of the settings.
        deviation : Deviation, optional
            Errors of the beam at each place.
        """
        scale = 1.0 if air is None else self._speed_m_s / sound_speed_m_s(air)
        path_m = scale * (2 * range_offset_m[:, None] - direction_offset @ self._positions_m.T)
        pulse = self._at(path_m, self._pulse)
        if deviation is not None:
            carrier_hz = self._carrier_1_m * self._speed_m_s / (2 * math.pi)
            pulse = pulse * (1 + deviation.mean + deviation.slope_s * (carrier_hz - deviation.centre_hz))
            pulse += deviation.slope_s * self._at(path_m, self._tilted_hz)
        return np.asarray(np.abs((pulse * np.exp(1j * self._carrier_1_m * path_m) * self._weights).mean(axis=1)))

    @functools.cached_property
    def _tilted_hz(self) -> NDArray[np.complex128]:
        """Pulse with the spectrum weighted by the frequency relative to the carrier."""
        offset_hz = (self._wave_1_m - self._carrier_1_m) * self._speed_m_s / (2 * math.pi)
        return np.asarray(np.fft.ifft(self._shares * offset_hz, self._count) * self._count * self._turn)

    def _at(self, path_m: NDArray[np.float64], pulse: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return a pulse at given path differences; the pulse at negative ones is the complex conjugate."""
        # Path differences of the table are evenly spaced; `numpy.interp` would search for the place of each.
        place = np.minimum(np.abs(path_m) / self._path_m[1], self._count - 1.0)
        before = np.minimum(place.astype(np.intp), self._count - 2)
        found = pulse[before]
        found += (place - before) * (pulse[before + 1] - found)
        found.imag[path_m < 0] *= -1
        return np.asarray(found)
