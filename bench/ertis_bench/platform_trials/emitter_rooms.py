"""Random surroundings of two to four sensors, rendered without the simulator, for trials of broken emitters."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_bench.platform_trials.rendered_rooms import (
    Face,
    Mountings,
    Room,
    images_of,
    mounted,
    random_room,
    rendered,
    settings_of,
    toward,
    wall,
)
from ertis_numba.frames import Energyscape

__all__ = ["KINDS", "EmitterRoom"]

Floats = NDArray[np.float64]

KINDS: Final = "posts", "walls", "corridor", "corner", "few"
_PLACES: Final = {
    "front": (0.2, 0.0, 0.0),
    "left": (0.0, 0.2, 90.0),
    "back": (-0.2, 0.0, 180.0),
    "right": (0.0, -0.2, -90.0),
}
_FASTEST_M: Final = 0.03  # Motion of the platform from pulse to pulse along each axis.
_CLEAR_M: Final = 0.2  # Distance of posts from walls.
_APART_M: Final = 0.4


class EmitterRoom(NamedTuple):
    """Platform in random surroundings, and the sensor whose emitter may be broken.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    mountings : mapping
    room : Room
    broken : str
    step_m : (2,) float64
        Motion of the platform from pulse to pulse.
    seed : int
    """

    kind: str
    mountings: Mountings
    room: Room
    broken: str
    step_m: Floats
    seed: int

    @classmethod
    def drawn(cls, seed: int) -> "EmitterRoom":
        """Return random surroundings."""
        kind, random = KINDS[seed % len(KINDS)], np.random.default_rng([seed, 77])
        names = [*_PLACES][: int(random.integers(2, 5))]
        room = random_room(seed, kind) if kind in ("posts", "walls") else _few(random, kind)
        broken = str(random.choice(names))
        step_m = random.uniform(-_FASTEST_M, _FASTEST_M, 2)
        return cls(kind, mounted({name: _PLACES[name] for name in names}), room, broken, step_m, seed)

    def images(self, pulse: int, diameter_m: float, *, is_broken: bool) -> list[Energyscape]:
        """Return the images of a pulse, in which the broken emitter is silent, or works."""
        offset_m, settings = self.step_m * pulse, settings_of()
        room = Room(
            self.room.posts_m - offset_m,
            self.room.strength_db,
            tuple(Face(each.start_m - offset_m, each.end_m - offset_m, each.reflection) for each in self.room.faces),
            self.room.edges_m - offset_m,
        )
        signals = rendered(
            self.mountings,
            settings,
            room,
            diameter_m=diameter_m,
            random=np.random.default_rng([self.seed, pulse, is_broken]),
            dead=self.broken if is_broken else "",
        )
        return [*images_of(signals, settings, pulse).values()]


def _few(random: np.random.Generator, kind: str) -> Room:
    """Return two to four posts, or up to six in a corridor or a corner."""
    turn_rad, walls = float(random.uniform(-np.pi, np.pi)), list[tuple[float, float]]()
    if kind == "corridor":
        turn_rad = float(random.choice([0, 0.5]) * np.pi + random.uniform(-0.2, 0.2))
        walls = [(turn_rad + side * np.pi / 2, float(random.uniform(0.8, 1.5))) for side in (1, -1)]
    elif kind == "corner":
        walls = [(turn_rad + quarter * np.pi / 2, float(random.uniform(1.0, 2.5))) for quarter in (0, 1)]
    faces = tuple(wall(turn_rad, away_m, float(random.uniform(-9, -2))) for turn_rad, away_m in walls)
    count, places = int(random.integers(2, 7 if walls else 5)), list[Floats]()
    while len(places) < count:
        place_m = random.uniform(0.9, 3.2) * toward(random.uniform(-np.pi, np.pi))
        is_inside = all(place_m @ toward(turn_rad) < away_m - _CLEAR_M for turn_rad, away_m in walls)
        if is_inside and all(np.linalg.norm(place_m - other) > _APART_M for other in places):
            places.append(place_m)
    range_m = np.maximum(1.0, np.linalg.norm(places, axis=1))
    return Room(np.array(places), random.uniform(-8, 0, count) + 6 * np.log2(range_m), faces)
