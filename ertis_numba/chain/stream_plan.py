"""Streams of a plan: the delay-and-sums from which an adaptive beamformer is computed, and the errors of each.

docs/explanation/accuracy.md has the errors of DMAS by Newton's identities. Each stream gets the fewest taps and the
cheapest beam grid whose error is not above that of the first stream. Only the stream of the signals themselves may have
gains, see `interpolation_fit`.
"""

import functools
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import Aperture, BeamGrid
from ertis_numba.chain.interpolation_fit import DelayFit, Spectrum
from ertis_numba.chain.planned_streams import ErrorShares, ImageErrors, PlannedStream, PlannedStreams, StreamGrid
from ertis_numba.chain.stream_recipe import LINEAR, Recipe
from ertis_numba.chain.stream_spectrum import StreamSpectrum, highest_hz, pulse_errors, spectrum_of_stream
from ertis_numba.settings import Settings
from ertis_numba.settings.beamformers import SignalStream

__all__ = [
    "GRID_DENSITIES",
    "StreamPlanner",
]

_SMALL: Final = 1.0  # Error that another stream may add, relative to that of the first stream.
GRID_DENSITIES: Final = {
    2: (1.5, 2.0, 2.5, 3.0, 4.0),
    4: (1.25, 1.5, 1.75, 2.0, 2.5, 3.0),
    6: (1.75, 2.0, 2.5, 3.0),
}
"""Densities of beam grids that plans choose from, by the number of taps."""

_NOISE_RATIO: Final = 9.0  # Power of noise relative to that of echoes in the image of delay-and-sum.
_PEAKED: Final = 2.0  # Common errors rise with the fourth power of frequency, so that few sudden changes add much.
_KEPT: Final = 512  # Number of cached fits.
_CORRELATED: Final = 2  # The beam of the coherence factor and the first power sum have errors of the same samples.


class StreamPlanner:
    """Planner of the streams of one sensor and one image; ``nearest_m`` is the smallest distance of a reflector."""

    def __init__(
        self,
        settings: Settings,
        recipe: Recipe,
        spectrum: Spectrum,
        aperture: Aperture,
        *,
        sound_speed_m_s: float,
        nearest_m: float,
    ) -> None:
        self.recipe = recipe
        self._spectrum, self._aperture = spectrum, aperture
        self._call, self._rate_hz = settings.call, settings.output_rate_hz
        self._speed_m_s, self._nearest_m = sound_speed_m_s, nearest_m
        self._n_mics = len(aperture.positions_m)

    def plan(
        self, n_phases: int, n_taps: int, beam_taps: int, density: float, delays_s: NDArray[np.float64] | None = None
    ) -> PlannedStreams:
        """Return the streams of a plan; ``delays_s`` (delay,) are all delays if few do not spread over a step."""
        step_s = 1 / (self._rate_hz * n_phases)
        _, first = self._delays(0, n_taps, step_s, delays_s)
        errors, small, order = first, _SMALL * first.echoes, self.recipe.order
        n_powers = order
        while n_powers > 1 and (missed := self._missed(n_powers - 1)).echoes <= small:
            errors += missed
            n_powers -= 1
        streams: list[PlannedStream] = []
        first_grid = 0.0
        for place, stream in enumerate(self.recipe.streams):
            if n_powers <= place < order:
                continue
            fewest = n_taps if place == 0 else 1
            fits = (self._delays(place, few, step_s, delays_s) for few in range(fewest, n_taps + 1))
            fit, added = next(found for found in fits if found[1].echoes <= small or found[0].n_taps == n_taps)
            if place:
                errors += added
            high_hz = highest_hz(self._call.low_frequency_hz, self._call.high_frequency_hz, stream)
            spectrum, shares = self._spectrum_of(stream), self._shares(place)
            grid = None
            if beam_taps and self._aperture.supports_grid:
                limit = math.inf if place == 0 else _SMALL * (first.echoes + first_grid)
                grid = self._grid(
                    *(spectrum, shares, beam_taps, density, high_hz, limit),
                    n_delay_taps=fit.n_taps,
                    has_gain=stream == LINEAR,
                )
            first_grid = grid.errors.echoes if place == 0 and grid else first_grid
            streams.append(PlannedStream(stream, spectrum, fit, high_hz, grid, shares))
        return PlannedStreams(streams, n_powers, errors)

    def beam_grid(self, planned: PlannedStream) -> BeamGrid | None:
        """Return the beam grid of a stream."""
        if planned.grid is None:
            return None
        return BeamGrid(
            self._aperture,
            planned.spectrum.bright,
            n_taps=planned.grid.n_taps,
            density=planned.grid.density,
            high_hz=planned.high_hz,
            sound_speed_m_s=self._speed_m_s,
            with_gain=planned.stream == LINEAR,
        )

    def _grid(
        self,
        spectrum: StreamSpectrum,
        shares: ErrorShares,
        beam_taps: int,
        density: float,
        high_hz: float,
        limit: float,
        *,
        n_delay_taps: int,
        has_gain: bool,
    ) -> StreamGrid | None:
        """Return the cheapest beam grid with an error up to ``limit``; None if direct sums are cheaper."""
        open_grids = [(beam_taps, density)]
        if limit < math.inf:
            open_grids = [
                (n_taps, each)
                for n_taps in GRID_DENSITIES
                for each in (*(some for some in GRID_DENSITIES[n_taps] if some < density), density)
                if n_taps <= beam_taps
            ]
        counted = [(n_taps, each, self._count(n_taps, each, high_hz)) for n_taps, each in open_grids]
        for n_taps, each, n_points in sorted(counted, key=lambda grid: self._terms(grid[0], grid[2], n_delay_taps)):
            if self._terms(n_taps, n_points, n_delay_taps) >= self._terms(0, 0, n_delay_taps):
                return None
            whole, bright, squares = _grid_errors(
                *(self._aperture, spectrum, n_taps, each, high_hz, self._speed_m_s, self._nearest_m), with_gain=has_gain
            )
            # The errors of neighbouring microphones are alike, so that they do not average out without a gain, which
            # removes their mean, and only partly with it.
            common = bright * min(1.0, _PEAKED / math.sqrt(self._n_mics)) if has_gain else bright
            errors = shares.errors(whole=whole, varying=bright - common, common=common)
            if errors.echoes <= limit:
                n_pairs = n_taps**self._aperture.n_axes // 2
                return StreamGrid(n_taps, each, n_points, n_pairs, errors, squares)
        return None

    def _terms(self, beam_taps: int, n_points: int, n_delay_taps: int) -> int:
        """Return the number of terms at each range, with a beam grid or with 0 taps; pairs count as terms."""
        n_directions: int = len(self._aperture.directions)
        n_terms = self._n_mics * n_delay_taps
        if not beam_taps:
            return n_directions * n_terms
        return n_points * n_terms + n_directions * int(beam_taps**self._aperture.n_axes) // 2

    def _missed(self, place: int) -> ImageErrors:
        """Return the errors of images if a power sum is left out."""
        return self._shares(place).errors(whole=1.0, varying=0.0, common=1.0)

    def _count(self, beam_taps: int, density: float, high_hz: float) -> int:
        spacing = self._aperture.spacing(density, high_hz=high_hz, sound_speed_m_s=self._speed_m_s)
        return self._aperture.count_grid_points(spacing, beam_taps)

    def _spectrum_of(self, stream: SignalStream) -> StreamSpectrum:
        return spectrum_of_stream(self._spectrum, stream)

    def _delays(
        self, place: int, n_taps: int, step_s: float, delays_s: NDArray[np.float64] | None
    ) -> tuple[DelayFit, ImageErrors]:
        """Return the fit of a stream's delays, and the errors of images due to it."""
        bright, whole = self._spectrum_of(self.recipe.streams[place])
        fit = _fitted(bright, n_taps, step_s, with_gain=self.recipe.streams[place] == LINEAR)
        if delays_s is None:
            whole_error, varying, common = _fit_errors(fit, whole)
            common *= _PEAKED
            if self.recipe.streams[place] != LINEAR:
                pulse = pulse_errors(fit, self._spectrum, self.recipe.streams[place])
                varying, common = max(varying, pulse[0]), max(common, pulse[1])
        else:
            whole_error = varying = float(fit.errors_at(fit.split(delays_s)[1], whole) @ whole.power)
            common = _PEAKED * whole_error
        return fit, self._shares(place).errors(whole=whole_error, varying=varying, common=common)

    def _shares(self, place: int) -> ErrorShares:
        """Return the shares of a stream, for an image of noise that is half as bright as expected."""
        n_mics, order = self._n_mics, self.recipe.order
        weighted, noise_share = self.recipe.total >= 0, self._noise_share
        if place == self.recipe.total:
            return ErrorShares(2.0 / n_mics, 1.0 / n_mics, 1.0, noise_share)
        if place == self.recipe.beam and order > 1:
            return ErrorShares(4.0 * _CORRELATED / (order + 2), 4.0 / n_mics, 4.0, noise_share)
        k = place + 1
        ratio = math.comb(n_mics, order - k) / math.comb(n_mics, order)
        noise, coherent, common = n_mics / k**2 * ratio, n_mics / k**2 * ratio**2, (n_mics / k * ratio) ** 2
        if weighted and order == 1:  # the third power of the beam
            return ErrorShares(3 * noise, 9 * coherent, 9 * common, noise_share)
        raised = _CORRELATED if weighted and place == 0 else 1
        return ErrorShares(raised * noise, raised * coherent, raised * common, noise_share)

    @functools.cached_property
    def _noise_share(self) -> float:
        """Share of noise in the power of an image of echoes, from the mean power of Gaussian noise in each image."""
        n_mics, order = self._n_mics, self.recipe.order
        suppressed = n_mics * math.gamma(1 + 1 / order) ** order / math.comb(n_mics, order)
        if self.recipe.total >= 0:
            suppressed *= (order + 1) * (order + 2) / n_mics**2
        return _NOISE_RATIO * suppressed / (1 + _NOISE_RATIO * suppressed)


@functools.lru_cache(maxsize=_KEPT)
def _fitted(spectrum: Spectrum, n_taps: int, step_s: float, *, with_gain: bool) -> DelayFit:
    return DelayFit(n_taps, step_s, spectrum, with_gain=with_gain)


@functools.lru_cache(maxsize=_KEPT)
def _fit_errors(fit: DelayFit, whole: Spectrum) -> tuple[float, float, float]:
    """Return the error power of a fit for the whole spectrum, and its two parts where the image is bright."""
    power = fit.spectrum.power
    error = float(fit.errors_at(fit.fractions, whole) @ whole.power)
    return error, float(fit.errors @ power), float(fit.biases @ power)


@functools.lru_cache(maxsize=_KEPT)
def _grid_errors(
    aperture: Aperture,
    spectrum: StreamSpectrum,
    n_taps: int,
    density: float,
    high_hz: float,
    sound_speed_m_s: float,
    nearest_m: float,
    *,
    with_gain: bool,
) -> tuple[float, float, float]:
    """Return the error power of a beam grid for both spectra, and the sum of its squared weights."""
    both = np.concatenate([spectrum.bright.frequency_hz, spectrum.whole.frequency_hz])
    estimate = BeamGrid(
        aperture,
        spectrum.bright,
        n_taps=n_taps,
        density=density,
        high_hz=high_hz,
        sound_speed_m_s=sound_speed_m_s,
        estimate=True,
        nearest_m=nearest_m,
        with_gain=with_gain,
        judged_hz=both,
    )
    n_bright = len(spectrum.bright.power)
    bright = float(estimate.errors[:n_bright] @ spectrum.bright.power)
    return float(estimate.errors[n_bright:] @ spectrum.whole.power), bright, estimate.squares
