"""Strongest arrival of a record: its signals after the matched filter, and the best-fitting wavefront."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.limits import MAX_DELAY_S
from ertis_numba.base import fourier
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Call

__all__ = ["Compressed", "Fit", "compress", "fit_delays", "fit_emitter", "strongest"]

_OVERSAMPLING = 8  # Oversampling of the envelope.
_PROMINENCE = 6.0  # Minimum amplitude of the arrival, relative to the median over time.
_FLAT = 0.99
_TRIALS = 80  # Number of subsets of microphones; half of the microphones may be wrong.
_SINGULAR = 1e-2  # Minimum volume of a subset of microphones, relative to the cube of the array's extent.
_DEGENERATE_M = 1e-3  # Minimum extent of an axis of the array that the fit uses.


@dataclass(frozen=True, slots=True, eq=False)
class Compressed:
    """Signals after the matched filter: spectrum (mic, bin) in the call's band, and envelope (mic, step).

    ``start_s`` is the time of the first step since the start of the record, negative if before; ``origin_s`` is the
    time that the phases of the spectrum refer to.
    """

    bins: NDArray[np.complex128]
    frequency_hz: NDArray[np.float64]
    envelope: NDArray[np.float64]
    step_s: float
    start_s: float
    origin_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Wavefront fitted to times of arrival, its time (mic,) at each microphone, and the median absolute residual."""

    delay_s: NDArray[np.float64]
    inliers: NDArray[np.bool_]
    spread_s: float
    emission_s: float

    @property
    def share(self) -> float:
        """Share of the microphones that the wavefront fits."""
        return float(np.mean(self.inliers))


def compress(
    signals: Callable[[int], NDArray[np.float32]],
    channels: Sequence[int],
    call: Call,
    *,
    rate_hz: float,
    first: int,
    last: int,
) -> Compressed:
    """Return samples ``first`` to ``last`` after the matched filter, starting one call length before the first."""
    replica = call_samples(call, rate_hz=rate_hz)
    n_fft = fourier.next_fast_len(last - first + len(replica), real=True)
    low, high = (round(hz * n_fft / rate_hz) for hz in (call.low_frequency_hz, call.high_frequency_hz))
    matched = np.conj(fourier.rfft(replica, n_fft)[low : high + 1])
    matched /= np.sum(np.abs(matched) ** 2) / n_fft
    bins = np.stack([_spectrum(signals(channel)[first:last], n_fft)[low : high + 1] for channel in channels]) * matched
    # Negative lags lie at the end of the cyclic result. A roll by the length of the call moves them to the start.
    frequency_hz = np.arange(low, high + 1) * rate_hz / n_fft
    n_steps = 1 << (_OVERSAMPLING * bins.shape[1] - 1).bit_length()
    step_s = n_fft / rate_hz / n_steps
    before = int(len(replica) / rate_hz / step_s)
    envelope = np.roll(np.abs(fourier.ifft(bins, n_steps)), before, axis=1) * (n_steps / n_fft)
    return Compressed(bins, frequency_hz, envelope, step_s, first / rate_hz - before * step_s, first / rate_hz)


def _spectrum(signal: NDArray[np.float32], n_fft: int) -> NDArray[np.complex64]:
    return np.asarray(fourier.rfft(signal - signal.mean(), n_fft))


def strongest(found: Compressed, width_s: float) -> tuple[NDArray[np.float64], float] | None:
    """Return the times (mic,) of the strongest arrival, at most ``width_s`` apart, and their middle; None for none."""
    width = max(1, int(np.ceil(width_s / found.step_s))) + 2
    widened = _highest_around(found.envelope, width)
    common = np.median(widened, axis=0)
    highest = int(np.argmax(common))
    # The median of maxima has a plateau around the arrival, and both have the same middle.
    lower = np.flatnonzero(common[highest:] < _FLAT * common[highest])
    middle = highest + (int(lower[0]) if len(lower) else len(common) - highest) // 2
    if common[middle] < _PROMINENCE * np.median(common):
        return None
    first, last = max(0, middle - width), min(found.envelope.shape[1], middle + width + 1)
    peaks = first + np.argmax(found.envelope[:, first:last], axis=1)
    peaks = np.clip(peaks, 1, found.envelope.shape[1] - 2)
    mics = np.arange(len(peaks))
    before, at, after = (found.envelope[mics, peaks + shift] for shift in (-1, 0, 1))
    curvature_s2 = np.minimum(before - 2 * at + after, -1e-30)
    steps = peaks + np.clip((before - after) / (2 * curvature_s2), -0.5, 0.5)
    return found.start_s + steps * found.step_s, found.start_s + middle * found.step_s


def _highest_around(envelope: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return the running maximum over ``width`` steps on either side, computed by doubling."""
    total = 2 * width + 1
    out = np.pad(envelope, ((0, 0), (width, width)))
    reach = 1
    while 2 * reach <= total:
        out = np.maximum(out[:, :-reach], out[:, reach:])
        reach *= 2
    rest = total - reach
    return np.maximum(out[:, :-rest], out[:, rest:]) if rest else out


def fit_delays(
    times_s: NDArray[np.float64], positions_m: NDArray[np.float64], curvatures: Sequence[float], speed_m_s: float
) -> Fit | None:
    """Return the wavefront, of given curvatures in 1/m, that most microphones agree with; None for too few of them."""
    _, extent, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=False)
    used = extent / np.sqrt(len(positions_m)) > _DEGENERATE_M
    places_m = positions_m @ axes[used].T
    if not used.any() or len(places_m) < 2 * (places_m.shape[1] + 1) + 1:
        return None
    squared_m2 = np.sum(positions_m**2, axis=1)
    fits = []
    for curvature in curvatures:
        curvature_s = curvature * squared_m2 / (2 * speed_m_s)
        for _ in range(2 if curvature else 1):
            fit = _robust(times_s - curvature_s, places_m)
            slope_m = places_m @ fit[1] * speed_m_s
            curvature_s = curvature * (squared_m2 - slope_m**2) / (2 * speed_m_s)
        fitted_s = fit[0] + places_m @ fit[1] + curvature_s
        fits.append(_fit(times_s, fitted_s, float(fit[0])))
    return max(fits, key=lambda item: (round(item.share, 2), -item.spread_s))


def fit_emitter(times_s: NDArray[np.float64], positions_m: NDArray[np.float64], speed_m_s: float) -> Fit:
    """Return the wavefront of an emitter at the array's centre, whose only unknown is the time of the emission."""
    travel_s = np.linalg.norm(positions_m, axis=1) / speed_m_s
    emission_s = float(np.median(times_s - travel_s))
    return _fit(times_s, emission_s + travel_s, emission_s)


def _fit(times_s: NDArray[np.float64], fitted_s: NDArray[np.float64], emission_s: float) -> Fit:
    residual_s = np.abs(times_s - fitted_s)
    return Fit(fitted_s, residual_s < MAX_DELAY_S, float(np.median(residual_s)), emission_s)


def _robust(times_s: NDArray[np.float64], places_m: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the time at the centre and the slopes: a least-median fit, refined by least squares over the inliers."""
    matrix = np.column_stack([np.ones(len(places_m)), places_m])
    subsets = _subsets(*matrix.shape)
    corners = matrix[subsets]
    usable = np.abs(np.linalg.det(corners)) > _SINGULAR * float(np.abs(places_m).max()) ** places_m.shape[1]
    if usable.any():
        solutions = np.linalg.solve(corners[usable], times_s[subsets[usable]][..., None])[..., 0]
        spreads = np.median(np.abs(times_s - np.sum(matrix * solutions[:, None], axis=2)), axis=1)
        solution = solutions[np.argmin(spreads)]
    else:
        solution = np.linalg.lstsq(matrix, times_s, rcond=None)[0]
    for _ in range(2):
        near = np.abs(times_s - matrix @ solution) < MAX_DELAY_S
        if near.sum() > matrix.shape[1]:
            solution = np.linalg.lstsq(matrix[near], times_s[near], rcond=None)[0]
    return float(solution[0]), solution[1:]


@functools.cache
def _subsets(n_mics: int, size: int) -> NDArray[np.intp]:
    """Return random subsets of microphones: (trial, size) intp."""
    rng = np.random.default_rng(n_mics)
    return np.argsort(rng.random((_TRIALS, n_mics)), axis=1)[:, :size]
