"""Ghosts by sound over hidden walls, which only sensors without an image face."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.echo_paths import NEAREST_M, EchoPaths
from ertis_numba.fusion.reflections import Walls

__all__ = ["over_hidden_walls"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_PATH_M: Final = 0.03  # Largest difference of the path of an echo from that over a wall that another one implies, …
_ANGLE_RAD: Final = math.radians(4.0)  # … and of its direction.
_FACING: Final = math.cos(math.radians(65.0))  # Cosine from which a sensor faces a wall.
_APART_M: Final = 0.2  # Least distance between a place and its mirror image.


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
        source, _, row = heard.arriving(origin_m, sent_m, _PATH_M, _ANGLE_RAD)
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
