"""Validity limits of the target models: impossible positions, and notes on inaccurate echoes."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.simulation.arrivals import transmitter_of
from ertis_numba.simulation.effects.spreading import NEAREST_M
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["notes", "require_clear"]

_MIN_DISTANCE_M = 1e-3


def notes(shot: Snapshot) -> list[str]:
    """Return a note for each target or source that is too close for its model."""
    return [*_near_targets(shot), *_near_discs(shot)]


def _near_targets(shot: Snapshot) -> list[str]:
    """Return a note for each target or source so close to an emitter or a microphone that its amplitude is limited."""
    scene, sensor = shot.scene, shot.sensor
    ends_m = np.concatenate([shot.receiver.positions_m[0], _emitter_m(shot, shot.number)[None]])
    targets = shot.targets
    things = list(zip(targets.names, targets.positions_m, strict=True))
    for kind in ("tones", "noises", "sonars"):
        sources = enumerate(getattr(scene, kind))
        things += [(f"{kind}[{number}]", source.position_at(shot.time_s)) for number, source in sources]
    found = []
    for name, place in things:
        apart_m = float(np.min(np.linalg.norm(ends_m - place, axis=1)))
        if apart_m < NEAREST_M:
            found.append(
                f"{name} is {1e3 * apart_m:.2g} mm from an emitter or a microphone of {sensor.name} at "
                f"{shot.time_s:.3g} s; the model uses its level at {1e3 * NEAREST_M:g} mm. Move it away from the sensor"
            )
    return found


def _near_discs(shot: Snapshot) -> list[str]:
    """Return a note for each disc that is too close for Fresnel's approximation."""
    targets = shot.targets
    wave = 2 * math.pi * shot.sensor.call.high_frequency_hz / shot.speed_m_s
    apart_m = np.linalg.norm(targets.positions_m - shot.receiver.centre_m, axis=1)
    min_m = np.cbrt(wave * (targets.diameter_m / 2) ** 4 / math.pi)
    return [
        f"{targets.names[k]} is a disc of {targets.diameter_m[k]:g} m at {apart_m[k]:.2g} m from {shot.sensor.name}; "
        f"its echo is accurate only from {min_m[k]:.2g} m. Make it smaller, move it away, or use a wall with size_m"
        for k in np.flatnonzero((targets.diameter_m > 0) & (apart_m < min_m))
    ]


def require_clear(shot: Snapshot) -> None:
    """Raise an error for spheres around or within 1 mm of a microphone or an emitter; `notes` reports close points."""
    targets = shot.targets
    places = {f"emitter of {other.name}": place for other, place in _emitters(shot)}
    places |= {
        f"microphone {channel} of {shot.sensor.name}": place
        for channel, place in zip(shot.channels, shot.receiver.positions_m[0], strict=True)
    }
    apart_m = np.linalg.norm(targets.positions_m[:, None] - np.array([*places.values()]), axis=2)
    blocked = np.argwhere((apart_m < targets.radius_m[:, None] + _MIN_DISTANCE_M) & (targets.radius_m[:, None] > 0))
    if not len(blocked):
        return
    target, place = blocked[0]
    at = f" at {shot.time_s:g} s" if shot.scene.moves else ""
    raise ArgumentError(
        f"{targets.names[target]} is {apart_m[target, place]:.3g} m from {[*places][place]}{at} and has a radius of "
        f"{targets.radius_m[target]:g} m; "
        f"leave at least {1000 * _MIN_DISTANCE_M:g} mm between them"
    )


def _emitters(shot: Snapshot) -> list[tuple[Sensor, NDArray[np.float64]]]:
    """Return the sensors that emit, and the positions of their emitters."""
    return [
        (other, _emitter_m(shot, number)) for number, other in enumerate(shot.scene.sensors) if not other.emitter.silent
    ]


def _emitter_m(shot: Snapshot, number: int) -> NDArray[np.float64]:
    """Return the position of a sensor's emitter: (axis,) float64."""
    offset = {"emitter_offset"} if any(shot.scene.sensors[number].emitter.position_m) else set()
    [position_m] = transmitter_of(shot, offset, number).position_m
    return np.asarray(position_m)
