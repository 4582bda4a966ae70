"""When an effect matters: for each one, by how much it would change an image, and why.

A change is one of decibels at some place of the image, beside the strongest of the image at that range or beside
the weakest reflector that it shows. An estimate of None means that the scene holds nothing for the effect
to act upon.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import absorption_db_m
from ertis_numba.simulation.arrivals import effect
from ertis_numba.simulation.sight import Echoes, Sight, change_db

__all__ = ["ESTIMATES", "Estimate"]



@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """By how much an effect changes the image.

    Attributes
    ----------
    change_db : float
    reason : str
    """

    change_db: float
    reason: str


def spreading(sight: Sight) -> Estimate | None:
    """Levels by distance, against the level at 1 m."""
    own = sight.own
    if not len(own):
        return None
    spread = sight.echoes(sight.shot.number, sight.active | {"spreading"})
    ratio_db = 20 * np.abs(np.log10(sight.levels(spread) / np.maximum(sight.levels(own), 1e-300) + 1e-300))
    lengths_m = own.delay_s * sight.shot.speed_m_s
    worst = int(np.argmax(ratio_db))
    return Estimate(
        change_db=float(ratio_db[worst]),
        reason=f"on a way of {lengths_m[worst]:.2f} m {own.names[worst]} changes by {ratio_db[worst]:.1f} dB",
    )


def walls(sight: Sight) -> Estimate | None:
    """The strongest echo over a wall."""
    if not sight.shot.mirrors:
        return None
    more = sight.echoes(sight.shot.number, sight.active | {"walls"})
    new = np.array([name not in sight.own.names for name in more.names], dtype=np.bool_)
    return _ghosts(sight, more, new, "heard by {name} at {range:.2f} m, {level:+.1f} dB beside what is there")


def occlusion(sight: Sight) -> Estimate | None:
    """The strongest echo that a wall hides."""
    if not sight.shot.mirrors:
        return None
    left = sight.echoes(sight.shot.number, sight.active | {"occlusion"})
    hidden = np.array([name not in left.names for name in sight.own.names], dtype=np.bool_)
    if not hidden.any():
        return Estimate(change_db=0.0, reason="no wall stands on any way")
    level = np.where(hidden & sight.inside(sight.own.delay_s), sight.levels(sight.own), 0.0)
    worst = int(np.argmax(level))
    open_sight = Sight(sight.shot, sight.active | {"occlusion"})
    beside = open_sight.beside(sight.own.delay_s)
    return Estimate(
        change_db=change_db(level, beside),
        reason=f"a wall hides {sight.own.names[worst]}"
        + (f" and {int(hidden.sum()) - 1} more" if hidden.sum() > 1 else ""),
    )


def target_size(sight: Sight) -> Estimate | None:
    """Surfaces before centres, discs that face elsewhere."""
    targets = sight.shot.targets
    if not (np.any(targets.radius_m) or np.any(targets.diameter_m)):
        return None
    return _filtered(sight, "target_size", "{name} has a size: its echo changes by {change:.2f} dB")


def absorption(sight: Sight) -> Estimate | None:
    """Absorption over the longest way."""
    if not len(sight.own):
        return None
    own = sight.own
    from_air = absorption_db_m(sight.shot.sensor.air, sight.frequency_hz)
    length_m = own.delay_s * sight.shot.speed_m_s
    after = Echoes(
        names=own.names,
        gain=own.gain * 10 ** (-length_m[:, None] * from_air / 20),
        delay_s=own.delay_s,
        direction=own.direction,
    )
    longest_m = float(np.max(length_m, where=sight.shown, initial=0.0))
    return _filtered(
        sight,
        after,
        f"{longest_m:.2f} m of air take {from_air[0] * longest_m:.2g} to {from_air[-1] * longest_m:.2g} dB over the band",
    )


def emitter_directivity(sight: Sight) -> Estimate | None:
    """How far off the emitter's axis the targets are."""
    diameter_m = sight.shot.sensor.emitter.diameter_m
    if not (diameter_m and len(sight.own)):
        return None
    return _filtered(
        sight,
        "emitter_directivity",
        f"a piston of {1000 * diameter_m:g} mm changes {{name}} by {{change:.2f}} dB",
    )


def microphone_directivity(sight: Sight) -> Estimate | None:
    """How far off the microphones' axis the sounds arrive."""
    diameter_m = sight.shot.sensor.electronics.microphone_diameter_m
    if not (diameter_m and len(sight.own)):
        return None
    return _filtered(
        sight,
        "microphone_directivity",
        f"ports of {1000 * diameter_m:g} mm change {{name}} by {{change:.2f}} dB",
    )


def doppler(sight: Sight) -> Estimate | None:
    """How far the motion of targets and sensors shifts the pulses.

    A call of hyperbolic frequency modulation, stretched by s, is the call shifted by ``-(s - 1) p₀ / p'``, p₀ being its first
    period and p' the growth of its periods with time.
    """
    shot = sight.shot
    scene = shot.scene
    moving = [*scene.points, *scene.spheres, *scene.walls, *scene.boxes, shot.sensor.path()]
    if not (len(sight.own) and any(thing.moves for thing in moving)):
        return None
    call = shot.sensor.call
    rise = (1 / call.stop_frequency_hz - 1 / call.start_frequency_hz) / call.duration_s
    coupling_s = 1 / call.start_frequency_hz / rise
    move = effect("doppler")
    shifts_s, stretches = [], []
    for paths in sight.paths(shot.number, sight.active):
        delay_s, stretch = move(paths, shot.speed_m_s)
        shift_s = delay_s - paths.length_m / shot.speed_m_s - (stretch - 1) * coupling_s
        shifts_s.append(np.mean(shift_s, axis=1))
        stretches.append(np.mean(stretch, axis=1))
    shift_s, stretch = np.concatenate(shifts_s), np.concatenate(stretches)
    own = sight.own
    moved = Echoes(names=own.names, gain=own.gain, delay_s=own.delay_s + shift_s, direction=own.direction)
    change = sight.envelope_change(own, moved) * sight.inside(own.delay_s)
    worst = int(np.argmax(np.abs(shift_s)))
    return Estimate(
        change_db=change_db(change, sight.beside(own.delay_s)),
        reason=f"{own.names[worst]}, coming at {-(stretch[worst] - 1) / 2 * shot.speed_m_s:.3g} m/s, shifts by "
        f"{shift_s[worst] * shot.speed_m_s / 2 * 1000:.3g} mm",
    )


def cross_emission(sight: Sight) -> Estimate | None:
    """The strongest that is heard of another sensor's call."""
    others = effect("cross_emission")(sight.shot)
    if not others:
        return None
    worst = Estimate(change_db=0.0, reason="no other sensor can be heard")
    for number in others:
        foreign = sight.echoes(number, sight.active)
        name = sight.shot.scene.sensors[number].name
        heard = _ghosts(
            sight,
            foreign,
            np.ones(len(foreign), dtype=np.bool_),
            f"{name} is heard by {{name}} at {{range:.2f}} m, {{level:+.1f}} dB beside what is there",
            like=_likeness(sight, number),
        )
        if heard.change_db > worst.change_db:
            worst = heard
    return worst


def sync_delay(sight: Sight) -> Estimate | None:
    """How far the calls of others shift, where they are heard."""
    if "cross_emission" not in sight.active:
        return None
    worst = Estimate(change_db=0.0, reason="nothing of another sensor is heard")
    for number in effect("cross_emission")(sight.shot):
        foreign = sight.echoes(number, sight.active)
        late_s = effect("sync_delay")(sight.shot, number)
        moved = Echoes(
            names=foreign.names, gain=foreign.gain, delay_s=foreign.delay_s + late_s, direction=foreign.direction
        )
        shift = sight.envelope_change(foreign, moved) * sight.inside(foreign.delay_s) * _likeness(sight, number)
        change = change_db(shift, sight.beside(foreign.delay_s))
        if change > worst.change_db:
            name = sight.shot.scene.sensors[number].name
            worst = Estimate(change_db=change, reason=f"{name} starts {late_s * 1e9:+.0f} ns beside this sensor")
    return worst


def direct_sound(sight: Sight) -> Estimate | None:
    """What is left of the direct sound where the image begins."""
    emitter = sight.shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return None
    call, speed_m_s = sight.shot.sensor.call, sight.shot.speed_m_s
    first_m = sight.settings.processing.range_m[0]
    paths = effect("direct_sound")(sight.shot)
    amplitude = 10 ** (emitter.direct_sound_db / 20) * effect("spreading")(paths)[0]
    over_m = sight.pulse_over_s() * speed_m_s / 2
    if first_m > over_m:
        return Estimate(
            change_db=0.0, reason=f"it is over at {over_m:.2f} m, and the image begins at {first_m:.2f} m"
        )
    left = sight.near_field(amplitude, paths.length_m[0] / speed_m_s)
    return Estimate(
        change_db=change_db(left, sight.beside(sight.lags_s())),
        reason=f"{20 * math.log10(amplitude.mean()):.0f} dB at the microphones, over at {over_m:.2f} m, "
        f"while the image begins at {first_m:.2f} m ({1000 * call.duration_s:g} ms of call)",
    )


def interference(sight: Sight) -> Estimate | None:
    """The loudest of tones, noises and other sonars."""
    scene, shot = sight.shot.scene, sight.shot
    if not (scene.tones or scene.noises or scene.sonars):
        return None
    way_from, spread = effect("interference", "way_from"), effect("spreading")
    loudest, reason = 0.0, "none is heard in the band"
    for kind in ("tones", "noises", "sonars"):
        for number, source in enumerate(getattr(scene, kind)):
            paths = way_from(shot, source)
            amplitude = float(10 ** (source.level_db / 20) * np.mean(spread(paths)))
            direction = -np.mean(paths.arriving, axis=1) @ paths.ear.axes.T
            part = float(sight.coverage(direction)[0])
            if kind == "tones":
                level = sight.of_tone(amplitude, source.frequency_hz)
            elif kind == "noises":
                level = sight.of_white_noise(20 * math.log10(amplitude), coherent=True, band_hz=source.band_hz)
            else:
                calls_s = effect("interference", "calls_of")(shot, source) + np.mean(paths.length_m) / shot.speed_m_s
                level = amplitude * sight.likeness(source.call) * bool(np.any(sight.inside(calls_s)))
            if level * part > loudest:
                loudest = level * part
                reason = f"{kind}[{number}] is heard with {20 * math.log10(loudest / sight.floor):+.1f} dB beside the weakest"
    return Estimate(change_db=change_db(np.array([loudest]), np.array([sight.floor])), reason=reason)


def ambient_noise(sight: Sight) -> Estimate | None:
    """Diffuse noise against the weakest reflector."""
    ambient = sight.shot.scene.ambient
    if ambient is None:
        return None
    level = sight.of_white_noise(ambient.level_dbfs, band_hz=ambient.band_hz)
    return _noise(sight, level, f"{ambient.level_dbfs:g} dBFS at each microphone")


def microphone_noise(sight: Sight) -> Estimate | None:
    """White noise against the weakest reflector."""
    dbfs = sight.shot.sensor.electronics.noise_dbfs
    if dbfs is None:
        return None
    return _noise(sight, sight.of_white_noise(dbfs), f"{dbfs:g} dBFS in each microphone")


def microphone_spread(sight: Sight) -> Estimate | None:
    """What unknown gains and delays do to main lobe and side lobes."""
    electronics = sight.shot.sensor.electronics
    if not (electronics.gain_spread_db or electronics.delay_spread_s):
        return None
    gain, late_s = effect("microphone_spread")(sight.shot)
    return _unequal(
        sight,
        gain[:, None] * np.exp(-2j * math.pi * late_s[:, None] * sight.frequency_hz),
        f"{electronics.gain_spread_db:g} dB and {1e6 * electronics.delay_spread_s:g} µs between microphones",
    )


def microphone_faults(sight: Sight) -> Estimate | None:
    """What missing microphones do to main lobe and side lobes."""
    faulty = sight.shot.sensor.electronics.faulty_channels
    if not faulty:
        return None
    hears = effect("microphone_faults")(sight.shot)
    count = int(np.sum(hears == 0))
    return _unequal(sight, hears[:, None] + np.zeros(len(sight.power)), f"{count} of {len(hears)} hear nothing")


def _ghosts(sight: Sight, seen: Echoes, new: NDArray[np.bool_], wording: str, like: float = 1.0) -> Estimate:
    """Return what new echoes add to the image."""
    new = new & sight.inside(seen.delay_s)
    if not new.any():
        return Estimate(change_db=0.0, reason="nothing of it comes to the ranges of the image")
    level, beside = like * sight.levels(seen) * new, sight.beside(seen.delay_s)
    worst = int(np.argmax(level / beside))
    return Estimate(
        change_db=change_db(level, beside),
        reason=wording.format(
            name=seen.names[worst],
            range=seen.delay_s[worst] * sight.shot.speed_m_s / 2,
            level=20 * math.log10(max(level[worst] / beside[worst], 1e-15)),
        ),
    )


def _filtered(sight: Sight, after: Echoes | str, wording: str) -> Estimate:
    """Return what a filter on each path, or the effect of that name, changes in the image."""
    if isinstance(after, str):
        after = sight.echoes(sight.shot.number, sight.active | {after})
    own = sight.own
    ratio = sight.envelope_change(own, after) * sight.shown / sight.beside(own.delay_s, after)
    worst = int(np.argmax(ratio))
    found = 20 * math.log10(1 + ratio[worst])
    return Estimate(change_db=found, reason=wording.format(name=own.names[worst], change=found))


def _noise(sight: Sight, level: float, reason: str) -> Estimate:
    ratio_db = 20 * math.log10(max(level / sight.floor, 1e-15))
    return Estimate(
        change_db=change_db(np.array([level]), np.array([sight.floor])),
        reason=f"{reason}: {ratio_db:+.1f} dB beside the weakest reflector of the image",
    )


def _unequal(sight: Sight, weight: NDArray[np.complex128], reason: str) -> Estimate:
    """Return what weights of microphones, (mic, node), change in the image of the echoes shown."""
    directions = sight.own.direction[sight.shown]
    if not len(directions):
        return Estimate(change_db=0.0, reason="the image shows nothing that they could change")
    change = sight.beam_change(directions, weight)
    found = 20 * math.log10(1 + change)
    return Estimate(change_db=found, reason=f"{reason}: beams change by {found:.2f} dB of their reflector")


def _likeness(sight: Sight, number: int) -> float:
    return sight.likeness(sight.shot.scene.sensors[number].call)


ESTIMATES: Final[dict[str, Callable[[Sight], Estimate | None]]] = {
    function.__name__: function
    for function in (
        spreading,
        walls,
        occlusion,
        target_size,
        absorption,
        emitter_directivity,
        microphone_directivity,
        doppler,
        cross_emission,
        sync_delay,
        direct_sound,
        interference,
        ambient_noise,
        microphone_noise,
        microphone_spread,
        microphone_faults,
    )
}
"""What is asked about each effect that can be left out."""
