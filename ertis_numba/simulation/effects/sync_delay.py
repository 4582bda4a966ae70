"""Each sensor of the SYNC chain starts later."""

from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["STEP_S", "sync_delay"]

STEP_S = 400e-9  # from one sensor to the next, measured by the authors of the 2019 paper


def sync_delay(shot: Snapshot, emitter: int) -> float:
    """Return how much later an emitter starts than the record of the sensor that listens, in seconds.

    Sensors are chained in the order of the scene; each starts emitter and record together.
    """
    return (emitter - shot.number) * STEP_S
