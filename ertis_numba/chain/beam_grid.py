"""Beam grid: interpolation of all beams from beams at a few grid points.

A beam is a weighted sum of beams at the points of a grid, slightly finer than the resolution of the aperture; see
docs/explanation/accuracy.md. Points lie in the plane of the array, also beyond the unit circle.
"""

import copy
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.interpolation_fit import Spectrum, fit, gain_of, two_columns, weights_of, without_small
from ertis_numba.chain.rows import aligned_axes
from ertis_numba.kernels import SteeringKernels, load_steering

__all__ = ["FEWEST_RANGES", "Aperture", "BeamGrid", "estimated_mics", "require_beam_grid"]

FEWEST_RANGES = 64
"""Minimum number of ranges of an image with beam interpolation. The kernels read blocks of this many samples."""


_FLAT_M = 1e-6  # An axis counts only if the array's extent along it exceeds this.
_MIN_POWER = 1e-8  # Regularisation. Large weights that cancel each other would amplify the rounding to 16 bits.
_POLYNOMIALS = 16  # Number of polynomials that interpolate weights along an axis.
_MAX_FITTED = 96  # Maximum number of directions, and of microphones, from which gain and error are computed.
_WAVES = 17  # Number of frequencies; the gain of a microphone is smooth over frequency.
_MAX_ESTIMATED, _WAVES_ESTIMATED = 40, 9  # These suffice for an error within some tenths of a decibel.
_REACHES = (0.0, 0.3, 0.6, 1.0)  # Source distances to try, relative to the radius of the array.
_MAX_COUNTS = 288  # Number of cached numbers of grid points.
_FEWEST_EQUATIONS = 120  # Microphones times frequencies. With fewer equations, the weights would overfit.


@dataclass(frozen=True, slots=True, eq=False)
class Aperture:
    """Microphones and directions in the principal axes of the array, or along its rows: one for a line, else two.

    ``positions_m`` (mic, axis), longest axis first; ``directions`` (direction, axis), components of unit vectors;
    ``square_m2`` (mic,), squared distance from the centre; ``axes`` (axis, 3) in the sensor frame. With ``is_turned``,
    the array is tilted, and a beam grid is fitted to directions anywhere between its points.
    """

    positions_m: NDArray[np.float64]
    directions: NDArray[np.float64]
    square_m2: NDArray[np.float64]
    axes: NDArray[np.float64]
    is_turned: bool = False

    @classmethod
    def of(cls, positions_m: NDArray[np.float64], directions: NDArray[np.float64], *, is_turned: bool = False) -> Self:
        """Return the aperture for microphone positions, (mic, 3) in metres, and unit vectors, (direction, 3)."""
        _, extent_m, axes = np.linalg.svd(positions_m, full_matrices=False)
        axes = axes[extent_m > _FLAT_M * math.sqrt(len(positions_m))]
        if len(axes) == 2:  # The principal axes of a square are arbitrary, and its beam grid is finest along rows.
            axes = aligned_axes(positions_m @ axes.T) @ axes
        return cls(positions_m @ axes.T, directions @ axes.T, np.sum(positions_m**2, axis=1), axes, is_turned)

    def turned(self, directions: NDArray[np.float64]) -> Self:
        """Return the aperture with other directions, as unit vectors: (direction, 3)."""
        return replace(self, directions=directions @ self.axes.T)

    def largest_delay_s(self, reach: float, own_s: NDArray[np.float64], *, sound_speed_m_s: float) -> float:
        """Return an upper limit on delays within ``reach`` ≥ 1, relative to the unit circle, with own delays (mic,)."""
        # The difference of distances, r − √(r² − 2 r u·p + p²), is largest where the root vanishes. For directions,
        # whose magnitude u is 1, it is at most p.
        farthest = reach + math.sqrt(reach**2 - 1)
        return float(np.max(np.abs(own_s) + farthest * np.sqrt(self.square_m2) / sound_speed_m_s))

    @property
    def n_axes(self) -> int:
        """Number of axes in which the array extends, 0 to 3."""
        return int(self.positions_m.shape[1])

    @property
    def supports_grid(self) -> bool:
        """True for a line or a plane with an extent along each axis; a microphone beside the origin has none."""
        return self.n_axes in {1, 2} and bool(np.all(np.ptp(self.positions_m, axis=0) > _FLAT_M))

    def delays_s(
        self, points: NDArray[np.float64], *, sound_speed_m_s: float, range_m: float = math.inf
    ) -> NDArray[np.float64]:
        """Return the delays of points in the array's plane: (point, mic), far-field or spherical at a finite range.

        The distance to a microphone, ``√(r² − 2 r u·p + p²)``, is defined for points outside the unit circle as well.
        """
        along_m = points @ self.positions_m.T
        if math.isinf(range_m):
            return np.asarray(-along_m / sound_speed_m_s)
        # A quotient keeps the digits that the difference of square root and range would lose at long ranges.
        bent_m = self.square_m2 - 2 * range_m * along_m
        root_m = np.sqrt(np.maximum(range_m**2 + bent_m, 0.0))
        return np.asarray(bent_m / (root_m + range_m) / sound_speed_m_s)

    def spacing(self, density: float, *, high_hz: float, sound_speed_m_s: float) -> NDArray[np.float64]:
        """Return the spacing of grid points along each axis: (axis,) float64."""
        extent_m = np.ptp(self.positions_m, axis=0)
        return np.asarray(sound_speed_m_s / (high_hz * density * extent_m))

    def fewest_grid_points(self, spacing: NDArray[np.float64], n_taps: int) -> NDArray[np.int64]:
        """Return the indices, along each axis, of the lowest grid point around each direction."""
        return np.asarray(np.floor(self.directions / spacing).astype(np.int64) - (n_taps // 2 - 1))

    def count_grid_points(self, spacing: NDArray[np.float64], n_taps: int) -> int:
        """Return the number of grid points that at least one direction uses."""
        return _counted(self, tuple(spacing.tolist()), n_taps)

    def _counted(self, spacing: NDArray[np.float64], n_taps: int) -> int:
        lowest = self.fewest_grid_points(spacing, n_taps)
        _, one = np.unique(_numbers(lowest), return_index=True)  # Many directions share their grid points.
        return len(np.unique(_numbers(_around(lowest[one], n_taps))))


@functools.lru_cache(maxsize=_MAX_COUNTS)
def _counted(aperture: Aperture, spacing: tuple[float, ...], n_taps: int) -> int:
    """Return a number of grid points, cached because it is the same for many plans and pipelines."""
    return aperture._counted(np.array(spacing), n_taps)  # noqa: SLF001  of the same module


def require_beam_grid(aperture: Aperture, n_ranges: int) -> None:
    """Require an array on a line or a plane, and at least `FEWEST_RANGES` ranges, for beam interpolation."""
    if not aperture.supports_grid:
        extent = "is neither a line nor a plane" if aperture.n_axes == 3 else "has no extent along an axis"
        raise ArgumentError(
            f"accuracy.beam_taps is above 0, but the array {extent}. Beam interpolation needs a line or a plane array; "
            "use 0 or omit accuracy.beam_taps"
        )
    if n_ranges < FEWEST_RANGES:
        raise ArgumentError(
            f"accuracy.beam_taps is above 0, but the image has {n_ranges} ranges. Beam interpolation needs at least "
            f"{FEWEST_RANGES}; use 0 or omit accuracy.beam_taps"
        )


def _around(lowest: NDArray[np.int64], n_taps: int) -> NDArray[np.int64]:
    """Return the grid points around directions: (direction, tap, axis); neighbours of the first axis are adjacent."""
    steps = np.indices((n_taps,) * lowest.shape[1]).reshape(lowest.shape[1], -1)[::-1].T
    return lowest[:, None, :] + steps


def _numbers(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number per grid point; numbers ascend along the first axis of the array first."""
    low = nodes.min(axis=tuple(range(nodes.ndim - 1)))
    extent = nodes.max(axis=tuple(range(nodes.ndim - 1))) - low + 1
    return np.asarray((nodes - low) @ np.concatenate([[1], np.cumprod(extent)[:-1]]))


class BeamGrid:
    """Beam-grid points, and the weights that interpolate the beams of all directions from them.

    ``points`` (node, axis) lie in the array's plane. ``rows`` (direction,) is the order of computation, in which
    directions that share grid points are adjacent; ``places`` (direction, pair) are the lower points of pairs in this
    order, and ``weights`` (direction, pair, 2). ``squares`` is the mean sum of a beam's squared weights, ``reach`` an
    upper limit on the distance of points from the centre, for any directions. Estimates alone have ``steering`` and
    ``wrong`` (mic, wave, direction), plane waves and their interpolation errors, and ``errors`` (wave,), error power
    relative to the beam, at the frequencies of ``spectrum`` or at ``judged_hz``. With ``with_gain=False``, no filter
    applies a gain to the signals.
    """

    def __init__(
        self,
        aperture: Aperture,
        spectrum: Spectrum,
        *,
        n_taps: int,
        density: float,
        high_hz: float,
        sound_speed_m_s: float,
        estimate: bool = False,
        nearest_m: float = math.inf,
        with_gain: bool = True,
        judged_hz: NDArray[np.float64] | None = None,
    ) -> None:
        self.errors: NDArray[np.float64]
        self._aperture = aperture
        self.is_curved = not math.isinf(nearest_m)
        self._sound_speed_m_s = sound_speed_m_s
        spacing = aperture.spacing(density, high_hz=high_hz, sound_speed_m_s=sound_speed_m_s)
        self._spacing, self._n_taps = spacing, n_taps
        self.reach = 1 + n_taps / 2 * float(np.linalg.norm(spacing))
        lowest = aperture.fewest_grid_points(spacing, n_taps)
        # All patches of grid points are alike, so only the position of the direction within its patch matters.
        inside = aperture.directions - lowest * spacing
        patch = _around(np.zeros((1, aperture.n_axes), dtype=np.int64), n_taps)[0] * spacing
        mics, chosen = _mics_and_waves(len(aperture.positions_m), len(spectrum.power), estimate=estimate)
        largest = _MAX_ESTIMATED if estimate else _MAX_FITTED
        directions = _some(len(lowest), largest)
        inside = inside[directions]
        if aperture.is_turned:
            directions = np.resize(directions, largest)
            inside = (n_taps // 2 - 1 + _evenly(largest, aperture.n_axes)) * spacing
        self.frequency_hz = spectrum.frequency_hz[chosen]
        power = np.tile(spectrum.power[chosen] / spectrum.power[chosen].sum() / len(mics), len(mics))
        taps, wanted = (self._waves(points, mics) for points in (patch, inside))
        self._has_gain = with_gain
        if with_gain:
            gain, weights = fit(taps, wanted, power, real=True, min_power=_MIN_POWER)
        else:
            gain = np.ones(len(taps), dtype=np.complex128)
            weights = weights_of(gain, taps, wanted, power, real=True, min_power=_MIN_POWER)
        self.squares = float(np.mean(np.sum(np.abs(weights) ** 2, axis=0)))
        if estimate:
            gain = self._estimate(
                lowest[directions] * spacing,
                patch,
                inside,
                mics,
                weights,
                spectrum.frequency_hz if judged_hz is None else judged_hz,
            )
            # Waves from about as far away as the array is wide are curved most in its plane.
            reach_m = math.sqrt(float(aperture.square_m2.max()))
            for distance_m in {max(nearest_m, share * reach_m) for share in _REACHES} if self.is_curved else ():
                bent = self._curvature_errors(
                    lowest[directions] * spacing, patch, inside, mics, gain, weights, distance_m
                )
                self.errors = np.maximum(self.errors, bent)
            return
        self._patch, self._fitted_weights, self._fitted = patch, weights, inside
        self._coefficients = self._coefficients_of(
            lambda inside: (
                weights_of(gain, taps, self._waves(inside, mics), power, real=True, min_power=_MIN_POWER).real.T
            )
        )
        self._place(aperture.directions, load_steering("numpy"))

    def turned(self, directions: NDArray[np.float64], kernels: SteeringKernels) -> Self:
        """Return the beam grid for other directions (direction, axis) as in `Aperture`, with the same gain."""
        other = copy.copy(self)
        other._coefficients = self._short_coefficients  # noqa: SLF001
        other._place(directions, kernels)  # noqa: SLF001  of the same class
        return other

    @functools.cached_property
    def _short_coefficients(self) -> NDArray[np.float64]:
        return without_small(self._coefficients)

    def _place(self, directions: NDArray[np.float64], kernels: SteeringKernels) -> None:
        """Compute the grid points of directions, and their weights."""
        lowest = replace(self._aperture, directions=directions).fewest_grid_points(self._spacing, self._n_taps)
        first = lowest.min(axis=0)
        strides = np.concatenate([[1], np.cumprod(lowest.max(axis=0) - first + self._n_taps)])
        numbers = (lowest - first) @ strides[:-1]
        order = np.argsort(numbers, kind="stable")  # Adjacent directions find shared points in the L1 cache.
        numbers = numbers[order]
        steps = _around(np.zeros((1, len(first)), dtype=np.int64), self._n_taps)[0] @ strides[:-1]
        is_used = np.zeros(strides[-1], dtype=np.bool_)
        is_used[np.unique(numbers)[:, None] + steps] = True
        used = np.flatnonzero(is_used)
        self.points = (first + used[:, None] // strides[:-1] % (strides[1:] // strides[:-1])) * self._spacing
        place = np.cumsum(is_used, dtype=np.int32) - np.int32(1)
        self.rows = order.astype(np.int32)
        self.places = place[numbers[:, None] + steps[::2]]
        inside = directions[order] - lowest[order] * self._spacing - (self._n_taps // 2 - 1) * self._spacing
        weights = np.empty((len(directions), self._coefficients.shape[2]))
        kernels.sum_polynomials(two_columns(2 * inside / self._spacing - 1), self._coefficients, weights)
        self.weights = weights.reshape(len(directions), -1, 2)

    def _coefficients_of(self, weights_at: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return polynomial coefficients of the weights in one grid cell: (degree, degree, tap)."""
        # Weights are sums of waves that turn by at most half a period across a cell, so that polynomials are exact.
        spacing = self._spacing
        places = chebyshev.chebpts1(_POLYNOMIALS)
        inverse = np.linalg.inv(chebyshev.chebvander(places, _POLYNOMIALS - 1))
        axes = [places] * len(spacing)
        cell = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(spacing))
        lowest = (self._n_taps // 2 - 1) * spacing
        parts = np.array_split(cell, -(-len(cell) // _MAX_FITTED))
        values = np.concatenate([weights_at(lowest + (part + 1) / 2 * spacing) for part in parts])
        coefficients = values.reshape(*(_POLYNOMIALS,) * len(spacing), -1)
        for axis in range(len(spacing)):
            coefficients = np.moveaxis(np.tensordot(inverse, coefficients, axes=(1, axis)), 0, axis)
        shape = (_POLYNOMIALS, coefficients.size // coefficients.shape[-1] // _POLYNOMIALS, -1)
        return np.ascontiguousarray(coefficients).reshape(shape)

    def _estimate(
        self,
        moved: NDArray[np.float64],
        patch: NDArray[np.float64],
        inside: NDArray[np.float64],
        mics: NDArray[np.intp],
        weights: NDArray[np.complex128],
        frequency_hz: NDArray[np.float64],
    ) -> NDArray[np.complex128]:
        """Compute the errors at given frequencies, and return the gains there."""
        self.frequency_hz = frequency_hz
        made, wanted = self._waves(patch, mics) @ weights, self._waves(inside, mics)
        gain = gain_of(made, wanted) if self._has_gain else np.ones(len(made), dtype=np.complex128)
        self._estimated = patch, mics, weights, gain
        wrong = gain[:, None] * made - wanted
        shape = (len(mics), len(self.frequency_hz), len(inside))
        self.errors = np.mean(np.abs(wrong.reshape(shape)) ** 2, axis=(0, 2))
        there = self._waves(moved, mics)  # Phase from the lowest point of each patch to the centre of the array.
        self.steering, self.wrong = (there * wanted).reshape(shape), (there * wrong).reshape(shape)
        return np.asarray(gain.reshape(shape[:2]))

    def passed(self, shift_hz: float) -> NDArray[np.float64]:
        """Return the mean power (wave,) of unit waves shifted before the interpolation. Estimates only."""
        patch, mics, weights, gain = self._estimated
        made = gain[:, None] * (self._waves(patch, mics, shift_hz=shift_hz) @ weights)
        return np.asarray(np.mean(np.abs(made.reshape(len(mics), len(self.frequency_hz), -1)) ** 2, axis=(0, 2)))

    def _curvature_errors(
        self,
        moved: NDArray[np.float64],
        patch: NDArray[np.float64],
        inside: NDArray[np.float64],
        mics: NDArray[np.intp],
        gain: NDArray[np.complex128],
        weights: NDArray[np.complex128],
        nearest_m: float,
    ) -> NDArray[np.float64]:
        """Return the errors, (wave,), of the plane-wave weights for waves from a point at ``nearest_m``."""
        errors, steps = np.zeros(len(self.frequency_hz)), _steps_of(self.frequency_hz)
        for k, place in enumerate(inside):
            points = np.concatenate([moved[k] + patch, (moved[k] + place)[None]])
            delays_s = self._aperture.delays_s(points, sound_speed_m_s=self._sound_speed_m_s, range_m=nearest_m)
            waves = _waves_of(delays_s[:, mics], *steps)
            made = np.einsum("wpm,p->mw", waves[:, :-1], weights[:, k]) * gain
            errors += np.mean(np.abs(made - waves[:, -1].T) ** 2, axis=0)
        return errors / len(inside)

    def gain(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gain of each microphone that complements the weights: (mic, frequency) complex128."""
        mics = np.arange(len(self._aperture.positions_m))
        made = self._waves(self._patch, mics) @ self._fitted_weights
        wanted = self._waves(self._fitted, mics)
        gain = gain_of(made, wanted)
        rows = gain.reshape(len(mics), len(self.frequency_hz))
        return np.stack(
            [
                np.interp(frequency_hz, self.frequency_hz, row.real)
                + 1j * np.interp(frequency_hz, self.frequency_hz, row.imag)
                for row in rows
            ]
        )

    def _waves(
        self, points: NDArray[np.float64], mics: NDArray[np.intp], *, shift_hz: float = 0.0
    ) -> NDArray[np.complex128]:
        """Return plane waves: (mic · frequency, point) complex128."""
        delay_s = -self._aperture.positions_m[mics] @ points.T / self._sound_speed_m_s
        turns = delay_s[:, None, :] * (2 * math.pi * (self.frequency_hz[:, None] + shift_hz))
        waves = np.empty(turns.shape, dtype=np.complex128)
        np.cos(turns, out=waves.real)  # Sine and cosine together take half as long as a complex exponential.
        np.sin(turns, out=waves.imag)
        return waves.reshape(-1, len(points))


def _steps_of(frequency_hz: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return the few different steps between frequencies, and the index of each: (wave,)."""
    found: tuple[NDArray[np.float64], NDArray[np.intp]] = np.unique(
        np.diff(frequency_hz, prepend=0.0), return_inverse=True
    )
    return found


def _waves_of(
    delay_s: NDArray[np.float64], steps_hz: NDArray[np.float64], which: NDArray[np.intp]
) -> NDArray[np.complex128]:
    """Return waves (wave, ...) of delays as products of those of the steps between frequencies."""
    factors = np.exp(2j * math.pi * steps_hz.reshape(-1, *[1] * delay_s.ndim) * delay_s)
    return np.asarray(np.multiply.accumulate(factors[which], axis=0))


def estimated_mics(n_mics: int) -> NDArray[np.intp]:
    """Return the microphones from which errors are estimated."""
    return _some(n_mics, _MAX_ESTIMATED)


def _mics_and_waves(n_mics: int, n_waves: int, *, estimate: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices of the microphones and frequencies from which weights are computed."""
    mics = estimated_mics(n_mics) if estimate else _some(n_mics, _MAX_FITTED)
    enough = max(_WAVES_ESTIMATED if estimate else _WAVES, _FEWEST_EQUATIONS // len(mics))
    return mics, _some(n_waves, enough)


def _evenly(count: int, n_axes: int) -> NDArray[np.float64]:
    """Return places that an additive sequence spreads evenly over a cell: (place, axis) from 0 to 1."""
    # Steps are powers of 1 / x for the positive root x of `x^(n + 1) = x + 1` (M. Roberts, 2018).
    root = {1: (1 + math.sqrt(5)) / 2, 2: 1.324717957244746}[n_axes]
    steps = root ** -np.arange(1.0, n_axes + 1)
    return np.asarray((0.5 + np.arange(count)[:, None] * steps) % 1.0)


def _some(count: int, largest: int) -> NDArray[np.intp]:
    """Return at most ``largest`` indices, spread evenly over ``count``."""
    return np.unique(np.linspace(0, count - 1, min(count, largest)).astype(np.intp))
