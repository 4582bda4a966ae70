"""Search for the call of another sensor beside the own one, whose echoes are ghosts."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ertis_numba.analysis.sound_spectra import SoundSpectra
from ertis_numba.analysis.sweep_search import FoundSweep, find_sweep, power_after
from ertis_numba.analysis.sweeps import Curve, Sweep
from ertis_numba.base import fourier
from ertis_numba.settings import Call

__all__ = ["foreign_sweep"]

_FRAME_S: Final = 0.5e-3  # Length over which another sweep is steady after the filter of the call.
_STEADY: Final = 3.0  # Power relative to its median in a frame, above which a sample belongs to a peak.
_MIN_SPREAD_S: Final = 0.2e-3  # Sweeps that the filter of the call spreads less count as the call.
_AROUND_S: Final = 1e-3
_MIN_RATIO: Final = 10.0  # Power at the peak of the other sweep, relative to the median within this time.
_BETTER: Final = 4.5  # Peak after the filter of the other sweep, relative to that after the filter of the call.
_GATE_S: Final = 0.3e-3  # Half the length of an arrival after the filter of its sweep.
_N_DELAYS: Final = 64
_MIN_SHARE: Final = 0.5  # Overlap of the other sweep with the band of the call, relative to the narrower band.


def foreign_sweep(sound: SoundSpectra, call: Call, curve: Curve) -> Sweep | None:
    """Return another sweep in the band of the call, whose curve is known; None without any."""
    rest = _without_peaks(sound, curve)
    found = find_sweep(rest)
    if found is None or not found.sweep.is_compressible:
        return None
    sweep = found.sweep
    shared_hz = max(sweep.low_hz, call.low_frequency_hz), min(sweep.high_hz, call.high_frequency_hz)
    narrower_hz = min(sweep.high_hz - sweep.low_hz, call.high_frequency_hz - call.low_frequency_hz)
    if shared_hz[1] - shared_hz[0] < _MIN_SHARE * narrower_hz:
        return None
    at_hz = np.linspace(*shared_hz, _N_DELAYS)
    spread_s = float(np.ptp(found.curve.delay_s(at_hz) - curve.delay_s(at_hz)))
    return None if spread_s < _MIN_SPREAD_S or _is_own(sound, rest, found, curve) else sweep


def _is_own(sound: SoundSpectra, rest: SoundSpectra, found: FoundSweep, curve: Curve) -> bool:
    """Return True if the filter of the call compresses an arrival of a sweep as well, or if other sound hides it."""
    part = rest.band(found.sweep.low_hz, found.sweep.high_hz)
    filter_rad, own_rad = (each.phase_rad(rest.frequency_hz[part]) for each in (found.curve, curve))
    peaks = power_after(rest, filter_rad, part).argmax(axis=1)
    turned = sound.bins[:, part] * np.exp(1j * filter_rad).astype(np.complex64)
    around = np.arange(round(-_AROUND_S * sound.time_rate_hz), round(_AROUND_S * sound.time_rate_hz) + 1)
    after = np.take_along_axis(fourier.ifft(turned, sound.n_times), (peaks[:, None] + around) % sound.n_times, axis=1)
    power = np.abs(after) ** 2
    at_peak, usual = power[:, len(around) // 2], np.median(power, axis=1)
    gated = np.zeros((len(after), sound.n_times), np.complex64)
    gated[:, : len(around)] = after * np.clip(1.5 - np.abs(around) / (_GATE_S * sound.time_rate_hz), 0, 1)
    own = fourier.fft(gated)[:, : len(own_rad)] * np.exp(1j * (own_rad - filter_rad)).astype(np.complex64)
    of_own = np.abs(fourier.ifft(own, sound.n_times)).max(axis=1) ** 2
    return bool(np.median(at_peak / np.maximum(np.maximum(_BETTER * of_own, _MIN_RATIO * usual), 1e-30)) < 1)


def _without_peaks(sound: SoundSpectra, curve: Curve) -> SoundSpectra:
    """Return the sound without the peaks after the filter of a curve."""
    turn = np.exp(1j * curve.phase_rad(sound.frequency_hz)).astype(np.complex64)
    after = fourier.ifft(sound.bins * turn, sound.n_times)
    power = after.real**2 + after.imag**2
    usual = _medians(power, max(1, round(_FRAME_S * sound.time_rate_hz)))
    after *= np.sqrt(np.minimum(1.0, _STEADY * usual / np.maximum(power, 1e-30))).astype(np.float32)
    bins = fourier.fft(after)[:, : len(turn)] * turn.conj()
    return replace(sound, bins=bins.astype(np.complex64))


def _medians(power: NDArray[np.float32], length: int) -> NDArray[np.float32]:
    """Return the median of each frame and of its neighbours, whichever is less, at all samples."""
    count = power.shape[1] // length
    frames = np.median(power[:, : count * length].reshape(len(power), count, length), axis=2)
    frames = sliding_window_view(np.pad(frames, ((0, 0), (1, 1)), mode="edge"), 3, axis=1).min(axis=2)
    return np.asarray(np.repeat(frames, length, axis=1)[:, np.minimum(np.arange(power.shape[1]), count * length - 1)])
