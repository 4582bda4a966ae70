"""Each sensor of the SYNC chain starts later."""

from ertis_numba.constants import SYNC_STEP_S
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["sync_delay"]


def sync_delay(shot: Snapshot, emitter: int) -> float:
    """Return how much later an emitter starts than the record of the sensor that listens, in seconds.

    Sensors are chained in the order of the scene; each starts emitter and record together.
    """
    return (emitter - shot.number) * SYNC_STEP_S
