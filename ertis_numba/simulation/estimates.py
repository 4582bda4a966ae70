"""Estimated change of an image by one effect, and comparisons that several effects share."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.echoes import Echoes
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.surroundings import change_db, greatest

__all__ = ["Estimate", "filtered", "ghosts", "noise", "unequal"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """Estimated greatest change of an image by an effect, which may be wrong by the factor ``sure``."""

    change_db: float
    reason: str
    sure: float = 20.0


def ghosts(sight: Sight, seen: Echoes, new: NDArray[np.bool_], wording: str) -> Estimate:
    """Return the change of the image by new echoes."""
    if not new.any():
        return Estimate(change_db=0.0, reason="no such sound arrives")
    level, around = seen.level * sight.reach(seen.delay_s) * new, sight.surroundings()
    worst, ratio = greatest(level / around.floor, lambda part: level[part] / around.at(seen.delay_s[part]))
    return Estimate(
        change_db=20 * math.log10(1 + ratio),
        reason=wording.format(
            name=seen.names[worst],
            range=seen.delay_s[worst] * sight.shot.speed_m_s / 2,
            level=20 * math.log10(max(ratio, 1e-15)),
        ),
    )


def filtered(sight: Sight, after: Echoes | str, wording: str) -> Estimate:
    """Return the change of the image by a filter on each path, or by the effect of that name."""
    name = after if isinstance(after, str) else None
    if isinstance(after, str):
        after = sight.echoes(sight.active | {after})
    if not len(sight.heard):
        return Estimate(change_db=0.0, reason="no echo arrives")
    own = sight.heard
    reach = sight.reach(own.delay_s)
    if name is not None:  # with ringing, an echo may reach into the window that did not before
        reach = np.maximum(reach, Sight.of(sight.shot, sight.active | {name}).reach(own.delay_s))
    worst, ratio = sight.most_changed(own, after, sight.surroundings(after), reach)
    found = 20 * math.log10(1 + ratio)
    if not ratio:
        return Estimate(change_db=0.0, reason="no echo in the range window changes")
    return Estimate(change_db=found, reason=wording.format(name=own.names[worst], change=found))


def noise(sight: Sight, level: float, reason: str) -> Estimate:
    """Return the change of the weakest reflector by noise of the given amplitude."""
    ratio_db = 20 * math.log10(max(level / sight.floor, 1e-15))
    return Estimate(
        change_db=change_db(np.array([level]), np.array([sight.quietest])),
        reason=f"{reason}: {ratio_db:+.1f} dB relative to the weakest reflector of the image",
    )


def unequal(sight: Sight, weight: Floats | NDArray[np.complex128], reason: str) -> Estimate:
    """Return the change of the image by weights of the microphones: (mic, frequency)."""
    directions = sight.heard.direction[sight.shown]
    if not len(directions):  # echoes outside the range window may still reach into it, which an A/B render measures
        return Estimate(change_db=sight.shot.scene.tolerance_db, reason=f"{reason}; the image shows only side lobes")
    change = sight.beam_change(directions, weight)
    found = 20 * math.log10(1 + change)
    return Estimate(change_db=found, reason=f"{reason}: beams change by {found:.2f} dB relative to their reflector")
