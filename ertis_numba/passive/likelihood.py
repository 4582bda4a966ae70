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
_ROUNDING: Final = 1e-6  # of powers in single precision, which have a mean of 1
_SINGULAR: Final = 1e-12  # Keeps the inverse of equal waves finite.
_STEP_RAD: Final = 1e-4  # of numerical derivatives
_MAX_STEPS: Final = 20
_MAX_HALVINGS: Final = 6
_LAST_STEP_RAD: Final = 1e-7
_FLATTEST: Final = 1e-3  # Least curvature relative to the largest, so that steps along blind directions stay short.


def tangents(direction: Floats) -> Floats:
    """Return the unit vectors sideways (towards larger azimuths) and upwards: (2, axis) float64."""
    sideways = np.array([-direction[1], direction[0], 0.0])
    size = float(np.linalg.norm(sideways))
    sideways = sideways / size if size > 1e-12 else np.array([0.0, 1.0, 0.0])
    (x, y, z), (u, v, w) = direction, sideways
    return np.array([sideways, (y * w - z * v, z * u - x * w, x * v - y * u)])  # np.cross takes ten times as long.


def moved(direction: Floats, offsets_rad: Floats, *, level: bool) -> Floats:
    """Return directions (n, axis) beside a direction, by offsets sideways and, unless level, upwards: (n, 2) rad."""
    if level:
        radius = float(np.hypot(direction[0], direction[1]))
        azimuth = np.arctan2(direction[1], direction[0]) + offsets_rad[:, 0] / max(radius, 1e-12)
        height = np.full(len(azimuth), direction[2])
        return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
    out = direction + offsets_rad @ tangents(direction)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


class BandLikelihood:
    """Likelihood of a further source in a band, given others.

    Sources have unknown signals, and noise has an unknown power in each bin. The likelihood of a direction is then ``Σ
    −w log(p − b^H C b)``, where p is the power of the matrix C outside of the other sources, and b the wave of unit
    power outside of them (I. Ziskind and M. Wax, Maximum likelihood localization of multiple sources by alternating
    projection, 1988). ``whitening`` (bin, mode, mic) is that of the matrix (bin, mic, mic), None for microphones; the
    weights (bin,) have a sum of 1; ``delays`` returns those from unit vectors, (direction, mic); ``others`` are
    (source, axis), with frequencies (bin, source), and numbers of derivatives of their waves, by frequency and by
    1/range, that belong to them, none by default. As attributes, the matrix is (bin, mode, mode), and its trace and
    number of dimensions outside of the others are ``power`` (bin,) and ``dimensions``.
    """

    def __init__(
        self,
        matrix: NDArray[np.complex128],
        whitening: Floats | None,
        omega: Floats,
        weights: Floats,
        delays: Delays,
        others: Floats = _NONE,
        others_omega: Floats | None = None,
        others_orders: tuple[tuple[int, int], ...] = (),
        curvatures: Delays | None = None,
    ) -> None:
        self._whitening, self.omega, self._delays, self._curvatures = whitening, omega, delays, curvatures
        self.is_whitened = whitening is not None
        self.weights = weights
        self.matrix, self.others_orders = matrix, others_orders
        self.dimensions = matrix.shape[1] - len(others) - sum(map(sum, others_orders))
        power = np.trace(matrix, axis1=1, axis2=2).real
        self._basis = None
        if len(others):
            waves = [self.waves(others, others_omega)]
            orders = np.array(others_orders, np.intp).reshape(-1, 2)
            for curved in (False, True):
                for order in range(1, orders[:, int(curved)].max(initial=0) + 1):
                    changed = np.flatnonzero(orders[:, int(curved)] >= order)
                    omegas = None if others_omega is None else others_omega[:, changed]
                    waves.append(self.waves(others[changed], omegas, order=order, curved=curved))
            self._basis, _ = np.linalg.qr(np.concatenate(waves, axis=2))
            power = power - (self._basis.conj() * (matrix @ self._basis)).sum(axis=(1, 2)).real
        self.power = np.maximum(power, _LEAST)

    @functools.cached_property
    def projection(self) -> NDArray[np.complex128]:
        """Projection outside of the other sources: (bin, mode, mode) complex128."""
        identity = np.broadcast_to(np.eye(self.matrix.shape[1], dtype=np.complex128), self.matrix.shape)
        return self.outside(identity)

    @functools.cached_property
    def rest(self) -> NDArray[np.complex128]:
        """Matrix outside of the other sources: (bin, mode, mode) complex128."""
        if self._basis is None:
            return self.matrix
        return np.asarray(self.projection @ self.matrix @ self.projection)

    def outside(self, waves: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the parts of waves outside of the other sources: (bin, mode, direction) complex128."""
        if self._basis is None:
            return waves
        return np.asarray(waves - self._basis @ (self._basis.conj().transpose(0, 2, 1) @ waves))

    def beside(
        self,
        others: Floats,
        others_omega: Floats | None = None,
        omega: Floats | None = None,
        others_orders: tuple[tuple[int, int], ...] = (),
    ) -> Self:
        """Return the likelihood given others (source, axis); frequencies are its own by default."""
        omega = self.omega if omega is None else omega
        orders = others, others_omega, others_orders
        return type(self)(self.matrix, self._whitening, omega, self.weights, self._delays, *orders, self._curvatures)

    def unwhitened(self, matrices: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return the matrices whose powers for a wave are those of given matrices for the whitened wave."""
        if self._whitening is None:
            return matrices
        return np.asarray(self._whitening.transpose(0, 2, 1) @ matrices @ self._whitening)

    def waves(
        self, directions: Floats, omega: Floats | None = None, *, order: int = 0, curved: bool = False, part: int = 1
    ) -> NDArray[np.complex128]:
        """Return whitened waves, or derivatives by angular frequency or 1/range: (bin, mode, direction)."""
        waves = self.unwhitened_waves(directions, omega, order=0 if curved else order)
        if curved:
            curvatures = (
                np.zeros_like(self._delays(directions))
                if self._curvatures is None
                else self._curvatures(directions)[part]
            )
            waves *= (-1j * (self.omega[:, None] if omega is None else omega)[:, None] * curvatures.T) ** order
        if self._whitening is None:
            return waves
        return (self._whitening @ waves.view(np.float64)).view(np.complex128)  # Weights are real.

    def beams(self, directions: Floats) -> tuple[Floats, Floats]:
        """Return the power b^H C b, and the size of the wave outside of other sources, both (bin, direction)."""
        return self._powers(self.waves(directions))

    def _powers(self, waves: NDArray[np.complex128]) -> tuple[Floats, Floats]:
        waves = self.outside(waves)
        size = np.maximum((waves.real**2 + waves.imag**2).sum(axis=1), _LEAST)
        return (waves.conj() * (self.matrix @ waves)).sum(axis=1).real / size, size

    def unwhitened_waves(
        self, directions: Floats, omega: Floats | None = None, *, order: int = 0
    ) -> NDArray[np.complex128]:
        """Return waves as `waves` does, at the microphones: (bin, mic, direction)."""
        delay_s = np.ascontiguousarray(self._delays(directions).T)
        lags = -(self.omega[:, None] if omega is None else omega)[:, None] * delay_s
        waves = np.empty(lags.shape, np.complex128)
        np.cos(lags, out=waves.real)  # Sine and cosine together take half as long as a complex exponential.
        np.sin(lags, out=waves.imag)
        if order:
            waves *= (-1j * delay_s) ** order
        return waves

    def separated(self, directions: Floats, omega: Floats | None = None) -> tuple[Floats, Floats]:
        """Return powers (bin, source) without noise, each outside of others, and noise per dimension (bin,)."""
        # Each row of the pseudoinverse of the waves is orthogonal to other sources. This likelihood must have no
        # others.
        waves = self.waves(directions, omega)
        products = waves.conj().transpose(0, 2, 1) @ waves
        inverse = np.linalg.inv(products + _SINGULAR * waves.shape[1] * np.eye(len(directions)))
        beams = waves @ inverse
        heard = self.matrix @ beams
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
        return self._of_powers(self.beams(directions)[0])

    def of_equal_channels(self) -> float:
        """Return the logarithm of the likelihood of a signal that is equal at all microphones, per sample."""
        waves = np.ones((*self.matrix.shape[:2], 1), np.complex128)
        if self._whitening is not None:
            waves = self._whitening @ waves
        return float(self._of_powers(self._powers(waves)[0])[0])

    def _of_powers(self, powers: Floats) -> Floats:
        left = np.maximum(self.power[:, None] - powers, 0) + _ROUNDING
        return np.asarray(-self.weights @ np.log(left))

    def slopes(self, direction: Floats) -> tuple[NDArray[np.complex128], NDArray[np.complex128], Floats]:
        """Return a wave outside of others (bin, mode, 1), changes per rad (bin, mode, 2), and size (bin,)."""
        offsets = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]) * _STEP_RAD
        waves = self.outside(self.waves(moved(direction, offsets, level=False)))
        wave, changes = waves[..., :1], (waves[..., 1:3] - waves[..., 3:]) / (2 * _STEP_RAD)
        size = np.maximum((wave.real**2 + wave.imag**2).sum(axis=(1, 2)), _LEAST)
        along = (wave.conj() * changes).sum(axis=1, keepdims=True) / size[:, None, None]
        return wave, changes - wave * along, size

    def powers_of(self, vectors: NDArray[np.complex128], others: NDArray[np.complex128]) -> Floats:
        """Return the real parts of ``x^H C y`` for vectors x and y: (bin, x, y) float64."""
        return np.asarray((vectors.conj().transpose(0, 2, 1) @ (self.matrix @ others)).real)

    def maximum(self, start: Floats, *, reach_rad: float, level: bool) -> Floats:
        """Return the maximum within reach_rad of a direction, by a Gauss-Newton method: (axis,)."""
        here, value = start, float(self(start[None])[0])
        for _ in range(_MAX_STEPS):
            step = self._step(here, longest_rad=reach_rad / 2, level=level)
            for _ in range(_MAX_HALVINGS):
                there = moved(here, step[None], level=level)[0]
                new = float(self(there[None])[0])
                if new >= value and np.linalg.norm(there - start) <= reach_rad:
                    break
                step = step / 2
            else:
                break
            here, value = there, new
            if np.linalg.norm(step) < _LAST_STEP_RAD:
                break
        return here

    def _step(self, here: Floats, *, longest_rad: float, level: bool) -> Floats:
        """Return a step towards the maximum: (2,) rad, sideways and upwards.

        For the power r of the rest, the gradient of ``-log r`` is ``2 Re(u^H C d) / N r`` with the wave u, its size N,
        and its changes d. The curvature of r is that of the wave's power, without changes of the changes.
        """
        wave, changes, size = self.slopes(here)
        powers = self.powers_of(wave, np.concatenate([wave, changes], axis=2))[:, 0]
        power = powers[:, 0] / size
        rest = np.maximum(self.power - power, 0) + _ROUNDING
        scale = 2 * self.weights / (size * rest)
        gradient = scale @ powers[:, 1:]
        metric = (changes.conj().transpose(0, 2, 1) @ changes).real
        curvature = np.tensordot(scale, power[:, None, None] * metric - self.powers_of(changes, changes), 1)
        if level:
            gradient, curvature = gradient * [1, 0], curvature * [[1, 0], [0, 0]]
        values, vectors = np.linalg.eigh(curvature)
        values = np.maximum(np.abs(values), _FLATTEST * np.abs(values).max())
        if not values.all():
            return np.zeros(2)
        step = vectors @ ((vectors.T @ gradient) / values)
        return np.asarray(step * min(1.0, longest_rad / max(float(np.linalg.norm(step)), 1e-30)))
