"""Motion shifts and stretches the call."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.paths import Paths, unit

__all__ = ["doppler"]

_ROUNDS = 6  # each makes the error smaller by v / c


def doppler(paths: Paths, speed_m_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return when the call's beginning arrives, and how long its seconds last: both (path, mic) float64.

    Everything moves steadily. What leaves at 0 meets the target at ``t₁``, where it then is, and the
    microphone at ``t₂``: ``c t₁ = |p + v t₁ - s|`` and so on. From there on the call is stretched by
    ``dt₂/dt₀ = (1 - e₁·vₛ/c) / (1 - e₁·v/c) · (1 - e₂·v/c) / (1 - e₂·vₘ/c)``, e₁ and e₂ being the directions in
    which the sound goes and vₛ, v, vₘ the velocities of emitter, target and microphone (P. M. Morse, K. U. Ingard,
    Theoretical Acoustics, 1968, chapter 11). Images in walls move as images do.
    """
    mouth, ear = paths.mouth, paths.ear
    start_m = mouth.position_m
    ear_m, ear_m_s = ear.positions_m, ear.velocity_m_s
    if not len(paths.targets):
        arrival_s = paths.second_m / speed_m_s
        for _ in range(_ROUNDS):
            arrival_s = _distance(ear_m + arrival_s[..., None] * ear_m_s - start_m) / speed_m_s
        way = unit(ear_m + arrival_s[..., None] * ear_m_s - start_m)
        return arrival_s, _slowed(way, mouth.velocity_m_s, speed_m_s) / _slowed(way, ear_m_s, speed_m_s)
    target_m_s = paths.targets.velocities_m_s[:, None, :]
    corner_m = start_m + paths.first_m[..., None] * paths.leaving
    there_s = paths.first_m / speed_m_s
    for _ in range(_ROUNDS):
        there_s = _distance(corner_m + there_s[..., None] * target_m_s - start_m) / speed_m_s
    met_m = corner_m + there_s[..., None] * target_m_s
    arrival_s = there_s + paths.second_m / speed_m_s
    for _ in range(_ROUNDS):
        arrival_s = there_s + _distance(ear_m + arrival_s[..., None] * ear_m_s - met_m) / speed_m_s
    first, second = unit(met_m - start_m), unit(ear_m + arrival_s[..., None] * ear_m_s - met_m)
    stretch = _slowed(first, mouth.velocity_m_s, speed_m_s) / _slowed(first, target_m_s, speed_m_s)
    return arrival_s, stretch * _slowed(second, target_m_s, speed_m_s) / _slowed(second, ear_m_s, speed_m_s)


def _distance(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.sum(vectors**2, axis=-1)))


def _slowed(way: NDArray[np.float64], velocity_m_s: NDArray[np.float64], speed_m_s: float) -> NDArray[np.float64]:
    return np.asarray(1 - np.sum(way * velocity_m_s, axis=-1) / speed_m_s)
