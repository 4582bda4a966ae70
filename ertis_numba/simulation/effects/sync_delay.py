"""Later start of each sensor along the SYNC chain."""

from dataclasses import replace
from typing import Final

from ertis_numba.constants import SYNC_STEP_S
from ertis_numba.simulation.effects._effect import Effect
from ertis_numba.simulation.effects.cross_emission import cross_emission
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.sight import Sight, change_db
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["EFFECT", "sync_delay"]


def sync_delay(shot: Snapshot, emitter: int) -> float:
    """Return the start of an emitter relative to the record of the receiving sensor, in seconds.

    Sensors are chained in the order of the scene. Each sensor starts its emitter and its record together.
    """
    return (emitter - shot.number) * SYNC_STEP_S


def _estimate(sight: Sight) -> Estimate | None:
    """Compute the shift of other sensors' calls due to later starts along the SYNC chain."""
    if "cross_emission" not in sight.active:
        return None
    worst = Estimate(change_db=0.0, reason="no call of another sensor arrives")
    for number in cross_emission(sight.shot):
        foreign = sight.of_emitter(number, sight.active)
        late_s = sync_delay(sight.shot, number)
        moved = replace(foreign, delay_s=foreign.delay_s + late_s)
        shift = sight.envelope_change(foreign, moved) * sight.reach(foreign.delay_s)
        change = change_db(shift, sight.beside(foreign.delay_s))
        if change > worst.change_db:
            name = sight.shot.scene.sensors[number].name
            worst = Estimate(
                change_db=change, reason=f"{name} starts {late_s * 1e9:+.0f} ns relative to this sensor", sure=200.0
            )
    return worst


EFFECT: Final = Effect(
    name="sync_delay",
    about="later start of each sensor along the SYNC chain",
    equation="400 ns from one sensor of the chain to the next",
    source="measured, 2019",
    needed_if="cross-emission is audible and shifts",
    estimate=_estimate,
)
