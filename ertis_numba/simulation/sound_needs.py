"""Estimated changes by other sound sources, noise and electronics."""

import math
from dataclasses import replace

import numpy as np

from ertis_numba.simulation.arrivals import effect, transmitter_of
from ertis_numba.simulation.estimates import Estimate, ghosts, noise, unequal
from ertis_numba.simulation.sight import Sight, change_db
from ertis_numba.simulation.sources import Sonar

__all__ = [
    "ambient_noise",
    "cross_emission",
    "direct_sound",
    "interference",
    "microphone_faults",
    "microphone_noise",
    "microphone_spread",
    "sync_delay",
]


def cross_emission(sight: Sight) -> Estimate | None:
    """Find the strongest arrival of another sensor's call, including paths over walls."""
    if len(sight.shot.scene.sensors) == 1 or not effect("cross_emission")(sight.shot):
        return None
    more = sight.echoes(sight.active | {"cross_emission", *(["walls"] if sight.shot.mirrors else [])})
    own = sight.shot.sensor.name
    foreign = np.array([_emitter(name, own) != own for name in more.names], dtype=np.bool_)
    return ghosts(sight, more, foreign, "{name} appears at {range:.2f} m, {level:+.1f} dB relative to the image there")


def sync_delay(sight: Sight) -> Estimate | None:
    """Compute the shift of other sensors' calls due to later starts along the SYNC chain."""
    if "cross_emission" not in sight.active:
        return None
    worst = Estimate(change_db=0.0, reason="no call of another sensor arrives")
    for number in effect("cross_emission")(sight.shot):
        foreign = sight.of_emitter(number, sight.active)
        late_s = effect("sync_delay")(sight.shot, number)
        moved = replace(foreign, delay_s=foreign.delay_s + late_s)
        shift = sight.envelope_change(foreign, moved) * sight.reach(foreign.delay_s)
        change = change_db(shift, sight.beside(foreign.delay_s))
        if change > worst.change_db:
            name = sight.shot.scene.sensors[number].name
            worst = Estimate(
                change_db=change, reason=f"{name} starts {late_s * 1e9:+.0f} ns relative to this sensor", sure=200.0
            )
    return worst


def direct_sound(sight: Sight) -> Estimate | None:
    """Compare the direct sound in the range window with the reflectors."""
    emitter = sight.shot.sensor.emitter
    if emitter.direct_sound_db is None or emitter.silent:
        return None
    paths = effect("direct_sound")(sight.shot, transmitter_of(sight.shot, sight.active, sight.shot.number))
    amplitude = 10 ** (emitter.direct_sound_db / 20) * effect("spreading")(paths)[0]
    time_s, level = sight.near_field(amplitude, paths.length_m[0] / sight.shot.speed_m_s)
    over_m = sight.settings.call.duration_s * sight.shot.speed_m_s / 2
    return Estimate(
        change_db=change_db(level, sight.beside(time_s)),
        reason=f"{20 * math.log10(amplitude.mean()):.0f} dB at the microphones, ends at {over_m:.2f} m; "
        f"the image begins at {sight.settings.processing.range_m[0]:.2f} m",
    )


def interference(sight: Sight) -> Estimate | None:
    """Find the loudest of tones, noises and other sonars."""
    scene, shot = sight.shot.scene, sight.shot
    if not (scene.tones or scene.noises or scene.sonars):
        return None
    way_from, spread = effect("interference", "way_from"), effect("spreading")
    total, loudest, reason = 0.0, 0.0, "no source reaches the band"
    for kind in ("tones", "noises", "sonars"):
        for number, source in enumerate(getattr(scene, kind)):
            paths = way_from(shot, source)
            amplitude = float(10 ** (source.level_db / 20) * np.mean(spread(paths)))
            direction = -np.mean(paths.arriving, axis=1) @ paths.receiver.axes.T
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
                reason = f"{kind}[{number}] reaches {level_db:+.1f} dB relative to the weakest reflector"
    return Estimate(change_db=change_db(np.array([total]), np.array([sight.quietest])), reason=reason)


def _part_in_window(sight: Sight, sonar: Sonar) -> float:
    """Return the largest fraction of another sonar's call that reaches into the image of any measurement."""
    scene, shot = sight.shot.scene, sight.shot
    if scene.count > 1:
        return 1.0  # its calls are not synchronised, so at least one measurement contains one
    way = effect("interference", "way_from")(shot, sonar)
    calls_s = effect("interference", "calls_of")(shot, sonar) + np.mean(way.length_m) / shot.speed_m_s
    return float(np.max(sight.reach(calls_s), initial=0.0))


def ambient_noise(sight: Sight) -> Estimate | None:
    """Compare diffuse noise with the weakest reflector."""
    ambient = sight.shot.scene.ambient
    if ambient is None:
        return None
    level = sight.of_white_noise(ambient.level_dbfs, band_hz=ambient.band_hz)
    return noise(sight, level, f"{ambient.level_dbfs:g} dBFS at each microphone")


def microphone_noise(sight: Sight) -> Estimate | None:
    """Compare white noise with the weakest reflector."""
    dbfs = sight.shot.sensor.electronics.noise_dbfs
    if dbfs is None:
        return None
    return noise(sight, sight.of_white_noise(dbfs), f"{dbfs:g} dBFS in each microphone")


def microphone_spread(sight: Sight) -> Estimate | None:
    """Compute the change of main lobe and side lobes by uncalibrated gains and delays."""
    electronics = sight.shot.sensor.electronics
    if not (electronics.gain_spread_db or electronics.delay_spread_s):
        return None
    gain, late_s = effect("microphone_spread")(sight.shot)
    return unequal(
        sight,
        gain[:, None] * np.exp(-2j * math.pi * late_s[:, None] * sight.frequency_hz),
        f"{electronics.gain_spread_db:g} dB and {1e6 * electronics.delay_spread_s:g} µs between microphones",
    )


def microphone_faults(sight: Sight) -> Estimate | None:
    """Compute the change of main lobe and side lobes by faulty microphones."""
    faulty = sight.shot.sensor.electronics.faulty_channels
    if not faulty:
        return None
    hears = effect("microphone_faults")(sight.shot)
    count = int(np.sum(hears == 0))
    return unequal(
        sight, hears[:, None] + np.zeros(len(sight.power)), f"{count} of {len(hears)} microphones receive no sound"
    )


def _emitter(name: str, own: str) -> str:
    """Return the name of the sensor whose call an echo is."""
    sensor, colon, _ = name.partition(": ")
    return sensor if colon else own
