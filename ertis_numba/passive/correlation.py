"""Generalised cross-correlation of two signals: its largest maximum, and the uncertainty of this delay."""

import math
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["Bins", "Correlation"]

_FINER: Final = 8  # Samples of the correlation per sample of the signals.
_N_STEPS: Final = 4
_CERTAIN: Final = 120.0  # Squared lead of a maximum, relative to the noise, that leaves no doubt.
_BEYOND: Final = 0.004  # Probability of delays beyond four uncertainties.
_N_PARTS: Final = 8  # Parts of the band whose delays are compared.
_MISFIT: Final = 5e-3  # Probability of as large differences between the parts if there is one source.
_SMOOTH: Final = 20.0  # Error relative to the misfit, if this changes its sign rarely, …
_ROUGH: Final = 0.3  # … and otherwise.
_MERGED: Final = 0.06  # Largest error by an echo that the band does not resolve, in periods of its width.
_AMBIGUOUS: Final = 0.7  # Correlation relative to the largest one, from which a misfit leaves no choice.
_TONE_BINS: Final = 3  # Largest distance of the bins of a tone under a Hann window …
_TONE_WIDTH: Final = 2.5  # … and their equivalent number, which is 2.0 to 2.2.
_TINY: Final = 1e-30


class Bins(NamedTuple):
    """Cross-spectrum of blocks, weights of frequencies, and the correlation of equal signals under them."""

    n_block: int
    cross: NDArray[np.complex128]
    weights: NDArray[np.float64]
    most: float
    coherence: NDArray[np.float64]
    evidence: NDArray[np.float64]
    is_coherent: bool

    @property
    def is_tone(self) -> bool:
        """True if the frequencies in use hold no more than one tone does under the window: no period is evident."""
        used = np.flatnonzero(self.weights)
        power = np.abs(self.cross[used])
        return bool(np.ptp(used) <= _TONE_BINS and power.sum() ** 2 < _TONE_WIDTH * (power**2).sum())


class Correlation:
    """Generalised cross-correlation of two signals, the second of which is late by a time."""

    def __init__(
        self, first: NDArray[np.float32], second: NDArray[np.float32], bins: Bins, late_s: float, rate_hz: float
    ) -> None:
        n = first.size
        self._bins, self._late_s, self._rate_hz, self._n = bins, late_s, rate_hz, n
        # Ends fade, so that a shift does not wrap them around.
        window = scipy.signal.get_window(("tukey", bins.n_block / n), n)
        squares = float((window**2).sum())
        frequency_hz = np.fft.rfftfreq(n, 1 / rate_hz)
        grid_hz = np.arange(bins.weights.size) * rate_hz / bins.n_block
        weights = np.interp(frequency_hz, grid_hz, bins.weights)
        weights *= bins.n_block / n * float((scipy.signal.get_window("hann", bins.n_block) ** 2).sum()) / squares
        spectra = [scipy.fft.rfft(each * window.astype(np.float32)) for each in (first, second)]
        self._spectrum = spectra[1] * spectra[0].conj() * weights
        used = np.flatnonzero(weights)
        self._weighted, self._omega = self._spectrum[used].astype(np.complex128), 2 * np.pi * frequency_hz[used]
        self._coherence, self._evidence = (
            np.interp(frequency_hz[used], grid_hz, each) for each in (bins.coherence, bins.evidence)
        )
        # The window correlates neighbouring frequencies.
        self._correlated = n * float((window**4).sum()) / squares**2

    def _at(self, apart_s: float) -> NDArray[np.complex128]:
        """Return the weighted spectrum without a delay relative to the late one."""
        turned: NDArray[np.complex128] = self._weighted * np.exp(1j * self._omega * apart_s)
        return turned

    def _maxima_s(self, most_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the delays of maxima up to a largest delay, to a fraction of a sample, and the values there."""
        step_s = 1 / (_FINER * self._rate_hz)
        lags = np.arange(math.ceil((-most_s - self._late_s) / step_s), int((most_s - self._late_s) // step_s) + 1)
        lags = lags if lags.size else np.array([round(-self._late_s / step_s)])
        values = scipy.fft.irfft(self._spectrum, self._n)
        n_near = 8 * self._bins.n_block  # Only small delays are needed at the finer step.
        if n_near < self._n:
            fade = np.fft.ifftshift(scipy.signal.get_window("tukey", n_near, fftbins=False))
            values = values[np.fft.ifftshift(np.arange(n_near) - n_near // 2) % self._n] * fade
        n_fine = _FINER * values.size
        values = (scipy.fft.irfft(scipy.fft.rfft(values), n_fine) * _FINER * self._n / 2)[lags % n_fine]
        beside = np.pad(values, 1, constant_values=-np.inf)
        tops = np.flatnonzero((values >= beside[:-2]) & (values >= beside[2:]))
        # A parabola through three samples has its top between them; a sample may miss several thousandths of it.
        before, top, after = beside[tops], values[tops], beside[tops + 2]
        inside = np.isfinite(before) & np.isfinite(after) & (before + after < 2 * top)
        before, after = np.where(inside, before, top - 1), np.where(inside, after, top - 1)
        slope = after - before
        shift = slope / (2 * (2 * top - before - after))
        tallest = top + slope * shift / 4
        order = np.argsort(-tallest, kind="stable")
        return ((lags[tops] + shift) * step_s + self._late_s)[order], tallest[order]

    def delay_s(self, most_s: float) -> float:
        """Return the delay of the largest maximum."""
        return self._refined_s(float(self._maxima_s(most_s)[0][0]), most_s)

    def _refined_s(self, delay_s: float, most_s: float) -> float:
        """Return the maximum next to a delay by Newton's method, within the limits."""
        for _ in range(_N_STEPS):
            turned = self._at(delay_s - self._late_s)
            curvature = float((self._omega**2 * turned.real).sum())
            if curvature <= 0:
                break
            delay_s -= float((self._omega * turned.imag).sum()) / curvature
        return min(max(delay_s, -most_s), most_s)

    def result(self, most_s: float) -> tuple[float, float, float]:
        """Return the delay up to a largest one, its uncertainty, and the relative height of its maximum."""
        maxima_s, values = self._maxima_s(most_s)
        found_s = self._refined_s(float(maxima_s[0]), most_s)
        turned = self._at(found_s - self._late_s)
        uncertainty_s = math.inf
        if self._bins.is_coherent and abs(found_s) < most_s:
            uncertainty_s = self._uncertainty_s(found_s, turned, maxima_s[1:], values[1:])
        omega = 2 * np.pi * np.arange(self._bins.weights.size) * self._rate_hz / self._bins.n_block
        turned_bins = self._bins.weights * self._bins.cross * np.exp(1j * omega * (found_s - self._late_s))
        height = float(turned_bins.real.sum())
        return found_s, uncertainty_s, height / max(self._bins.most, _TINY)

    def _uncertainty_s(
        self,
        found_s: float,
        turned: NDArray[np.complex128],
        others_s: NDArray[np.float64],
        values: NDArray[np.float64],
    ) -> float:
        """Return the uncertainty of a maximum beside others."""
        curvature = float((self._omega**2 * turned.real).sum())
        if curvature <= 0:
            return math.inf
        # Each frequency has a square of G₁₁ G₂₂ (1 + γ²), and noise of half of G₁₁ G₂₂ (1 - γ²) across its phase.
        square, coherence = np.abs(turned) ** 2, self._coherence
        noise = self._correlated * square * (1 - coherence) / (1 + coherence) / 2
        size = self._evidence * np.sqrt(square * coherence / (1 + coherence))
        n_free = max(float(np.sqrt(noise).sum() ** 2 / max(noise.sum(), _TINY)) / self._correlated, 3.0)
        variance = float((self._omega**2 * noise).sum()) / curvature**2
        lead = float(turned.real.sum()) - values
        misfit_s = self._misfit_s(turned, noise)
        ambiguous = (values > _AMBIGUOUS * float(turned.real.sum())) & (misfit_s > 0 or self._bins.is_tone)
        near = (lead**2 < _CERTAIN * noise.sum()) | ambiguous
        apart_s, odds = [0.0], [1.0]
        for other_s, unclear in zip(others_s[near].tolist(), ambiguous[near].tolist(), strict=True):
            change = 1 - np.exp(1j * self._omega * (other_s - found_s))
            ahead = float((turned * change).real.sum())
            expected = min(float((turned.real * change.real).sum()), float((size * change.real).sum()))
            spread = float((np.abs(change) ** 2 * noise).sum())
            # Log odds of one delay against another; the noise is estimated, so the odds are those of Student.
            evidence = 2 * max(ahead, 0.0) * max(expected, 0.0) / max(spread, _TINY)
            odds.append(1.0 if unclear else (1 + 2 * evidence / n_free) ** (-n_free / 2))
            apart_s.append(abs(other_s - found_s))
        order = np.argsort(apart_s)
        shares = np.array(odds)[order] / sum(odds)
        distances_s = np.array(apart_s)[order]
        beyond = np.cumsum(shares[::-1])[::-1] > _BEYOND
        rare_s = float(distances_s[beyond].max()) / 4
        return math.sqrt(variance + misfit_s**2 + max(float((shares * distances_s**2).sum()), rare_s**2))

    def _misfit_s(self, turned: NDArray[np.complex128], noise: NDArray[np.float64]) -> float:
        """Return the error that several sources or echoes may cause; 0 if one delay fits all parts of the band."""
        within = np.cumsum(np.abs(turned)) / np.abs(turned).sum()
        edges = np.unique(np.searchsorted(within, np.linspace(0, 1, _N_PARTS + 1)[1:-1]))
        whole, spread = (np.add.reduceat(each, np.unique([0, *edges])) for each in (turned, noise))
        if whole.size < 3:
            return 0.0
        phase, variance = np.angle(whole), spread / np.maximum(np.abs(whole) ** 2, _TINY)
        if scipy.stats.chi2.sf(float((phase**2 / np.maximum(variance, _TINY)).sum()), whole.size - 1) > _MISFIT:
            return 0.0
        omega = math.sqrt(float((self._omega**2 * np.abs(turned)).sum() / np.abs(turned).sum()))
        rms_s = math.sqrt(max(float((phase**2 - variance).mean()), 0.0)) / omega
        changes = int((np.diff(np.sign(phase)) != 0).sum())
        merged_s = _MERGED * 2 * math.pi / float(np.ptp(self._omega))
        return max(_ROUGH * rms_s, min(_SMOOTH * rms_s, merged_s) if changes <= 2 else 0.0)
