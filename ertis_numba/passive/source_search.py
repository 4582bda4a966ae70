"""Search for the sources of one band of a cross-spectral matrix."""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.cross_spectrum import CrossSpectrum
from ertis_numba.passive.detection_law import LAGS, chance_of_phases, exceedance, independent_samples
from ertis_numba.passive.direction_errors import covariance_of, powers_in_noise
from ertis_numba.passive.heard_band import HeardBand
from ertis_numba.passive.likelihood import BandLikelihood, moved
from ertis_numba.passive.model_errors import beside_others, beside_sources
from ertis_numba.passive.noise_model import NoiseFluctuations, NoiseModel
from ertis_numba.passive.scan_extent import ScanExtent, ScanMesh
from ertis_numba.passive.wave_delays import WaveDelays

__all__ = ["BandSearch", "FoundSource", "Scan"]

Floats = NDArray[np.float64]
Matrices = NDArray[np.complex128]

_NONE: Final = np.zeros((0, 3))
_BLIND: Final = 0.3  # Size of a wave outside of other sources, relative to its whole, below which it is theirs.
_SHARE_STEPS: Final = 10  # Per decade of white noise. Between steps, extents change by a few hundredths.
_CANDIDATES: Final = 16  # Maxima between directions of the scan that are compared, …
_STARTS: Final = 3  # … and those from which the most likely direction is searched.
_MAY_BE_LOUDEST: Final = 0.5  # Share of the power of a start, relative to the largest.
_BINS_OF_TONE: Final = 2.2  # Bins over which a Hann window spreads a tone.
_LEAST: Final = 1e-30
_SWEEPS: Final = 2  # Corrections of all sources after each new one.
_OWN: Final = 0.75  # Largest distance of sound from the centre of its bin, in spacings of bins.
_WITHIN_NOISE: Final = 4.5  # Log-likelihood below its maximum: three standard deviations of a direction.
_ARRAY_ERROR_RAD: Final = math.radians(0.4)  # Two standard deviations, as in `BearingTracker`.
_AROUND: Final = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
_DIAGONAL: Final = np.array([(1.0, 1.0), (-1.0, 1.0)])
_MAX_EXCESS: Final = 10**0.1  # Power of all sources relative to that of the band: 1 dB for errors of estimates.


class Scan(NamedTuple):
    """Directions that are searched, as unit vectors."""

    directions: Floats
    mesh: ScanMesh
    reach_rad: float  # largest distance from one of the directions to a maximum
    level: bool  # all have one elevation, which maxima then keep


class FoundSource(NamedTuple):
    """Source in a band, with the covariance of its direction's errors sideways and upwards."""

    direction: Floats  # unit vector
    power: float  # mean square in the band, without noise
    ratio: float  # power relative to the noise of a microphone
    covariance_rad2: Floats  # (2, 2), infinite where not resolved
    may_be_crosstalk: bool  # a signal equal at all microphones fits as well
    may_be_interference: bool = False  # random phases fit as well more often than the requested false alarms


class BandSearch:
    """Search for the sources of one band, in bins of which shares lie within the band."""

    # `delays` returns those from unit vectors, (direction, mic), and `steer` the power of matrices (bin, mic, mic).

    def __init__(
        self,
        scan: Scan,
        frequency_hz: Floats,
        shares: Floats,
        noise: NoiseModel,
        delays: WaveDelays,
        steer: Callable[[NDArray[np.complex64]], NDArray[np.float32]],
    ) -> None:
        self._scan, self._noise, self._delays, self._steer = scan, noise, delays, steer
        self._shares, self._weights = shares, shares / shares.sum()
        self._omega = 2 * np.pi * frequency_hz
        self._spacing_hz = float(frequency_hz[1] - frequency_hz[0]) if len(frequency_hz) > 1 else 0.0
        self._laws: dict[int, tuple[ScanExtent, NDArray[np.float64]]] = {}

    def __call__(self, heard: CrossSpectrum, *, false_alarm: float, top: int, least: float) -> list[FoundSource]:
        """Return up to ``top`` sources above noise, whose powers are at least ``least`` times the strongest.

        Noise alone yields a source with the probability ``false_alarm``.
        """
        places, n_mics = np.zeros((0, 3)), heard.matrix.shape[1]
        band = HeardBand.of(heard, places, self._shares, self._delays) if _has_power(heard) else None
        while band is not None and len(places) < min(top, n_mics - 1):
            likelihood, share = self._likelihood(band, places)
            rest, error = beside_sources(likelihood, places, band.omegas, band, band.omega)
            place = self._place(rest, likelihood)
            limits = {"false_alarm": false_alarm, "least": least}
            if not self._is_found(place, rest, likelihood, band, share, places, error=error, **limits):
                break
            more = np.concatenate([places, place[None]])
            next_band = HeardBand.of(heard, more, band.shares, self._delays)
            if next_band is None or next_band.is_beyond:
                break
            likelihood, share = self._likelihood(next_band, more)
            rest, error = beside_sources(
                likelihood, places, next_band.omegas[:, :-1], next_band, next_band.omegas[:, -1]
            )
            if (next_band.shares < band.shares).any() and not self._is_found(
                place, rest, likelihood, next_band, share, places, error=error, **limits
            ):  # It is sound beyond the band, which the window spreads.
                band = HeardBand.of(heard, places, next_band.shares, self._delays)
                continue
            more = self._corrected(likelihood, more, next_band)
            if not self._is_possible(likelihood, more, next_band, least=least):
                break
            places, band = more, next_band
        if band is None or not len(places):
            return []
        likelihood, _ = self._likelihood(band, places)
        sources = [self._source(likelihood, places, k, band) for k in range(len(places))]
        certain: list[int] = []
        for k in sorted(range(len(sources)), key=lambda k: -sources[k].power):
            if self._chance_of_phases(places, k, certain, band) > false_alarm:
                sources[k] = sources[k]._replace(may_be_interference=True)
            else:
                certain.append(k)
        strongest = max((source.power for source in sources), default=0.0)
        return [source for source in sources if source.power >= least * strongest]

    def _is_possible(self, likelihood: BandLikelihood, places: Floats, band: HeardBand, *, least: float) -> bool:
        """Return False if corrected sources lie too close together to be separated, or exceed the sound of the band."""
        for k, place in enumerate(places):
            beside = beside_others(likelihood, places, k, band)
            size, whole = (band.weights @ each.beams(place[None])[1] for each in (beside, beside.beside(_NONE)))
            if size < _BLIND * whole:
                return False
        powers = np.maximum(band.shares @ (likelihood.separated(places, band.omegas)[0] * band.level[:, None]), 0)
        is_heard = powers[-1] > 0 and powers[-1] >= least * powers.max()
        waves = likelihood.unwhitened_waves(places, band.omegas)
        beams = (waves.conj() * (band.matrix @ waves)).sum(axis=1).real / waves.shape[1] ** 2
        is_in_map = powers <= _MAX_EXCESS * (band.shares @ (beams * band.level[:, None]))
        return bool(is_heard and is_in_map.all() and powers.sum() <= _MAX_EXCESS * (band.shares @ band.level))

    def _place(self, rest: BandLikelihood, whole: BandLikelihood) -> Floats:
        """Return the most likely direction of a further source."""
        scan, loudest = self._scan, self._loudest(rest, whole)
        around = scan.reach_rad * np.concatenate([[(0.0, 0.0)], _AROUND / 3, _AROUND @ _DIAGONAL / 3])
        near = np.stack([moved(each, around, level=scan.level) for each in loudest])
        powers = rest.relative_power(near.reshape(-1, 3)).reshape(near.shape[:2])
        starts = [near[k, powers[k].argmax()] for k in np.argsort(-powers.max(axis=1))[:_STARTS]]
        tops = [rest.maximum(each, reach_rad=scan.reach_rad, level=scan.level) for each in starts]
        return tops[int(rest.relative_power(np.array(tops)).argmax())]

    def _is_found(
        self,
        place: Floats,
        rest: BandLikelihood,
        whole: BandLikelihood,
        band: HeardBand,
        diffuse: float,
        places: Floats,
        *,
        error: float,
        false_alarm: float,
        least: float,
    ) -> bool:
        """Return False if noise or errors of the known sources may cause a further source."""
        share = (float(rest.relative_power(place[None])[0]) - error) / rest.dimensions
        chance = self._chance(share, place, rest, whole, band, diffuse, places)
        known = band.weights @ whole.separated(places, band.omegas[:, : len(places)])[0] if len(places) else np.zeros(0)
        strongest = max(0.0, known.max(initial=0.0))
        power = float(band.weights @ powers_in_noise(rest, place)[0])
        size, whole_size = (float(band.weights @ each.beams(place[None])[1][:, 0]) for each in (rest, whole))
        return chance <= false_alarm and power >= least * strongest and size >= _BLIND * whole_size

    def _chance(
        self,
        share: float,
        place: Floats,
        rest: BandLikelihood,
        whole: BandLikelihood,
        band: HeardBand,
        diffuse: float,
        places: Floats,
    ) -> float:
        """Return the probability that noise as it is heard outside of a direction and of known sources has a share."""
        extent, similarity = self._of_noise(diffuse)
        of_white = independent_samples(band.weights, band.n_blocks, similarity)
        omegas = np.append(band.omegas[:, : len(places)], rest.omega[:, None], axis=1)
        beside = whole.beside(
            np.concatenate([places, place[None]]), omegas, others_orders=(*rest.others_orders, (0, 0))
        )
        outside = beside.projection
        if self._scan.level:  # The source may be above or below.
            loudest = np.linalg.eigh(beside.rest)[1][:, :, -1:]
            outside = outside - loudest @ loudest.conj().transpose(0, 2, 1)
        wave = rest.unwhitened_waves(place[None])
        noise = NoiseFluctuations.of(whole.matrix, outside, wave, band.weights, of_white)
        n_samples = noise.samples_at(share, rest.dimensions)
        return exceedance(share, n_samples=n_samples, n_dimensions=rest.dimensions, extent=extent)

    def _of_noise(self, share: float) -> tuple[ScanExtent, Floats]:
        """Return the extent of the scan, and the similarity of the beams of neighbouring bins."""
        step = round(-_SHARE_STEPS * math.log10(1 - share))
        if step not in self._laws:
            omega = math.sqrt(float(self._weights @ self._omega**2))
            nearest = int(np.abs(self._omega - omega).argmin())
            whitening = self._noise.whitening(1 - 10 ** (-step / _SHARE_STEPS))[nearest] if step else None
            mesh, spacing = self._scan.mesh, float(self._omega[1] - self._omega[0]) if len(self._omega) > 1 else 0.0
            self._laws[step] = mesh.extent(omega, whitening), mesh.similarity(omega, spacing, LAGS + 1, whitening)
        return self._laws[step]

    def _likelihood(self, band: HeardBand, places: Floats) -> tuple[BandLikelihood, float]:
        """Return the likelihood of sources in noise, and the diffuse share of the noise."""
        matrix = band.matrix
        plain = BandLikelihood(matrix, None, band.omega, band.weights, self._delays, curvatures=self._delays.curvatures)
        share = self._noise.diffuse_share(matrix, band.weights, _of_sources(plain, places, band.omegas))
        if not share:
            return plain, share
        whitening = self._noise.whitening(share)
        white = whitening @ matrix @ whitening.transpose(0, 2, 1)
        return BandLikelihood(
            white, whitening, band.omega, band.weights, self._delays, curvatures=self._delays.curvatures
        ), share

    def _corrected(self, likelihood: BandLikelihood, places: Floats, band: HeardBand) -> Floats:
        """Return the directions of sources that are most likely together."""
        places = places.copy()
        for _ in range(_SWEEPS if len(places) > 1 else 1):
            for k, place in enumerate(places):
                beside = beside_others(likelihood, places, k, band)
                places[k] = beside.maximum(place, reach_rad=self._scan.reach_rad, level=self._scan.level)
        return places

    def _loudest(self, rest: BandLikelihood, whole: BandLikelihood) -> Floats:
        """Return directions of the scan with the largest mean power relative to the noise, apart from each other."""
        every: Floats | NDArray[np.float32] = np.full((len(self._omega), 1), float(whole.dimensions))
        if whole.is_whitened:
            every = self._powers_of(whole, whole.projection)
        sizes = every if rest.dimensions == whole.dimensions else self._powers_of(whole, rest.projection)
        powers = self._powers_of(whole, rest.rest)
        ratio = np.where(sizes >= _BLIND * every, powers / np.maximum(sizes, _BLIND * every), 0)
        # Beams of bins with the sound of other bins point elsewhere.
        is_own = np.abs(rest.omega - self._omega) <= _OWN * 2 * np.pi * self._spacing_hz
        weights = np.where(is_own, rest.weights, 0) if (is_own & (rest.weights > 0)).any() else rest.weights
        shares, directions = (weights / rest.power) @ ratio, self._scan.directions
        found: list[int] = []
        least = _MAY_BE_LOUDEST * shares.max()
        while (len(found) < _CANDIDATES and shares.max() >= least > 0) or not found:
            found.append(int(shares.argmax()))
            shares[directions @ directions[found[-1]] > math.cos(self._scan.reach_rad)] = 0
        return directions[found]

    def _powers_of(self, whole: BandLikelihood, matrices: Matrices) -> NDArray[np.float32]:
        """Return the powers of matrices for the whitened wave from each direction: (bin, direction)."""
        return self._steer(whole.unwhitened(matrices).astype(np.complex64))

    def _source(self, likelihood: BandLikelihood, places: Floats, k: int, band: HeardBand) -> FoundSource:
        """Return one of the sources with its power and uncertainty."""
        powers, noise = powers_in_noise(beside_others(likelihood, places, k, band), places[k], band.width)
        ratio, power = float(band.weights @ (powers / noise)), float(band.shares @ (powers * band.level))
        covariance = covariance_of(likelihood, places, k, band, level=self._scan.level)
        may_be_crosstalk = self._may_be_crosstalk(beside_others(likelihood, places, k, band), places[k], band)
        return FoundSource(places[k], max(0.0, power), max(0.0, ratio), covariance, may_be_crosstalk)

    def _chance_of_phases(self, places: Floats, k: int, certain: list[int], band: HeardBand) -> float:
        """Return the probability that the sound of a source, with random phases, fits a direction as well."""
        plain = BandLikelihood(
            band.matrix, None, band.omega, band.weights, self._delays, curvatures=self._delays.curvatures
        )
        beside, n_mics = beside_others(plain, places, k, band), band.matrix.shape[1]
        powers = np.maximum(band.shares * band.level * powers_in_noise(beside, places[k], band.width)[0], 0)
        if not powers.any():
            return 1.0
        loudest = int(powers.argmax())
        values = np.linalg.eigvalsh(plain.beside(places[[*certain, k]], band.omegas[:, [*certain, k]]).rest[loudest])
        n = n_mics - len(certain) - 1
        values = values[-n:] if n else np.zeros(1)
        noise = values[:-1].mean() if n > 1 else 0.0
        n_samples = independent_samples(np.ones(1), band.n_blocks)
        hidden = noise * math.sqrt(2 / n_samples)
        misfit = max(float(values[-1] - noise * (1 + math.sqrt(n / n_samples)) ** 2), hidden)
        alone = plain.beside(places[certain], band.omegas[:, certain], band.omegas[:, k])
        beam = max(float(alone.beams(places[k : k + 1])[0][loudest, 0] - noise), 0.0)
        return chance_of_phases(
            beam / max(beam + misfit, _LEAST),
            n_bins=powers.sum() ** 2 / (powers @ powers) / _BINS_OF_TONE,
            n_mics=n_mics,
            extent=self._of_noise(0.0)[0],
        )

    def _may_be_crosstalk(self, beside: BandLikelihood, place: Floats, band: HeardBand) -> bool:
        """Return True if equal channels are as likely as a direction within its noise, or as errors of the array."""
        n_samples = independent_samples(band.weights, band.n_blocks)
        nearby = beside(moved(place, _ARRAY_ERROR_RAD * _AROUND, level=False))
        least = min(float(beside(place[None])[0]) - _WITHIN_NOISE / n_samples, float(nearby.min()))
        return beside.of_equal_channels() >= least


def _has_power(heard: CrossSpectrum) -> bool:
    return bool(np.trace(heard.matrix, axis1=1, axis2=2).real.all())


def _of_sources(plain: BandLikelihood, places: Floats, omegas: Floats) -> Matrices:
    """Return the waves of sources with their changes by frequency, if enough dimensions are left: (bin, mic, n)."""
    n_left = plain.dimensions // 2
    orders = [order for order in range(3) if (order + 1) * len(places) <= n_left] or [0]
    return np.concatenate([plain.waves(places, omegas, order=order) for order in orders], axis=2)
