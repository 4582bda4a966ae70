"""When an effect matters: for each one, by how much it would change an image, and why.

A change is one of decibels at some place of the image, beside the strongest of the image at that range or beside
the weakest reflector that it shows. An estimate of None means that the scene holds nothing for the effect
to act upon.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import absorption_db_m
from ertis_numba.simulation.arrivals import effect, mouth_of
from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.sight import Echoes, Sight, change_db
from ertis_numba.simulation.sources import Sonar

__all__ = ["ESTIMATES", "Estimate"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """By how much an effect changes the image.

    Attributes
    ----------
    change_db : float
    reason : str
    sure : float
        The factor by which the change may be off.
    """

    change_db: float
    reason: str
    sure: float = 20.0


def _spreading(sight: Sight) -> Estimate | None:
    """Compare levels with those without distance."""
    if not len(sight.heard):
        return None
    longest_m = float(np.max(sight.heard.delay_s)) * sight.shot.speed_m_s
    return _filtered(sight, "spreading", f"on ways of up to {longest_m:.2f} m {{name}} changes by {{change:.1f}} dB")


def _emitter_offset(sight: Sight) -> Estimate | None:
    """Compare paths from emitters at their positions with those from the centres of their arrays."""
    sensors = sight.shot.scene.sensors
    if not any(any(sensors[number].emitter.position_m) for number in sight.emitters(sight.active)):
        return None
    return replace(
        _filtered(sight, "emitter_offset", "the emitter's position changes {name} by {change:.2f} dB"), sure=200.0
    )


def _clock_drift(sight: Sight) -> Estimate | None:
    """Compute the shift of echoes by drift of the sensors' clocks."""
    shot = sight.shot
    sensors = shot.scene.sensors
    heard = [shot.number, *sight.emitters(sight.active)]
    if not any(sensors[number].electronics.clock_drift_ppm for number in heard):
        return None
    worst = Estimate(change_db=0.0, reason="nothing is heard")
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
            most = shift_s[np.argmax(np.abs(shift_s))]
            reason = f"clock drift shifts the call of {sensors[number].name} by up to {1e9 * most:+.3g} ns"
            worst = Estimate(change_db=change, reason=reason, sure=200.0)
    return worst


def _emitter_response(sight: Sight) -> Estimate | None:
    """Compare echoes with those of a transducer with a flat frequency response."""
    shot = sight.shot
    emitters = [shot.scene.sensors[number].emitter for number in sight.emitters(sight.active)]
    resonances_hz = [emitter.resonance_hz for emitter in emitters if emitter.resonance_hz is not None]
    if not (resonances_hz and len(sight.heard)):
        return None
    reason = f"a resonance at {resonances_hz[0] / 1000:.3g} kHz changes {{name}} by {{change:.2f}} dB"
    return replace(_filtered(sight, "emitter_response", reason), sure=200.0)


def _walls(sight: Sight) -> Estimate | None:
    """Find the strongest echo over a wall."""
    if not sight.shot.mirrors:
        return None
    more = sight.echoes(sight.active | {"walls"})
    new = np.array([name not in sight.heard.names for name in more.names], dtype=np.bool_)
    return _ghosts(sight, more, new, "heard by {name} at {range:.2f} m, {level:+.1f} dB beside what is there")


def _occlusion(sight: Sight) -> Estimate | None:
    """Find the strongest echo that a wall hides."""
    if not sight.shot.mirrors:
        return None
    left = sight.echoes(sight.active | {"occlusion"})
    hidden = np.array([name not in left.names for name in sight.heard.names], dtype=np.bool_)
    if not hidden.any():
        return Estimate(change_db=0.0, reason="no wall stands on any way")
    level = hidden * sight.levels(sight.heard) * sight.reach(sight.heard.delay_s)
    worst = int(np.argmax(level))
    open_sight = Sight.of(sight.shot, sight.active | {"occlusion"})
    beside = open_sight.beside(sight.heard.delay_s)
    return Estimate(
        change_db=change_db(level, beside),
        reason=f"a wall hides {sight.heard.names[worst]}"
        + (f" and {int(hidden.sum()) - 1} more" if hidden.sum() > 1 else ""),
    )


def _target_size(sight: Sight) -> Estimate | None:
    """Compare surfaces with centres, and discs with points."""
    targets = sight.shot.targets
    if not (np.any(targets.radius_m) or np.any(targets.diameter_m)):
        return None
    return _filtered(sight, "target_size", "{name} has a size: its echo changes by {change:.2f} dB")


def _absorption(sight: Sight) -> Estimate | None:
    """Compare echoes with those through air without absorption."""
    if not len(sight.heard):
        return None
    own = sight.heard
    from_air = absorption_db_m(sight.shot.sensor.air, sight.frequency_hz)
    length_m = own.delay_s * sight.shot.speed_m_s
    after = replace(own, gain=own.gain * 10 ** (-length_m[:, None] * from_air / 20))
    longest_m = float(np.max(length_m, where=sight.reach(own.delay_s) > 0.1, initial=0.0))
    return _filtered(
        sight,
        after,
        f"{longest_m:.2f} m of air take {from_air[0] * longest_m:.2g} dB at the lower end of the band and "
        f"{from_air[-1] * longest_m:.2g} dB at the upper",
    )


def _emitter_directivity(sight: Sight) -> Estimate | None:
    """Ask how far off the emitters' axes the targets are."""
    sensors = sight.shot.scene.sensors
    diameter_m = max((sensors[number].emitter.diameter_m for number in sight.emitters(sight.active)), default=0.0)
    if not (diameter_m and len(sight.heard)):
        return None
    return _filtered(
        sight,
        "emitter_directivity",
        f"a piston of {1000 * diameter_m:.3g} mm changes {{name}} by {{change:.2f}} dB",
    )


def _microphone_directivity(sight: Sight) -> Estimate | None:
    """Ask how far off the microphones' axis the sounds arrive."""
    diameter_m = sight.shot.sensor.electronics.microphone_diameter_m
    if not (diameter_m and len(sight.heard)):
        return None
    return _filtered(
        sight,
        "microphone_directivity",
        f"ports of {1000 * diameter_m:.3g} mm change {{name}} by {{change:.2f}} dB",
    )


def _doppler(sight: Sight) -> Estimate | None:
    """Ask how far the motion of targets and sensors shifts the pulses.

    A call of hyperbolic frequency modulation, stretched by s, is the call shifted by ``-(s - 1) p₀ / p'``, p₀
    being its first period and p' the growth of its periods with time. In the mean over its frequencies that is so of a
    linear one, too.
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
        reason=f"{own.names[worst]}, {_told_m_s(float(stretch[worst]), shot.speed_m_s)}, shifts by "
        f"{shift_s[worst] * shot.speed_m_s / 2 * 1000:.3g} mm",
    )


def _told_m_s(stretch: float, speed_m_s: float) -> str:
    """Return the velocity of a reflector that stretches a call so."""
    away_m_s = speed_m_s * (stretch - 1) / (stretch + 1)
    return f"{'going' if away_m_s > 0 else 'coming'} at {abs(away_m_s):.3g} m/s"


def _aside_rad(paths: Paths, speed_m_s: float) -> NDArray[np.float64]:
    """Return by which angle targets move across the line of sight until the sound meets them: (path,) float64."""
    if not len(paths.targets):
        return np.zeros(len(paths))
    way = paths.arriving[:, 0]
    across_m_s = paths.targets.velocities_m_s - paths.ear.velocity_m_s
    across_m_s = across_m_s - np.sum(across_m_s * way, axis=-1, keepdims=True) * way
    return np.asarray(np.linalg.norm(across_m_s, axis=-1) * paths.first_m[:, 0] / speed_m_s / paths.second_m[:, 0])


def _cross_emission(sight: Sight) -> Estimate | None:
    """Find the strongest that is heard of another sensor's call, walls included."""
    if len(sight.shot.scene.sensors) == 1 or not effect("cross_emission")(sight.shot):
        return None
    more = sight.echoes(sight.active | {"cross_emission", *(["walls"] if sight.shot.mirrors else [])})
    own = sight.shot.sensor.name
    foreign = np.array([_emitter(name, own) != own for name in more.names], dtype=np.bool_)
    return _ghosts(sight, more, foreign, "{name} is heard at {range:.2f} m, {level:+.1f} dB beside what is there")


def _sync_delay(sight: Sight) -> Estimate | None:
    """Ask how far the calls of others shift, where they are heard."""
    if "cross_emission" not in sight.active:
        return None
    worst = Estimate(change_db=0.0, reason="nothing of another sensor is heard")
    for number in effect("cross_emission")(sight.shot):
        foreign = sight.of_emitter(number, sight.active)
        late_s = effect("sync_delay")(sight.shot, number)
        moved = replace(foreign, delay_s=foreign.delay_s + late_s)
        shift = sight.envelope_change(foreign, moved) * sight.reach(foreign.delay_s)
        change = change_db(shift, sight.beside(foreign.delay_s))
        if change > worst.change_db:
            name = sight.shot.scene.sensors[number].name
            worst = Estimate(
                change_db=change, reason=f"{name} starts {late_s * 1e9:+.0f} ns beside this sensor", sure=200.0
            )
    return worst


def _direct_sound(sight: Sight) -> Estimate | None:
    """Ask what is left of the direct sound where the image begins."""
    emitter = sight.shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return None
    paths = effect("direct_sound")(sight.shot, mouth_of(sight.shot, sight.active, sight.shot.number))
    amplitude = 10 ** (emitter.direct_sound_db / 20) * effect("spreading")(paths)[0]
    time_s, level = sight.near_field(amplitude, paths.length_m[0] / sight.shot.speed_m_s)
    over_m = sight.settings.call.duration_s * sight.shot.speed_m_s / 2
    return Estimate(
        change_db=change_db(level, sight.beside(time_s)),
        reason=f"{20 * math.log10(amplitude.mean()):.0f} dB at the microphones, over at {over_m:.2f} m; "
        f"the image begins at {sight.settings.processing.range_m[0]:.2f} m",
    )


def _interference(sight: Sight) -> Estimate | None:
    """Find the loudest of tones, noises and other sonars."""
    scene, shot = sight.shot.scene, sight.shot
    if not (scene.tones or scene.noises or scene.sonars):
        return None
    way_from, spread = effect("interference", "way_from"), effect("spreading")
    total, loudest, reason = 0.0, 0.0, "none is heard in the band"
    for kind in ("tones", "noises", "sonars"):
        for number, source in enumerate(getattr(scene, kind)):
            paths = way_from(shot, source)
            amplitude = float(10 ** (source.level_db / 20) * np.mean(spread(paths)))
            direction = -np.mean(paths.arriving, axis=1) @ paths.ear.axes.T
            level = float(sight.coverage(direction)[0])
            if kind == "tones":
                level *= sight.of_tone(amplitude, source.frequency_hz)
            elif kind == "noises":
                level *= sight.of_white_noise(20 * math.log10(amplitude), coherent=True, band_hz=source.band_hz)
            else:
                level *= amplitude * sight.likeness(source.call) * _part_in_window(sight, source)
            total += level
            if level > loudest:
                loudest = level
                level_db = 20 * math.log10(loudest / sight.floor)
                reason = f"{kind}[{number}] is heard with {level_db:+.1f} dB beside the weakest reflector"
    return Estimate(change_db=change_db(np.array([total]), np.array([sight.quietest])), reason=reason)


def _part_in_window(sight: Sight, sonar: Sonar) -> float:
    """Return how much of a foreign call reaches into the image, in the measurement where it does most."""
    scene, shot = sight.shot.scene, sight.shot
    if scene.count > 1:
        return 1.0  # nobody keeps it in step, so some measurement or other meets it
    way = effect("interference", "way_from")(shot, sonar)
    calls_s = effect("interference", "calls_of")(shot, sonar) + np.mean(way.length_m) / shot.speed_m_s
    return float(np.max(sight.reach(calls_s), initial=0.0))


def _ambient_noise(sight: Sight) -> Estimate | None:
    """Compare diffuse noise with the weakest reflector."""
    ambient = sight.shot.scene.ambient
    if ambient is None:
        return None
    level = sight.of_white_noise(ambient.level_dbfs, band_hz=ambient.band_hz)
    return _noise(sight, level, f"{ambient.level_dbfs:g} dBFS at each microphone")


def _microphone_noise(sight: Sight) -> Estimate | None:
    """Compare white noise with the weakest reflector."""
    dbfs = sight.shot.sensor.electronics.noise_dbfs
    if dbfs is None:
        return None
    return _noise(sight, sight.of_white_noise(dbfs), f"{dbfs:g} dBFS in each microphone")


def _microphone_spread(sight: Sight) -> Estimate | None:
    """Ask what unknown gains and delays do to main lobe and side lobes."""
    electronics = sight.shot.sensor.electronics
    if not (electronics.gain_spread_db or electronics.delay_spread_s):
        return None
    gain, late_s = effect("microphone_spread")(sight.shot)
    return _unequal(
        sight,
        gain[:, None] * np.exp(-2j * math.pi * late_s[:, None] * sight.frequency_hz),
        f"{electronics.gain_spread_db:g} dB and {1e6 * electronics.delay_spread_s:g} µs between microphones",
    )


def _microphone_faults(sight: Sight) -> Estimate | None:
    """Ask what missing microphones do to main lobe and side lobes."""
    faulty = sight.shot.sensor.electronics.faulty_channels
    if not faulty:
        return None
    hears = effect("microphone_faults")(sight.shot)
    count = int(np.sum(hears == 0))
    return _unequal(sight, hears[:, None] + np.zeros(len(sight.power)), f"{count} of {len(hears)} hear nothing")


def _ghosts(sight: Sight, seen: Echoes, new: NDArray[np.bool_], wording: str) -> Estimate:
    """Return what new echoes add to the image."""
    if not new.any():
        return Estimate(change_db=0.0, reason="nothing of it arrives")
    level, beside = sight.levels(seen) * sight.reach(seen.delay_s) * new, sight.beside(seen.delay_s)
    worst = int(np.argmax(level / beside))
    return Estimate(
        change_db=change_db(level, beside),
        reason=wording.format(
            name=seen.names[worst],
            range=seen.delay_s[worst] * sight.shot.speed_m_s / 2,
            level=20 * math.log10(max(level[worst] / beside[worst], 1e-15)),
        ),
    )


def _emitter(name: str, own: str) -> str:
    """Return whose call an echo is."""
    sensor, colon, _ = name.partition(": ")
    return sensor if colon else own


def _filtered(sight: Sight, after: Echoes | str, wording: str) -> Estimate:
    """Return what a filter on each path, or the effect of that name, changes in the image."""
    name = after if isinstance(after, str) else None
    if isinstance(after, str):
        after = sight.echoes(sight.active | {after})
    if not len(sight.heard):
        return Estimate(change_db=0.0, reason="nothing arrives")
    own = sight.heard
    reach = sight.reach(own.delay_s)
    if name is not None:  # by ringing, an echo may reach into the window that did not before
        reach = np.maximum(reach, Sight.of(sight.shot, sight.active | {name}).reach(own.delay_s))
    ratio = sight.envelope_change(own, after) * reach / sight.beside(own.delay_s, after)
    worst = int(np.argmax(ratio))
    found = 20 * math.log10(1 + ratio[worst])
    if not ratio[worst]:
        return Estimate(change_db=0.0, reason="no echo in reach changes")
    return Estimate(change_db=found, reason=wording.format(name=own.names[worst], change=found))


def _noise(sight: Sight, level: float, reason: str) -> Estimate:
    ratio_db = 20 * math.log10(max(level / sight.floor, 1e-15))
    return Estimate(
        change_db=change_db(np.array([level]), np.array([sight.quietest])),
        reason=f"{reason}: {ratio_db:+.1f} dB beside the weakest reflector of the image",
    )


def _unequal(sight: Sight, weight: NDArray[np.complex128], reason: str) -> Estimate:
    """Return what weights of microphones, (mic, node), change in the image of the echoes shown."""
    directions = sight.heard.direction[sight.shown]
    if not len(directions):  # though echoes from elsewhere may reach into it: left to a rehearsal
        return Estimate(
            change_db=sight.shot.scene.tolerance_db, reason=f"{reason}; the image shows nothing but side lobes"
        )
    change = sight.beam_change(directions, weight)
    found = 20 * math.log10(1 + change)
    return Estimate(change_db=found, reason=f"{reason}: beams change by {found:.2f} dB of their reflector")


ESTIMATES: Final[dict[str, Callable[[Sight], Estimate | None]]] = {
    "spreading": _spreading,
    "emitter_offset": _emitter_offset,
    "walls": _walls,
    "occlusion": _occlusion,
    "target_size": _target_size,
    "absorption": _absorption,
    "emitter_response": _emitter_response,
    "emitter_directivity": _emitter_directivity,
    "microphone_directivity": _microphone_directivity,
    "doppler": _doppler,
    "cross_emission": _cross_emission,
    "sync_delay": _sync_delay,
    "clock_drift": _clock_drift,
    "direct_sound": _direct_sound,
    "interference": _interference,
    "ambient_noise": _ambient_noise,
    "microphone_noise": _microphone_noise,
    "microphone_spread": _microphone_spread,
    "microphone_faults": _microphone_faults,
}
"""What is asked about each effect that can be left out."""
