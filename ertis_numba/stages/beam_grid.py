"""Beams of all directions from those of few: a grid of nodes as fine as the aperture can tell directions apart.

A beam changes with its direction no faster than the array's outermost microphones turn their phase. So beams at
the nodes of a grid say all there is, once the grid has a few nodes more than the aperture resolves, and any
other beam is a sum of the nodes around it, by the weights of `fitting`. With 32 microphones and 3000 directions that
sum has 16 real terms instead of 32 or more complex ones, and there are ten times fewer nodes than directions.

The grid lies in the array's own axes: a line array needs one, a plane array two. A node is a point of that plane, not
of the sphere; those outside of the unit circle belong to no direction, and are as good as any to interpolate from.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.stages.fitting import Spectrum, fit, gain_of, weights_of

__all__ = ["FEWEST_RANGES", "Aperture", "BeamNodes", "estimated_mics", "require_nodes"]

FEWEST_RANGES = 64
"""Of an image whose beams are interpolated: the kernels read signals as far."""


_FLAT_M = 1e-6  # an axis along which microphones differ by less is none
_MIN_POWER = 1e-8  # large weights that cancel each other would let 16 bits be heard
_POLYNOMIALS = 16  # by which weights are interpolated along an axis
_AT_A_TIME = 4096  # directions
_MAX_FITTED = 96  # directions and microphones from which gain and error are found
_WAVES = 17  # frequencies, over which the gain of a microphone is smooth
_MAX_ESTIMATED, _WAVES_ESTIMATED = 40, 9  # for an error within some tenths of a decibel
_REACHES = (0.0, 0.3, 0.6, 1.0)  # of the array's, at which near waves are tried
_FEWEST_EQUATIONS = 120  # microphones by frequencies: weights would suit fewer better than what lies between them


@dataclass(frozen=True, slots=True, eq=False)
class Aperture:
    """Microphones and directions in the axes of the array itself.

    Attributes
    ----------
    positions_m : (mic, axis) float64
        Along the axes in which the array extends, the longest first: one for a line, two for a plane.
    directions : (direction, axis) float64
        Components of the unit vectors along them.
    square_m2 : (mic,) float64
        Squared distance from the centre.
    """

    positions_m: NDArray[np.float64]
    directions: NDArray[np.float64]
    square_m2: NDArray[np.float64]

    @classmethod
    def of(cls, positions_m: NDArray[np.float64], directions: NDArray[np.float64]) -> Self:
        """Return the aperture of microphones, (mic, 3), and unit vectors, (direction, 3)."""
        _, extent_m, axes = np.linalg.svd(positions_m, full_matrices=False)
        axes = axes[extent_m > _FLAT_M * math.sqrt(len(positions_m))]
        return cls(positions_m @ axes.T, directions @ axes.T, np.sum(positions_m**2, axis=1))

    @property
    def n_axes(self) -> int:
        """In how many axes the array extends, 0 to 3."""
        return int(self.positions_m.shape[1])

    def delays_s(
        self, points: NDArray[np.float64], *, sound_speed_m_s: float, range_m: float = math.inf
    ) -> NDArray[np.float64]:
        """Return the delays of points of the array's plane: (point, mic) float64.

        As `geometry.far_field_delays` and, for a finite range, `geometry.spherical_delays`, of which the distance
        to a microphone, ``√(r² − 2 r u·p + p²)``, holds for points outside of the unit circle as well.
        """
        along_m = points @ self.positions_m.T
        if math.isinf(range_m):
            return np.asarray(-along_m / sound_speed_m_s)
        # As a quotient, since the difference of square root and range would lose digits far away.
        bent_m = self.square_m2 - 2 * range_m * along_m
        root_m = np.sqrt(np.maximum(range_m**2 + bent_m, 0.0))
        return np.asarray(bent_m / (root_m + range_m) / sound_speed_m_s)

    def spacing(self, density: float, *, high_hz: float, sound_speed_m_s: float) -> NDArray[np.float64]:
        """Return the distance of nodes along each axis: (axis,) float64."""
        extent_m = np.ptp(self.positions_m, axis=0)
        return np.asarray(sound_speed_m_s / (high_hz * density * extent_m))

    def lowest_nodes(self, spacing: NDArray[np.float64], n_taps: int) -> NDArray[np.int64]:
        """Return the lowest of the nodes around each direction, as its numbers along the axes."""
        return np.asarray(np.floor(self.directions / spacing).astype(np.int64) - (n_taps // 2 - 1))

    def count_nodes(self, spacing: NDArray[np.float64], n_taps: int) -> int:
        """Return how many nodes lie around any direction."""
        lowest = self.lowest_nodes(spacing, n_taps)
        _, one = np.unique(_numbers(lowest), return_index=True)  # many directions have the same
        return len(np.unique(_numbers(_around(lowest[one], n_taps))))


def require_nodes(aperture: Aperture, n_ranges: int) -> None:
    """Refuse an array or an image whose beams cannot be interpolated.

    Raises
    ------
    ArgumentError
    """
    if aperture.n_axes not in {1, 2}:
        extent = "has no extent" if aperture.n_axes == 0 else "is neither a line nor a plane"
        raise ArgumentError(f"accuracy.beam_taps is above 0, but the array {extent}; give 0 or leave it out")
    if n_ranges < FEWEST_RANGES:
        raise ArgumentError(
            f"accuracy.beam_taps is above 0, but the image has {n_ranges} ranges, fewer than {FEWEST_RANGES}; "
            "give 0 or leave it out"
        )


def _around(lowest: NDArray[np.int64], n_taps: int) -> NDArray[np.int64]:
    """Return the nodes around directions, neighbours along the first axis side by side: (direction, tap, axis)."""
    steps = np.indices((n_taps,) * lowest.shape[1]).reshape(lowest.shape[1], -1)[::-1].T
    return lowest[:, None, :] + steps


def _numbers(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number per node, ascending along the first axis of the array first."""
    low = nodes.min(axis=tuple(range(nodes.ndim - 1)))
    extent = nodes.max(axis=tuple(range(nodes.ndim - 1))) - low + 1
    return np.asarray((nodes - low) @ np.concatenate([[1], np.cumprod(extent)[:-1]]))


class BeamNodes:
    """Nodes, and how the beams of all directions are made of theirs.

    Attributes
    ----------
    is_bent : bool
        Whether errors are those of a spherical wave where they are larger.
    steering, wrong : (mic, wave, direction) complex128
        Of an estimate: plane waves of some directions at some microphones, and by how much they are missed.
    squares : float
        Sum of a beam's squared weights, the mean over directions.
    points : (node, axis) float64
        In the array's plane.
    rows : (direction,) int32
        The directions in the order in which they are computed: those that share nodes one after the other.
    places : (direction, pair) int32
        Lower node of each pair, in that order; the other one is the next.
    weights : (direction, pair, 2) float64
        In that order.
    frequency_hz, errors : (wave,) float64
        Of an estimate: power of the error by that of the beam, the mean over uncorrelated microphones and over
        directions.
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
    ) -> None:
        self.errors: NDArray[np.float64]
        self._aperture = aperture
        self.is_bent = not math.isinf(nearest_m)
        self._sound_speed_m_s = sound_speed_m_s
        spacing = aperture.spacing(density, high_hz=high_hz, sound_speed_m_s=sound_speed_m_s)
        lowest = aperture.lowest_nodes(spacing, n_taps)
        # A patch looks the same wherever it lies: only where the direction is in it matters.
        self._inside = aperture.directions - lowest * spacing
        patch = _around(np.zeros((1, aperture.n_axes), dtype=np.int64), n_taps)[0] * spacing
        mics, chosen = _mics_and_waves(len(aperture.positions_m), len(spectrum.power), estimate=estimate)
        directions = _some(len(lowest), _MAX_ESTIMATED if estimate else _MAX_FITTED)
        self.frequency_hz = spectrum.frequency_hz[chosen]
        power = np.tile(spectrum.power[chosen] / spectrum.power[chosen].sum() / len(mics), len(mics))
        taps, wanted = (self._waves(points, mics) for points in (patch, self._inside[directions]))
        gain, weights = fit(taps, wanted, power, real=True, min_power=_MIN_POWER)
        self.squares = float(np.mean(np.sum(np.abs(weights) ** 2, axis=0)))
        if estimate:
            gain = self._estimate(
                lowest[directions] * spacing, patch, self._inside[directions], mics, weights, spectrum
            )
            # Of near waves those from about as far as the array is wide are bent most in its plane.
            reach_m = math.sqrt(float(aperture.square_m2.max()))
            for distance_m in {max(nearest_m, share * reach_m) for share in _REACHES} if self.is_bent else ():
                bent = self._bent_errors(
                    lowest[directions] * spacing, patch, directions, mics, gain, weights, distance_m
                )
                self.errors = np.maximum(self.errors, bent)
            return
        self._patch, self._fitted_weights = patch, weights
        self._fitted_directions = directions
        found = self._weights(
            spacing,
            n_taps,
            lambda inside: (
                weights_of(gain, taps, self._waves(inside, mics), power, real=True, min_power=_MIN_POWER).real.T
            ),
        )
        nodes = _around(lowest, n_taps)
        _, one, index = np.unique(_numbers(nodes).reshape(-1), return_index=True, return_inverse=True)
        self.points = nodes.reshape(-1, aperture.n_axes)[one] * spacing
        places = index.reshape(len(lowest), -1, 2)[:, :, 0]
        order = np.argsort(places[:, 0], kind="stable")  # who shares nodes finds them in the first cache level
        self.rows = order.astype(np.int32)
        self.places = np.ascontiguousarray(places[order], np.int32)
        self.weights = np.ascontiguousarray(found[order]).reshape(len(lowest), -1, 2)

    def _weights(
        self,
        spacing: NDArray[np.float64],
        n_taps: int,
        weights_at: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return the weights of all directions, (direction, tap), from those at points of a cell between nodes.

        A weight is a sum of waves, at microphones and frequencies. Across a cell they turn by half a period at most,
        and so polynomials give them in double precision, in a fraction of the time.
        """
        places = chebyshev.chebpts1(_POLYNOMIALS)
        inverse = np.linalg.inv(chebyshev.chebvander(places, _POLYNOMIALS - 1))
        axes = [places] * len(spacing)
        cell = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(spacing))
        lowest = (n_taps // 2 - 1) * spacing
        parts = np.array_split(cell, -(-len(cell) // _MAX_FITTED))
        values = np.concatenate([weights_at(lowest + (part + 1) / 2 * spacing) for part in parts])
        coefficients = values.reshape(*(_POLYNOMIALS,) * len(spacing), -1)
        for axis in range(len(spacing)):
            coefficients = np.moveaxis(np.tensordot(inverse, coefficients, axes=(1, axis)), 0, axis)
        coefficients = coefficients.reshape(len(cell), -1)
        found = np.empty((len(self._inside), coefficients.shape[1]))
        scaled = 2 * (self._inside - lowest) / spacing - 1
        for first in range(0, len(found), _AT_A_TIME):
            part = scaled[first : first + _AT_A_TIME]
            terms = np.ones((len(part), 1))
            for axis in range(len(spacing)):
                along = chebyshev.chebvander(part[:, axis], _POLYNOMIALS - 1)
                terms = (terms[:, :, None] * along[:, None, :]).reshape(len(part), -1)
            found[first : first + len(part)] = terms @ coefficients
        return found

    def _estimate(
        self,
        moved: NDArray[np.float64],
        patch: NDArray[np.float64],
        inside: NDArray[np.float64],
        mics: NDArray[np.intp],
        weights: NDArray[np.complex128],
        spectrum: Spectrum,
    ) -> NDArray[np.complex128]:
        """Evaluate what is missed at all frequencies of the spectrum; return the gains there."""
        self.frequency_hz = spectrum.frequency_hz
        made, wanted = self._waves(patch, mics) @ weights, self._waves(inside, mics)
        gain = gain_of(made, wanted)
        wrong = gain[:, None] * made - wanted
        shape = (len(mics), len(self.frequency_hz), len(inside))
        self.errors = np.mean(np.abs(wrong.reshape(shape)) ** 2, axis=(0, 2))
        there = self._waves(moved, mics)  # from the lowest node of each patch to the centre of the array
        self.steering, self.wrong = (there * wanted).reshape(shape), (there * wrong).reshape(shape)
        return np.asarray(gain.reshape(shape[:2]))

    def _bent_errors(
        self,
        moved: NDArray[np.float64],
        patch: NDArray[np.float64],
        directions: NDArray[np.intp],
        mics: NDArray[np.intp],
        gain: NDArray[np.complex128],
        weights: NDArray[np.complex128],
        nearest_m: float,
    ) -> NDArray[np.float64]:
        """Return the errors, (wave,), of waves from a point at ``nearest_m``, made by the weights of plane waves."""
        errors = np.zeros(len(self.frequency_hz))
        for k, direction in enumerate(directions):
            points = np.concatenate([moved[k] + patch, self._aperture.directions[direction][None]])
            delays_s = self._aperture.delays_s(points, sound_speed_m_s=self._sound_speed_m_s, range_m=nearest_m)
            waves = np.exp(2j * math.pi * delays_s.T[mics, None, :] * self.frequency_hz[:, None])
            made = gain * (waves[:, :, :-1] @ weights[:, k])
            errors += np.mean(np.abs(made - waves[:, :, -1]) ** 2, axis=0)
        return errors / len(directions)

    def gain(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the gain of each microphone that goes with the weights: (mic, frequency) complex128."""
        mics = np.arange(len(self._aperture.positions_m))
        made = self._waves(self._patch, mics) @ self._fitted_weights
        wanted = self._waves(self._inside[self._fitted_directions], mics)
        gain = gain_of(made, wanted)
        rows = gain.reshape(len(mics), len(self.frequency_hz))
        return np.stack(
            [
                np.interp(frequency_hz, self.frequency_hz, row.real)
                + 1j * np.interp(frequency_hz, self.frequency_hz, row.imag)
                for row in rows
            ]
        )

    def _waves(self, points: NDArray[np.float64], mics: NDArray[np.intp]) -> NDArray[np.complex128]:
        """Return plane waves: (mic · frequency, point) complex128."""
        delay_s = -self._aperture.positions_m[mics] @ points.T / self._sound_speed_m_s
        turns = delay_s[:, None, :] * (2 * math.pi * self.frequency_hz[:, None])
        waves = np.empty(turns.shape, dtype=np.complex128)
        np.cos(turns, out=waves.real)  # both take half as long as an exponential function of complex numbers
        np.sin(turns, out=waves.imag)
        return waves.reshape(-1, len(points))


def estimated_mics(n_mics: int) -> NDArray[np.intp]:
    """Return the microphones from which errors are estimated."""
    return _some(n_mics, _MAX_ESTIMATED)


def _mics_and_waves(n_mics: int, n_waves: int, *, estimate: bool) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the microphones and the frequencies of the spectrum from which weights are found."""
    mics = estimated_mics(n_mics) if estimate else _some(n_mics, _MAX_FITTED)
    enough = max(_WAVES_ESTIMATED if estimate else _WAVES, _FEWEST_EQUATIONS // len(mics))
    return mics, _some(n_waves, enough)


def _some(count: int, largest: int) -> NDArray[np.intp]:
    """Return ``largest`` indices at the most, spread evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, largest)).astype(np.intp))
