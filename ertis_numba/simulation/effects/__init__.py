"""Registry of the effects of a scene.

Each effect has an entry in `EFFECTS` and a module of the same name in this package. The entry holds words, keys, an
example, and the places where the effect acts. The module holds the physics, as one function per place, and
``estimate(sight)``. This function estimates the change of an image by the effect. It returns None if the effect applies
to nothing in the scene. A module is imported only if its effect may apply.

Each place is a step of the rendering. It calls the function of each active effect, in the order of the registry. Some
functions receive an earlier result, and return it changed or unchanged.

==================  ====================================================  =============================================
place               arguments                                             result
==================  ====================================================  =============================================
``other_emitters``  shot                                                  other sensors whose calls arrive, as indices
``transmitter``     shot, number, transmitter                             pose of the emitter of sensor ``number``
``views``           shot, number, views                                   ends of paths, and their mirror images
``turns``           first, second, targets                                paths over targets, instead of `by_targets`
``gain``            shot, paths, emitter, frequency_hz                    factor, broadcast to (path, mic, frequency)
``times``           shot, paths, sent_s, times                            delay and stretch of each path
``emission``        shot, paths, received_s                               times at which received sound left its source
``clock_times``     shot, number, delay_s, stretch                        the same on the receiver's clock
``call_filter``     emitter                                               `CallFilter` of the call, or None
``arrivals``        shot, active, frequency_hz, found                     all copies of calls: those found, and more
``frames``          shot, active, frequency_hz                            copies of frames of noise
``microphones``     shot, gain, delay_s                                   sensitivity and delay of each microphone
``sounds``          shot, active, seed                                    sounds with ``add_to(signals, first)``
``noise_rms``       sensor                                                RMS of white noise in each microphone
``loudness``        shot, active                                          bounds on amplitude and noise power
``samples``         samples, sensor                                       None; it changes recorded samples in place
==================  ====================================================  =============================================
"""

import functools
import importlib
from collections.abc import Callable, Set as AbstractSet
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Final, Literal

import msgspec

__all__ = ["ASKED_FOR", "EFFECTS", "INDISPENSABLE", "Effect", "Place", "acting", "module"]

Place = Literal[
    "other_emitters",
    "transmitter",
    "views",
    "turns",
    "gain",
    "times",
    "emission",
    "clock_times",
    "call_filter",
    "arrivals",
    "frames",
    "microphones",
    "sounds",
    "noise_rms",
    "loudness",
    "samples",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """Entry of an effect in the registry.

    - ``example``: small scene that the effect changes at each of its places, as TOML.
    - ``places``: functions of the module that the rendering calls.
    - ``keys``: without them the effect applies to nothing; ``*`` stands for every key, none for every scene.
    - ``requested``: True if these keys request the effect even if no image shows it, because recordings contain it.
    - ``indispensable``: reason for which every scene needs the effect; empty if it can be left out.
    - ``weakens``: True if the effect only lowers the amplitude of calls.
    """

    name: str
    summary: str
    example: str
    places: tuple[Place, ...] = ()
    keys: tuple[str, ...] = ()
    requested: bool = False
    indispensable: str = ""
    weakens: bool = False

    def may_apply(self, scene: msgspec.Struct) -> bool:
        """Return True if a scene sets any of the effect's keys, or if the effect has none."""
        return not self.keys or any(_is_set(scene, *key.split(".")) for key in self.keys)


def _is_set(thing: Any, key: str, *inner: str) -> bool:
    """Return True if a key of a struct, or of one in a tuple of structs, differs from its default."""
    if isinstance(thing, tuple):
        return any(_is_set(each, key, *inner) for each in thing)
    if not isinstance(thing, msgspec.Struct):
        return False
    defaults = _defaults(type(thing))
    names = [name for name in defaults if key in {name, "*"}]
    if inner:
        return any(_is_set(getattr(thing, name), *inner) for name in names)
    return any(getattr(thing, name) != defaults[name] for name in names)


@functools.cache  # msgspec evaluates all annotations of a type at each call
def _defaults(kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the defaults of a struct's fields."""
    return {each.name: each.default for each in msgspec.structs.fields(kind)}


_POINT = "points = [{range_m = 0.5}]\n"
_ASIDE = "points = [{range_m = 0.5, azimuth_deg = 50.0}]\n"
_TWO_SENSORS = 'sensors = [{name = "left"}, {name = "right", position_m = [0.0, -0.05, 0.0]}]\n'

EFFECTS: Final = {
    effect.name: effect
    for effect in (
        Effect(
            name="propagation",
            summary="propagation delays, including fractions of a sample",
            places=("times",),
            indispensable="images are computed from delays",
            example=_POINT,
        ),
        Effect(
            name="spreading",
            summary="decrease of amplitude with distance",
            places=("gain",),
            example=_POINT,
        ),
        Effect(
            name="emitter_offset",
            summary="offset of the emitter from the centre of the array",
            places=("transmitter",),
            keys=("sensors.emitter.position_m",),
            requested=True,
            example=_POINT + "sensors = [{emitter = {position_m = [0.0, 0.1, 0.0]}}]\n",
        ),
        Effect(
            name="cross_emission",
            summary="calls of the other sensors of the scene",
            places=("other_emitters",),
            keys=("sensors",),
            example=_TWO_SENSORS,
        ),
        Effect(
            name="sync_delay",
            summary="later start of each sensor along the SYNC chain",
            places=("clock_times",),
            keys=("sensors",),
            example=_POINT + _TWO_SENSORS,
        ),
        Effect(
            name="clock_drift",
            summary="sample clocks that run fast or slow",
            places=("clock_times",),
            keys=("sensors.electronics.clock_drift_ppm",),
            requested=True,
            example=_POINT + "sensors = [{electronics = {clock_drift_ppm = 500.0}}]\n",
        ),
        Effect(
            name="walls",
            summary="mirror images of emitters and targets in walls",
            places=("views",),
            keys=("walls", "boxes"),
            example="walls = [{position_m = [0.5, 0.0, 0.0], facing_deg = [180.0, 0.0]}]\n",
        ),
        Effect(
            name="occlusion",
            summary="walls that block sound paths",
            places=("views",),
            keys=("walls", "boxes"),
            weakens=True,
            example=_POINT + "walls = [{position_m = [0.4, 0.0, 0.0], facing_deg = [180.0, 0.0]}]\n",
        ),
        Effect(
            name="target_size",
            summary="surfaces of spheres, and size and orientation of discs",
            places=("turns", "gain"),
            keys=("spheres", "points.diameter_m"),
            example="spheres = [{range_m = 0.5, radius_m = 0.05}]\n",
        ),
        Effect(
            name="absorption",
            summary="absorption of high frequencies by air",
            places=("gain",),
            weakens=True,
            example=_POINT,
        ),
        Effect(
            name="emitter_response",
            summary="frequency response and ringing of the transducer",
            places=("call_filter",),
            keys=("sensors.emitter.resonance_hz",),
            requested=True,
            weakens=True,
            example=_POINT + "sensors = [{emitter = {resonance_hz = 40e3}}]\n",
        ),
        Effect(
            name="emitter_directivity",
            summary="directivity of emitters and sources as circular pistons",
            places=("gain",),
            keys=("sensors.emitter.diameter_m", "tones.diameter_m", "noises.diameter_m", "sonars.diameter_m"),
            requested=True,
            weakens=True,
            example=_ASIDE + "sensors = [{emitter = {diameter_m = 0.02}}]\n",
        ),
        Effect(
            name="microphone_directivity",
            summary="directivity of the microphone ports",
            places=("gain",),
            keys=("sensors.electronics.microphone_diameter_m",),
            requested=True,
            weakens=True,
            example=_ASIDE + "sensors = [{electronics = {microphone_diameter_m = 0.01}}]\n",
        ),
        Effect(
            name="doppler",
            summary="shift and stretch of sound due to motion",
            places=("times", "emission"),
            keys=("*.velocity_m_s", "*.waypoints"),
            weakens=True,
            example="points = [{range_m = 0.5, velocity_m_s = [-3.0, 0.0, 0.0]}]\n"
            "tones = [{range_m = 1.0, velocity_m_s = [-3.0, 0.0, 0.0], frequency_hz = 30e3, level_db = -40.0}]\n",
        ),
        Effect(
            name="direct_sound",
            summary="direct sound from the emitter to its own microphones",
            places=("arrivals",),
            keys=("sensors.emitter.direct_sound_db",),
            requested=True,
            example="sensors = [{emitter = {direct_sound_db = -40.0}}]\n",
        ),
        Effect(
            name="interference",
            summary="tones, noise and other sonars",
            places=("arrivals", "frames", "sounds", "loudness"),
            keys=("tones", "noises", "sonars"),
            requested=True,
            example="tones = [{position_m = [1.0, 0.0, 0.0], frequency_hz = 40e3, level_db = -40.0}]\n"
            "noises = [{position_m = [0.0, 1.0, 0.0], level_db = -40.0}]\n"
            "sonars = [{position_m = [1.0, 0.0, 0.0], level_db = -40.0}]\n",
        ),
        Effect(
            name="ambient_noise",
            summary="diffuse noise from all directions",
            places=("sounds", "loudness"),
            keys=("ambient",),
            requested=True,
            example="ambient = {level_dbfs = -40.0}\n",
        ),
        Effect(
            name="microphone_noise",
            summary="white noise of each microphone",
            places=("noise_rms", "loudness"),
            keys=("sensors.electronics.noise_dbfs",),
            requested=True,
            example="sensors = [{electronics = {noise_dbfs = -40.0}}]\n",
        ),
        Effect(
            name="microphone_spread",
            summary="gains and delays that the calibration does not contain",
            places=("microphones",),
            keys=("sensors.electronics.gain_spread_db", "sensors.electronics.delay_spread_s"),
            requested=True,
            example=_POINT + "sensors = [{electronics = {gain_spread_db = 3.0}}]\n",
        ),
        Effect(
            name="microphone_faults",
            summary="dead and stuck microphones",
            places=("microphones", "samples"),
            keys=tuple(f"sensors.electronics.{key}" for key in ("dead_channels", "stuck_low", "stuck_high")),
            requested=True,
            example=_POINT + "sensors = [{electronics = {dead_channels = [1], stuck_low = [2]}}]\n",
        ),
        Effect(
            name="modulation",
            summary="conversion to PDM bits or PCM samples",
            indispensable="recordings contain bits or samples",
            example=_POINT,
        ),
    )
}
"""All effects, in the order in which they are decided, reported and applied."""

INDISPENSABLE: Final = {name: effect.indispensable for name, effect in EFFECTS.items() if effect.indispensable}
"""Effects that every scene needs, and the reason."""

ASKED_FOR: Final = frozenset(name for name, effect in EFFECTS.items() if effect.requested)
"""Effects that are simulated if a scene sets one of their keys, even if no image shows them."""


def module(name: str) -> ModuleType:
    """Return the module of an effect, and import it at the first call."""
    return importlib.import_module(f"{__name__}.{name}")


def acting(place: Place, active: AbstractSet[str]) -> list[tuple[str, Callable[..., Any]]]:
    """Return the active effects that act at a place, in the order of the registry, with their functions."""
    return [
        (name, getattr(module(name), place))
        for name, effect in EFFECTS.items()
        if name in active and place in effect.places
    ]
