"""Least-squares interpolation of delays and beams.

Weights ``c[tap, target]`` and a gain ``g[wave]`` that all targets share minimise ``Σ_wave power · Σ_target |T − g (E
c)|²`` in turns, as in gridding (J. A. Fessler and B. P. Sutton, 2003). docs/explanation/accuracy.md explains it.
"""

import functools
import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import threadpoolctl
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ertis_numba.base.forks import ForkSafeLock
from ertis_numba.kernels import SteeringKernels

__all__ = [
    "WAVES",
    "DelayFit",
    "Spectrum",
    "fit",
    "gain_of",
    "one_thread",
    "two_columns",
    "weights_of",
    "without_small",
]

WAVES = 40
"""Number of frequencies of the spectra that weight fits and errors."""

_TURNS = 12  # Number of iterations; further ones reduce the error by less than 0.1 dB.
_MIN_POWER = 1e-14  # Regularisation relative to the power of the taps. It keeps weights small if taps are nearly equal.
_IMAGES = (-2, -1, 1, 2)  # The nearest images hold nearly all of the error.
_MIN_COEFFICIENT = 1e-9  # Relative to the largest one; rounding to single precision causes larger errors.
_TARGETS = 65  # Number of targets over one step of the stored samples.


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Power spectrum of the output of the matched filter: shares (wave,) at frequencies in Hz, with the sum 1."""

    frequency_hz: NDArray[np.float64]
    power: NDArray[np.float64]

    @property
    def centre_hz(self) -> float:
        """Mean frequency in hertz, weighted by power."""
        return float(self.frequency_hz @ self.power)


class _OneThread:
    """Context manager that limits BLAS to one thread while any Python thread is inside."""

    def __init__(self) -> None:
        self._lock = ForkSafeLock()
        self._inside = 0
        self._controller: threadpoolctl.ThreadpoolController | None = None
        self._limits: Any = None

    def __enter__(self) -> None:
        with self._lock:
            self._inside += 1
            if self._inside == 1:
                # Finding the libraries takes milliseconds. NumPy has loaded the BLAS of the fit by now.
                self._controller = self._controller or threadpoolctl.ThreadpoolController()
                self._limits = self._controller.limit(limits=1, user_api="blas")

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0 and self._limits is not None:
                self._limits.restore_original_limits()


_ONE_THREAD = _OneThread()


def one_thread() -> AbstractContextManager[None]:
    """Limit BLAS to one thread: with the planner's small matrices, its threads wait for each other on busy cores."""
    return _ONE_THREAD


def fit(
    taps: NDArray[np.complex128],
    targets: NDArray[np.complex128],
    power: NDArray[np.float64],
    *,
    real: bool = False,
    min_power: float = _MIN_POWER,
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the gain (wave,) and weights (tap, target) that approximate ``targets`` by ``taps`` with the least error.

    ``taps`` (wave, tap), ``targets`` (wave, target), and ``power`` (wave,), the weight of each frequency. ``min_power``
    is the regularisation, relative to the mean diagonal of the Gram matrix of the taps.
    """
    gain: NDArray[Any] = np.ones(len(taps), dtype=np.complex128)
    for _ in range(_TURNS):
        weights = weights_of(gain, taps, targets, power, real=real, min_power=min_power)
        made = taps @ weights
        gain = gain_of(made, targets)
    return gain, weights_of(gain, taps, targets, power, real=real, min_power=min_power)


def gain_of(made: NDArray[np.complex128], targets: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the gain, (wave,), that minimises the distance of ``made`` from the targets; both (wave, target)."""
    return np.asarray(np.sum(np.conj(made) * targets, axis=1) / np.sum(np.abs(made) ** 2, axis=1))


def weights_of(
    gain: NDArray[np.complex128],
    taps: NDArray[np.complex128],
    targets: NDArray[np.complex128],
    power: NDArray[np.float64],
    *,
    real: bool = False,
    min_power: float = _MIN_POWER,
) -> NDArray[np.complex128]:
    """Return the optimal weights for a given gain: (tap, target) complex128; other parameters as for `fit`."""
    gained = gain[:, None] * taps
    left = np.conj(gained.T) * power
    gram, right = left @ gained, left @ targets
    if real:
        gram, right = gram.real.astype(np.complex128), right.real.astype(np.complex128)
    gram += min_power * np.trace(gram).real / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(gram, right))


def without_small(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients of polynomials, (degree, degree, value), without negligible ones of the highest degrees."""
    largest = np.abs(coefficients).max(axis=2)
    is_kept = largest > _MIN_COEFFICIENT * largest.max()
    rows, columns = (int(np.flatnonzero(is_kept.any(axis=axis))[-1]) + 1 for axis in (1, 0))
    return np.ascontiguousarray(coefficients[:rows, :columns])


def two_columns(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return places with one or two coordinates, (place, axis), as (place, 2); a missing second coordinate is 0."""
    found = np.zeros((len(places), 2))
    found[:, : places.shape[1]] = places
    return found


class DelayFit:
    """Fractional-delay filters: interpolation of a sample at any time from samples stored at a fixed step.

    ``fractions`` (target,) spread evenly over one step, over which ``errors`` (wave,) are the error power relative to
    the sample, without ``biases`` (wave,), the power of the mean error, which all microphones share. ``with_gain`` is
    False for streams, which are nonlinear functions of signals.
    """

    def __init__(self, n_taps: int, step_s: float, spectrum: Spectrum, *, with_gain: bool = True) -> None:
        self.n_taps = n_taps
        self.step_s = step_s
        self.spectrum = spectrum
        self._middle = (self.n_taps - 1) // 2 + 0.5 * (1 - self.n_taps % 2)
        self.fractions = (np.arange(_TARGETS) + 0.5) / _TARGETS + self._middle - 0.5
        self._has_gain, self._scale = with_gain, 1.0
        self._gain: NDArray[np.complex128] = np.ones(len(spectrum.power), dtype=np.complex128)
        if with_gain:
            self._gain, _ = fit(self._taps(spectrum.frequency_hz), self._wanted(self.fractions), spectrum.power)
        else:
            # Least squares shrink a single tap. All microphones share this error, so a larger variance is better.
            made = self._wrong(self.fractions) + self._wanted(self.fractions)
            shrunk = np.mean(made * np.conj(self._wanted(self.fractions)), axis=1).real
            self._scale = 1 / float(shrunk @ spectrum.power)
        wrong = self._wrong(self.fractions)
        self.errors, self.biases = np.var(wrong, axis=1), np.abs(np.mean(wrong, axis=1)) ** 2

    def errors_at(self, fractions: NDArray[np.float64], spectrum: Spectrum | None = None) -> NDArray[np.float64]:
        """Return the mean error power (wave,), with the shared error, at given fractions, or in another spectrum."""
        found = np.unique(np.round(fractions, 4))
        return np.asarray(np.mean(np.abs(self._wrong(found, spectrum)) ** 2, axis=1))

    @functools.cached_property
    def images(self) -> dict[int, NDArray[np.float64]]:
        """Share of the error, (wave,), in each image of the spectrum by its number."""
        # The error has the period of a step, so it consists of waves at distances of the rate of the stored samples.
        relative = self._wrong(self.fractions) * np.conj(self._wanted(self.fractions))
        power = np.abs(np.fft.fft(relative, axis=1)[:, _IMAGES]) ** 2
        total = np.maximum(power.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
        return dict(zip(_IMAGES, (power / total).T, strict=True))

    def _wrong(self, fractions: NDArray[np.float64], spectrum: Spectrum | None = None) -> NDArray[np.complex128]:
        """Return the error of unit waves: (wave, fraction)."""
        frequency_hz = (spectrum or self.spectrum).frequency_hz
        made = self.gain(frequency_hz)[:, None] * (self._taps(frequency_hz) @ self.weights(fractions).T)
        return np.asarray(made - self._wave(frequency_hz, fractions))

    def split(self, delays_s: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the first stored sample that contributes to each delayed sample, and the delay after it, in steps."""
        steps = delays_s / self.step_s
        nearest = np.rint(steps) if self.n_taps % 2 else np.floor(steps)
        first = nearest - (self.n_taps - 1) // 2
        return first.astype(np.int64), steps - first

    def weights(self, fractions: NDArray[np.float64], kernels: SteeringKernels | None = None) -> NDArray[np.complex128]:
        """Return the weights (..., tap) for fractions of `split`; kernels share the computation among threads."""
        places = 2 * (fractions - self._middle)
        if kernels is None:
            found = chebyshev.chebval(places, self._polynomials)
            return np.asarray(self._scale * np.ascontiguousarray(np.moveaxis(found, 0, -1)), np.complex128)
        made = np.empty((fractions.size, self.n_taps), np.complex128)
        kernels.sum_polynomials(two_columns(places.reshape(-1, 1)), self._short_polynomials, made.view(np.float64))
        return made.reshape(*fractions.shape, self.n_taps)

    @functools.cached_property
    def _polynomials(self) -> NDArray[np.complex128]:
        """Chebyshev coefficients of the weights over the fractions of one step: (degree, tap)."""
        # Those of a wave are Bessel functions of half the phase of a step.
        half_phase = math.pi * float(np.abs(self.spectrum.frequency_hz).max()) * self.step_s
        degree = math.ceil(1.5 * half_phase) + 20
        places = chebyshev.chebpts1(degree + 1)
        values = self._weights(self._middle + places / 2).T
        return np.asarray(np.linalg.solve(chebyshev.chebvander(places, degree), values))

    @functools.cached_property
    def _short_polynomials(self) -> NDArray[np.float64]:
        """Coefficients of the scaled weights for kernels: (degree, 1, 2 · tap) float64, real and imaginary parts."""
        return without_small((self._scale * self._polynomials).view(np.float64)[:, None])

    def _weights(self, fractions: NDArray[np.float64]) -> NDArray[np.complex128]:
        taps = self._taps(self.spectrum.frequency_hz)
        return weights_of(self._gain, taps, self._wanted(fractions), self.spectrum.power)

    def gain(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gain that complements the weights: (frequency,) complex128."""
        if not self._has_gain:
            return np.ones(len(frequency_hz), dtype=np.complex128)
        made = self._taps(frequency_hz) @ self.weights(self.fractions).T
        wanted = self._wave(frequency_hz, self.fractions)
        return gain_of(made, wanted)

    def _taps(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        return self._wave(frequency_hz, np.arange(self.n_taps, dtype=np.float64))

    def _wanted(self, fractions: NDArray[np.float64]) -> NDArray[np.complex128]:
        return self._wave(self.spectrum.frequency_hz, fractions)

    def _wave(self, frequency_hz: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(np.exp(2j * math.pi * self.step_s * np.outer(frequency_hz, steps)))
