"""Noise of microphones and of the surroundings, and its removal from cross-spectral matrices."""

from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["NoiseModel"]

_MAX_DIFFUSE: Final = 0.999  # Some noise of the microphones remains, so that whitening stays finite.
_TINY: Final = 1e-30
_RESPONSE_BINS: Final = 3.5  # The response of a Hann window has 3e-5 of its power beyond.
_RESPONSE_POINTS: Final = 56  # An even number: the response at one bin is the limit of 0 / 0.


class NoiseModel:
    """Mixture of white noise of the microphones and of a diffuse field of sound.

    The coherence of a diffuse field between microphones at a distance d is ``sin(k d) / (k d)`` (R. K. Cook et al.,
    Measurement of correlation coefficients in reverberant sound fields, 1955). A bin measures its mean over the
    frequency response of the Hann window, which is smaller: the blocks of distant microphones hear different parts of
    the sound.

    Parameters
    ----------
    positions_m : (mic, axis) float64
    frequency_hz : (bin,) float64
    spacing_hz : float
        Spacing of the bins of the blocks.
    sound_speed_m_s : float
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
        """Return the most likely share of the diffuse field, 0 to 1.

        Parameters
        ----------
        matrix : (bin, mic, mic) complex128
            Cross-spectral matrix.
        weights : (bin,) float64
            Number of samples of each bin.
        sources : (bin, mic, n) complex128, optional
            Waves of sources, outside of which there is noise alone.
        """
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
        """Return the matrices that make noise with a share of diffuse sound white: (bin, mode, mic) float64."""
        values = 1 - share + share * self._values
        return np.asarray(self._modes.transpose(0, 2, 1) / np.sqrt(values)[:, :, None])
