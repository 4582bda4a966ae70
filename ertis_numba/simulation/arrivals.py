"""Delay, amplitude and filter of every call of a scene at every microphone."""

import importlib
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Call
from ertis_numba.simulation.bounds import require_few_amplitudes, require_few_paths
from ertis_numba.simulation.mirrors import images
from ertis_numba.simulation.paths import Paths, by_targets, without_target
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import Snapshot, TransmitterPose
from ertis_numba.simulation.stopwatch import CostStopwatch

__all__ = ["Arrivals", "arrivals", "echoes", "effect", "emitted", "gains", "responses", "transmitter_of"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_TICK_S = 1e-12
_LONGEST_STRETCH = 2.0  # of a call; speeds are limited to a third of the speed of sound


@dataclass(frozen=True, slots=True, eq=False)
class Arrivals:
    """Copies of one call at the microphones.

    Attributes
    ----------
    call : Call
    delay_s : (path, mic) float64
        Delay from the start of the record, including the microphone's own delay.
    amplitude : (path, mic, frequency) float64 or complex128
        Amplitude at each frequency, or one value for all, including the microphone's sensitivity.
    stretch : (path, mic) float64 or None
        Received duration relative to the emitted duration; None if nothing moves and clocks agree.
    emitter : Emitter or None
        Emitter whose transducer filters the call; None if none does.
    """

    call: Call
    delay_s: Floats
    amplitude: Floats | Complexes
    stretch: Floats | None = None
    emitter: Emitter | None = None


def effect(name: str, function: str | None = None) -> Any:
    """Return the function of an effect; its module is imported at the first call."""
    return getattr(importlib.import_module(f"ertis_numba.simulation.effects.{name}"), function or name)


def arrivals(shot: Snapshot, active: AbstractSet[str], frequency_hz: Floats, clock: CostStopwatch) -> list[Arrivals]:
    """Return all copies of calls that arrive at the microphones.

    Delays are rounded to picoseconds. This is far finer than a measurement can resolve. It is coarse enough to hide the
    last digits of sines and roots, which differ between processors.

    Parameters
    ----------
    shot : Snapshot
    active : set of str
        The effects that are simulated.
    frequency_hz : (frequency,) float64
        Frequencies at which filters are evaluated.
    clock : CostStopwatch
        Accumulates the time spent on each effect.

    Returns
    -------
    list of Arrivals
    """
    gain, late_s = gains(shot, active, clock)
    found = []
    numbers = [] if shot.sensor.emitter.silent else [shot.number]
    if "cross_emission" in active:
        numbers += effect("cross_emission")(shot)
    for number in numbers:
        sensor = shot.scene.sensors[number]
        level = _linear(sensor.emitter.level_db)
        start_s = effect("sync_delay")(shot, number) if "sync_delay" in active else 0.0
        own = "propagation" if number == shot.number else "cross_emission"
        for paths in echoes(shot, active, number, clock, n_frequencies=len(frequency_hz)):
            amplitude = level * responses(shot, active, paths, sensor.emitter, frequency_hz, clock)
            with clock("doppler" if "doppler" in active else own):
                delay_s, stretch = _times(shot, active, paths)
            amplitude = gain[:, None] * amplitude
            found.append(_arrivals(shot, active, number, delay_s + start_s, amplitude, late_s, stretch))
    direct_db = shot.sensor.emitter.direct_sound_db
    if "direct_sound" in active and direct_db is not None and not shot.sensor.emitter.silent:
        with clock("direct_sound"):
            paths = effect("direct_sound")(shot, transmitter_of(shot, active, shot.number))
            amplitude = (_linear(direct_db) * gain * effect("spreading")(paths))[..., None]
            delay_s = effect("propagation")(paths, shot.speed_m_s)
            found.append(_arrivals(shot, active, shot.number, delay_s, amplitude, late_s))
    if "interference" in active:
        with clock("interference"):
            found += _sonars(shot, gain, late_s)
    return found


def transmitter_of(shot: Snapshot, active: AbstractSet[str], number: int) -> TransmitterPose:
    """Return the emitter of a sensor, at the sensor's origin or at its offset."""
    if "emitter_offset" in active:
        return cast("TransmitterPose", effect("emitter_offset")(shot, number))
    return shot.transmitters[number]


def echoes(
    shot: Snapshot, active: AbstractSet[str], number: int, clock: CostStopwatch, *, n_frequencies: int = 1
) -> list[Paths]:
    """Return the paths of an emitter's call over targets and walls.

    The direct path is included only for the emitter of another sensor.

    Parameters
    ----------
    shot : Snapshot
    active : set of str
        The effects that are simulated.
    number : int
        Index of the emitting sensor.
    clock : CostStopwatch
    n_frequencies : int
        Number of frequencies at which amplitudes will be computed.

    Raises
    ------
    ArgumentError
        There are too many paths or amplitudes.
    """
    transmitter = transmitter_of(shot, active, number)
    if "walls" in active:
        key = "walls", number, "emitter_offset" in active
        with clock("walls"):
            firsts, seconds, specular = shot.once(key, lambda: effect("walls")(shot, transmitter))
    else:
        firsts = tuple(images(transmitter, shot.targets.positions_m, (), 0))
        seconds = tuple(images(shot.receiver, shot.targets.positions_m, (), 0))
        specular = tuple(images(transmitter, shot.receiver.centre_m[None], (), 0))
    if "occlusion" in active:
        with clock("occlusion"):
            hide = effect("occlusion")
            firsts, seconds, specular = (hide(seen, shot.mirrors) for seen in (firsts, seconds, specular))
    over = by_targets
    if "target_size" in active and np.any(shot.targets.radius_m):
        over = effect("target_size", "over_surfaces")
    found, n_paths = [], 0
    for first in firsts:
        for second in seconds:
            chosen = np.flatnonzero(first.exists & second.exists)
            if len(chosen) and len(first.mirrors) + len(second.mirrors) <= shot.scene.max_reflections:
                n_paths += len(chosen)
                require_few_paths(n_paths)
                require_few_amplitudes(n_paths, len(shot.channels), n_frequencies)
                found.append(over(first, second, shot.targets, chosen))
    here = np.arange(1)
    return found + [
        without_target(seen.end, shot.receiver, shot.targets, seen.to_corners_m(here))
        for seen in specular
        if seen.exists[0] and (seen.mirrors or number != shot.number)
    ]


def responses(
    shot: Snapshot,
    active: AbstractSet[str],
    paths: Paths,
    emitter: Emitter,
    frequency_hz: Floats,
    clock: CostStopwatch,
) -> Floats | Complexes:
    """Return the gain of a call due to distance, air, walls, targets and directivity: (path, mic, frequency).

    The type is float64, or complex128 if a target shifts the phase. `emitted` returns the transducer's own response.
    """
    strength = _strength(paths, spreads="spreading" in active)
    amplitude = paths.reflection * strength[:, None, None] * np.ones((*paths.second_m.shape, 1))
    if "spreading" in active:
        with clock("spreading"):
            amplitude *= effect("spreading")(paths)[..., None]
    if "target_size" in active and len(paths.targets):
        with clock("target_size"):
            amplitude = amplitude * effect("target_size", "patterns")(paths, frequency_hz, shot.speed_m_s)
    if "absorption" in active:
        with clock("absorption"):
            amplitude = amplitude * effect("absorption")(paths, shot.sensor.air, frequency_hz)
    if "emitter_directivity" in active and emitter.diameter_m:
        with clock("emitter_directivity"):
            pattern = effect("emitter_directivity")(paths, emitter.diameter_m, frequency_hz, shot.speed_m_s)
            amplitude = amplitude * pattern
    diameter_m = shot.sensor.electronics.microphone_diameter_m
    if "microphone_directivity" in active and diameter_m:
        with clock("microphone_directivity"):
            pattern = effect("microphone_directivity")(paths, diameter_m, frequency_hz, shot.speed_m_s)
            amplitude = amplitude * pattern
    return amplitude


def emitted(active: AbstractSet[str], emitter: Emitter, frequency_hz: Floats) -> Floats | Complexes:
    """Return the transducer's response at each frequency of a call: (frequency,) float64 or complex128."""
    if "emitter_response" in active and emitter.resonance_hz is not None:
        return cast("Complexes", effect("emitter_response")(emitter, frequency_hz))
    return np.ones(len(frequency_hz))


def gains(shot: Snapshot, active: AbstractSet[str], clock: CostStopwatch) -> tuple[Floats, Floats]:
    """Return the sensitivity and the delay of each microphone: both (mic,) float64.

    Both include the calibration of the settings and the uncalibrated spread. Processing corrects only the calibration.
    """
    gain, late_s = shot.layout.gain[shot.channels], shot.layout.delay_s[shot.channels]
    if "microphone_spread" in active:
        with clock("microphone_spread"):
            more, later_s = effect("microphone_spread")(shot)
            gain, late_s = gain * more, late_s + later_s
    if "microphone_faults" in active:
        with clock("microphone_faults"):
            gain = gain * effect("microphone_faults")(shot)
    return gain, late_s


def _strength(paths: Paths, *, spreads: bool) -> Floats:
    """Return the reflected amplitude of each target: (path,) float64.

    In the far field a sphere acts as a point whose strength is half of the radius. The spreading law of spheres already
    includes this factor.
    """
    targets = paths.targets
    if not len(targets):
        return np.ones(1)
    as_point = (targets.radius_m > 0) & (not (paths.surface and spreads))
    return np.asarray(targets.strength * np.where(as_point, targets.radius_m / 2, 1.0))


def _times(shot: Snapshot, active: AbstractSet[str], paths: Paths) -> tuple[Floats, Floats | None]:
    if "doppler" in active:
        delay_s, stretch = effect("doppler")(paths, shot.speed_m_s)
        return delay_s, stretch
    return effect("propagation")(paths, shot.speed_m_s), None


def _sonars(shot: Snapshot, gain: Floats, late_s: Floats) -> list[Arrivals]:
    found = []
    for sonar in shot.scene.sonars:
        paths = effect("interference", "way_from")(shot, sonar)
        amplitude = _linear(sonar.level_db) * effect("spreading")(paths)
        way_s = effect("propagation")(paths, shot.speed_m_s)
        starts_s = effect("interference", "calls_of")(shot, sonar)
        if len(starts_s):
            delay_s = way_s + starts_s[:, None] + late_s
            amplitude = np.repeat((gain * amplitude)[..., None], len(starts_s), axis=0)
            found.append(Arrivals(sonar.call, _ticks(delay_s), amplitude))
    return found


def _arrivals(
    shot: Snapshot,
    active: AbstractSet[str],
    number: int,
    delay_s: Floats,
    amplitude: Floats | Complexes,
    late_s: Floats,
    stretch: Floats | None = None,
) -> Arrivals:
    """Return copies of a sensor's call, timed by the clock of the receiving sensor.

    Copies that end before the record begins are left out. Clocks that differ can cause such copies.
    """
    sensor = shot.scene.sensors[number]
    if "clock_drift" in active:
        delay_s, stretch = effect("clock_drift")(shot, number, delay_s, stretch)
    emitter, lasts_s = None, sensor.call.duration_s
    if "emitter_response" in active and sensor.emitter.resonance_hz is not None:
        emitter = sensor.emitter
        lasts_s += effect("emitter_response", "ringing_s")(emitter)
    delay_s = delay_s + late_s
    heard = np.max(delay_s, axis=1) > -_LONGEST_STRETCH * lasts_s
    if not heard.all():
        delay_s, amplitude = delay_s[heard], amplitude[heard]
        stretch = None if stretch is None else stretch[heard]
    return Arrivals(sensor.call, _ticks(delay_s), amplitude, stretch, emitter)


def _ticks(delay_s: Floats) -> Floats:
    return np.asarray(np.rint(delay_s / _TICK_S) * _TICK_S)


def _linear(level_db: float) -> float:
    return float(10 ** (level_db / 20))
