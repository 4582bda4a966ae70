"""Least-squares fit of poses and reflectors to the waves that sensors hear."""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.calibration.spherical_waves import N_PARAMETERS

__all__ = ["PoseFit", "PoseProblem", "WaveTable", "fit_poses", "predicted_waves"]

_F_SCALE: Final = 2.0  # Residual in standard deviations from which the loss is linear.
_MEDIAN_OF_NORMAL: Final = 0.6745
_CLIPPED: Final = 4.0
_MIN_FACTOR: Final = 0.15  # Errors that waves share, as those of overlapping echoes, are larger than residuals show.


class WaveTable(NamedTuple):
    """Waves with their origins; arrays are (wave, ...)."""

    receiver: NDArray[np.intp]  # number of the sensor that heard the wave
    emitter: NDArray[np.intp]  # number of the sensor that emitted it
    reflector: NDArray[np.intp]  # number; −1 for calls that arrive directly
    parameters: NDArray[np.float64]  # as in `Wave`
    root: NDArray[np.float64]  # (wave, parameter, parameter), W with information Wᵀ W
    sync_m: NDArray[np.float64]  # path of sound from the start of the receiver's record to the emission


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """Poses and reflectors."""

    rotation: NDArray[np.float64]  # (sensor, axis, axis)
    translation_m: NDArray[np.float64]  # (sensor, axis)
    reflectors_m: NDArray[np.float64]  # (reflector, axis)
    covariance: NDArray[np.float64]  # (sensor, 6, 6), as in `SensorPose`; 0 for the reference
    path_residual_m: NDArray[np.float64]  # (wave,), measured minus fitted


def predicted_waves(
    source_m: NDArray[np.float64],
    rotation: NDArray[np.float64],
    place_m: NDArray[np.float64],
    emitter_m: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the wave from each source s at a receiver p, with path ``|s − e| + |s − p|``: (wave, parameter)."""
    inside_m = np.einsum("wij,wi->wj", rotation, source_m - place_m)
    distance_m = np.maximum(np.linalg.norm(inside_m, axis=1), 1e-6)
    path_m = np.linalg.norm(source_m - emitter_m, axis=1) + distance_m
    return np.column_stack([path_m, inside_m / distance_m[:, None], 1 / distance_m])


class PoseProblem:
    """Residuals of waves and their derivatives.

    The unknowns are, for each sensor except the reference, the change of its position in metres and a rotation vector
    about its own axes in radians, and then the positions of the reflectors in metres.
    """

    def __init__(
        self,
        waves: WaveTable,
        rotation: NDArray[np.float64],
        translation_m: NDArray[np.float64],
        reflectors_m: NDArray[np.float64],
        reference: int,
    ) -> None:
        self._waves, self._rotation, self._translation_m = waves, rotation, translation_m
        self._reflectors_m = reflectors_m
        self._moving = np.array([number for number in range(len(rotation)) if number != reference], dtype=np.intp)
        self._column = np.full(len(rotation), -1)
        self._column[self._moving] = 6 * np.arange(len(self._moving))
        self.n_poses = 6 * len(self._moving)
        self.n_unknown = self.n_poses + reflectors_m.size
        self._is_direct = waves.reflector < 0

    @property
    def moving(self) -> NDArray[np.intp]:
        """Sensors that the fit moves."""
        return self._moving

    def split(
        self, unknown: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return rotations, positions and reflectors: (sensor, 3, 3), (sensor, 3) and (reflector, 3) float64."""
        change = unknown[: self.n_poses].reshape(-1, 6)
        rotation, translation_m = self._rotation.copy(), self._translation_m.copy()
        rotation[self._moving] = rotation[self._moving] @ _rotations(change[:, 3:])
        translation_m[self._moving] += change[:, :3]
        return rotation, translation_m, self._reflectors_m + unknown[self.n_poses :].reshape(-1, 3)

    def start(self) -> NDArray[np.float64]:
        """Return the unknowns of the start, which are all 0: (unknown,) float64."""
        return np.zeros(self.n_unknown)

    def residuals(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``W (measured − predicted)``, one wave after the other: (wave × parameter,) float64."""
        rotation, translation_m, reflectors_m = self.split(unknown)
        rest = self._waves.parameters - self._model(rotation, translation_m, reflectors_m)
        return np.asarray(np.einsum("wij,wj->wi", self._waves.root, rest).ravel())

    def path_residuals_m(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return measured minus predicted paths: (wave,) float64."""
        return np.asarray((self._waves.parameters - self._model(*self.split(unknown)))[:, 0])

    def _model(
        self, rotation: NDArray[np.float64], translation_m: NDArray[np.float64], reflectors_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        waves = self._waves
        model = predicted_waves(
            self._sources(translation_m, reflectors_m),
            rotation[waves.receiver],
            translation_m[waves.receiver],
            translation_m[waves.emitter],
        )
        model[:, 0] += waves.sync_m
        return model

    def jacobian(self, unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the residuals: (wave × parameter, unknown) float64."""
        rotation, translation_m, reflectors_m = self.split(unknown)
        waves, change = self._waves, unknown[: self.n_poses].reshape(-1, 6)
        source_m = self._sources(translation_m, reflectors_m)
        n_waves = len(waves.receiver)
        turned = rotation[waves.receiver]
        inside_m = np.einsum("wij,wi->wj", turned, source_m - translation_m[waves.receiver])
        distance_m = np.maximum(np.linalg.norm(inside_m, axis=1), 1e-6)[:, None]
        unit = inside_m / distance_m
        first_m = source_m - translation_m[waves.emitter]
        first = first_m / np.maximum(np.linalg.norm(first_m, axis=1), 1e-6)[:, None]
        first[self._is_direct] = 0.0  # The source is the emitter itself.
        # Derivatives of the second part of the path, the direction and the curvature, by the source in the own frame.
        by_inside = np.empty((n_waves, N_PARAMETERS, 3))
        by_inside[:, 0] = unit
        by_inside[:, 1:4] = (np.eye(3) - unit[:, :, None] * unit[:, None]) / distance_m[..., None]
        by_inside[:, 4] = -unit / distance_m**2
        by_source = np.einsum("wpj,wij->wpi", by_inside, turned)
        by_place = -by_source
        by_source[:, 0] += first
        # R changes to R exp([δ]), so that the source in the own frame changes by its cross product with δ.
        by_turn = np.einsum("wpj,wjk->wpk", by_inside, _cross(inside_m))
        slopes = np.zeros((n_waves, N_PARAMETERS, self.n_unknown))
        everyone = np.arange(n_waves)
        right = np.tile(np.eye(3), (len(rotation), 1, 1))
        right[self._moving] = _right_jacobians(change[:, 3:])
        by_turn = np.einsum("wpj,wjk->wpk", by_turn, right[waves.receiver])
        by_emitter = np.zeros_like(by_source)
        by_emitter[:, 0] = -first
        by_emitter[self._is_direct] = by_source[self._is_direct]
        for values, sensor, offset in (
            (by_place, waves.receiver, 0),
            (by_turn, waves.receiver, 3),
            (by_emitter, waves.emitter, 0),
        ):
            chosen = self._column[sensor] >= 0
            rows = everyone[chosen]
            for axis in range(3):
                slopes[rows, :, self._column[sensor[chosen]] + offset + axis] += values[chosen, :, axis]
        rows = everyone[~self._is_direct]
        for axis in range(3):
            column = self.n_poses + 3 * waves.reflector[rows] + axis
            slopes[rows, :, column] = by_source[rows, :, axis]
        return np.asarray(-np.einsum("wij,wjk->wik", waves.root, slopes).reshape(-1, self.n_unknown))

    def _sources(self, translation_m: NDArray[np.float64], reflectors_m: NDArray[np.float64]) -> NDArray[np.float64]:
        source_m = translation_m[self._waves.emitter].copy()
        source_m[~self._is_direct] = reflectors_m[self._waves.reflector[~self._is_direct]]
        return source_m


def fit_poses(problem: PoseProblem, *, max_steps: int = 30) -> PoseFit:
    """Fit poses and reflectors by least squares with the loss soft_l1."""
    # The covariance is `(JᵀJ)⁻¹` times the robust mean square of residuals (B. Triggs et al., 2000, section 6).
    found = scipy.optimize.least_squares(
        problem.residuals,
        problem.start(),
        jac=problem.jacobian,
        loss="soft_l1",
        f_scale=_F_SCALE,
        x_scale="jac",
        xtol=1e-8,
        ftol=1e-8,
        gtol=1e-8,
        max_nfev=max_steps,
    )
    rotation, translation_m, reflectors_m = problem.split(found.x)
    rest, slopes = problem.residuals(found.x), problem.jacobian(found.x)
    # Weights of the loss, as in iterated least squares.
    weight = 1 / np.sqrt(1 + (rest / _F_SCALE) ** 2)
    inverse = _inverse((slopes.T * weight) @ slopes)
    # Waves at flat arrays have fewer than five residuals, the others are 0.
    factor = max(_MIN_FACTOR, _mean_square(rest[np.abs(slopes).max(axis=1) > 0], problem.n_unknown))
    covariance = np.zeros((len(rotation), 6, 6))
    for place, sensor in enumerate(problem.moving):
        own = slice(6 * place, 6 * place + 6)
        covariance[sensor] = factor * inverse[own, own]
    return PoseFit(rotation, translation_m, reflectors_m, covariance, problem.path_residuals_m(found.x))


def _inverse(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse; directions without information get a large variance."""
    length = np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information / np.outer(length, length))
    return np.asarray((vectors / np.maximum(values, 1e-12)) @ vectors.T / np.outer(length, length))


def _mean_square(rest: NDArray[np.float64], n_unknown: int) -> float:
    """Return the mean square of residuals per degree of freedom, with outliers clipped."""
    scale = float(np.median(np.abs(rest))) / _MEDIAN_OF_NORMAL
    clipped = np.minimum(np.abs(rest), _CLIPPED * scale)
    return float(np.sum(clipped**2)) / max(1, len(rest) - n_unknown)


def _cross(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrices of cross products: (n, 3, 3) float64."""
    matrices = np.zeros((len(vectors), 3, 3))
    for row, column, axis, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
        matrices[:, row, column] = sign * vectors[:, axis]
        matrices[:, column, row] = -sign * vectors[:, axis]
    return matrices


def _rotations(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(scipy.spatial.transform.Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix())


def _right_jacobians(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the right Jacobians of the rotation group: (n, 3, 3) float64."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = _cross(vectors)
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)
