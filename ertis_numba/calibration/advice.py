"""Quantities that recordings cannot determine, and advice on better recordings."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.base.units import counted
from ertis_numba.calibration.observations import Tolerances
from ertis_numba.calibration.wavefronts import Target

__all__ = ["how_to_record", "not_observable", "require_directions"]

_MIN_RECORDS: Final = 4  # A delay and three coordinates of each microphone need as many times.
_MIN_SPREAD_DEG: Final = 5.0
_HOW_TO_RECORD: Final[dict[Target, str]] = {
    "reflector": "place one small, hard reflector 0.5 to 2 m in front of the array, far from other objects",
    "wall": "point the array at a large flat wall at 0.5 to 2 m",
    "direct": "record the sound of the sensor's own emitter, from the start of the emission on",
    "beacon": "place one other sensor of the SYNC chain in front of the array, facing it",
}
_AXES: Final = ("x (ahead)", "y (left)", "z (up)")


def how_to_record(target: Target) -> str:
    """Return how to make recordings that can be used."""
    return _HOW_TO_RECORD[target]


def require_directions(source_m: NDArray[np.float64], target: Target) -> None:
    """Raise DataError for fewer than 4 recordings, or if all sources are in about the same direction."""
    remedy = "or keep the positions of the layout (position_tolerance_m=0)"
    if len(source_m) < _MIN_RECORDS:
        raise DataError(
            f"{counted(len(source_m), 'usable recording')} cannot tell positions from delays; record at "
            f"least {_MIN_RECORDS}, better 20, with the {target} at different places, {remedy}"
        )
    unit = source_m / np.linalg.norm(source_m, axis=1, keepdims=True)
    middle = unit.mean(axis=0) / np.linalg.norm(unit.mean(axis=0))
    spread_deg = math.degrees(float(np.sqrt(np.mean(np.arccos(np.clip(unit @ middle, -1, 1)) ** 2))))
    if spread_deg < _MIN_SPREAD_DEG:
        raise DataError(
            f"all {len(source_m)} recordings are from one direction, within {spread_deg:.1f}°, which cannot tell "
            f"positions from delays; move the {target} by 20° or more between recordings, left, right, up and down, "
            f"{remedy}"
        )


def not_observable(
    observed: NDArray[np.bool_], target: Target, expected: Tolerances, *, is_line: bool
) -> tuple[str, ...]:
    """Return the quantities that no recording determines, one line each; observed is (mic, gain, delay, x, y, z)."""
    lines = [
        "a common gain, delay or polarity of all microphones: their means are unchanged",
        "a rotation or shift of the whole array, or a mirrored layout if the place of no reflector is given",
    ]
    if not expected.position_m:
        if target == "direct" or is_line:
            lines.append("positions: direct sound and lines of microphones do not tell them from delays")
        else:
            lines.append("positions: with a tolerance of 0, delays take up their errors, for these directions only")
        return tuple(lines)
    if expected.model_s:
        lines.append(
            "the scale of the array: it remains that of the layout, and intervals leave its error out; measure the "
            "distance of two microphones, or state an exact --first-place far to the side"
        )
    for axis, name in enumerate(_AXES):
        missing = int(np.sum(~observed[:, 2 + axis]))
        if missing:
            lines.append(
                f"positions along {name} of {missing} of {len(observed)} microphones: record the {target} nearer, and "
                "farther to the sides, up and down"
            )
    delays = int(np.sum(~observed[:, 1]))
    if delays:
        lines.append(f"delays of {delays} of {len(observed)} microphones: record at more places")
    return tuple(lines)
