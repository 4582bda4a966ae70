"""Offset of the emitter from the centre of its array."""

from dataclasses import replace

import numpy as np

from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.snapshot import Snapshot, Transmitters

__all__ = ["estimate", "transmitter"]


def transmitter(shot: Snapshot, number: int, transmitter: Transmitters) -> Transmitters:
    """Return a sensor's emitter at its mounting position ``o + R p``, which makes paths bistatic."""
    sensor = shot.scene.sensors[number]
    pose = shot.scene.pose_of(sensor, shot.time_s).at(np.array(sensor.emitter.position_m), np.eye(3))
    return replace(transmitter, position_m=pose.position_m[None], velocity_m_s=pose.velocity_m_s[None])


def estimate(sight: Sight) -> Estimate | None:
    """Compare paths from emitters at their positions with those from the centres of their arrays."""
    sensors = sight.shot.scene.sensors
    if not any(any(sensors[number].emitter.position_m) for number in sight.emitters(sight.active)):
        return None
    return replace(
        filtered(sight, "emitter_offset", "the emitter's position changes {name} by {change:.2f} dB"), sure=200.0
    )
