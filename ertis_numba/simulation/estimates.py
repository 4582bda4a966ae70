"""Estimated change of an image by one effect, and comparisons shared by several effects."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.sight import Echoes, Sight, change_db

__all__ = ["Estimate", "filtered", "ghosts", "noise", "unequal"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """By how much an effect changes the image.

    Attributes
    ----------
    change_db : float
    reason : str
    sure : float
        The factor by which the change may be off.
    """

    change_db: float
    reason: str
    sure: float = 20.0


def ghosts(sight: Sight, seen: Echoes, new: NDArray[np.bool_], wording: str) -> Estimate:
    """Return what new echoes add to the image."""
    if not new.any():
        return Estimate(change_db=0.0, reason="nothing of it arrives")
    level, beside = sight.levels(seen) * sight.reach(seen.delay_s) * new, sight.beside(seen.delay_s)
    worst = int(np.argmax(level / beside))
    return Estimate(
        change_db=change_db(level, beside),
        reason=wording.format(
            name=seen.names[worst],
            range=seen.delay_s[worst] * sight.shot.speed_m_s / 2,
            level=20 * math.log10(max(level[worst] / beside[worst], 1e-15)),
        ),
    )


def filtered(sight: Sight, after: Echoes | str, wording: str) -> Estimate:
    """Return what a filter on each path, or the effect of that name, changes in the image."""
    name = after if isinstance(after, str) else None
    if isinstance(after, str):
        after = sight.echoes(sight.active | {after})
    if not len(sight.heard):
        return Estimate(change_db=0.0, reason="nothing arrives")
    own = sight.heard
    reach = sight.reach(own.delay_s)
    if name is not None:  # by ringing, an echo may reach into the window that did not before
        reach = np.maximum(reach, Sight.of(sight.shot, sight.active | {name}).reach(own.delay_s))
    ratio = sight.envelope_change(own, after) * reach / sight.beside(own.delay_s, after)
    worst = int(np.argmax(ratio))
    found = 20 * math.log10(1 + ratio[worst])
    if not ratio[worst]:
        return Estimate(change_db=0.0, reason="no echo in reach changes")
    return Estimate(change_db=found, reason=wording.format(name=own.names[worst], change=found))


def noise(sight: Sight, level: float, reason: str) -> Estimate:
    """Return the change of the weakest reflector by noise of a level."""
    ratio_db = 20 * math.log10(max(level / sight.floor, 1e-15))
    return Estimate(
        change_db=change_db(np.array([level]), np.array([sight.quietest])),
        reason=f"{reason}: {ratio_db:+.1f} dB beside the weakest reflector of the image",
    )


def unequal(sight: Sight, weight: NDArray[np.complex128], reason: str) -> Estimate:
    """Return what weights of microphones, (mic, node), change in the image of the echoes shown."""
    directions = sight.heard.direction[sight.shown]
    if not len(directions):  # though echoes from elsewhere may reach into it: left to a rehearsal
        return Estimate(
            change_db=sight.shot.scene.tolerance_db, reason=f"{reason}; the image shows nothing but side lobes"
        )
    change = sight.beam_change(directions, weight)
    found = 20 * math.log10(1 + change)
    return Estimate(change_db=found, reason=f"{reason}: beams change by {found:.2f} dB of their reflector")
