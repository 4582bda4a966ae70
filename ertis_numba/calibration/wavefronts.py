"""Travel times of spherical wavefronts from a source to each microphone, with their derivatives."""

from typing import Final, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

__all__ = ["TARGETS", "Target", "TravelTimes", "locate_source", "travel_times"]

Target = Literal["reflector", "wall", "direct", "beacon"]
"""Origin of the sound: a small reflector, a flat wall, the sensor's own emitter, or another sensor of the SYNC chain.
"""
TARGETS: Final[tuple[Target, ...]] = get_args(Target)

_ROUNDS = 30
_STEP_M = 1e-9  # Change of a position at which the search has converged.


class TravelTimes(NamedTuple):
    """Travel times (record, mic) and their derivatives (record, mic, axis) in s/m."""

    time_s: NDArray[np.float64]
    distance_m: NDArray[np.float64]  # from the source to the microphone
    by_microphone: NDArray[np.float64]  # by the position of the microphone
    by_source: NDArray[np.float64]  # by the position of the source


def travel_times(
    source_m: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    speed_m_s: float | NDArray[np.float64],
    target: Target,
) -> TravelTimes:
    """Return the times from the emission to the arrival at each microphone.

    The emitter e is at the origin of the sensor. A reflector at s delays the call by ``(|s − e| + |s − x|) / c``. A
    wall delays it as if it came from the mirror image s of the emitter, by ``|s − x| / c``, and so does the call of
    another sensor at s. Direct sound does the same, and its s is the place of the emitter.
    """
    apart_m = positions_m - source_m[:, None]
    distance_m = np.maximum(np.linalg.norm(apart_m, axis=2), 1e-9)
    unit = apart_m / distance_m[..., None]
    time_m, by_source = distance_m, -unit
    if target == "reflector":
        first_m = np.maximum(np.linalg.norm(source_m, axis=1), 1e-9)
        time_m = distance_m + first_m[:, None]
        by_source = by_source + (source_m / first_m[:, None])[:, None]
    pace_s_m = 1 / np.broadcast_to(np.asarray(speed_m_s, dtype=np.float64), len(source_m))[:, None]
    return TravelTimes(time_m * pace_s_m, distance_m, unit * pace_s_m[..., None], by_source * pace_s_m[..., None])


def locate_source(
    time_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    start_m: NDArray[np.float64],
    speed_m_s: float,
    target: Target,
    *,
    scale_s: float,
) -> NDArray[np.float64]:
    """Return the position of a source (axis,) by Gauss-Newton; residuals beyond scale_s lose weight (Cauchy)."""
    source_m = np.array(start_m, dtype=np.float64)
    damping = 1e-6
    for _ in range(_ROUNDS):
        model = travel_times(source_m[None], positions_m, speed_m_s, target)
        rest_s = time_s - model.time_s[0]
        weight = 1 / (1 + (rest_s / scale_s) ** 2)
        slopes = model.by_source[0]
        normal = (slopes.T * weight) @ slopes
        step_m = np.linalg.solve(normal + damping * np.trace(normal) * np.eye(3), (slopes.T * weight) @ rest_s)
        step_m *= min(1.0, 0.3 * float(np.linalg.norm(source_m)) / max(float(np.linalg.norm(step_m)), 1e-12))
        source_m = source_m + step_m
        if np.linalg.norm(step_m) < _STEP_M:
            break
    return source_m
