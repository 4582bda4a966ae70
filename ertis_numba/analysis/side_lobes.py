"""Side lobes of reflectors in an image: predicted for an array as designed, bounded for a real array."""

import math
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.point_spread import PULSE_M, PointSpread, spread_of
from ertis_numba.frames import Energyscape

Floats = NDArray[np.float64]

__all__ = ["SIDE_LOBE_DB", "EdgeFloor", "SideLobes", "side_lobe_floor", "without_side_lobes"]

SIDE_LOBE_DB = 10.0
"""Level in dB below the strongest direction of the same range at which side lobes are expected.

The side lobes of eRTIS_v3D1 at 25–50 kHz reach -12.3 dB. At ranges that differ by `point_spread.PULSE_M`, they reach
-28 dB.
"""

_STEEPNESS: Final = 14  # Further dB per dB below the floor of side lobes in pictures.
_MARGIN: Final = 10 ** (3.0 / 20)  # Factor by which a reflector must exceed predicted side lobes of stronger ones.
_FALSE_ALARM: Final = 0.01
_N_DIRECTIONS: Final = 64  # Number of directions in which the prediction and the image are compared.
_N_COMPARED: Final = 8  # Number of reflectors that serve to assess the prediction.
# Deviations relative to the mean side lobe. Below the first, the prediction is trusted; above the second, it is not.
_TRUSTED: Final = (0.25, 0.4)
_OWN: Final = 0.7  # Share of a reflector's level that it must have by comparison with its side lobes.
_LEAST_OWN: Final = 0.1
# Deviations of a pulse from that of one echo, relative to its maximum. Below the first, it is one echo. Above the
# second, its side lobes are those of several.
_ONE_ECHO: Final = (0.1, 0.25)
_SHARE: Final = 0.25  # Share of the ranges that count as near an edge, at most, for large arrays.
_SKIRT_M: Final = 2.5 * PULSE_M
_OPEN: Final = 0.65  # Amplitude of a pulse at an edge, above which its maximum may lie beyond the edge.
_SKIRT: Final = 0.18  # Amplitude at an edge relative to a maximum near it, above which both may be parts of one skirt.
_LEAST_DIRECTIONS: Final = 8
_N_OFFSETS: Final = 9  # Number of range offsets with a tabulated mean of the side lobes.
# Upper quartiles of the magnitude of a complex normal variable of power 1, and of the magnitude of one component. The
# main lobes of reflectors cover less than a quarter of the directions, so upper quartiles ignore them.
_QUARTILE: Final = 0.75
_QUARTILE_OF_MAGNITUDE: Final = math.sqrt(math.log(4))
_QUARTILE_OF_COMPONENT: Final = 0.8134


class SideLobes:
    """Classifier of the maxima of an image, strongest first: reflectors, or possible side lobes of stronger ones.

    `PointSpread` predicts side lobes for an array as designed. The limit adds a possible deviation, a sum of many
    phasors: in N directions, it stays below ``σ √ln(N / p)`` with a probability of 1 - p (J. W. Goodman, Speckle
    Phenomena in Optics, 2nd edition, chapter 3). σ is measured at the same range, and is 0 if the pattern around the
    reflector that fits best matches. A maximum must exceed the limit by ``noise`` as well, the amplitude that noise
    alone reaches.
    """

    def __init__(
        self, image: Energyscape, directions: NDArray[np.float64], candidates: NDArray[np.int64], *, noise: float = 0.0
    ) -> None:
        self._noise, self._directions = noise, directions
        self._image, self._spread = image, spread_of(image.settings)
        count = len(directions)
        self._samples = np.unique(np.linspace(0, count - 1, min(count, _N_DIRECTIONS)).astype(np.int64))
        self._sampled = directions[self._samples]
        self._factor = math.sqrt(math.log(count / _FALSE_ALARM))
        self._is_focused = image.settings.processing.wavefront == "spherical"
        self._offsets_m = np.linspace(0.0, self._spread.skirt_m, _N_OFFSETS)
        self._mean = np.zeros(_N_OFFSETS)  # Mean side lobes of a reflector of amplitude 1, for each range offset.
        self._sources: list[tuple[NDArray[np.float64], float, float]] = []
        self._doubts: list[float] = []  # Uncertainty of the pattern of each source.
        self._deviations: dict[int, float] = {}  # The keys are range bins.
        self._doubt = self._doubt_of(directions, candidates)

    @property
    def reach_m(self) -> float:
        """Range offset in metres beyond which reflectors have no side lobes."""
        return self._spread.skirt_m

    def add(self, direction: NDArray[np.float64], range_m: float, amplitude: float) -> None:
        """Add a reflector. Reflectors must be added in descending order of amplitude."""
        if not self._sources:
            self._mean = self._mean_around(direction)
        self._sources.append((direction, range_m, amplitude))
        self._doubts.append(max(self._doubt, _MARGIN * self._doubt_of_pulse(direction, range_m)))
        self._deviations.clear()

    def explain(self, direction: NDArray[np.float64], range_bin: int, level: float) -> bool:
        """Return True if a maximum may be a side lobe of the reflectors added so far."""
        range_m = float(self._image.range_m[range_bin])
        near = [
            (*source, doubt)
            for source, doubt in zip(self._sources, self._doubts, strict=True)
            if abs(range_m - source[1]) < self._spread.skirt_m
        ]
        if not near:
            return False
        sources, ranges_m, amplitudes, doubts = (np.array(each) for each in zip(*near, strict=True))
        offsets_m = range_m - ranges_m
        places = np.broadcast_to(direction, sources.shape), np.full(len(near), range_m)
        predicted = float(amplitudes @ self._spread.of_echo(*places, sources, ranges_m, is_focused=self._is_focused))
        level -= self._noise
        if level <= _MARGIN * predicted:
            return True
        # Echoes of real surfaces are longer than the pulse.
        means = doubts * amplitudes * np.interp(np.abs(offsets_m) - PULSE_M, self._offsets_m, self._mean)
        largest = self._factor * math.hypot(*means)
        deviation = max(1.0, doubts.max()) * self._factor * self._deviation(range_bin)
        return bool(level <= predicted + min(largest, deviation))

    def _doubt_of_pulse(self, direction: NDArray[np.float64], range_m: float) -> float:
        """Return the uncertainty of the pattern of a reflector, from 0 to 1, by the shape of its pulse."""
        offsets_m = self._image.range_m - range_m
        near = np.flatnonzero(np.abs(offsets_m) < 2 * PULSE_M)
        if len(near) < 3 or self._image.settings.processing.is_adaptive:
            return 0.0
        pulse = self._spread(np.zeros((len(near), 3)), np.abs(offsets_m[near]))
        column = int(np.argmax(self._directions @ direction))
        measured = self._image.amplitude[column, near].astype(np.float64)
        scale = float(measured @ pulse / (pulse @ pulse))
        apart = float(np.abs(measured - scale * pulse).max()) - self._noise
        low, high = _ONE_ECHO
        return min(1.0, max(0.0, (apart / scale - low) / (high - low))) if scale > 0 else 0.0

    def _doubt_of(self, directions: NDArray[np.float64], candidates: NDArray[np.int64]) -> float:
        """Return the uncertainty of the side-lobe pattern, from 0 to 1, at the reflector whose pattern fits best."""
        if self._image.settings.processing.is_adaptive:
            return 0.0
        ratios: list[float] = []
        ranges_m: list[float] = []
        for direction, range_bin in candidates:
            range_m = float(self._image.range_m[range_bin])
            if any(abs(range_m - other_m) < self._spread.reach_m for other_m in ranges_m):
                continue
            ranges_m.append(range_m)
            amplitude = float(self._image.amplitude[direction, range_bin])
            levels = amplitude * self._spread(self._sampled - directions[direction], np.zeros(len(self._samples)))
            measured = self._image.amplitude[self._samples, range_bin]
            mean = float(np.quantile(levels, _QUARTILE)) / _QUARTILE_OF_MAGNITUDE
            ratios.append(_deviation_of(measured, levels) / mean)
            if len(ratios) == _N_COMPARED:
                break
        low, high = _TRUSTED
        return min(1.0, max(0.0, (min(ratios, default=high) - low) / (high - low)))

    def _deviation(self, range_bin: int) -> float:
        """Return the standard deviation of the image from the prediction at a range."""
        if range_bin not in self._deviations:
            n_samples = len(self._samples)
            sources, ranges_m, amplitudes = (np.array(each) for each in zip(*self._sources, strict=True))
            range_m = float(self._image.range_m[range_bin])
            near = np.abs(range_m - ranges_m) < self._spread.skirt_m
            sources, ranges_m, amplitudes = sources[near], ranges_m[near], amplitudes[near]
            levels = self._spread.of_echo(
                np.tile(self._sampled, (len(sources), 1)),
                np.full(len(sources) * n_samples, range_m),
                np.repeat(sources, n_samples, axis=0),
                np.repeat(ranges_m, n_samples),
                is_focused=self._is_focused,
            ).reshape(-1, n_samples)
            predicted = np.sqrt(((amplitudes[:, None] * levels) ** 2).sum(axis=0))
            measured = self._image.amplitude[self._samples, range_bin]
            self._deviations[range_bin] = _deviation_of(measured, predicted)
        return self._deviations[range_bin]

    def _mean_around(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the root mean square of the side lobes of a reflector of amplitude 1: (offset,) float64."""
        n_samples = len(self._samples)
        offsets = np.repeat(self._sampled - direction, _N_OFFSETS, axis=0)
        levels = self._spread(offsets, np.tile(self._offsets_m, n_samples)).reshape(n_samples, _N_OFFSETS)
        return np.asarray(np.quantile(levels, _QUARTILE, axis=0) / _QUARTILE_OF_MAGNITUDE)


def _deviation_of(measured: NDArray[np.float32], predicted: NDArray[np.float64]) -> float:
    """Return the standard deviation between complex amplitudes, estimated from their magnitudes."""
    return float(np.quantile(np.abs(measured - predicted), _QUARTILE)) / _QUARTILE_OF_COMPONENT


class EdgeFloor:
    """Amplitudes below which maxima near the first or the last range may belong to an echo beyond it.

    Side lobes of such an echo extend into the image by `PointSpread.reach_m`, and the skirt of its pulse in all
    directions. A reflector must exceed the level that its own side lobes would have by comparison with the image, and
    its pulse must fall towards the edge.
    """

    def __init__(self, directions: NDArray[np.float64], spread: PointSpread) -> None:
        count = len(directions)
        self._samples = np.unique(np.linspace(0, count - 1, min(count, _N_DIRECTIONS)).astype(np.int64))
        middle = directions[np.argmax(directions @ directions.mean(axis=0))]
        own = spread(directions[self._samples] - middle, np.zeros(len(self._samples)))
        self._own, self._spread = float(np.quantile(own, _QUARTILE)), spread
        self._known: tuple[Floats, NDArray[np.intp], list[_Skirt]] | None = None

    def __call__(self, image: Energyscape) -> NDArray[np.float32]:
        """Return the amplitudes: (range,) float32; 0 far from both edges."""
        floor = np.zeros(len(image.range_m), np.float32)
        if len(floor) < 3 or len(self._samples) < _LEAST_DIRECTIONS:
            return floor
        known = self._known
        if known is None or not np.array_equal(known[0], image.range_m):
            known = self._known = image.range_m, *self._edges(image.range_m)
        _, places, skirts = known
        level = _upper_quartile(image.amplitude[np.ix_(self._samples, places)])
        floor[places] = level * min(_OWN / self._own, 1 / _LEAST_OWN)
        for skirt in skirts:
            skirt.raise_floor(floor[skirt.inwards], image.amplitude[:, skirt.inwards])
        return floor

    def _edges(self, range_m: Floats) -> "tuple[NDArray[np.intp], list[_Skirt]]":
        """Return the ranges near the edges, and the skirts of pulses beyond each edge."""
        reach_m = min(self._spread.reach_m, _SHARE * float(range_m[-1] - range_m[0]))
        before = range_m[0] > range_m[1] - range_m[0]  # Nothing is nearer than range 0.
        ends = (before & (range_m - range_m[0] < reach_m)) | (range_m[-1] - range_m < reach_m)
        directions = (slice(None), slice(None, None, -1))[0 if before else 1 :]
        skirts = [_Skirt.of(self._spread, np.abs(range_m - range_m[each][0])[each], each) for each in directions]
        return np.flatnonzero(ends), skirts


class _Skirt(NamedTuple):
    """Pulse of an echo beyond an edge of an image, whose ranges are (range,) ``inwards``."""

    inwards: slice
    is_open: NDArray[np.bool_]
    last: NDArray[np.intp]
    share: NDArray[np.float32]

    @classmethod
    def of(cls, spread: PointSpread, offset_m: Floats, inwards: slice) -> "_Skirt":
        """Return the skirt at distances from an edge."""
        near = int(np.count_nonzero(offset_m < _SKIRT_M))
        pulse = spread(np.zeros((near, 3)), offset_m[:near])
        width = int(np.argmax(pulse < _SKIRT)) or near
        envelope = np.maximum.accumulate(pulse[::-1])[::-1]
        places = np.arange(near)
        last = (places - width).clip(0, width)  # Between these bins and the edge, there is at most a skirt.
        share = _MARGIN * np.maximum(envelope[places - last], _SKIRT)
        return cls(inwards, pulse > _OPEN, last, share.astype(np.float32))

    def raise_floor(self, floor: NDArray[np.float32], amplitude: NDArray[np.float32]) -> None:
        """Raise a floor near the edge, unless amplitudes fall towards it as the pulse of a reflector does."""
        near = len(self.last)
        skirt = np.maximum.accumulate(amplitude[:, :near].max(axis=0))[self.last] / self.share
        floor[:near] = np.where(self.is_open, np.inf, np.maximum(floor[:near], skirt))


def _upper_quartile(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the upper quartile of each column; `numpy.quantile` takes five times as long."""
    place = _QUARTILE * (len(values) - 1)
    before = int(place)
    low, high = np.sort(values, axis=0)[before : before + 2]
    return np.asarray(low + np.float32(place - before) * (high - low))


def side_lobe_floor(
    highest: NDArray[np.float32], range_m: NDArray[np.float64], noise: float = 0.0
) -> NDArray[np.float32]:
    """Return the amplitude (range,) below which side lobes are expected, coarser than `SideLobes`, but fast."""
    # It lies `SIDE_LOBE_DB` below the strongest amplitude of all ranges within a pulse; the power of `noise` adds to
    # it.
    reach = max(1, round(PULSE_M / float(range_m[1] - range_m[0])))
    around = scipy.ndimage.maximum_filter1d(highest, 2 * reach + 1, mode="nearest")
    floor = np.hypot(around * np.float32(10 ** (-SIDE_LOBE_DB / 20)), np.float32(noise))
    return np.asarray(np.minimum(floor, around))


def without_side_lobes(image: Energyscape) -> Energyscape:
    """Return a copy of an image in which amplitudes below `side_lobe_floor` are much weaker, for pictures."""
    if len(image.range_m) < 2:
        return image
    floor = side_lobe_floor(image.amplitude.max(axis=0, initial=0.0), image.range_m)
    share = np.divide(image.amplitude, floor, out=np.ones_like(image.amplitude), where=floor > 0)
    return image.replace(amplitude=image.amplitude * np.minimum(share, 1) ** _STEEPNESS)
