"""First approximation of the poses of all sensors."""

from collections.abc import Mapping
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.calibration.pose_fit import PoseProblem, fit_poses
from ertis_numba.calibration.pose_links import RigidLink, WavesOfSensor, candidate_links
from ertis_numba.calibration.pose_matching import Gates, match_waves

__all__ = ["MIN_REFLECTORS", "place_sensors", "too_few"]

MIN_REFLECTORS: Final = 3
"""Different places that a sensor must have in common with others."""
_GATES: Final = (Gates(0.03, 0.05), Gates(0.006, 0.03))
_CERTAIN: Final = 3.2  # Waves per measurement beyond which a link is certain; a reflector yields four.


class _Confirmed(NamedTuple):
    """Transform between two sensors, and the reflectors and waves that confirm it."""

    n_waves: int
    n_reflectors: int
    link: RigidLink


def place_sensors(
    waves: Mapping[str, WavesOfSensor], reference: str, speed_m_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotations and positions relative to the reference; raise DataError without enough reflectors."""
    links: dict[tuple[str, str], _Confirmed] = {}
    for first, second in combinations(waves, 2):
        confirmed = _confirmed({first: waves[first], second: waves[second]}, speed_m_s)
        if confirmed is not None:
            links[first, second] = confirmed
    placed = {reference: (np.eye(3), np.zeros(3))}
    while len(placed) < len(waves):
        usable = [(each, pair) for pair, each in links.items() if (pair[0] in placed) != (pair[1] in placed)]
        if not usable:
            raise too_few(next(name for name in waves if name not in placed), list(placed))
        (_, _, link), (first, second) = max(usable, key=lambda item: item[0][:2])
        if first in placed:
            rotation, shift_m = placed[first]
            placed[second] = rotation @ link.rotation, rotation @ link.translation_m + shift_m
        else:
            rotation, shift_m = placed[second]
            turn = rotation @ link.rotation.T
            placed[first] = turn, shift_m - turn @ link.translation_m
    return np.array([placed[name][0] for name in waves]), np.array([placed[name][1] for name in waves])


def too_few(sensor: str, others: list[str]) -> DataError:
    """Return the error for a sensor without enough common reflectors."""
    return DataError(
        f"sensor {sensor} has fewer than {MIN_REFLECTORS} reflectors in common with {' and '.join(others)}; place one "
        "small reflector where both hear it, at 10 to 20 different places"
    )


def _confirmed(waves: Mapping[str, WavesOfSensor], speed_m_s: float) -> _Confirmed | None:
    """Return the transform between two sensors that most reflectors confirm; None if there are too few."""
    first, second = waves.values()
    n_common = len(first.keys() & second.keys())
    best: _Confirmed | None = None
    for link in candidate_links(first, second):
        found = _refined(waves, link, speed_m_s)
        if found.n_reflectors >= MIN_REFLECTORS and (best is None or found[:2] > best[:2]):
            best = found
        if best is not None and best.n_waves > _CERTAIN * n_common:
            break
    return best


def _refined(waves: Mapping[str, WavesOfSensor], link: RigidLink, speed_m_s: float) -> _Confirmed:
    """Return a transform after a fit, with the waves that confirm it within narrow gates, where few match by chance."""
    rotation = np.stack([np.eye(3), link.rotation])
    translation_m = np.stack([np.zeros(3), link.translation_m])
    matched = match_waves(waves, rotation, translation_m, speed_m_s, _GATES[0])
    if len(matched.reflectors_m) < MIN_REFLECTORS:
        return _Confirmed(0, 0, link)
    fit = fit_poses(PoseProblem(matched.waves, rotation, translation_m, matched.reflectors_m, 0), max_steps=10)
    again = match_waves(waves, fit.rotation, fit.translation_m, speed_m_s, _GATES[1])
    refined = RigidLink(fit.rotation[1], fit.translation_m[1])
    return _Confirmed(len(again.waves.receiver), len(again.reflectors_m), refined)
