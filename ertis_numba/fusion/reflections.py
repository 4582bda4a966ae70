"""Echoes of sound that two surfaces reflect: two walls, or a wall and another reflector.

Only sensors without an image may face one of the walls, which is then hidden.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.echo_paths import NEAREST_M, EchoPaths

__all__ = ["Reflected", "Walls", "over_hidden_walls", "reflected_twice"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_PATH_M: Final = 0.03  # Largest difference of a path over two located surfaces, …
_ANGLE_RAD: Final = math.radians(3.0)  # … and of its direction.
_ALIKE: Final = 10 ** (8.0 / 10)  # Largest power of an echo relative to the highest possible one of its path.
_BEFORE_M: Final = 0.05  # Least distance of a wall from a reflector in front of it.
_HIDDEN_RAD: Final = math.radians(4.0)  # The same over a hidden wall that another one implies.
_FACING: Final = math.cos(math.radians(65.0))  # Cosine from which a sensor faces a wall.
_APART_M: Final = 0.2  # Least distance between a place and its mirror image.


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


def over_hidden_walls(
    heard: EchoPaths, place_m: Floats, walls: Walls, confirming: Flags, hidden: Numbers, is_ghost: Flags
) -> Flags:
    """Return True for reflectors whose echoes sound over a nearer surface and a hidden wall explains: (reflector,).

    ``hidden`` sensors emit, but have no image; ``is_ghost`` reflectors do not exist, and reflect no sound to others.
    """
    range_m = np.linalg.norm(place_m[:, None] - heard.sensor_m, axis=2).min(axis=1)
    found = np.zeros(len(place_m), np.bool_)
    for number in np.flatnonzero(confirming.any(axis=(1, 2))):
        echo, emitter = np.nonzero(confirming[number])
        strongest = np.argmax(heard.power[echo])
        shown = _Shown(heard, int(echo[strongest]), int(emitter[strongest]), place_m[number])
        is_nearer = (range_m < range_m[number]) & ~is_ghost
        nearer = walls.only(is_nearer[walls.number])
        origin_m, sent_m = (
            np.concatenate(each)
            for each in zip(
                shown.over_reflector(place_m[is_nearer], hidden),
                *(shown.over_wall(nearer, int(silent), hidden) for silent in hidden),
                strict=True,
            )
        )
        explained = np.zeros((len(origin_m), len(heard.path_m)), np.bool_)
        source, _, row = heard.arriving(origin_m, sent_m, _PATH_M, _HIDDEN_RAD)
        explained[source, row] = True
        found[number] = explained[:, np.unique(echo)].all(axis=1).any()
    return found


class _Shown:
    """An echo that shows a reflector, and the places from which its sound may come instead."""

    def __init__(self, heard: EchoPaths, echo: int, emitter: int, place_m: Floats) -> None:
        receiver = next(number for number, rows in heard.rows.items() if echo in rows)
        self._heard, self._emitter, self._path_m = heard, emitter, heard.path_m[echo]
        self._receiver_m = heard.sensor_m[receiver]
        toward = place_m - self._receiver_m
        self._toward = toward / max(NEAREST_M, float(np.linalg.norm(toward)))

    def over_reflector(self, place_m: Floats, hidden: Numbers) -> tuple[Floats, Floats]:
        """Return the mirror images of reflectors in hidden walls, and the paths of sound to the reflectors."""
        sent_m = np.linalg.norm(place_m[:, None] - self._heard.sensor_m, axis=2)
        far_m = self._path_m[self._emitter] - sent_m[:, self._emitter]
        image_m = self._receiver_m + far_m[:, None] * self._toward
        is_wall = _is_hidden(self._heard, place_m, image_m, hidden) & (far_m > _APART_M)
        return np.repeat(image_m[is_wall, None], len(self._heard.sensor_m), axis=1), sent_m[is_wall]

    def over_wall(self, walls: Walls, silent: int, hidden: Numbers) -> tuple[Floats, Floats]:
        """Return the mirror images of a sensor without an image in a known wall and a hidden one, in either order."""
        sensor_m = self._heard.sensor_m
        image_m = self._receiver_m + self._path_m[silent] * self._toward  # NaN if the receiver does not hear the call.
        first_m, last_m = walls.images(image_m), walls.images(sensor_m[silent])
        is_wall = _is_hidden(self._heard, np.broadcast_to(sensor_m[silent], first_m.shape), first_m, hidden)
        is_wall |= _is_hidden(self._heard, last_m, np.broadcast_to(image_m, last_m.shape), hidden)
        origin_m = np.full((int(is_wall.sum()), *sensor_m.shape), np.nan)
        origin_m[:, silent] = image_m
        return origin_m, np.zeros(origin_m.shape[:2])


def _is_hidden(heard: EchoPaths, place_m: Floats, image_m: Floats, hidden: Numbers) -> Flags:
    """Return True where only a sensor without an image faces the wall between a place and its mirror image."""
    offset_m = image_m - place_m
    apart_m = np.linalg.norm(offset_m, axis=1)
    normal = offset_m / np.maximum(apart_m, NEAREST_M)[:, None]
    depth_m = np.einsum("pi,psi->ps", normal, ((place_m + image_m) / 2)[:, None] - heard.sensor_m)
    facing = normal @ heard.ahead.T
    best = np.argmax(facing, axis=1)
    is_facing = (facing.max(axis=1, initial=-1.0) > _FACING) & np.isin(best, hidden)
    return np.asarray(is_facing & (depth_m.min(axis=1, initial=np.inf) > _APART_M / 2) & (apart_m > _APART_M))
