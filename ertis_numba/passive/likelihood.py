"""Likelihood of directions of sources in noise, and its maximum."""

import functools
from collections.abc import Callable
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["BandLikelihood", "moved", "tangents"]

Floats = NDArray[np.float64]
Delays = Callable[[Floats], Floats]

_NONE: Final = np.zeros((0, 3))
_LEAST: Final = 1e-30
_SINGULAR: Final = 1e-12  # Keeps the inverse of equal waves finite.
_STEP_RAD: Final = 1e-4  # of numerical derivatives
_MAX_STEPS: Final = 12
_LAST_STEP_RAD: Final = 1e-5  # Newton's method converges quadratically: the error after such a step is below 1e-8.
_FLATTEST: Final = 1e-3  # Least curvature relative to the largest, so that steps along blind directions stay short.


def tangents(direction: Floats) -> Floats:
    """Return the unit vectors sideways (towards larger azimuths) and upwards: (2, axis) float64."""
    sideways = np.array([-direction[1], direction[0], 0.0])
    size = float(np.linalg.norm(sideways))
    sideways = sideways / size if size > 1e-12 else np.array([0.0, 1.0, 0.0])
    (x, y, z), (u, v, w) = direction, sideways
    return np.array([sideways, (y * w - z * v, z * u - x * w, x * v - y * u)])  # np.cross takes ten times as long.


def moved(direction: Floats, offsets_rad: Floats, *, level: bool) -> Floats:
    """Return directions beside a direction: (n, axis) float64.

    Parameters
    ----------
    direction : (axis,) float64
        Unit vector.
    offsets_rad : (n, 2) float64
        Offsets sideways and upwards.
    level : bool
        Keep the elevation, and ignore offsets upwards.
    """
    if level:
        radius = float(np.hypot(direction[0], direction[1]))
        azimuth = np.arctan2(direction[1], direction[0]) + offsets_rad[:, 0] / max(radius, 1e-12)
        height = np.full(len(azimuth), direction[2])
        return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
    out = direction + offsets_rad @ tangents(direction)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


class BandLikelihood:
    """Likelihood of a further source in a band, given others.

    Sources have unknown signals, and noise has an unknown power in each bin. The likelihood of a direction is then
    ``Σ −w log(p − b^H C b)``, where p is the power of the matrix C outside of the other sources, and b the wave of unit
    power outside of them (I. Ziskind and M. Wax, Maximum likelihood localization of multiple sources by alternating
    projection, 1988).

    Parameters
    ----------
    matrix : (bin, mic, mic) complex128
        Cross-spectral matrix of whitened signals.
    whitening : (bin, mode, mic) float64 or None
        None if the signals are those of the microphones.
    omega : (bin,) float64
        Angular frequencies.
    weights : (bin,) float64
        Share of each bin in the band, with a sum of 1.
    delays : callable
        Returns the delays of the sound from unit vectors, (direction, mic).
    others : (source, axis) float64
        Directions of the other sources; none by default.

    Attributes
    ----------
    power : (bin,) float64
        Trace of the matrix outside of the other sources.
    dimensions : int
        Number of dimensions outside of the other sources.
    is_whitened : bool
    """

    def __init__(
        self,
        matrix: NDArray[np.complex128],
        whitening: Floats | None,
        omega: Floats,
        weights: Floats,
        delays: Delays,
        others: Floats = _NONE,
    ) -> None:
        self._whitening, self._omega, self._delays = whitening, omega, delays
        self.is_whitened = whitening is not None
        self.weights = weights
        self._matrix, self.dimensions = matrix, matrix.shape[1] - len(others)
        power = np.trace(matrix, axis1=1, axis2=2).real
        self._basis = None
        if len(others):
            self._basis, _ = np.linalg.qr(self.waves(others))
            power = power - (self._basis.conj() * (matrix @ self._basis)).sum(axis=(1, 2)).real
        self.power = np.maximum(power, _LEAST)

    @functools.cached_property
    def projection(self) -> NDArray[np.complex128]:
        """Projection outside of the other sources: (bin, mode, mode) complex128."""
        identity = np.broadcast_to(np.eye(self._matrix.shape[1], dtype=np.complex128), self._matrix.shape)
        return self.outside(identity)

    @functools.cached_property
    def rest(self) -> NDArray[np.complex128]:
        """Matrix outside of the other sources: (bin, mode, mode) complex128."""
        if self._basis is None:
            return self._matrix
        return np.asarray(self.projection @ self._matrix @ self.projection)

    def outside(self, waves: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the parts of waves outside of the other sources: (bin, mode, direction) complex128."""
        if self._basis is None:
            return waves
        return np.asarray(waves - self._basis @ (self._basis.conj().transpose(0, 2, 1) @ waves))

    def beside(self, others: Floats) -> Self:
        """Return the likelihood given other sources in some directions, (source, axis)."""
        return type(self)(self._matrix, self._whitening, self._omega, self.weights, self._delays, others)

    def unwhitened(self, matrices: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the matrices whose powers for a wave are those of given matrices for the whitened wave."""
        if self._whitening is None:
            return matrices
        return np.asarray(self._whitening.transpose(0, 2, 1) @ matrices @ self._whitening)

    def waves(self, directions: Floats) -> NDArray[np.complex128]:
        """Return the whitened waves from directions: (bin, mode, direction) complex128."""
        lags = -self._omega[:, None, None] * np.ascontiguousarray(self._delays(directions).T)
        waves = np.empty(lags.shape, np.complex128)
        np.cos(lags, out=waves.real)  # Sine and cosine together take half as long as a complex exponential.
        np.sin(lags, out=waves.imag)
        if self._whitening is None:
            return waves
        return (self._whitening @ waves.view(np.float64)).view(np.complex128)  # Weights are real.

    def beams(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the power b^H C b, and the size of the wave outside of other sources, both (bin, direction)."""
        waves = self.outside(self.waves(directions))
        size = np.maximum((waves.real**2 + waves.imag**2).sum(axis=1), _LEAST)
        return (waves.conj() * (self._matrix @ waves)).sum(axis=1).real / size, size

    def separated(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the powers of sources without noise, each outside of the others, and the noise in each dimension.

        Each row of the pseudoinverse of the waves is orthogonal to the waves of the other sources.

        Parameters
        ----------
        directions : (source, axis) float64
            All sources, one or more. This likelihood must have no other sources.

        Returns
        -------
        powers : (bin, source) float64
        noise : (bin,) float64
        """
        waves = self.waves(directions)
        products = waves.conj().transpose(0, 2, 1) @ waves
        inverse = np.linalg.inv(products + _SINGULAR * waves.shape[1] * np.eye(len(directions)))
        beams = waves @ inverse
        heard = self._matrix @ beams
        within = (waves.conj() * heard).sum(axis=(1, 2)).real
        noise = np.maximum(self.power - within, _LEAST) / max(self.dimensions - len(directions), 1)
        sizes = np.einsum("kss->ks", inverse).real
        return (beams.conj() * heard).sum(axis=1).real - noise[:, None] * sizes, noise

    def relative_power(self, directions: Floats) -> Floats:
        """Return the mean over the band of the power relative to that of noise alone: (direction,) float64."""
        powers, _ = self.beams(directions)
        return np.asarray(self.dimensions * self.weights @ (powers / self.power[:, None]))

    def __call__(self, directions: Floats) -> Floats:
        """Return the logarithm of the likelihood of directions, per sample: (direction,) float64."""
        powers, _ = self.beams(directions)
        left = np.maximum(self.power[:, None] - powers, 1e-12 * self.power[:, None])
        return np.asarray(-self.weights @ np.log(left))

    def maximum(self, start: Floats, *, reach_rad: float, level: bool) -> Floats:
        """Return the direction of the maximum next to a direction, by Newton's method with numerical derivatives.

        Parameters
        ----------
        start : (axis,) float64
            Unit vector.
        reach_rad : float
            Largest distance from the start.
        level : bool
            Keep the elevation.

        Returns
        -------
        (axis,) float64
        """
        longest_rad = reach_rad / 2
        here, (value, step) = start, self._newton_step(start, longest_rad=longest_rad, level=level)
        for _ in range(_MAX_STEPS):
            if np.linalg.norm(step) < _LAST_STEP_RAD:
                return np.asarray(moved(here, step[None], level=level)[0])
            for _ in range(4):
                there = moved(here, step[None], level=level)[0]
                new, next_step = self._newton_step(there, longest_rad=longest_rad, level=level)
                if new >= value and np.linalg.norm(there - start) <= reach_rad:
                    break
                step = step / 2
            else:
                break
            here, value, step = there, new, next_step
        return here

    def _newton_step(self, here: Floats, *, longest_rad: float, level: bool) -> tuple[float, Floats]:
        """Return the value, and the step to the maximum of a parabola: (2,) float64, sideways and upwards."""
        grid = _STEP_RAD * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)], np.float64)
        f = self(moved(here, grid, level=level)).reshape(3, 3)
        gradient = np.array([f[2, 1] - f[0, 1], f[1, 2] - f[1, 0]]) / (2 * _STEP_RAD)
        mixed = (f[2, 2] - f[2, 0] - f[0, 2] + f[0, 0]) / 4
        along, across = f[2, 1] - 2 * f[1, 1] + f[0, 1], f[1, 2] - 2 * f[1, 1] + f[1, 0]
        values, vectors = np.linalg.eigh(-np.array([[along, mixed], [mixed, across]]) / _STEP_RAD**2)
        values = np.maximum(np.abs(values), _FLATTEST * np.abs(values).max())
        if not values.all():
            return float(f[1, 1]), np.zeros(2)
        step = vectors @ ((vectors.T @ gradient) / values)
        return float(f[1, 1]), np.asarray(step * min(1.0, longest_rad / max(float(np.linalg.norm(step)), 1e-30)))

    def information(self, direction: Floats, others: Floats, ratio: float, *, level: bool) -> Floats:
        """Return the Fisher information of a direction per sample in 1/rad²: (2, 2) float64.

        With the power ρ of a source relative to the noise, its whitened wave u, its size ``N = u^H u`` outside of other
        sources, and the projection P outside of all sources, the information is ``2 ρ² N / (1 + ρ N) · Re(∂u^H P ∂u)``
        (P. Stoica and A. Nehorai, Performance study of conditional and unconditional direction-of-arrival estimation,
        1990).

        Parameters
        ----------
        direction : (axis,) float64
        others : (source, axis) float64
            All other sources.
        ratio : float
            Power ρ of the source relative to the noise of a microphone.
        level : bool
            The elevation is given.
        """
        _, size = self.beside(others).beams(direction[None])
        gain = float(self.weights @ size[:, 0])
        every = self.beside(np.concatenate([direction[None], others]))
        places = _STEP_RAD * np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
        waves = every.outside(every.waves(moved(direction, places, level=level)))
        slopes = (waves[..., ::2] - waves[..., 1::2]) / (2 * _STEP_RAD)
        metric = np.einsum("k,kmi,kmj->ij", self.weights, slopes.conj(), slopes).real
        return np.asarray(2 * ratio**2 * gain / (1 + ratio * gain) * metric)
