"""Comparison of the directions of a grid with the main lobe of the array."""

import functools
import math
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.array_response import ArrayAxes, CallResponse, Response
from ertis_numba.analysis.between_directions import Between, farthest_places
from ertis_numba.base.angles import DegreesFromRadians
from ertis_numba.geometry import direction_grid, microphones, named_grid, observable_angles, spacing_rad, unit_vectors
from ertis_numba.geometry.neighbours import Nearest
from ertis_numba.settings import Processing, Settings

__all__ = ["LARGEST_GRID", "MAX_LOSS_DB", "GridCheck", "Lobe", "Peak", "image_peak", "rounded_down", "spacing_warning"]

MAX_LOSS_DB: Final = 3.0
"""Largest loss of a source between the directions of a sufficient grid, in dB."""

LARGEST_GRID: Final = 200_000
"""Number of directions of the largest grid that warnings name, for its time and memory."""

Floats = NDArray[np.float64]
Peak = Callable[[Floats], Floats]

_MARGIN_DB: Final = 0.03  # The weakest source is searched, and the search may miss it by a little.
_NEAREST: Final = 6
_ABOVE: Final = 1.03  # Least amplitude of the weakest source relative to the highest side lobe …
_AS_STRONG: Final = 0.94  # … up to this one, -0.5 dB, which no grid tells from a source.
_GAP: Final = 3.0  # Gap between directions relative to their spacing, above which a list is irregular.
_STEP: Final = 1.12
_NARROWEST_RAD: Final = 1e-5
_ANGLES: Final = 1200
_FIRST_COUNT: Final = 4000  # Largest grid from which the size of a finer one is estimated.
_BELOW: Final = 0.94  # First size that is tried relative to the estimated one …
_MUCH_ABOVE: Final = 1.5  # … which counts as impossible above this many of the largest.
_MOST_DB: Final = 40.0
_LEAST: Final = 1e-9


class Lobe(NamedTuple):
    """Main lobe of an array at one frequency, or of a call, for one method."""

    response: Response
    peak: Peak
    max_loss_db: float = MAX_LOSS_DB

    def loss_db(self, amplitude: float) -> float:
        """Return the loss of a source with an amplitude of delay-and-sum, in dB."""
        return -20 * math.log10(max(float(self.peak(np.array([amplitude]))[0]), _LEAST))

    def is_loud(self, amplitude: float) -> bool:
        """Return True if a source with an amplitude of delay-and-sum loses little."""
        return self.loss_db(amplitude) <= self.max_loss_db - _MARGIN_DB

    def largest_rad(self, side_lobe: float) -> float:
        """Return the angle, along the longest axis of the array, at which a source is as weak as it may be."""
        away_rad = np.append(0.0, np.geomspace(_NARROWEST_RAD, math.pi / 2, _ANGLES))[:, None]
        along = self.response.axes.longest
        ahead = np.eye(3)[int(np.abs(along).argmin())]
        ahead = ahead - (ahead @ along) * along
        ahead /= np.linalg.norm(ahead)
        amplitude = self.response(
            np.cos(away_rad) * ahead + np.sin(away_rad) * along, np.repeat(ahead[None], len(away_rad), 0)
        )
        least = _ABOVE * side_lobe if side_lobe <= _AS_STRONG else 0.0
        loss_db = -20 * np.log10(np.maximum(self.peak(amplitude), _LEAST))
        is_weak = (loss_db > self.max_loss_db - _MARGIN_DB) | (amplitude < least)
        return float(away_rad[max(1, int(is_weak.argmax()) - 1), 0]) if is_weak.any() else math.pi / 2


class GridCheck:
    """Check of sources between the directions of a grid, which ``processing`` names, for lobes of one array."""

    def __init__(
        self, grid: DegreesFromRadians, processing: Processing, *, side_lobes: dict[Response, float] | None = None
    ) -> None:
        self._directions = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
        self.processing, self._between = processing, Between(self._directions, processing)
        self._farthest: tuple[Floats, NDArray[np.intp], float] | None = None
        self._side_lobes = {} if side_lobes is None else side_lobes
        self.is_single = not len(self._between.places)

    @classmethod
    def of(cls, processing: Processing) -> Self:
        """Return the check of the grid that settings name or list."""
        return cls(direction_grid(processing), processing)

    @functools.cached_property
    def spacing_rad(self) -> float:
        """Spacing of the directions in radians."""
        return spacing_rad(self._directions)

    def apart(self, lobe: Lobe) -> str:
        """Return the distance of the directions in words: the usual one, or the largest gap of an irregular list."""
        sources, near, _ = self.farthest_of(lobe.response.axes)
        nearest = self._directions[near[:, 0]]
        gap_rad = 2 * float(lobe.response.axes.apart_rad(sources, nearest).max(initial=0.0))
        is_irregular = gap_rad > _GAP * self.spacing_rad
        return f"{'up to ' if is_irregular else ''}{math.degrees(gap_rad if is_irregular else self.spacing_rad):.1f}°"

    def weakest(self, lobe: Lobe) -> float:
        """Return the amplitude of delay-and-sum in the direction nearest to the weakest source."""
        sources, near, _ = self.farthest_of(lobe.response.axes)
        directions = self._directions[near].reshape(-1, 3)
        amplitude = lobe.response(np.repeat(sources, near.shape[1], axis=0), directions)
        return float(amplitude.reshape(near.shape).max(axis=1).min())

    def farthest_of(self, axes: ArrayAxes) -> tuple[Floats, NDArray[np.intp], float]:
        """Return the places farthest from all directions, the directions nearest to them, and their distance in m."""
        if self._farthest is None:
            tree, count = Nearest(axes.scaled_m(self._directions)), min(_NEAREST, len(self._directions))
            sources = farthest_places(self._between, lambda places: tree.query(axes.scaled_m(places))[0])
            apart_m, near = tree.query(axes.scaled_m(sources), k=count)
            farthest_m = float(apart_m.reshape(len(sources), count)[:, 0].max())
            self._farthest = sources, near.reshape(len(sources), count), farthest_m
        return self._farthest

    def side_lobe(self, lobe: Lobe) -> float:
        """Return the highest side lobe between the directions, 0 to 1."""
        if lobe.response not in self._side_lobes:
            self._side_lobes[lobe.response] = lobe.response.side_lobe(self._between.everywhere())
        return self._side_lobes[lobe.response]

    def suffices(self, lobe: Lobe) -> bool:
        """Return True if sources between directions are strong enough, and above side lobes weaker than a source."""
        if self.is_single:
            return True
        amplitude = self.weakest(lobe)
        return lobe.is_loud(amplitude) and (amplitude >= _ABOVE * self.side_lobe(lobe) or self.is_ambiguous(lobe))

    def is_ambiguous(self, lobe: Lobe) -> bool:
        """Return True if side lobes are as strong as a source."""
        return self.side_lobe(lobe) > _AS_STRONG

    def exceeds_side_lobes(self, lobe: Lobe) -> bool:
        """Return True if the weakest source exceeds the side lobes of others."""
        return self.weakest(lobe) >= self.side_lobe(lobe)

    def loss_db(self, lobe: Lobe) -> str:
        """Return the loss of the weakest source in words."""
        loss_db = lobe.loss_db(self.weakest(lobe))
        return f"{loss_db:.1f}" if loss_db < 10 else f"{min(loss_db, _MOST_DB):.0f}"

    def remedy(self, lobe: Lobe, verb: str = "use") -> str | None:
        """Return the advice to use a grid with which the check succeeds; None if there is none."""
        named = self.finer(lobe)
        return None if named is None else self._worded(named, lobe.largest_rad(self.side_lobe(lobe)), verb)

    def finer(self, lobe: Lobe) -> Processing | None:
        """Return settings with a grid of the same kind and limits with which the check succeeds; None without any."""
        kind, processing = self._kind_and_limits()
        largest_rad = lobe.largest_rad(self.side_lobe(lobe))
        width_rad = float(np.ptp(processing.azimuth_limits_rad))
        area = width_rad * float(np.ptp(np.sin(processing.elevation_limits_rad)))
        # A square whose middle is as far from its corners has twice the area of the square of this distance.
        count = (
            max(width_rad / 8, area / (4 * largest_rad)) / largest_rad if kind == "3d" else width_rad / 2 / largest_rad
        )
        side_lobes: dict[Response, float] = {}
        shared = side_lobes if kind == "3d" else None  # Their places depend on the limits only.
        if count > _FIRST_COUNT and kind == "3d":  # Large grids take long, and distances follow from a smaller one.
            smaller = _named(processing, kind, _FIRST_COUNT, shared)
            relative = smaller.farthest_of(lobe.response.axes)[2] / (
                2 * math.sin(largest_rad / 2) * lobe.response.axes.longest_m
            )
            count = max(count, _BELOW * _FIRST_COUNT * relative**2)
            if count > _MUCH_ABOVE * LARGEST_GRID:
                return None
        for tried in _counts(count):
            check = _named(processing, kind, tried, shared)
            if check.suffices(lobe):
                return check.processing
        return None

    def _kind_and_limits(self) -> tuple[str, Processing]:
        """Return the kind of the grid, and settings with its limits."""
        named = named_grid(self.processing)
        if named is None:
            return "2d" if self._between.is_planar else "3d", self.processing
        kind, azimuth_deg, elevation_deg = named
        limits = {"azimuth_limits_deg": azimuth_deg, "elevation_limits_deg": elevation_deg}
        return kind, self.processing.replace(**limits if kind == "3d" else {"azimuth_limits_deg": azimuth_deg})

    def _worded(self, named: Processing, largest_rad: float, verb: str) -> str:
        """Return the name of a grid, with its limits unless they are those of the settings, or a spacing."""
        words, ours = f"{verb} at least {named.directions} directions", self.processing
        (west, east), (low, high) = named.azimuth_limits_deg, named.elevation_limits_deg
        if (west, east) != ours.azimuth_limits_deg or (low, high) != ours.elevation_limits_deg:
            words += f" within azimuths {west:g}:{east:g} and elevations {low:g}:{high:g}"
        if named_grid(ours) is not None:
            return words
        factor = 2.0 if self._between.is_planar else math.sqrt(2)
        closer = f"list directions at most {rounded_down(math.degrees(factor * largest_rad)):g}° apart"
        is_aside = self._between.is_planar and np.ptp(self._directions[:, 2]) > 0  # No grid has a name.
        return closer if is_aside else f"{words}, or {closer}"


def _named(processing: Processing, kind: str, count: int, side_lobes: dict[Response, float] | None) -> GridCheck:
    """Return the check of a grid with a name."""
    named = processing.replace(directions=f"{kind}:{count}")
    return GridCheck(direction_grid(named), named, side_lobes=side_lobes)


def rounded_down(number: float) -> float:
    """Return a number with two significant digits, rounded down."""
    digits = 1 - math.floor(math.log10(number))
    return round(math.floor(number * 10.0**digits + _LEAST) / 10.0**digits, max(digits, 0))


def _counts(first: float) -> Iterator[int]:
    """Yield numbers of directions with two digits and zeros, from the first upwards; none if it is too large."""
    count, last = max(2.0, first), 0
    while last < LARGEST_GRID and count <= 4 * LARGEST_GRID:
        unit = 10 ** max(0, math.floor(math.log10(count)) - 1)
        last = min(max(last + 1, unit * math.ceil(count / unit)), LARGEST_GRID)
        yield last
        count = _STEP * max(count, last)


def image_peak(settings: Settings) -> Peak:
    """Return the function from amplitudes of delay-and-sum to those of the beamformer of images, for one echo.

    ``ρ`` becomes ``ρ^n`` for DMAS of order n, and ``ρ δ / (δ + M (1 − ρ²))`` for Capon with the loading δ and M
    microphones. The coherence factor multiplies by ``ρ²``.
    """
    processing = settings.processing
    n_mics = len(microphones(settings.array).enabled_positions_m)

    def peak(rho: Floats) -> Floats:
        rho = np.clip(rho, 0.0, 1.0)
        out = rho**processing.dmas_order if processing.beamformer == "dmas" else rho
        if processing.beamformer == "capon":
            loading = processing.diagonal_loading
            out = rho * loading / (loading + n_mics * (1 - rho**2))
        return np.asarray(out * rho**2 if processing.weighting == "coherence_factor" else out)

    return peak


def spacing_warning(settings: Settings, grid: DegreesFromRadians) -> str | None:
    """Return a warning, with a grid that suffices, if a reflector between directions may lose half of its power."""
    if not any(observable_angles(settings.array)[:2]):
        return None
    lobe = Lobe(CallResponse(settings), image_peak(settings))
    check = GridCheck(grid, settings.processing)
    if check.suffices(lobe):
        return None
    processing = settings.processing
    methods = [name for name in (processing.beamformer, processing.weighting) if name not in {"delay_and_sum", "none"}]
    narrower = f" in images with {' and '.join(methods)}" if methods else ""
    remedy = check.remedy(lobe, "process with")
    return (
        f"directions are {check.apart(lobe)} apart, so a reflector between them appears up to "
        f"{check.loss_db(lobe)} dB too weak{narrower}; "
        + (
            remedy
            or f"no grid of up to {LARGEST_GRID} directions suffices, so use narrower limits "
            "(azimuth_limits_deg, elevation_limits_deg), "
            "or delay_and_sum"
        )
    )
