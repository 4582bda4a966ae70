"""Random scenes for odometry: few reflectors, moving objects, corridors, platforms at rest, and other motions."""

import math
import zlib
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.platform_trials.drawn_images import (
    DrawnMounting,
    DrawnPath,
    DrawnReflectors,
    DrawnScene,
    DrawnWall,
)

__all__ = ["KINDS", "drawn_scene"]

Floats = NDArray[np.float64]
Draws = np.random.Generator

_AROUND: Final = {
    name: DrawnMounting(0.2 * math.cos(yaw), 0.2 * math.sin(yaw), yaw)
    for name, yaw in (("front", 0.0), ("left", math.pi / 2), ("back", math.pi), ("right", -math.pi / 2))
}
_PULSES_S: Final = np.linspace(0.0, 0.7, 8)
_DIAMETERS_M: Final = 0.0, 0.012
_REST: Final = np.zeros(3)
_BRAKING_S: Final = 0.3  # Time in which a platform stops or reverses


def _places(draws: Draws, count: int, nearest_m: float = 0.9, farthest_m: float = 4.0) -> Floats:
    turn = draws.uniform(-math.pi, math.pi, count)
    range_m = np.sqrt(draws.uniform(nearest_m**2, farthest_m**2, count))
    return np.stack([range_m * np.cos(turn), range_m * np.sin(turn)], axis=1)


def _still(draws: Draws, least: int, most: int, low_db: float = -14.0, high_db: float = -4.0) -> DrawnReflectors:
    """Return reflectors at rest."""
    count = int(draws.integers(least, most + 1))
    return DrawnReflectors(_places(draws, count), np.zeros((count, 2)), draws.uniform(low_db, high_db, count))


def _people(draws: Draws, least: int, most: int) -> DrawnReflectors:
    """Return people who walk by, each with up to three echoes."""
    found = _still(draws, 0, 0)
    for _ in range(int(draws.integers(least, most + 1))):
        place_m = _places(draws, 1, 1.2, 3.2)
        heading, speed_m_s = draws.uniform(-math.pi, math.pi), draws.uniform(0.4, 1.5)
        count = int(draws.integers(2, 4))
        offset_m = np.concatenate([np.zeros((1, 2)), draws.normal(0.0, 0.18, (count - 1, 2))])
        stretch = np.concatenate([[1.0], draws.uniform(0.9, 1.1, count - 1)])
        way = speed_m_s * np.outer(stretch, [math.cos(heading), math.sin(heading)])
        strength_db = np.concatenate([draws.uniform(-4, 1, 1), draws.uniform(-9, -3, count - 1)])
        found = found.joined(DrawnReflectors(place_m + offset_m, way, strength_db))
    return found


def _twist(draws: Draws, fastest_m_s: float = 1.3, fastest_deg_s: float = 60.0) -> Floats:
    """Return a velocity, mostly straight ahead."""
    speed_m_s = draws.uniform(0.1, fastest_m_s)
    heading = draws.uniform(-math.pi, math.pi) if draws.uniform() < 0.25 else 0.0
    turn_rad_s = math.radians(draws.uniform(-fastest_deg_s, fastest_deg_s)) if draws.uniform() < 0.5 else 0.0
    return np.array([speed_m_s * math.cos(heading), speed_m_s * math.sin(heading), turn_rad_s])


def _scene(
    draws: Draws,
    reflectors: DrawnReflectors,
    twist: Floats | None = None,
    *,
    names: tuple[str, ...] = tuple(_AROUND),
    mountings: Mapping[str, DrawnMounting] = _AROUND,
    walls: tuple[DrawnWall, ...] = (),
    path: DrawnPath | None = None,
    pulses_s: Floats = _PULSES_S,
) -> DrawnScene:
    twist = _twist(draws) if twist is None else twist
    path = path or DrawnPath(np.array([0.0, pulses_s[-1] + 0.1]), np.array([twist, twist]))
    noise, diameter_m = 3e-4 * 10 ** draws.uniform(0, 1), float(draws.choice(_DIAMETERS_M))
    return DrawnScene(mountings, names, reflectors, walls, path, pulses_s, noise, diameter_m)


def _of_sensors(*names: str, alone: bool = False) -> Callable[[Draws], DrawnScene]:
    """Return scenes of which only some sensors have images."""
    mountings = {name: _AROUND[name] for name in names} if alone else _AROUND
    return lambda draws: _scene(draws, _still(draws, 15, 70), names=names, mountings=mountings)


def _few_and_people(draws: Draws) -> DrawnScene:
    twist = _REST if draws.uniform() < 0.3 else None
    mountings = _AROUND if draws.uniform() < 0.5 else {"front": _AROUND["front"]}
    reflectors = _still(draws, 2, 4).joined(_people(draws, 1, 2))
    return _scene(draws, reflectors, twist, names=tuple(mountings), mountings=mountings)


def _at_rest(draws: Draws) -> DrawnScene:
    count = int(draws.choice([3, 5, 8, 15, 30]))
    walls = (DrawnWall((1.0, 0.0), -2.4, (-3.0, 3.0), -9.0),) if draws.uniform() < 0.5 else ()
    return _scene(draws, _still(draws, count, count).joined(_people(draws, 1, 3)), _REST, walls=walls)


def _corridor(draws: Draws) -> DrawnScene:
    """Return a corridor with smooth walls, at times with an end, doors or posts, or a person who walks along."""
    half_m, speed_m_s = draws.uniform(0.7, 1.4), draws.uniform(-1.3, 1.3)
    walls = [
        DrawnWall((0.0, 1.0), half_m, (-9.0, 9.0), -6.0),
        DrawnWall((0.0, 1.0), -half_m * draws.uniform(0.8, 1.2), (-9.0, 9.0), -6.0),
    ]
    if draws.uniform() < 0.5:
        walls.append(DrawnWall((1.0, 0.0), draws.uniform(1.5, 3.5), (-2.0, 2.0), -6.0))
    count, spacing_m = int(draws.integers(0, 12)), float(draws.choice([0.0, 0.5, 0.8, 1.0]))
    along_m = (np.arange(count) - count / 2) * spacing_m if spacing_m else draws.uniform(-4, 4, count)
    side = np.ones(count) if spacing_m else draws.choice([-1.0, 1.0], count)
    places_m = np.stack([along_m, side * (half_m - 0.03)], axis=1)
    reflectors = DrawnReflectors(places_m, np.zeros((count, 2)), draws.uniform(-14, -5, count))
    if draws.uniform() < 0.4:
        person = _people(draws, 1, 1)
        place_m = person.place_m - person.place_m[0] + [draws.uniform(-3, 3), draws.uniform(-0.5, 0.5)]
        way = np.tile([draws.choice([-1, 1]) * draws.uniform(0.5, 1.4), 0.0], (len(place_m), 1))
        reflectors = reflectors.joined(DrawnReflectors(place_m, way, person.strength_db))
    return _scene(draws, reflectors, np.array([speed_m_s, 0.0, 0.0]), walls=tuple(walls))


def _wall_only(draws: Draws) -> DrawnScene:
    heading = draws.uniform(-math.pi, math.pi)
    walls = (DrawnWall((math.cos(heading), math.sin(heading)), draws.uniform(1.5, 3.0), (-9.0, 9.0), -6.0),)
    return _scene(draws, _still(draws, 0, 0), walls=walls)


def _one_reflector(draws: Draws) -> DrawnScene:
    reflectors = _still(draws, 1, 1, -6.0, 0.0)
    if draws.uniform() < 0.5:
        beside = DrawnReflectors(reflectors.place_m + 0.3, np.array([[0.5, 0.2]]), np.array([-5.0]))
        reflectors = reflectors.joined(beside)
    return _scene(draws, reflectors)


def _elsewhere(draws: Draws) -> DrawnScene:
    """Return one to four sensors at any places and headings."""
    mountings = {}
    for number in range(int(draws.integers(1, 5))):
        x_m, y_m = _places(draws, 1, 0.0, 0.3)[0].tolist()
        mountings[f"sensor_{number}"] = DrawnMounting(x_m, y_m, draws.uniform(-math.pi, math.pi))
    return _scene(draws, _still(draws, 15, 60), names=tuple(mountings), mountings=mountings)


def _on_the_spot(draws: Draws) -> DrawnScene:
    twist = np.array([0.0, 0.0, math.radians(draws.uniform(10, 110)) * draws.choice([-1, 1])])
    return _scene(draws, _still(draws, 8, 60), twist)


def _fast(draws: Draws) -> DrawnScene:
    heading = draws.choice([0.0, math.pi / 2, math.pi, -math.pi / 2])
    speed_m_s = draws.uniform(1.2, 1.95)
    return _scene(draws, _still(draws, 15, 60), speed_m_s * np.array([math.cos(heading), math.sin(heading), 0.0]))


def _changes(draws: Draws, factor: float) -> DrawnScene:
    """Return a platform that stops or reverses within a moment."""
    twist, begin_s = _twist(draws), draws.uniform(0.2, 0.4)
    knots_s = np.array([0.0, begin_s, begin_s + _BRAKING_S, _PULSES_S[-1] + 0.1])
    path = DrawnPath(knots_s, np.outer([1.0, 1.0, factor, factor], twist))
    return _scene(draws, _still(draws, 8, 60), path=path)


def _gaps(draws: Draws) -> DrawnScene:
    """Return pulses of which some were missed, at times for ten seconds."""
    steps_s = draws.choice([0.1, 0.2, 0.3, 0.6], 7)
    steps_s[4] = draws.choice([0.1, 0.9, 10.0])
    pulses_s = np.concatenate([[0.0], np.cumsum(steps_s)])
    knots_s = np.array([0.0, pulses_s[4], pulses_s[5], pulses_s[-1] + 0.1])
    twist = _twist(draws)
    path = DrawnPath(knots_s, np.outer([1.0, 1.0, 0.3, 0.3], twist) if steps_s[4] > 1 else np.outer([1] * 4, twist))
    return _scene(draws, _still(draws, 8, 60), path=path, pulses_s=pulses_s)


def _wrong_clock(draws: Draws) -> DrawnScene:
    """Return a sensor whose clock differs from that of the others."""
    late = str(draws.choice(list(_AROUND)))
    clock_s = float(draws.uniform(-0.4, 0.4))
    mountings = {name: each._replace(clock_s=clock_s * (name == late)) for name, each in _AROUND.items()}
    return _scene(draws, _still(draws, 15, 60), mountings=mountings)


KINDS: Final[Mapping[str, tuple[str, Callable[[Draws], DrawnScene]]]] = {
    "four": ("four sensors", _of_sensors(*_AROUND)),
    "front and left": ("front and left of four", _of_sensors("front", "left")),
    "front and back": ("front and back of four", _of_sensors("front", "back")),
    "front": ("front of four", _of_sensors("front")),
    "alone": ("one sensor alone", _of_sensors("front", alone=True)),
    "elsewhere": ("1–4 sensors at any places", _elsewhere),
    "few": ("2–4 reflectors", lambda draws: _scene(draws, _still(draws, 2, 4))),
    "few and people": ("2–4 reflectors, people", _few_and_people),
    "people": (
        "8–40 reflectors, people",
        lambda draws: _scene(draws, _still(draws, 8, 40).joined(_people(draws, 1, 3))),
    ),
    "rest": ("at rest, people", _at_rest),
    "corridor": ("corridor", _corridor),
    "wall": ("smooth wall only", _wall_only),
    "one": ("1 reflector, at times an object", _one_reflector),
    "noise": ("noise only", lambda draws: _scene(draws, _still(draws, 0, 0))),
    "turning": ("turning on the spot", _on_the_spot),
    "fast": ("1.2–1.95 m/s", _fast),
    "stop": ("abrupt stop", lambda draws: _changes(draws, 0.0)),
    "reversal": ("reversal", lambda draws: _changes(draws, -1.0)),
    "gaps": ("missed pulses", _gaps),
    "clock": ("one wrong clock", _wrong_clock),
}
"""Descriptions and makers of scenes, by kind."""


def drawn_scene(kind: str, seed: int) -> tuple[DrawnScene, Draws]:
    """Return a scene, and the generator for the noise of its images."""
    draws = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    return KINDS[kind][1](draws), draws
