"""Echoes of sound that two surfaces reflect: two walls, or a wall and another reflector."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.echo_paths import EchoPaths

__all__ = ["Reflected", "Walls", "reflected_twice"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_PATH_M: Final = 0.03  # Largest difference of a path over two located surfaces, …
_ANGLE_RAD: Final = math.radians(3.0)  # … and of its direction.
_ALIKE: Final = 10 ** (8.0 / 10)  # Largest power of an echo relative to the highest possible one of its path.
_BEFORE_M: Final = 0.05  # Least distance of a wall from a reflector in front of it.


class Walls(NamedTuple):
    """Planes of mirror-like walls (wall,), each of a reflector; ``strength`` is the power of an echo after 1 m."""

    number: Numbers
    normal: Floats
    depth_m: Floats
    strength: Floats

    def only(self, kept: Flags) -> "Walls":
        """Return some of the walls."""
        return Walls._make(each[kept] for each in self)

    def images(self, place_m: Floats) -> Floats:
        """Return the mirror images of places: (wall, …, axis) float64."""
        normal = self.normal.reshape(-1, *[1] * (place_m.ndim - 1), 3)
        beyond_m = self.depth_m.reshape(-1, *[1] * (place_m.ndim - 1)) - np.sum(place_m * normal, axis=-1)
        return np.asarray(place_m + 2 * beyond_m[..., None] * normal)


class _Sources(NamedTuple):
    """Apparent origins (source, emitter, axis) of sound that two reflectors reflect, and its paths to them.

    ``sent_m`` is 0 for mirror images of the emitter.
    """

    first: Numbers
    second: Numbers
    origin_m: Floats
    sent_m: Floats
    strength: Floats

    def highest(self, source: Numbers, emitter: Numbers, receiver_m: Floats) -> Floats:
        """Return the highest power of sound that receivers at (match, axis) hear from sources."""
        apart_m = np.linalg.norm(self.origin_m[source, emitter] - receiver_m, axis=1)
        sent_m = self.sent_m[source, emitter]
        return np.asarray(self.strength[source] / (np.where(sent_m > 0, sent_m, 1.0) * apart_m) ** 2)


class Reflected(NamedTuple):
    """Echoes (reflector, echo) that two nearer reflectors explain, and ghosts (reflector,), which have no others."""

    is_explained: Flags
    is_ghost: Flags


def reflected_twice(
    heard: EchoPaths, place_m: Floats, walls: Walls, reflectivity: Floats, members: Sequence[Numbers]
) -> Reflected:
    """Return the echoes that are explained by sound over two nearer surfaces, one of them a wall.

    A reflector without other echoes is a ghost, which reflects no sound to others.
    """
    range_m = np.linalg.norm(place_m[:, None] - heard.sensor_m, axis=2).min(axis=1)
    is_explained = np.zeros((len(place_m), len(heard.path_m)), np.bool_)
    is_ghost = np.zeros(len(place_m), np.bool_)
    sources = _sources(heard, place_m, walls, reflectivity)
    number, echo = _explaining(heard, sources)
    first, second = sources.first[number], sources.second[number]
    beyond_m = np.maximum(range_m[first], range_m[second])
    for each in np.argsort(range_m) if len(echo) else ():
        is_explained[each, echo[(beyond_m < range_m[each]) & ~is_ghost[first] & ~is_ghost[second]]] = True
        is_ghost[each] = is_explained[each, members[each]].all()
    return Reflected(is_explained, is_ghost)


def _sources(heard: EchoPaths, place_m: Floats, walls: Walls, reflectivity: Floats) -> _Sources:
    """Return the places from which sound over a wall and another reflector, or over two walls, arrives."""
    depth_m = walls.depth_m[:, None] - walls.normal @ place_m.T
    wall, point = np.nonzero((depth_m > _BEFORE_M) & (walls.number[:, None] != np.arange(len(place_m))))
    straight_m = np.linalg.norm(place_m[point, None] - heard.sensor_m, axis=2)
    images_m = walls.images(heard.sensor_m)
    mirrored_m = np.linalg.norm(place_m[point, None] - images_m[wall], axis=2)
    shape = (len(point), len(heard.sensor_m), 3)
    there_m = np.broadcast_to(place_m[point, None], shape)
    behind_m = np.broadcast_to(walls.images(place_m)[wall, point, None], shape)
    last, before = np.nonzero(walls.number[:, None] != walls.number)
    twice_m = walls.images(images_m)[last, before]
    return _Sources(
        np.concatenate([*[walls.number[wall]] * 3, walls.number[before]]),
        np.concatenate([*[point] * 3, walls.number[last]]),
        np.concatenate([there_m, behind_m, behind_m, twice_m]),
        np.concatenate([mirrored_m, straight_m, mirrored_m, np.zeros(twice_m.shape[:2])]),
        np.concatenate([*[reflectivity[point]] * 3, np.minimum(walls.strength[before], walls.strength[last])]),
    )


def _explaining(heard: EchoPaths, sources: _Sources) -> tuple[Numbers, Numbers]:
    """Return the sources that may explain echoes, and these echoes."""
    source, emitter, echo = heard.arriving(sources.origin_m, sources.sent_m, _PATH_M, _ANGLE_RAD)
    receiver_m = heard.sensor_m[heard.receiver[echo]]
    is_weak = heard.power[echo] < _ALIKE * sources.highest(source, emitter, receiver_m)
    return source[is_weak], echo[is_weak]
