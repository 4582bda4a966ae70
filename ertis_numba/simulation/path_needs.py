"""Estimated changes by effects on the paths and levels of echoes."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import absorption_db_m
from ertis_numba.simulation.arrivals import effect
from ertis_numba.simulation.estimates import Estimate, filtered, ghosts
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.sight import Sight, change_db

__all__ = [
    "absorption",
    "clock_drift",
    "doppler",
    "emitter_directivity",
    "emitter_offset",
    "emitter_response",
    "microphone_directivity",
    "occlusion",
    "spreading",
    "target_size",
    "walls",
]


def spreading(sight: Sight) -> Estimate | None:
    """Compare the levels of echoes with those without spreading."""
    if not len(sight.heard):
        return None
    longest_m = float(np.max(sight.heard.delay_s)) * sight.shot.speed_m_s
    return filtered(sight, "spreading", f"on paths of up to {longest_m:.2f} m {{name}} changes by {{change:.1f}} dB")


def emitter_offset(sight: Sight) -> Estimate | None:
    """Compare paths from emitters at their positions with those from the centres of their arrays."""
    sensors = sight.shot.scene.sensors
    if not any(any(sensors[number].emitter.position_m) for number in sight.emitters(sight.active)):
        return None
    return replace(
        filtered(sight, "emitter_offset", "the emitter's position changes {name} by {change:.2f} dB"), sure=200.0
    )


def clock_drift(sight: Sight) -> Estimate | None:
    """Compute the shift of echoes due to drift of the sensors' clocks."""
    shot = sight.shot
    sensors = shot.scene.sensors
    heard = [shot.number, *sight.emitters(sight.active)]
    if not any(sensors[number].electronics.clock_drift_ppm for number in heard):
        return None
    worst = Estimate(change_db=0.0, reason="no echo arrives")
    for number in sight.emitters(sight.active):
        seen = sight.of_emitter(number, sight.active)
        if not len(seen):
            continue
        counted_s, _ = effect("clock_drift")(shot, number, seen.delay_s[:, None], None)
        moved = replace(seen, delay_s=counted_s[:, 0])
        shift_s = moved.delay_s - seen.delay_s
        reach = np.maximum(sight.reach(seen.delay_s), sight.reach(moved.delay_s))
        change = change_db(sight.envelope_change(seen, moved) * reach, sight.beside(seen.delay_s))
        if change >= worst.change_db:
            largest = shift_s[np.argmax(np.abs(shift_s))]
            reason = f"clock drift shifts the call of {sensors[number].name} by up to {1e9 * largest:+.3g} ns"
            worst = Estimate(change_db=change, reason=reason, sure=200.0)
    return worst


def emitter_response(sight: Sight) -> Estimate | None:
    """Compare echoes with those of a transducer with a flat frequency response."""
    shot = sight.shot
    emitters = [shot.scene.sensors[number].emitter for number in sight.emitters(sight.active)]
    resonances_hz = [emitter.resonance_hz for emitter in emitters if emitter.resonance_hz is not None]
    if not (resonances_hz and len(sight.heard)):
        return None
    reason = f"a resonance at {resonances_hz[0] / 1000:.3g} kHz changes {{name}} by {{change:.2f}} dB"
    return replace(filtered(sight, "emitter_response", reason), sure=200.0)


def walls(sight: Sight) -> Estimate | None:
    """Find the strongest echo over a wall."""
    if not sight.shot.mirrors:
        return None
    more = sight.echoes(sight.active | {"walls"})
    new = np.array([name not in sight.heard.names for name in more.names], dtype=np.bool_)
    return ghosts(sight, more, new, "{name} appears at {range:.2f} m, {level:+.1f} dB relative to the image there")


def occlusion(sight: Sight) -> Estimate | None:
    """Find the strongest echo that a wall blocks."""
    if not sight.shot.mirrors:
        return None
    left = sight.echoes(sight.active | {"occlusion"})
    hidden = np.array([name not in left.names for name in sight.heard.names], dtype=np.bool_)
    if not hidden.any():
        return Estimate(change_db=0.0, reason="no wall blocks any path")
    level = hidden * sight.levels(sight.heard) * sight.reach(sight.heard.delay_s)
    worst = int(np.argmax(level))
    open_sight = Sight.of(sight.shot, sight.active | {"occlusion"})
    beside = open_sight.beside(sight.heard.delay_s)
    return Estimate(
        change_db=change_db(level, beside),
        reason=f"a wall blocks {sight.heard.names[worst]}"
        + (f" and {int(hidden.sum()) - 1} more" if hidden.sum() > 1 else ""),
    )


def target_size(sight: Sight) -> Estimate | None:
    """Compare echoes from surfaces with those from centres, and echoes of discs with those of points."""
    targets = sight.shot.targets
    if not (np.any(targets.radius_m) or np.any(targets.diameter_m)):
        return None
    return filtered(sight, "target_size", "{name} has a size: its echo changes by {change:.2f} dB")


def absorption(sight: Sight) -> Estimate | None:
    """Compare echoes with those through air without absorption."""
    if not len(sight.heard):
        return None
    own = sight.heard
    from_air = absorption_db_m(sight.shot.sensor.air, sight.frequency_hz)
    length_m = own.delay_s * sight.shot.speed_m_s
    after = replace(own, gain=own.gain * 10 ** (-length_m[:, None] * from_air / 20))
    longest_m = float(np.max(length_m, where=sight.reach(own.delay_s) > 0.1, initial=0.0))
    return filtered(
        sight,
        after,
        f"{longest_m:.2f} m of air absorb {from_air[0] * longest_m:.2g} dB at the lower end of the band and "
        f"{from_air[-1] * longest_m:.2g} dB at the upper end",
    )


def emitter_directivity(sight: Sight) -> Estimate | None:
    """Compare echoes with those of omnidirectional emitters."""
    sensors = sight.shot.scene.sensors
    diameter_m = max((sensors[number].emitter.diameter_m for number in sight.emitters(sight.active)), default=0.0)
    if not (diameter_m and len(sight.heard)):
        return None
    return filtered(
        sight,
        "emitter_directivity",
        f"a piston of {1000 * diameter_m:.3g} mm changes {{name}} by {{change:.2f}} dB",
    )


def microphone_directivity(sight: Sight) -> Estimate | None:
    """Compare echoes with those at omnidirectional microphones."""
    diameter_m = sight.shot.sensor.electronics.microphone_diameter_m
    if not (diameter_m and len(sight.heard)):
        return None
    return filtered(
        sight,
        "microphone_directivity",
        f"ports of {1000 * diameter_m:.3g} mm change {{name}} by {{change:.2f}} dB",
    )


def doppler(sight: Sight) -> Estimate | None:
    """Compute the shift of pulses due to the motion of targets and sensors.

    A hyperbolic chirp stretched by s equals the chirp shifted by ``-(s - 1) p₀ / p'``. Here p₀ is its first period, and
    p' the growth of its periods with time. For a linear chirp this holds in the mean over its frequencies.
    """
    shot = sight.shot
    scene = shot.scene
    moving = [*scene.points, *scene.spheres, *scene.walls, *scene.boxes, *(sensor.path() for sensor in scene.sensors)]
    if not (len(sight.heard) and any(thing.moves for thing in moving)):
        return None
    move = effect("doppler")
    shifts_s, turns_s, stretches, asides = [], [], [], []
    for number in sight.emitters(sight.active):
        call = scene.sensors[number].call
        rise = (1 / call.stop_frequency_hz - 1 / call.start_frequency_hz) / call.duration_s
        for paths in sight.paths(number, sight.active):
            delay_s, stretch = move(paths, shot.speed_m_s)
            late_s = delay_s - paths.length_m / shot.speed_m_s
            coupled_s = (stretch - 1) / call.start_frequency_hz / rise
            shifts_s.append(np.mean(late_s - coupled_s, axis=1))
            turns_s.append(np.mean(np.abs(late_s) + np.abs(coupled_s), axis=1))
            stretches.append(np.mean(stretch, axis=1))
            asides.append(_aside_rad(paths, shot.speed_m_s))
    shift_s, turn_s, stretch, aside_rad = (np.concatenate(parts) for parts in (shifts_s, turns_s, stretches, asides))
    own = sight.heard
    moved = replace(own, delay_s=own.delay_s + shift_s)
    change = np.maximum(sight.envelope_change(own, moved, turn_s), sight.turn_change(own, aside_rad))
    change *= sight.reach(own.delay_s)
    worst = int(np.argmax(np.abs(shift_s)))
    return Estimate(
        change_db=change_db(change, sight.beside(own.delay_s)),
        sure=200.0,
        reason=f"{own.names[worst]}, {_reported_m_s(float(stretch[worst]), shot.speed_m_s)}, shifts by "
        f"{shift_s[worst] * shot.speed_m_s / 2 * 1000:.3g} mm",
    )


def _reported_m_s(stretch: float, speed_m_s: float) -> str:
    """Return the velocity of a reflector that causes a stretch of the call, as text."""
    away_m_s = speed_m_s * (stretch - 1) / (stretch + 1)
    return f"{'going' if away_m_s > 0 else 'coming'} at {abs(away_m_s):.3g} m/s"


def _aside_rad(paths: Paths, speed_m_s: float) -> NDArray[np.float64]:
    """Return the angle that targets move across the line of sight until the sound meets them: (path,) float64."""
    if not len(paths.targets):
        return np.zeros(len(paths))
    way = paths.arriving[:, 0]
    across_m_s = paths.targets.velocities_m_s - paths.receiver.velocity_m_s
    across_m_s = across_m_s - np.sum(across_m_s * way, axis=-1, keepdims=True) * way
    return np.asarray(np.linalg.norm(across_m_s, axis=-1) * paths.first_m[:, 0] / speed_m_s / paths.second_m[:, 0])
