"""Search for the sources of one band of a cross-spectral matrix."""

import functools
import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.detection_law import LAGS, exceedance, independent_samples
from ertis_numba.passive.likelihood import BandLikelihood, Delays
from ertis_numba.passive.noise_model import NoiseModel
from ertis_numba.passive.scan_extent import ScanExtent, ScanMesh

__all__ = ["BandSearch", "FoundSource", "Scan"]

Floats = NDArray[np.float64]
Matrices = NDArray[np.complex128]

_BLIND: Final = 0.3  # Size of a wave outside of other sources, relative to its whole, below which it is theirs.
_FLAT: Final = 1e-9  # Information relative to the largest, below which a direction is not resolved.
_SHARE_STEPS: Final = 10  # Per decade of white noise. Between steps, extents change by a few hundredths.
_SWEEPS: Final = 2  # Corrections of all sources after each new one.
_MAX_EXCESS: Final = 10**0.1  # Power of all sources relative to that of the band: 1 dB for errors of estimates.


class Scan(NamedTuple):
    """Directions that are searched.

    Attributes
    ----------
    directions : (direction, axis) float64
        Unit vectors.
    mesh : ScanMesh
    reach_rad : float
        Largest distance from one of the directions to a maximum.
    level : bool
        True if all have one elevation, which maxima then keep.
    """

    directions: Floats
    mesh: ScanMesh
    reach_rad: float
    level: bool


class FoundSource(NamedTuple):
    """Source in a band.

    Attributes
    ----------
    direction : (axis,) float64
        Unit vector.
    power : float
        Mean square of its sound in the band, without noise.
    ratio : float
        This power relative to the noise of a microphone.
    covariance_rad2 : (2, 2) float64
        Covariance of the direction's errors sideways and upwards; infinite along directions that are not resolved.
    """

    direction: Floats
    power: float
    ratio: float
    covariance_rad2: Floats


class BandSearch:
    """Search for the sources of one band.

    Parameters
    ----------
    scan : Scan
    frequency_hz, shares : (bin,) float64
        Frequencies of the band's bins, and the share of each that lies within the band.
    noise : NoiseModel
        Noise at these frequencies.
    delays : callable
        Returns the delays of the sound from unit vectors, (direction, mic).
    steer : callable
        Returns the power of matrices, (bin, mic, mic) complex64, for the wave from each direction of the scan.
    """

    def __init__(
        self,
        scan: Scan,
        frequency_hz: Floats,
        shares: Floats,
        noise: NoiseModel,
        delays: Delays,
        steer: Callable[[NDArray[np.complex64]], NDArray[np.float32]],
    ) -> None:
        self._scan, self._noise, self._delays, self._steer = scan, noise, delays, steer
        self._shares, self._weights = shares, shares / shares.sum()
        self._omega = 2 * np.pi * frequency_hz
        self._laws: dict[int, tuple[ScanExtent, NDArray[np.float64]]] = {}

    def __call__(
        self, matrix: Matrices, n_blocks: int, *, false_alarm: float, top: int, least: float
    ) -> list[FoundSource]:
        """Return the sources of a matrix that noise does not explain.

        Parameters
        ----------
        matrix : (bin, mic, mic) complex128
            Cross-spectral matrix.
        n_blocks : int
            Number of blocks of which it is the mean.
        false_alarm : float
            Probability that noise alone yields a source.
        top : int
            Largest number of sources.
        least : float
            Least power relative to the strongest source.
        """
        level = np.trace(matrix, axis1=1, axis2=2).real / matrix.shape[1]
        if not level.all():
            return []
        scaled = matrix / level[:, None, None]
        n_samples = independent_samples(self._shares, n_blocks)
        places = np.zeros((0, 3))
        likelihood, share = self._likelihood(scaled, places)
        while len(places) < min(top, matrix.shape[1] - 1):
            extent, similarity = self._of_noise(share)
            n_beam_samples = independent_samples(self._shares, n_blocks, similarity)
            law = functools.partial(exceedance, n_samples=n_beam_samples, extent=extent)
            place = self._next(likelihood, places, law, false_alarm=false_alarm, least=least)
            if place is None:
                break
            more = np.concatenate([places, place[None]])
            next_likelihood, next_share = self._likelihood(scaled, more)
            more = self._corrected(next_likelihood, more)
            if not self._is_possible(next_likelihood, more, level, least=least):
                break
            places, likelihood, share = more, next_likelihood, next_share
        sources = [self._source(likelihood, places, k, level, n_samples) for k in range(len(places))]
        strongest = max((source.power for source in sources), default=0.0)
        return [source for source in sources if source.power >= least * strongest]

    def _is_possible(self, likelihood: BandLikelihood, places: Floats, level: Floats, *, least: float) -> bool:
        """Return False if corrected sources lie too close together to be separated, or exceed the sound of the band.

        The last of them, which is new, must also have its least power.
        """
        whole = likelihood.beams(places)[1]
        for k, place in enumerate(places):
            size = likelihood.beside(np.delete(places, k, axis=0)).beams(place[None])[1][:, 0]
            if self._weights @ size < _BLIND * (self._weights @ whole[:, k]):
                return False
        powers = np.maximum(self._shares @ (likelihood.separated(places)[0] * level[:, None]), 0)
        is_heard = powers[-1] > 0 and powers[-1] >= least * powers.max()
        return bool(is_heard and powers.sum() <= _MAX_EXCESS * (self._shares @ level))

    def _next(
        self, likelihood: BandLikelihood, places: Floats, law: Callable[..., float], *, false_alarm: float, least: float
    ) -> Floats | None:
        """Return the direction of a further source; None if noise or errors of the known sources may cause it."""
        rest = likelihood.beside(places)
        place = rest.maximum(self._loudest(rest, likelihood), reach_rad=self._scan.reach_rad, level=self._scan.level)
        share = float(rest.relative_power(place[None])[0]) / rest.dimensions
        chance = law(share, n_dimensions=rest.dimensions)
        known = self._weights @ likelihood.separated(places)[0] if len(places) else np.zeros(0)
        strongest = max(0.0, known.max(initial=0.0))
        power = float(self._weights @ _powers(rest, place)[0])
        size, whole = (float(self._weights @ each.beams(place[None])[1][:, 0]) for each in (rest, likelihood))
        is_source = chance <= false_alarm and power >= least * strongest and size >= _BLIND * whole
        return place if is_source else None

    def _of_noise(self, share: float) -> tuple[ScanExtent, Floats]:
        """Return the extent of the scan, and the similarity of the beams of neighbouring bins.

        Both are those of noise with a diffuse share, at the mean square frequency of the band.
        """
        step = round(-_SHARE_STEPS * math.log10(1 - share))
        if step not in self._laws:
            omega = math.sqrt(float(self._weights @ self._omega**2))
            nearest = int(np.abs(self._omega - omega).argmin())
            whitening = self._noise.whitening(1 - 10 ** (-step / _SHARE_STEPS))[nearest] if step else None
            mesh, spacing = self._scan.mesh, float(self._omega[1] - self._omega[0]) if len(self._omega) > 1 else 0.0
            self._laws[step] = mesh.extent(omega, whitening), mesh.similarity(omega, spacing, LAGS + 1, whitening)
        return self._laws[step]

    def _likelihood(self, matrix: Matrices, places: Floats) -> tuple[BandLikelihood, float]:
        """Return the likelihood of sources in noise, and the diffuse share of the noise."""
        plain, rest = BandLikelihood(matrix, None, self._omega, self._weights, self._delays), matrix
        if len(places):
            waves, powers = plain.waves(places), np.maximum(plain.separated(places)[0], 0)
            rest = matrix - (waves * powers[:, None]) @ waves.conj().transpose(0, 2, 1)
        share = self._noise.diffuse_share(rest, self._weights)
        if not share:
            return plain, share
        whitening = self._noise.whitening(share)
        white = whitening @ matrix @ whitening.transpose(0, 2, 1)
        return BandLikelihood(white, whitening, self._omega, self._weights, self._delays), share

    def _corrected(self, likelihood: BandLikelihood, places: Floats) -> Floats:
        """Return the directions of sources that are most likely together."""
        places = places.copy()
        for _ in range(_SWEEPS if len(places) > 1 else 1):
            for k, place in enumerate(places):
                beside = likelihood.beside(np.delete(places, k, axis=0))
                places[k] = beside.maximum(place, reach_rad=self._scan.reach_rad, level=self._scan.level)
        return places

    def _loudest(self, rest: BandLikelihood, whole: BandLikelihood) -> Floats:
        """Return the direction of the scan with the largest mean power relative to the noise."""
        every: Floats | NDArray[np.float32] = np.full((len(self._omega), 1), float(whole.dimensions))
        if whole.is_whitened:
            every = self._powers_of(whole, whole.projection)
        sizes = every if rest.dimensions == whole.dimensions else self._powers_of(whole, rest.projection)
        powers = self._powers_of(whole, rest.rest)
        ratio = np.where(sizes >= _BLIND * every, powers / np.maximum(sizes, _BLIND * every), 0)
        return np.asarray(self._scan.directions[int(((rest.weights / rest.power) @ ratio).argmax())])

    def _powers_of(self, whole: BandLikelihood, matrices: Matrices) -> NDArray[np.float32]:
        """Return the powers of matrices for the whitened wave from each direction: (bin, direction)."""
        return self._steer(whole.unwhitened(matrices).astype(np.complex64))

    def _source(
        self, likelihood: BandLikelihood, places: Floats, k: int, level: Floats, n_samples: float
    ) -> FoundSource:
        """Return one of the sources with its power and uncertainty."""
        place, others = places[k], np.delete(places, k, axis=0)
        powers, noise = _powers(likelihood.beside(others), place)
        ratio = max(0.0, float(self._weights @ (powers / noise)))
        information = n_samples * likelihood.information(place, others, ratio, level=self._scan.level)
        covariance = _inverse(information[:1, :1] if self._scan.level else information)
        return FoundSource(place, max(0.0, float(self._shares @ (powers * level))), ratio, covariance)


def _powers(beside: BandLikelihood, place: Floats) -> tuple[Floats, Floats]:
    """Return the power of a source without noise, and that of the noise in each dimension, both (bin,)."""
    powers, size = beside.beams(place[None])
    noise = (beside.power - powers[:, 0]) / max(beside.dimensions - 1, 1)
    return (powers[:, 0] - noise) / size[:, 0], noise


def _inverse(information: Floats) -> Floats:
    """Return the covariance (2, 2), infinite along directions without information; one row has a given elevation."""
    out = np.diag([math.inf, math.inf])
    n = len(information)
    values, vectors = np.linalg.eigh(information)
    if values[0] > _FLAT * values[-1]:
        out[:n, :n] = (vectors / values) @ vectors.T
    elif values[-1] > 0:
        seen = np.flatnonzero(np.abs(vectors[:, 0]) <= math.sqrt(_FLAT))
        out[seen, seen] = 1 / values[-1]
    return out
