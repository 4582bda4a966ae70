"""Later start of each sensor along the SYNC chain."""

from ertis_numba.constants import SYNC_STEP_S
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["sync_delay"]


def sync_delay(shot: Snapshot, emitter: int) -> float:
    """Return the start of an emitter relative to the record of the receiving sensor, in seconds.

    Sensors are chained in the order of the scene. Each sensor starts its emitter and its record together.
    """
    return (emitter - shot.number) * SYNC_STEP_S
