"""Offset of the emitter from the centre of its array."""

from dataclasses import replace

import numpy as np

from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose

__all__ = ["emitter_offset"]


def emitter_offset(shot: Snapshot, number: int) -> TransmitterPose:
    """Return a sensor's emitter at its mounting position, ``o + R p``.

    ``o`` is the sensor's origin, ``R`` its rotation and ``p`` the setting ``emitter.position_m``. A path is then
    bistatic: its length is ``|x - (o + R p)| + |x - m|`` for a target x and a microphone m.
    """
    sensor, transmitter = shot.scene.sensors[number], shot.transmitters[number]
    return replace(
        transmitter, position_m=transmitter.position_m + sensor.rotation() @ np.array(sensor.emitter.position_m)
    )
