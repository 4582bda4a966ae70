"""Likelihood of directions of sources in noise, and its maximum."""

from collections.abc import Callable
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["BandLikelihood", "moved", "tangents"]

Floats = NDArray[np.float64]
Delays = Callable[[Floats], Floats]

_NONE: Final = np.zeros((0, 3))
_LEAST: Final = 1e-30
_STEP_RAD: Final = 1e-4  # of numerical derivatives
_MAX_STEPS: Final = 12
_CONVERGED_RAD: Final = 1e-7
_FLATTEST: Final = 1e-3  # Least curvature relative to the largest, so that steps along blind directions stay short.


def tangents(direction: Floats) -> Floats:
    """Return the unit vectors sideways (towards larger azimuths) and upwards: (2, axis) float64."""
    sideways = np.array([-direction[1], direction[0], 0.0])
    size = float(np.linalg.norm(sideways))
    sideways = sideways / size if size > 1e-12 else np.array([0.0, 1.0, 0.0])
    return np.stack([sideways, np.cross(direction, sideways)])


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
    whitening : (bin, mode, mic) float64
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
    projection, rest : (bin, mode, mode) complex128
        Projection outside of the other sources, and the matrix outside of them.
    power : (bin,) float64
        Trace of the latter.
    dimensions : int
        Number of dimensions outside of the other sources.
    """

    def __init__(
        self,
        matrix: NDArray[np.complex128],
        whitening: Floats,
        omega: Floats,
        weights: Floats,
        delays: Delays,
        others: Floats = _NONE,
    ) -> None:
        self._whitening, self._omega, self._delays = whitening, omega, delays
        self.weights = weights
        self._matrix, self.dimensions = matrix, matrix.shape[1] - len(others)
        self.projection = np.broadcast_to(np.eye(matrix.shape[1], dtype=np.complex128), matrix.shape)
        if len(others):
            basis, _ = np.linalg.qr(self.waves(others))
            self.projection = self.projection - basis @ basis.conj().transpose(0, 2, 1)
        self.rest = self.projection @ matrix @ self.projection if len(others) else matrix
        self.power = np.maximum(np.trace(self.rest, axis1=1, axis2=2).real, _LEAST)

    def beside(self, others: Floats) -> Self:
        """Return the likelihood given other sources in some directions, (source, axis)."""
        return type(self)(self._matrix, self._whitening, self._omega, self.weights, self._delays, others)

    def unwhitened(self, matrices: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the matrices whose powers for a wave are those of given matrices for the whitened wave."""
        return np.asarray(self._whitening.transpose(0, 2, 1) @ matrices @ self._whitening)

    def waves(self, directions: Floats) -> NDArray[np.complex128]:
        """Return the whitened waves from directions: (bin, mode, direction) complex128."""
        delay_s = self._delays(directions)
        return np.asarray(self._whitening @ np.exp(-1j * self._omega[:, None, None] * delay_s.T))

    def beams(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the power b^H C b, and the size of the wave outside of other sources, both (bin, direction)."""
        waves = self.projection @ self.waves(directions)
        size = np.maximum((np.abs(waves) ** 2).sum(axis=1), 1e-30)
        return np.einsum("kmd,kmd->kd", waves.conj(), self.rest @ waves).real / size, size

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
        here, value = start, float(self(start[None])[0])
        for _ in range(_MAX_STEPS):
            step = self._newton_step(here, longest_rad=reach_rad / 2, level=level)
            for _ in range(4):
                there = moved(here, step[None], level=level)[0]
                new = float(self(there[None])[0])
                if new >= value and np.linalg.norm(there - start) <= reach_rad:
                    break
                step = step / 2
            else:
                break
            here, value = there, new
            if np.linalg.norm(step) < _CONVERGED_RAD:
                break
        return here

    def _newton_step(self, here: Floats, *, longest_rad: float, level: bool) -> Floats:
        """Return the step to the maximum of a parabola: (2,) float64, sideways and upwards."""
        grid = _STEP_RAD * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)], np.float64)
        f = self(moved(here, grid, level=level)).reshape(3, 3)
        gradient = np.array([f[2, 1] - f[0, 1], f[1, 2] - f[1, 0]]) / (2 * _STEP_RAD)
        mixed = (f[2, 2] - f[2, 0] - f[0, 2] + f[0, 0]) / 4
        along, across = f[2, 1] - 2 * f[1, 1] + f[0, 1], f[1, 2] - 2 * f[1, 1] + f[1, 0]
        values, vectors = np.linalg.eigh(-np.array([[along, mixed], [mixed, across]]) / _STEP_RAD**2)
        values = np.maximum(np.abs(values), _FLATTEST * np.abs(values).max())
        if not values.all():
            return np.zeros(2)
        step = vectors @ ((vectors.T @ gradient) / values)
        return np.asarray(step * min(1.0, longest_rad / max(float(np.linalg.norm(step)), 1e-30)))

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
        waves = every.projection @ every.waves(moved(direction, places, level=level))
        slopes = (waves[..., ::2] - waves[..., 1::2]) / (2 * _STEP_RAD)
        metric = np.einsum("k,kmi,kmj->ij", self.weights, slopes.conj(), slopes).real
        return np.asarray(2 * ratio**2 * gain / (1 + ratio * gain) * metric)
