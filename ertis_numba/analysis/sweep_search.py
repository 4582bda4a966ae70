"""Search for the sweep in a record, without knowledge of the emitted call.

Sub-bands find the slope of the group delay at each frequency, because few slopes differ within a narrow band. One curve
through these slopes compresses the sound over its whole band, and is then refined around the strongest arrival.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ertis_numba.analysis.sound_spectra import SoundSpectra
from ertis_numba.analysis.sweeps import MODULATIONS, Curve, Modulation, Sweep
from ertis_numba.base import fourier

__all__ = [
    "FoundSweep",
    "GatedArrival",
    "arrival_of",
    "find_sweep",
    "power_after",
    "refined",
    "run_around",
    "sub_band_hz",
    "sweep_along",
]

_SUB_BAND_HZ: Final = 10e3
_SUB_BAND: Final = 0.045  # Largest sub-band relative to the sample rate.
_MAX_TURNS: Final = 80.0  # Steepest slope times the square of a sub-band.
_N_SLOPES: Final = 161
_N_CURVES: Final = 120  # of either direction
_MIN_RATIO: Final = 17.0  # Peak to mean power in a sub-band; noise reaches about 13.
_MIN_SCORE: Final = 10.0  # Sum of the excess over sub-bands.
_MIN_POWER: Final = 10**-2.5  # Power of a sub-band relative to the strongest; others contain side lobes of its sound.
_MAX_GAP: Final = 2  # Sub-bands
_OCCUPIED: Final = 0.1  # Excess of an occupied sub-band relative to the highest.
_ALTERNATIVE: Final = 0.3  # Score of another modulation relative to the best, with which it is also refined.
_GATE_S: Final = 2e-3  # Half the length of the sound around the strongest arrival.
_COARSE: Final = 1.5  # Steps of the slope in units of the inverse of the squared bandwidth.
_FINE: Final = 0.25
_MAX_STEPS: Final = 60
_ROUNDS: Final = 4
_GAIN: Final = 1.03  # A refinement that gains less is the last one.
_SMOOTHED_HZ: Final = 1e3
_WIDER: Final = 1.2
_EDGE: Final = 0.1  # Power at the edges of a band relative to its middle.


@dataclass(frozen=True, eq=False)
class GatedArrival:
    """Sound around the strongest arrival of each microphone after a curve's filter, with its power ``peak`` (mic,)."""

    # `around` returns the spectra at a shift in samples, and `noise` (bin,) has divided them.

    spectra: NDArray[np.complex128]
    frequency_hz: NDArray[np.float64]
    peak: NDArray[np.float64]
    shifts: range
    around: Callable[[int], NDArray[np.complex128]]
    noise: NDArray[np.float64]

    @functools.cached_property
    def elsewhere(self) -> NDArray[np.float64]:
        """Median power spectrum of other parts of the record: (bin,) float64. Most arrivals are compared without it."""
        others = [np.mean(np.abs(self.around(shift)) ** 2, axis=0) for shift in self.shifts]
        return np.asarray(np.median(others or np.zeros((1, len(self.frequency_hz))), axis=0))

    @property
    def power(self) -> NDArray[np.float64]:
        """Recorded power spectrum without that of other parts of the record: (bin,) float64."""
        return self._smoothed(np.mean(np.abs(self.spectra) ** 2, axis=0) - self.elsewhere)

    @property
    def background(self) -> NDArray[np.float64]:
        """Recorded power spectrum of other parts of the record: (bin,) float64."""
        return self._smoothed(self.elsewhere)

    def _smoothed(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        step_hz = self.frequency_hz[1] - self.frequency_hz[0]
        size = max(1, round(_SMOOTHED_HZ / step_hz))
        around = np.pad(power * self.noise**2, (size // 2, (size - 1) // 2), mode="symmetric")
        return np.asarray(sliding_window_view(around, size).mean(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class FoundSweep:
    """Sweep that the strongest sound of a record contains."""

    curve: Curve
    sweep: Sweep


def sub_band_hz(rate_hz: float) -> float:
    """Return the width of sub-bands in hertz."""
    return min(_SUB_BAND_HZ, _SUB_BAND * rate_hz)


def find_sweep(found: SoundSpectra) -> FoundSweep | None:
    """Return the sweep of the strongest sound; None if no sound exceeds the noise."""
    width_hz = sub_band_hz(found.rate_hz)
    slopes_s_hz = np.linspace(-1, 1, _N_SLOPES) * _MAX_TURNS / width_hz**2
    centres_hz, ratios, power = _sub_bands(found, slopes_s_hz, width_hz)
    if not len(centres_hz) or power.max() <= 0:
        return None
    weights = np.clip(power / power.max() / _MIN_POWER, 0, 1)
    excess = weights[:, None] * np.maximum(ratios - _MIN_RATIO, 0)
    loud_hz = centres_hz[weights >= 1]
    pivot_hz = float(np.sqrt(loud_hz[0] * loud_hz[-1]))
    coarse = [_best_curve(excess, centres_hz, slopes_s_hz, name, pivot_hz) for name in MODULATIONS]
    best_score = max(score for score, *_ in coarse)
    if best_score < _MIN_SCORE:
        return None
    found_at = []
    for score, curve, along in coarse:
        if score >= _ALTERNATIVE * best_score:
            occupied = _run_around_highest(along)
            low_hz, high_hz = centres_hz[occupied][0] - width_hz / 2, centres_hz[occupied][-1] + width_hz / 2
            found_at.append(_focused(found, curve, low_hz, high_hz))
    best, arrival = max(found_at, key=lambda each: float(np.median(each[1].peak)))
    low_hz, high_hz = arrival.frequency_hz[[0, -1]]
    # The ends may be too weak for a sub-band.
    return FoundSweep(best, sweep_along(found, best, low_hz / _WIDER, high_hz * _WIDER))


def _sub_bands(
    found: SoundSpectra, slopes_s_hz: NDArray[np.float64], width_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres of sub-bands, the peak to mean power for each slope, and the power of the sound."""
    n_bins = round(width_hz * found.n_fft / found.rate_hz)
    starts = range(0, len(found.frequency_hz) - n_bins, n_bins // 2)
    offset_hz = (np.arange(n_bins) - (n_bins - 1) / 2) * found.rate_hz / found.n_fft
    window = np.cos(np.pi * offset_hz / width_hz) ** 2
    filters = (window * np.exp(1j * np.pi * slopes_s_hz[:, None] * offset_hz**2)).astype(np.complex64)
    parts = [found.bins[:, start : start + n_bins] for start in starts]
    centres_hz = np.array([found.frequency_hz[start] - offset_hz[0] for start in starts])
    ratios = np.array([np.median([_peak_ratios(filters, bins) for bins in part], axis=0) for part in parts])
    power = np.array([float(np.mean(np.abs(part) ** 2)) for part in parts])
    return centres_hz, ratios, power


def _peak_ratios(filters: NDArray[np.complex64], bins: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the peak to mean power after each filter, which have equal magnitudes: (filter,) float32."""
    n_fft = fourier.next_fast_len(2 * len(bins), real=True)  # without slow factors of 7 and 11
    after = fourier.ifft(filters * bins, n_fft, normalised=False, overwrite=True)
    parts = after.view(np.float32)
    np.multiply(parts, parts, out=parts)
    peaks = (parts[:, ::2] + parts[:, 1::2]).max(axis=1)
    mean = np.sum(np.abs(filters[0] * bins) ** 2)  # Parseval's theorem
    return np.asarray(peaks / np.maximum(mean, 1e-30))


def _best_curve(
    excess: NDArray[np.float64],
    centres_hz: NDArray[np.float64],
    slopes_s_hz: NDArray[np.float64],
    modulation: Modulation,
    pivot_hz: float,
) -> tuple[float, Curve, NDArray[np.float64]]:
    """Return the score of the curve that follows the sound through most sub-bands, the curve, and its excess there."""
    steepest, step = slopes_s_hz[-1], slopes_s_hz[1] - slopes_s_hz[0]
    rising = np.geomspace(steepest / 1e3, steepest, _N_CURVES)
    found = []
    for slope in [*-rising, 0.0, *rising]:
        curve = Curve(modulation, float(slope), pivot_hz)
        places = np.rint((curve.slopes_s_hz(centres_hz) + steepest) / step)
        inside = (places >= 0) & (places < len(slopes_s_hz))
        along = np.where(inside, excess[np.arange(len(places)), places.clip(0, len(slopes_s_hz) - 1).astype(int)], 0.0)
        found.append((float(along.sum()), curve, along))
    return max(found, key=lambda each: each[0])


def _run_around_highest(along: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the occupied sub-bands around the strongest one, across short gaps: (sub-band,) bool."""
    is_occupied = along > _OCCUPIED * along.max()
    return run_around(is_occupied, int(along.argmax()), _MAX_GAP)


def run_around(is_loud: NDArray[np.bool_], place: int, max_gap: int) -> NDArray[np.bool_]:
    """Return the loud places of the run around one of them, across gaps of at most ``max_gap`` places."""
    loud = np.flatnonzero(is_loud)
    runs = np.cumsum(np.diff(loud, prepend=loud[0]) > max_gap + 1)
    found = np.zeros(is_loud.shape, np.bool_)
    found[loud[runs == runs[np.searchsorted(loud, place)]]] = True
    return found


def _focused(found: SoundSpectra, curve: Curve, low_hz: float, high_hz: float) -> tuple[Curve, GatedArrival]:
    """Return the curve near a given one with the highest peak, and the arrival after its filter."""
    arrival = arrival_of(found, curve, low_hz, high_hz)
    for _ in range(_ROUNDS):
        better, gain = refined(arrival, curve)
        if gain < _GAIN:
            break
        curve, arrival = better, arrival_of(found, better, low_hz, high_hz)
    return curve, arrival


def power_after(found: SoundSpectra, filter_rad: NDArray[np.float64], part: slice) -> NDArray[np.float32]:
    """Return the power over time after a filter with given phases in a band: (mic, sample) float32."""
    after = fourier.ifft(found.bins[:, part] * np.exp(1j * filter_rad).astype(np.complex64), found.n_times)
    return np.asarray(after.real**2 + after.imag**2)


def arrival_of(
    found: SoundSpectra,
    curve: Curve,
    low_hz: float,
    high_hz: float,
    *,
    gate_s: float = _GATE_S,
    whole_hz: Sequence[float] = (),
) -> GatedArrival:
    """Return the strongest arrival of each microphone after the filter of a curve in a band."""
    part = found.band(low_hz, high_hz)
    frequency_hz = found.frequency_hz[part]
    turned = found.bins[:, part] * np.exp(1j * curve.phase_rad(frequency_hz)).astype(np.complex64)
    after = fourier.ifft(turned, found.n_times)
    power = after.real**2 + after.imag**2
    half = min(round(gate_s * found.time_rate_hz), found.n_times // 4)
    window = np.hanning(2 * half) ** 0.25
    n_fft = fourier.next_fast_len(2 * len(window))
    step_hz = found.time_rate_hz / n_fft
    n_bins = int((frequency_hz[-1] - frequency_hz[0]) / step_hz) + 1
    at_hz = frequency_hz[0] + np.arange(n_bins) * step_hz
    noise = np.interp(at_hz, found.frequency_hz, found.noise)  # For the spectrum as it was recorded.

    def around(shift: int) -> NDArray[np.complex128]:
        places = (peaks[:, None] + shift + np.arange(-half, half)) % found.n_times
        parts = np.take_along_axis(after, places, axis=1) * window
        return np.asarray(fourier.fft(parts, n_fft)[:, :n_bins])

    seconds = np.arange(found.n_times)[:, None] / found.time_rate_hz + curve.delay_s(np.array(whole_hz))
    seconds %= found.n_fft / found.rate_hz
    is_whole = ((seconds >= found.whole_s[0]) & (seconds <= found.whole_s[1])).all(axis=1)
    power = np.where(is_whole, power, 0)
    peaks = power.argmax(axis=1)
    shifts = range(2 * half, found.n_times - 2 * half + 1, 2 * half)
    return GatedArrival(around(0), at_hz, power.max(axis=1), shifts, around, noise)


def refined(arrival: GatedArrival, curve: Curve) -> tuple[Curve, float]:
    """Return the curve of any modulation with the highest peak at an arrival, and the ratio of both peak powers."""
    at_hz = arrival.frequency_hz
    before_rad = curve.phase_rad(at_hz)
    n_fft = fourier.next_fast_len(2 * len(at_hz))
    given = _peaks(arrival, np.zeros((1, len(at_hz))), n_fft)[0]
    best = (1.0, curve)
    is_heard = given > 0
    if not is_heard.any():
        return curve, 1.0
    given, arrival = given[is_heard], replace(arrival, spectra=arrival.spectra[is_heard])
    bandwidth_hz = at_hz[-1] - at_hz[0]
    for modulation in MODULATIONS:
        unit = Curve(modulation, 1.0, curve.pivot_hz)
        unit_rad, extent = unit.phase_rad(at_hz), float(unit.delay_s(at_hz[-1]) - unit.delay_s(at_hz[0]))
        middle = float(curve.delay_s(at_hz[-1]) - curve.delay_s(at_hz[0])) / extent
        step = 1 / (extent * bandwidth_hz)
        count = min(_MAX_STEPS, int(_GATE_S / extent / (_COARSE * step)) + 1)
        of_modulation = middle, 0.0
        for size, number in ((_COARSE * step, count), (_FINE * step, round(_COARSE / _FINE))):
            slopes = of_modulation[0] + size * np.arange(-number, number + 1)
            gains = np.median(_peaks(arrival, slopes[:, None] * unit_rad - before_rad, n_fft) / given, axis=1)
            of_modulation = float(slopes[gains.argmax()]), float(gains.max())
        if of_modulation[1] > best[0]:
            best = of_modulation[1], Curve(modulation, of_modulation[0], curve.pivot_hz)
    return best[1], best[0]


def _peaks(arrival: GatedArrival, phases_rad: NDArray[np.float64], n_fft: int) -> NDArray[np.float64]:
    """Return the peak power after filters with given phases: (filter, mic) float64."""
    filters = np.exp(1j * phases_rad).astype(np.complex64)
    after = fourier.ifft(filters[:, None] * arrival.spectra.astype(np.complex64), n_fft)
    return np.asarray((after.real**2 + after.imag**2).max(axis=2), dtype=np.float64)


def sweep_along(found: SoundSpectra, curve: Curve, low_hz: float, high_hz: float) -> Sweep:
    """Return the sweep that follows a curve through the strongest arrival, as far as it sounds in a band."""
    arrival = arrival_of(found, curve, low_hz, high_hz)
    slopes_s_hz = np.abs(curve.slopes_s_hz(arrival.frequency_hz))
    is_sound = (arrival.power > arrival.background) & (arrival.power > _MIN_POWER * arrival.power.max())
    power = np.where(is_sound, arrival.power, 0) / np.maximum(slopes_s_hz, 1e-30)
    loud = np.flatnonzero(power >= _EDGE * power.max())
    return Sweep.of_curve(curve, float(arrival.frequency_hz[loud[0]]), float(arrival.frequency_hz[loud[-1]]))
