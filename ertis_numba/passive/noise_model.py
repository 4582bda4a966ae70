"""Noise of microphones and of the surroundings: its removal from cross-spectral matrices, and its fluctuations."""

import math
from typing import Final, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.passive.detection_law import LAGS

__all__ = ["NoiseFluctuations", "NoiseModel"]

Floats = NDArray[np.float64]
Matrices = NDArray[np.complex128]

_MAX_DIFFUSE: Final = 0.999  # Some noise of the microphones remains, so that whitening stays finite.
_TINY: Final = 1e-30
_RESPONSE_BINS: Final = 3.5  # The response of a Hann window has 3e-5 of its power beyond.
_LEAST_SHARE: Final = 0.5  # Share of noise in a bin; with less, its remainder is that of a source.
_ERRORS: Final = 3.0  # Standard deviations of an estimate that show other noise than modelled.
_LARGER: Final = 1.3  # Least distance of eigenvalues from their mean, relative to that in white noise, of other noise.
_RESPONSE_POINTS: Final = 56  # An even number: the response at one bin is the limit of 0 / 0.


class NoiseModel:
    """Mixture of white noise of the microphones and of a diffuse field of sound.

    Its coherence is ``sin(k d) / (k d)`` (R. K. Cook et al., 1955), averaged over the response of the Hann window.
    """

    def __init__(
        self,
        positions_m: NDArray[np.float64],
        frequency_hz: NDArray[np.float64],
        *,
        spacing_hz: float,
        sound_speed_m_s: float,
    ) -> None:
        apart_s = np.linalg.norm(positions_m[:, None] - positions_m, axis=-1) / sound_speed_m_s
        offsets = np.linspace(-_RESPONSE_BINS, _RESPONSE_BINS, _RESPONSE_POINTS)
        response = (np.sinc(offsets) / (1 - offsets**2)) ** 2
        coherence = sum(
            share * np.sinc(2 * apart_s * (frequency_hz + offset * spacing_hz)[:, None, None])
            for share, offset in zip(response / response.sum(), offsets, strict=True)
        )
        values, self._modes = np.linalg.eigh(coherence)
        self._values = np.maximum(values, 0.0)

    def diffuse_share(
        self,
        matrix: NDArray[np.complex128],
        weights: NDArray[np.float64],
        sources: NDArray[np.complex128] | None = None,
    ) -> float:
        """Return the most likely share of the diffuse field, 0 to 1, outside of sources (bin, mic, n)."""
        modes: NDArray[np.complex128] = self._modes.astype(np.complex128)
        if sources is not None and sources.shape[2]:
            basis = np.linalg.qr(sources)[0]
            modes = modes - basis @ (basis.conj().transpose(0, 2, 1) @ modes)
        powers = np.maximum((modes.conj() * (matrix @ modes)).sum(axis=1).real, _TINY)
        products = self._modes.transpose(0, 2, 1) @ modes
        of_white = np.maximum(np.einsum("kmm->km", products).real, _TINY)
        of_diffuse = ((products.real**2 + products.imag**2) @ self._values[:, :, None])[:, :, 0]
        n_mics = powers.shape[1]

        def misfit(share: float) -> float:
            values = (1 - share) * of_white + share * of_diffuse
            terms = np.log(values).sum(axis=1) + n_mics * np.log((powers / values).sum(axis=1))
            return float(weights @ terms)

        found = scipy.optimize.minimize_scalar(
            misfit, bounds=(0.0, _MAX_DIFFUSE), method="bounded", options={"xatol": 1e-4}
        )
        return 0.0 if misfit(0.0) <= found.fun else float(found.x)

    def whitening(self, share: float) -> NDArray[np.float64]:
        """Return the symmetric matrices that make noise with a diffuse share white: (bin, mic, mic) float64."""
        values = 1 - share + share * self._values
        return np.asarray((self._modes / np.sqrt(values)[:, None]) @ self._modes.transpose(0, 2, 1))


class NoiseFluctuations(NamedTuple):
    """Fluctuations of the power that beams hear in the noise of a band."""

    # In noise of a part of the band or of a short time, and in tones, it is larger, as if there were fewer samples.

    n_samples: float  # of white noise with the same variance
    values: Floats  # eigenvalues of the mean matrix, with mean 1; empty as in white noise

    @classmethod
    def of(cls, matrix: Matrices, outside: Matrices, wave: Matrices, weights: Floats, of_white: float) -> Self:
        """Return fluctuations outside of sources; of_white is the number of samples in white noise."""
        # `outside` (bin, mic, mic) projects outside of the sources, and `wave` (bin, mic, 1) is that of the beam.
        n_mics, none = matrix.shape[1], np.zeros(0)
        n = round(float(np.trace(outside[0]).real))
        if n < 2:
            return cls(of_white, none)
        whole = np.trace(matrix, axis1=1, axis2=2).real
        power = np.maximum(np.einsum("bij,bji->b", outside, matrix).real, _LEAST_SHARE * whole)
        apart = outside @ (matrix * (1 - np.eye(n_mics))) @ outside  # Gains of microphones do not count.
        apart -= (np.trace(apart, axis1=1, axis2=2).real / n)[:, None, None] * outside
        apart *= wave.conj() * wave.transpose(0, 2, 1) * (weights / power)[:, None, None]
        rows = apart.reshape(len(apart), -1)
        products = (rows.conj() @ rows.T).real * (n + 1) / n
        # Only bins near each other are correlated in noise of a smooth spectrum.
        near, error = float(np.tril(np.triu(products, -LAGS), LAGS).sum()), math.sqrt(2 / (n * (n - 1)))
        variance = max(near, (1 - _ERRORS * error) * float(products.sum()), _TINY)
        of_bins = error * math.sqrt(min(1.0, float(weights @ weights) * variance / max(np.trace(products), _TINY)))
        n_samples = of_white if of_white * variance <= 1 + _ERRORS * of_bins else max(1.0, 1 / variance)
        values = np.linalg.eigvalsh(apart.sum(axis=0))
        values = 1 + n * values[np.argsort(np.abs(values))[-n:]]
        largest = (1 + math.sqrt(n / n_samples)) ** 2
        return cls(n_samples, values if values.max() - 1 > _LARGER * (largest - 1) else none)

    def samples_at(self, share: float, n_dimensions: int) -> float:
        """Return the number of white-noise samples whose beams exceed a share as often.

        In noise of a random orientation with the eigenvalues a, a beam has the share of ``Σ a |x|² / Σ |x|²`` with
        complex Gaussian x. This exceeds s with a probability of at most ``Π 1 / (1 − t (a − s))`` for any t (H.
        Chernoff, 1952).
        """
        level = share * n_dimensions
        highest = self.values.max(initial=0.0) - level
        if level <= 1 or highest <= 0 or share >= 1:
            return self.n_samples
        found = scipy.optimize.minimize_scalar(
            lambda t: -float(np.log1p(-t / highest * (self.values - level)).sum()), bounds=(0.0, 1.0), method="bounded"
        )
        rest = n_dimensions - 1
        of_one = -math.log(level) - rest * math.log((1 - share) * n_dimensions / rest)  # of one sample of white noise
        return min(self.n_samples, max(1.0, -float(found.fun) / of_one))
