"""Rigid transforms between two sensors that heard the same reflectors."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.calibration.wave_finder import Wave

__all__ = ["RigidLink", "WavesOfSensor", "candidate_links", "echo_points", "unit_direction"]

WavesOfSensor = Mapping[tuple[int, int], Sequence[Wave]]
"""Waves of one sensor by SYNC pulse: its number, and a count of measurements with this number."""

_TOLERANCE_M: Final = 0.02
_SAME_M: Final = 0.02  # Places within this distance are one.
_APART_M: Final = 0.1  # Smallest distance of two reflectors that determine a rotation.
_TRIALS: Final = 400
_MAX_LINKS: Final = 6
_SAME_TRACE: Final = 2.98  # Trace of a rotation by 8 degrees.
_MAX_PLATFORM_M: Final = 2.0  # Longest path of a call from sensor to sensor.
_MIN_ECHO_M: Final = 0.3
_SIGMAS: Final = 4.0
_LOOSE: Final = 0.3  # Additional relative error of a curvature, such as that of a reflector that is not a point.
_PATH_TOLERANCE_M: Final = 8e-3
_SAME_COSINE: Final = 0.03


class RigidLink(NamedTuple):
    """Rigid transform ``x = R y + t`` from the frame of one sensor to that of another."""

    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]


class _Pairs(NamedTuple):
    """Points of two sensors that may be the same place."""

    first_m: NDArray[np.float64]
    second_m: NDArray[np.float64]
    weight: NDArray[np.float64]


def unit_direction(wave: Wave) -> NDArray[np.float64]:
    """Return the unit vector to the source, in front if the array is flat and cannot tell front from back."""
    direction = wave.parameters[1:4].copy()
    if wave.information[1, 1] < 1:
        across = float(direction[1] ** 2 + direction[2] ** 2)
        direction[0] = np.sqrt(max(0.0, 1 - across))
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-9))


def echo_points(waves: Sequence[Wave]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return reflectors of waves that can be echoes of the own call (curvature is possible), and their numbers."""
    points, numbers = [], []
    for number, wave in enumerate(waves):
        expected = 2 / max(wave.path_m, 1e-3)
        if wave.path_m > _MIN_ECHO_M and _fits(wave, expected):
            points.append(unit_direction(wave) * wave.path_m / 2)
            numbers.append(number)
    return np.array(points).reshape(-1, 3), np.array(numbers, dtype=np.intp)


def _fits(wave: Wave, curvature_1_m: float) -> bool:
    within = _SIGMAS * wave.curvature_sd_1_m + _LOOSE * curvature_1_m
    return abs(float(wave.parameters[4]) - curvature_1_m) < within


def _emitter_points(waves: Sequence[Wave]) -> list[NDArray[np.float64]]:
    """Return the places of other emitters if waves are their direct calls, in front of and behind the array."""
    found = []
    for wave in waves:
        if wave.path_m < _MAX_PLATFORM_M and _fits(wave, 1 / max(wave.path_m, 1e-3)):
            place_m = unit_direction(wave) * wave.path_m
            found += [place_m, place_m * np.array([-1, 1, 1])] if wave.information[1, 1] < 1 else [place_m]
    return found


def candidate_links(first: WavesOfSensor, second: WavesOfSensor) -> list[RigidLink]:
    """Return transforms from the second sensor to the first that many reflectors agree with, best first."""
    # Three pairs with equal distances yield a transform (W. Kabsch, 1976); agreement selects (Fischler and Bolles,
    # 1981).
    pairs = _pairs(first, second)
    triples = _triples(pairs, np.random.default_rng(0))
    if not len(triples):
        return []
    rotation, shift_m = _kabsch(pairs.first_m[triples], pairs.second_m[triples], np.ones(triples.shape))
    rest_m = np.linalg.norm(
        np.einsum("tij,nj->tni", rotation, pairs.second_m) + shift_m[:, None] - pairs.first_m, axis=2
    )
    score = np.maximum(0.0, 1 - (rest_m / _TOLERANCE_M) ** 2) @ pairs.weight
    found: list[RigidLink] = []
    for best in np.argsort(-score):
        if all(_differ(RigidLink(rotation[best], shift_m[best]), other) for other in found):
            found.append(_refined(RigidLink(rotation[best], shift_m[best]), pairs))
        if len(found) == _MAX_LINKS:
            break
    return found


def _differ(link: RigidLink, other: RigidLink) -> bool:
    """Return True if transforms differ by more than their errors."""
    turned = float(np.trace(link.rotation.T @ other.rotation))
    return turned < _SAME_TRACE or bool(np.linalg.norm(link.translation_m - other.translation_m) > _APART_M)


def _refined(link: RigidLink, pairs: _Pairs) -> RigidLink:
    """Return the transform after a fit to all pairs that agree."""
    for _ in range(4):
        moved_m = pairs.second_m @ link.rotation.T + link.translation_m
        rest = np.linalg.norm(moved_m - pairs.first_m, axis=1) / _TOLERANCE_M
        weight = pairs.weight * np.maximum(0.0, 1 - rest**2)
        if np.count_nonzero(weight) < 3:
            break
        rotation, shift_m = _kabsch(pairs.first_m[None], pairs.second_m[None], weight[None])
        link = RigidLink(rotation[0], shift_m[0])
    return link


def _pairs(first: WavesOfSensor, second: WavesOfSensor) -> _Pairs:
    rows: list[tuple[NDArray[np.float64], NDArray[np.float64], float]] = []
    for pulse in sorted(first.keys() & second.keys()):
        (points, indices), (others, other_indices) = echo_points(first[pulse]), echo_points(second[pulse])
        for point, index in zip(points, indices, strict=True):
            for other, other_index in zip(others, other_indices, strict=True):
                own, distant = first[pulse][index], second[pulse][other_index]
                common_m = (own.path_m + distant.path_m) / 2
                agree = _hears(first[pulse], own, common_m) + _hears(second[pulse], distant, common_m)
                rows.append((point, other, 1.0 + agree))
        # Another sensor's call comes from the origin of that sensor.
        rows += [(place, np.zeros(3), 1.0) for place in _emitter_points(first[pulse])]
        rows += [(np.zeros(3), place, 1.0) for place in _emitter_points(second[pulse])]
    if not rows:
        return _Pairs(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    first_m, second_m = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    both = np.concatenate([first_m, second_m], axis=1)
    # Reflectors at rest appear in each measurement, but count once.
    alike = (np.abs(both[:, None] - both).max(axis=2) < _SAME_M).sum(axis=1)
    weight = np.array([row[2] for row in rows]) / alike
    return _Pairs(first_m, second_m, weight)


def _hears(waves: Sequence[Wave], own: Wave, path_m: float) -> bool:
    """Return True if a wave from the same direction has the path from the other sensor over the reflector."""
    return any(
        abs(wave.path_m - path_m) < _PATH_TOLERANCE_M
        and np.abs(wave.parameters[2:4] - own.parameters[2:4]).max() < _SAME_COSINE
        for wave in waves
    )


def _triples(pairs: _Pairs, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return triples of pairs whose distances agree: (trial, 3) intp."""
    n_pairs = len(pairs.weight)
    if n_pairs < 3:
        return np.zeros((0, 3), np.intp)
    distance_m = np.linalg.norm(pairs.first_m[:, None] - pairs.first_m, axis=2)
    other_m = np.linalg.norm(pairs.second_m[:, None] - pairs.second_m, axis=2)
    agree = (np.abs(distance_m - other_m) < _TOLERANCE_M) & (distance_m > _APART_M)
    preference = pairs.weight * (agree @ pairs.weight) ** 2
    if not preference.any():
        return np.zeros((0, 3), np.intp)
    found = []
    for start in rng.choice(n_pairs, _TRIALS, p=preference / preference.sum()):
        near = np.where(agree[start], preference, 0.0)
        second = rng.choice(n_pairs, p=near / near.sum())
        both = np.where(agree[second], near, 0.0)
        if both.any():
            found.append((start, second, rng.choice(n_pairs, p=both / both.sum())))
    return np.array(found, dtype=np.intp).reshape(-1, 3)


def _kabsch(
    first_m: NDArray[np.float64], second_m: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations and translations that move second points onto first ones: (trial, 3, 3) and (trial, 3)."""
    share = (weight / weight.sum(axis=1, keepdims=True))[..., None]
    first, second = np.sum(share * first_m, axis=1), np.sum(share * second_m, axis=1)
    product = np.einsum("tni,tnj->tij", share * (first_m - first[:, None]), second_m - second[:, None])
    left, _, right = np.linalg.svd(product)
    mirrored = np.sign(np.linalg.det(left @ right))
    left[:, :, 2] *= np.where(mirrored == 0, 1.0, mirrored)[:, None]
    rotation = left @ right
    return rotation, first - np.einsum("tij,tj->ti", rotation, second)
