"""Random platforms of two to four sensors between smooth walls that reflect sound several times, or among posts."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_bench.platform_trials.platform_scenes import EMITTERS_M
from ertis_bench.platform_trials.rendered_rooms import (
    Face,
    Room,
    images_of,
    mounted,
    rendered,
    settings_of,
    toward,
    wall,
)
from ertis_numba.frames import Energyscape

__all__ = ["KINDS", "PLATFORMS", "ReflectingScene"]

Floats = NDArray[np.float64]

KINDS: Final = "bare corridor", "corridor", "bare corner", "corner", "bare wall", "wall", "room", "posts"
PLATFORMS: Final = tuple(
    mounted(places)
    for places in (
        {"front": (0.2, 0, 0), "left": (0, 0.2, 90), "back": (-0.2, 0, 180), "right": (0, -0.2, -90)},
        {"front": (0.2, 0, 0), "left": (-0.05, 0.18, 120), "right": (-0.05, -0.18, -120)},
        {"left": (0.15, 0.15, 60), "front": (0.22, 0, 0), "right": (0.15, -0.15, -60)},
        {"left": (0, 0.15, 90), "right": (0, -0.15, -90)},
        {"front": (0.25, 0, 0), "back": (-0.25, 0, 180)},
        {"left": (0.2, 0.12, 40), "right": (0.2, -0.12, -40)},
    )
)
"""Mountings of the sensors of each platform."""
_N_POSTS: Final = {False: (5, 10), True: (2, 6)}  # without and with walls
_POSTS_M: Final = 0.6, 3.0  # Distance of posts from the platform.
_CLEAR_M: Final = 0.2  # Distance of posts from walls.
_APART_M: Final = 0.35
_MAX_REFLECTIONS: Final = 3
_RANGE_M: Final = 0.3, 4.5


class ReflectingScene(NamedTuple):
    """Platform in random surroundings."""

    seed: int
    kind: str
    platform: int
    diameter_m: float
    room: Room

    @classmethod
    def drawn(cls, seed: int, kind: str) -> "ReflectingScene":
        """Return a random scene."""
        random = np.random.default_rng([seed, KINDS.index(kind), 777])
        platform, diameter_m = int(random.integers(len(PLATFORMS))), float(random.choice(EMITTERS_M))
        walls = _walls(random, kind)
        posts_m = np.empty((0, 2)) if kind.startswith("bare") else _posts_m(random, walls)
        faces = tuple(wall(turn_rad, away_m, level_db) for turn_rad, away_m, level_db in walls)
        return cls(seed, kind, platform, diameter_m, Room(posts_m, random.uniform(-12, -2, len(posts_m)), faces))

    def images(self) -> dict[str, Energyscape]:
        """Return the images of all sensors, by name."""
        settings = settings_of(_RANGE_M)
        signals = rendered(
            PLATFORMS[self.platform],
            settings,
            self.room,
            diameter_m=self.diameter_m,
            random=np.random.default_rng([self.seed, KINDS.index(self.kind), 5]),
            reflections=_MAX_REFLECTIONS,
        )
        return images_of(signals, settings)

    def beside_m(self, place_m: Floats) -> Floats:
        """Return the distance of places from the nearest post or wall: (place,) float64, from (place, 2)."""
        distances_m = [np.full(len(place_m), np.inf)]
        distances_m += [np.linalg.norm(place_m - post_m, axis=1) for post_m in self.room.posts_m]
        distances_m += [_from_face_m(face, place_m) for face in self.room.faces]
        return np.asarray(np.min(distances_m, axis=0))


def _walls(random: np.random.Generator, kind: str) -> list[tuple[float, float, float]]:
    """Return the azimuth, the distance and the level of reflected sound of each wall."""
    turn_rad, kind = random.uniform(-np.pi, np.pi), kind.removeprefix("bare ")
    if kind == "corridor":
        width_m, end_m = random.uniform(1.2, 3.0, 2)
        aside_m = random.uniform(-0.4, 0.4) * (width_m - 1)
        has_end = random.random() < 0.3
        turns_rad, away_m = (0, np.pi, np.pi / 2), (width_m / 2 + aside_m, width_m / 2 - aside_m, end_m)
        places = list(zip(turns_rad, away_m, strict=True))[: 2 + has_end]
        levels_db = -6.0, -0.5
    elif kind == "corner":
        opening_deg = 90.0 if random.random() < 0.6 else random.uniform(60, 120)
        places = [(turn, random.uniform(0.6, 2.2)) for turn in (0.0, math.radians(opening_deg))]
        levels_db = -6.0, -0.5
    elif kind == "wall":
        places, levels_db = [(0.0, random.uniform(0.6, 2.5))], (-14.0, -0.5)
    elif kind == "room":
        places, levels_db = [(n * np.pi / 2, random.uniform(0.7, 2.5)) for n in range(4)], (-9.0, -1.0)
    else:
        places, levels_db = [], (0.0, 0.0)
    return [(turn_rad + turn, float(away_m), float(random.uniform(*levels_db))) for turn, away_m in places]


def _posts_m(random: np.random.Generator, walls: list[tuple[float, float, float]]) -> Floats:
    """Return random places between walls: (post, 2) float64."""
    count, places = random.integers(*_N_POSTS[bool(walls)]), list[Floats]()
    while len(places) < count:
        place_m = random.uniform(*_POSTS_M) * toward(random.uniform(-np.pi, np.pi))
        is_inside = all(place_m @ toward(turn_rad) < away_m - _CLEAR_M for turn_rad, away_m, _ in walls)
        if is_inside and all(np.linalg.norm(place_m - other) > _APART_M for other in places):
            places.append(place_m)
    return np.array(places)


def _from_face_m(face: Face, place_m: Floats) -> Floats:
    along_m = face.end_m - face.start_m
    part = np.clip((place_m - face.start_m) @ along_m / (along_m @ along_m), 0, 1)
    return np.asarray(np.linalg.norm(place_m - face.start_m - part[:, None] * along_m, axis=1))
