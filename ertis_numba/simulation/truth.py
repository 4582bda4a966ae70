"""Ground truth: the reflectors that the image of a simulated measurement should show."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Reflector, TrueSource
from ertis_numba.simulation.arrivals import echoes, emitted, responses
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.paths import Paths, unit
from ertis_numba.simulation.snapshot import Snapshot
from ertis_numba.simulation.source_paths import AnySource, SourceInScene, all_sources
from ertis_numba.simulation.sources import Tone
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["reflectors", "true_sources"]

Floats = NDArray[np.float64]
_SILENT = 1e-9  # of the strongest
_LOWEST = 1e-30  # mean square of −300 dBFS


def reflectors(shot: Snapshot, active: frozenset[str]) -> list[Reflector]:
    """Return the echoes of a sensor's own call, then those of others if cross-emission is simulated, strongest first.

    Ranges are half of the sound path, directions those of arrival, and levels relative to the strongest own echo.
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


def true_sources(shot: Snapshot, active: frozenset[str]) -> list[TrueSource]:
    """Return the sources of sound, in the order of tones, noises and sonars; none without simulated interference."""
    if "interference" not in active:
        return []
    return [_true_source(shot, each) for each in all_sources(shot, active)]


def _true_source(shot: Snapshot, source: SourceInScene[AnySource]) -> TrueSource:
    place = source.source.position_at(shot.time_s)
    apart_m = shot.receiver.axes[0] @ (place - shot.receiver.centre_m[0])
    range_m = float(np.linalg.norm(apart_m))
    frequency_hz, _ = source.spectrum
    return TrueSource(
        name=source.name,
        kind=source.source.label(),
        position_m=(float(place[0]), float(place[1]), float(place[2])),
        azimuth_deg=float(np.degrees(np.arctan2(apart_m[1], apart_m[0]))),
        elevation_deg=float(np.degrees(np.arcsin(apart_m[2] / range_m))) if range_m else 0.0,
        range_m=range_m,
        band_hz=(float(frequency_hz.min()), float(frequency_hz.max())),
        level_dbfs=float(10 * np.log10(max(_mean_square(source), _LOWEST))),
    )


def _mean_square(source: SourceInScene[AnySource]) -> float:
    """Return the mean square of a source's sound at the microphones: paths of tones interfere, others add powers."""
    if not len(source.paths):
        return 0.0
    frequency_hz, power = source.spectrum
    response = source.response(frequency_hz)
    if isinstance(source.source, Tone):
        delay_s = source.paths.length_m / source.shot.speed_m_s
        heard = np.abs(np.sum(response * np.exp(-2j * np.pi * delay_s[..., None] * frequency_hz), axis=0)) ** 2
    else:
        heard = np.sum(response**2, axis=0)
    return float(np.mean(heard @ power))
