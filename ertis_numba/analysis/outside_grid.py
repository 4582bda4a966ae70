"""Sound from directions that a grid does not contain, found by the pattern of its side lobes.

The powers of a single source over a grid are the pattern of its beam, which fits a source outside clearly better.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

__all__ = ["OutsidePatterns", "OutsideSource"]

Floats = NDArray[np.float64]

_SAMPLES: Final = 128  # Directions of the grid at which patterns are compared.
_MAX_PLACES: Final = 30_000  # Directions all around; arrays with narrower beams need more, and are not examined.
_PER_BEAM: Final = 2.5  # Steps of these directions within a wavelength divided by the size of the array.
_FLAT: Final = 0.05  # Extent of an array in periods, as a standard deviation, along an axis that it does not resolve.
_MIN_MATCH: Final = 0.6  # Share of the variance that the pattern of the source outside must explain.
_MUCH_BETTER: Final = 0.85  # Its unexplained share relative to that of the best source inside.
_MIN_DIRECTIONS: Final = 8
_LEAST_NORM: Final = 1e-6


class OutsideSource(NamedTuple):
    """Source outside of a grid: a unit vector, (axis,) float64, and its power."""

    direction: Floats
    power: float


@dataclass(frozen=True, slots=True, eq=False)
class OutsidePatterns:
    """Beam patterns (source, sample) of sources inside and outside of a grid, with a mean of 0 and a norm of 1."""

    samples: NDArray[np.int64]
    places: Floats
    outside: NDArray[np.float32]
    inside: NDArray[np.float32]
    norms: Floats

    @classmethod
    def of(
        cls,
        directions: Floats,
        delays: Callable[[Floats], Floats],
        frequency_hz: Floats,
        weights: Floats | None = None,
    ) -> "OutsidePatterns | None":
        """Return the patterns of an array, whose powers add up over frequencies; None if there are none to compare."""
        if len(directions) < _MIN_DIRECTIONS:
            return None
        highest_hz = float(frequency_hz.max())
        axes, across_s = _axes(delays, highest_hz)
        spacing_rad = float(np.median(KDTree(directions).query(directions, k=2)[0][:, 1]))
        step_rad = 1 / (_PER_BEAM * max(highest_hz * across_s, 1.0))
        is_planar = bool(np.ptp(directions[:, 2]) == 0)
        count = math.ceil(2 * math.pi / step_rad if is_planar else 4 * math.pi / step_rad**2)
        if not axes.size or count > _MAX_PLACES:
            return None
        every = _circle(count, float(directions[0, 2])) if is_planar else _sphere(count)
        if axes.shape[1] == 2:  # Directions behind a plane array equal those ahead.
            across = np.cross(axes[:, 0], axes[:, 1])
            every = every[every @ across * math.copysign(1.0, directions.mean(axis=0) @ across) >= 0]
        away, _ = KDTree(directions @ axes).query(every @ axes)
        is_outside = away > max(spacing_rad, step_rad / 2)
        places = every[is_outside]
        if not len(places):
            return None
        samples = np.unique(np.linspace(0, len(directions) - 1, min(len(directions), _SAMPLES)).astype(np.int64))
        towards_s = delays(directions[samples])
        inside, outside = (
            _patterns(delays(each), towards_s, frequency_hz, weights)
            for each in (np.concatenate([directions[samples], every[~is_outside]]), places)
        )
        inside, outside = (each - each.mean(axis=1, keepdims=True) for each in (inside, outside))
        norms = np.linalg.norm(outside, axis=1)
        inside /= np.maximum(np.linalg.norm(inside, axis=1, keepdims=True), _LEAST_NORM)
        norms = np.maximum(norms, _LEAST_NORM)
        outside /= norms[:, None]
        return cls(samples, places, outside.astype(np.float32), inside.astype(np.float32), norms)

    def source_of(self, values: Floats) -> OutsideSource | None:
        """Return the source outside that explains powers (sample,), or linear values; None if one inside may."""
        centred = values - values.mean()
        size = float(np.linalg.norm(centred))
        if size <= 0:
            return None
        unit = (centred / size).astype(np.float32)
        outside = self.outside @ unit
        best = int(outside.argmax())
        match, own = (max(float(each), 0.0) ** 2 for each in (outside[best], (self.inside @ unit).max()))
        if match < _MIN_MATCH or 1 - match > _MUCH_BETTER * (1 - own):
            return None
        return OutsideSource(self.places[best], float(outside[best]) * size / float(self.norms[best]))


def _axes(delays: Callable[[Floats], Floats], highest_hz: float) -> tuple[Floats, float]:
    """Return the axes along which an array distinguishes directions, (axis, used axis), and its size in seconds."""
    along_s = (delays(np.eye(3)) - delays(-np.eye(3))) / 2
    along_s -= along_s.mean(axis=1, keepdims=True)
    axes, sizes_s, _ = np.linalg.svd(along_s, full_matrices=False)
    is_used = highest_hz * sizes_s / math.sqrt(along_s.shape[1]) > _FLAT
    return axes[:, is_used], 2 * float(np.linalg.norm(along_s, axis=0).max())


def _patterns(of_sources_s: Floats, towards_s: Floats, frequency_hz: Floats, weights: Floats | None) -> Floats:
    """Return the powers of sources in directions: (source, direction) float64."""
    total = np.zeros((len(of_sources_s), len(towards_s)))
    shares = np.ones(len(frequency_hz)) if weights is None else weights
    for hz, share in zip(frequency_hz.tolist(), shares.tolist(), strict=True):
        sources, towards = (
            np.exp(2j * np.pi * hz * delay_s).astype(np.complex64) for delay_s in (of_sources_s, towards_s)
        )
        total += share * np.abs(sources @ towards.conj().T / towards_s.shape[1]) ** 2
    return np.asarray(total / shares.sum())


def _circle(count: int, height: float) -> Floats:
    """Return directions around the vertical axis at one height."""
    angle = 2 * np.pi * np.arange(count) / count
    radius = math.sqrt(max(0.0, 1 - height**2))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)


def _sphere(count: int) -> Floats:
    """Return evenly distributed directions."""
    height = 1 - (2 * np.arange(count) + 1) / count
    angle = math.pi * (3 - math.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
