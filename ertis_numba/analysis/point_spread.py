"""Point-spread function: image of a single reflector, computed from array and call."""

import functools
import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import fourier
from ertis_numba.chain.plan_response import Deviation
from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.settings import Air, Settings

__all__ = ["PULSE_M", "PointSpread", "spread_of"]

Floats = NDArray[np.float64]

PULSE_M = 0.04
"""Range offset, in metres, at which a compressed pulse of 25 kHz bandwidth is 26 dB down.

At 2.5 times this offset, it is 40 dB down.
"""

_STEPS_PER_WAVE = 512  # Table steps per wavelength at the band's edge: linear interpolation has an error of 5e-6.
_SKIRTS = (0.05, 0.01)  # Amplitudes at the ends of a pulse and of its skirt.
_MOST_TILT = 0.9  # Largest change of amplitude by a tilt, from the carrier to an edge of the band.


class PointSpread:
    """Point-spread function of delay-and-sum: ``|Σ_f P(f) Σ_mic w exp(j k(f) d)| / n_mics``.

    P is the power spectrum of the call, w are the array weights, whose mean is 1, and d are differences of paths: for
    plane waves, 2 Δr − p·Δu at a range offset Δr and a direction offset Δu. Beyond ``reach_m``, the image ends: a side
    lobe is as long as the pulse, and its shift is half of the difference of two paths, at most the aperture's radius.
    ``skirt_m`` includes the skirt of the pulse to -40 dB. ``path_m`` of air absorb a part of P.
    """

    def __init__(self, settings: Settings, *, path_m: float = 0.0) -> None:
        self._speed_m_s, rate_hz = sound_speed_m_s(settings.air), settings.signal_rate_hz
        self._positions_m = microphones(settings.array).enabled_positions_m
        self._weights = array_weights(settings)
        radius_m = float(np.max(np.linalg.norm(self._positions_m, axis=1)))
        self.reach_m, self.skirt_m = (radius_m + max(PULSE_M, end_m) for end_m in self._ends_m(settings))
        # The sum over bins has a period of speed / spacing. Paths differ by at most four times ``skirt_m``.
        spacing_hz = self._speed_m_s / (6 * self.skirt_m)
        n_fft = math.ceil(max(settings.call.end_s * rate_hz + 1, rate_hz / spacing_hz))
        matched = matched_filter_spectrum(settings, n_fft=n_fft)
        thinned = slice(None, None, max(1, math.floor(spacing_hz * n_fft / rate_hz)))
        bins = (matched.first_bin + np.arange(len(matched.values)))[thinned]
        wave_1_m = 2 * math.pi * bins * rate_hz / n_fft / self._speed_m_s
        frequency_hz = wave_1_m * self._speed_m_s / (2 * math.pi)
        power = matched.echo_power[thinned] * np.exp(-path_m * _absorption_1_m(Air(), frequency_hz))
        self._carrier_1_m = float(wave_1_m[len(wave_1_m) // 2])
        # Wave numbers are evenly spaced, so the sum is a Fourier transform, with a period of six times ``skirt_m``.
        period_m = 2 * math.pi / float(wave_1_m[1] - wave_1_m[0]) if len(wave_1_m) > 1 else 8 * self.skirt_m
        count = 2 ** math.ceil(math.log2(len(wave_1_m) * _STEPS_PER_WAVE))
        steps_m = np.arange(count) * (period_m / count)
        shares = power / power.sum()
        self._turn = np.exp(1j * (wave_1_m[0] - self._carrier_1_m) * steps_m)
        self._shares, self._wave_1_m, self._path_m, self._air = shares, wave_1_m, path_m, settings.air
        self._absorbed: tuple[Air, Floats, Floats] | None = None  # Tables for the latest air.
        # Paths may differ by half of the period.
        self.valid_m = period_m / 4 - radius_m
        self.pulse = kernels.Pulse(
            self._table(shares),
            self._table(shares * (wave_1_m - self._carrier_1_m) * self._speed_m_s / (2 * math.pi)),
            float(steps_m[1]),
            self._carrier_1_m,
            np.ascontiguousarray(self._positions_m),
            np.array(self._weights, np.float64),
            self._speed_m_s,
        )

    @property
    def spectrum(self) -> tuple[Floats, Floats]:
        """Frequencies in Hz, evenly spaced, and their shares of the amplitude of an echo: (frequency,) each."""
        return self._wave_1_m * self._speed_m_s / (2 * math.pi), self._shares

    def __call__(self, direction_offset: Floats, range_offset_m: Floats, air: Air | None = None) -> Floats:
        """Return the amplitude (place,), 1 at zero offset, by differences of unit vectors and ranges, in any air."""
        along_m = direction_offset @ self._positions_m.T
        return self._amplitudes(self.scale(air) * (2 * range_offset_m[:, None] - along_m))

    def along(self, range_offset_m: Floats, tilt_s: float) -> Floats:
        """Return the amplitude, in the direction of an echo, at differences of ranges in an array of any shape."""
        table = self.pulse.table + tilt_s * self.pulse.tilted_hz if tilt_s else self.pulse.table
        place = np.minimum(2 * np.abs(range_offset_m) / self.pulse.step_m, len(table) - 1)
        return np.asarray(np.abs(table[np.rint(place).astype(np.intp)] / table[0]))

    def of_echo(self, direction: Floats, range_m: Floats, echo: Floats, echo_m: Floats, *, is_focused: bool) -> Floats:
        """Return the amplitudes (place,) that point echoes cause elsewhere; focused beams assume spherical waves."""
        beam_m = (
            self._paths_m(direction, range_m) if is_focused else 2 * range_m[:, None] - direction @ self._positions_m.T
        )
        return self._amplitudes(beam_m - self._paths_m(echo, echo_m))

    def _paths_m(self, direction: Floats, range_m: Floats) -> Floats:
        """Return the paths from the emitter to a place and to the microphones: (place, mic) float64."""
        place_m = range_m[:, None] * direction
        return np.asarray(range_m[:, None] + np.linalg.norm(place_m[:, None] - self._positions_m, axis=2))

    def _amplitudes(self, path_m: Floats) -> Floats:
        found = np.empty(len(path_m))
        kernels.load_points().spread_amplitudes(self.pulse, np.ascontiguousarray(path_m), found)
        return found

    def _ends_m(self, settings: Settings) -> list[float]:
        """Return the range offsets beyond which the pulse is weaker than each of `_SKIRTS`."""
        rate_hz = settings.signal_rate_hz
        n_fft = fourier.next_fast_len(2 * math.ceil(settings.call.end_s * rate_hz) + 1)
        power = matched_filter_spectrum(settings, n_fft=n_fft).echo_power
        pulse = np.abs(np.fft.ifft(power, n_fft))[: n_fft // 2]
        ends = (np.flatnonzero(~(pulse < level * pulse[0]))[-1] for level in _SKIRTS)
        return [(float(end) + 1) / rate_hz * self._speed_m_s / 2 for end in ends]

    def scale(self, air: Air | None) -> float:
        """Return the sound speed of the settings relative to that in some air."""
        return 1.0 if air is None else self._speed_m_s / sound_speed_m_s(air)

    def tilts(self, range_m: Floats, air: Air | None) -> tuple[Floats, Floats]:
        """Return the tilts of the spectra of echoes relative to the pulse in 1/Hz, and their amplitudes: (place,)."""
        frequency_hz, shares = self.spectrum
        offset_hz = frequency_hz - self._carrier_1_m * self._speed_m_s / (2 * math.pi)
        mean_hz, air, known = float(shares @ offset_hz), air or self._air, self._absorbed
        if known is None or known[0] != air:
            usual = self._path_m * _absorption_1_m(Air(), frequency_hz)
            known = self._absorbed = air, _absorption_1_m(air, frequency_hz), usual
        loss = 2 * np.outer(range_m, known[1])
        change = np.exp((loss @ shares)[:, None] - loss + known[2])
        slope_s = change @ (shares * (offset_hz - mean_hz)) / float(shares @ (offset_hz - mean_hz) ** 2 or 1.0)
        limit_s = _MOST_TILT / float(np.abs(offset_hz).max(initial=1e-30))  # Far away, lines would end below zero.
        tilt_s = np.clip(slope_s / (change @ shares - slope_s * mean_hz), -limit_s, limit_s)
        return tilt_s, 1 + tilt_s * mean_hz

    def beams(self, directions: Floats, deviation: Deviation | None) -> kernels.BeamErrors:
        """Return directions with the errors of their beams."""
        if deviation is None:
            none = np.empty((0, len(self._weights)), np.complex64)
            return kernels.BeamErrors(directions, none, none)
        centre_hz = self._carrier_1_m * self._speed_m_s / (2 * math.pi) - deviation.centre_hz
        return kernels.BeamErrors(directions, 1 + deviation.mean + deviation.slope_s * centre_hz, deviation.slope_s)

    def _table(self, spectrum: Floats) -> NDArray[np.complex128]:
        """Return the pulse of a spectrum, relative to its carrier: (path,) complex128."""
        count = len(self._turn)
        return np.asarray(np.fft.ifft(spectrum, count) * count * self._turn)


spread_of = functools.lru_cache(maxsize=8)(PointSpread)
"""Point-spread function of settings; all images of a pipeline share its tables, which take milliseconds."""


def _absorption_1_m(air: Air, frequency_hz: Floats) -> Floats:
    """Return the absorption of air in nepers per metre."""
    return math.log(10) / 20 * absorption_db_m(air, frequency_hz)
