"""Ground truth: the reflectors that the image of a simulated measurement should show."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Reflector
from ertis_numba.simulation.arrivals import echoes, emitted, responses
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths, unit
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["reflectors"]

Floats = NDArray[np.float64]
_SILENT = 1e-9  # of the strongest


def reflectors(shot: Snapshot, active: frozenset[str]) -> list[Reflector]:
    """Return the echoes of a sensor's own call, then those of other sensors' calls, strongest first.

    The range of a reflector is half of the length of its sound path. Its direction is that from which the sound
    arrives. For an echo over walls, this is the position of the mirror image.

    Its level is that of the mean amplitude over the microphones and the call's band, relative to the strongest echo of
    the sensor's own call. Its velocity is relative to the sensor; for echoes over walls it is only the component along
    the line of sight. Calls of other sensors are included if cross-emission is simulated.

    Parameters
    ----------
    shot : Snapshot
    active : frozenset of str
        The effects that are simulated.

    Returns
    -------
    list of Reflector
    """
    sight = Sight(shot, active)
    levels = {number: _levels(shot, sight, number) for number in sight.emitters(active)}
    strongest = [float(np.max(level, initial=0.0)) for level in levels.values()]
    reference = strongest[0] if shot.number in levels and strongest[0] else max(strongest, default=0.0)
    return [found for number, level in levels.items() for found in _echoes(shot, sight, number, level, reference)]


def _echoes(shot: Snapshot, sight: Sight, number: int, level: Floats, reference: float) -> list[Reflector]:
    """Return the echoes of one emitter, strongest first."""
    if not len(level) or not level.max():
        return []
    seen = sight.of_emitter(number, sight.active)
    velocity_m_s = np.concatenate([_velocity_m_s(paths) for paths in sight.paths(number, sight.active)])
    found = [
        Reflector(
            name=seen.names[k],
            azimuth_deg=float(np.degrees(np.arctan2(direction[1], direction[0]))),
            elevation_deg=float(np.degrees(np.arcsin(np.clip(direction[2], -1.0, 1.0)))),
            range_m=float(seen.delay_s[k] * shot.speed_m_s / 2),
            level_db=float(20 * np.log10(level[k] / reference)),
            velocity_m_s=(float(velocity_m_s[k, 0]), float(velocity_m_s[k, 1]), float(velocity_m_s[k, 2])),
            emitter="" if number == shot.number else shot.scene.sensors[number].name,
        )
        for k, direction in enumerate(unit(seen.direction))
        if level[k] > _SILENT * reference
    ]
    return sorted(found, key=lambda reflector: -reflector.level_db)


def _levels(shot: Snapshot, sight: Sight, number: int) -> Floats:
    """Return the mean amplitude of each path of an emitter's call over microphones and band: (path,) float64."""
    other = shot.scene.sensors[number]
    emitter, active = other.emitter, sight.active
    loudness = 10 ** (emitter.level_db / 20) * sight.likeness(other.call)
    parts = [
        responses(shot, active, paths, emitter, sight.frequency_hz, CostStopwatch())
        * (emitted(active, emitter, sight.frequency_hz) * sight.power)
        for paths in echoes(shot, active, number, CostStopwatch())
    ]
    return loudness * np.concatenate([np.zeros(0), *(np.abs(np.sum(part, axis=2)).mean(axis=1) for part in parts)])


def _velocity_m_s(paths: Paths) -> Floats:
    """Return velocities in the sensor frame: (path, axis) float64."""
    transmitter, receiver, targets = paths.transmitter, paths.receiver, paths.targets
    leaving, arriving = np.mean(paths.leaving, axis=1), np.mean(paths.arriving, axis=1)
    corner_m_s = targets.velocities_m_s if len(targets) else transmitter.velocity_m_s
    longer_m_s = np.sum(leaving * (corner_m_s - transmitter.velocity_m_s), axis=1)
    longer_m_s += np.sum(arriving * (receiver.velocity_m_s - corner_m_s), axis=1)
    velocity_m_s = -arriving * (longer_m_s / 2)[:, None]
    if len(targets):
        direct = [not (before or after) for before, after in zip(transmitter.walls, receiver.walls, strict=True)]
        velocity_m_s[direct] = (targets.velocities_m_s - receiver.velocity_m_s)[direct]
    return np.asarray(np.einsum("pkx,px->pk", receiver.axes, velocity_m_s))
