"""Offset of the emitter from the centre of its array."""

from dataclasses import replace
from typing import Final

import numpy as np

from ertis_numba.simulation.effects._effect import Effect
from ertis_numba.simulation.estimates import Estimate, filtered
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose

__all__ = ["EFFECT", "emitter_offset"]


def emitter_offset(shot: Snapshot, number: int) -> TransmitterPose:
    """Return a sensor's emitter at its mounting position, ``o + R p``.

    ``o`` is the sensor's origin, ``R`` its rotation and ``p`` the setting ``emitter.position_m``. A path is then
    bistatic: its length is ``|x - (o + R p)| + |x - m|`` for a target x and a microphone m.
    """
    sensor, transmitter = shot.scene.sensors[number], shot.transmitters[number]
    return replace(
        transmitter, position_m=transmitter.position_m + sensor.rotation() @ np.array(sensor.emitter.position_m)
    )


def _estimate(sight: Sight) -> Estimate | None:
    """Compare paths from emitters at their positions with those from the centres of their arrays."""
    sensors = sight.shot.scene.sensors
    if not any(any(sensors[number].emitter.position_m) for number in sight.emitters(sight.active)):
        return None
    return replace(
        filtered(sight, "emitter_offset", "the emitter's position changes {name} by {change:.2f} dB"), sure=200.0
    )


EFFECT: Final = Effect(
    name="emitter_offset",
    about="offset of the emitter from the centre of the array",
    equation="r₁ begins at o + R p, with the origin o, the rotation R and `emitter.position_m` p",
    needed_if="the emitter is away from the centroid and echoes shift",
    requested=True,
    changes_paths=True,
    estimate=_estimate,
)
