"""Later start of each sensor along the SYNC chain."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.constants import SYNC_STEP_S
from ertis_numba.simulation.effects.cross_emission import other_emitters
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["clock_times", "estimate"]

Floats = NDArray[np.float64]


def clock_times(shot: Snapshot, number: int, delay_s: Floats, stretch: Floats | None) -> tuple[Floats, Floats | None]:
    """Return delays relative to the record of the receiving sensor, for the call of sensor ``number``."""
    return delay_s + _start_s(shot, number), stretch


def _start_s(shot: Snapshot, emitter: int) -> float:
    """Return the start of an emitter after the receiving sensor's record; sensors are chained in the scene's order."""
    return (emitter - shot.number) * SYNC_STEP_S


def estimate(sight: Sight) -> Estimate | None:
    """Compute the shift of other sensors' calls due to later starts along the SYNC chain."""
    if "cross_emission" not in sight.active:
        return None
    worst = Estimate(change_db=0.0, reason="no call of another sensor arrives")
    for number in other_emitters(sight.shot):
        foreign = sight.of_emitter(number, sight.active)
        late_s = _start_s(sight.shot, number)
        moved = replace(foreign, delay_s=foreign.delay_s + late_s)
        _, ratio = sight.most_changed(foreign, moved, sight.surroundings(), sight.reach(foreign.delay_s))
        change = 20 * math.log10(1 + ratio)
        if change > worst.change_db:
            name = sight.shot.scene.sensors[number].name
            worst = Estimate(
                change_db=change, reason=f"{name} starts {late_s * 1e9:+.0f} ns relative to this sensor", sure=200.0
            )
    return worst
