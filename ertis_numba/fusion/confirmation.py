"""Confirmation of located reflectors by the echoes of all pairs of emitter and receiver.

Sound that two surfaces reflect has a longer path than that over either one, and shows reflectors that do not exist.
Its echoes at the other pairs do not fit the same place, unlike those of a reflector.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.echo_paths import NEAREST_M, EchoPaths
from ertis_numba.fusion.reflections import Walls, over_hidden_walls, reflected_twice

__all__ = ["Confirmation", "confirmation"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_PATH_M: Final = 0.012  # Largest difference between the path of an echo and the predicted one.
_ANGLE_RAD: Final = math.radians(4.0)  # Largest difference of directions ahead of a receiver.
_COUNTS_FROM: Final = 0.1  # Gain relative to the highest of all pairs, from which a pair should hear a reflector.
_FACING: Final = 0.3  # Cosine from which a sensor may show the surface of a wall.
_PART: Final = 0.6
_MIN_APART_M: Final = 0.06  # Least difference of ranges of a ghost and a nearer reflector.
_PLANE_M: Final = 0.04  # Largest distance of a located wall from the plane that a ghost implies, …
_FOOT_M: Final = 0.4  # … and from the foot of the perpendicular to it.
_SAME_RAD: Final = math.radians(2.5)  # Difference of directions below which a nearer reflector may send the sound.
_N_LEAST: Final = 2  # Least number of echoes: a single one may be that of another sensor's call.
_N_IMAGES: Final = 2  # Images that must show a reflector if that of an emitting sensor is missing, …
_AGREED: Final = 0.7  # … and share of pairs that must each have a different echo.
_N_SURE: Final = 4  # Echoes that two reflections hardly cause at the right paths.


class Confirmation(NamedTuple):
    """Reflectors (reflector,) that enough echoes confirm, as points or mirror-like walls, and pairs to hear each."""

    is_confirmed: Flags
    is_wall: Flags
    n_pairs: NDArray[np.int64]


def confirmation(
    heard: EchoPaths, place_m: Floats, gain: Floats, reflectivity: Floats, members: Sequence[Numbers]
) -> Confirmation:
    """Return the confirmation of reflectors, each as a point or as a mirror-like wall, by their ``members``: echoes.

    At least 60 % of the pairs that should hear a reflector must do so, rounded down, and four if there are as many. On
    a platform with several sensors, at least two echoes must remain that no two nearer surfaces explain, and at least
    two must locate a point. A reflector that a nearer one and a wall explain is not confirmed.
    If the image of an emitting sensor is missing, two images must show a reflector, and 70 % of the pairs must each
    have a different echo. Sound over a nearer surface and a wall that only that sensor faces must not explain all of
    these echoes.
    """
    if not len(place_m):
        none = np.zeros(0, np.bool_)
        return Confirmation(none, none, none.astype(np.int64))
    n_sensors = len(heard.sensor_m)
    counts = gain > _COUNTS_FROM * gain.max(axis=(1, 2), keepdims=True)
    away_m = place_m[:, None] - heard.sensor_m
    range_m = np.linalg.norm(away_m, axis=2)
    normal = away_m / np.maximum(range_m, NEAREST_M)[..., None]
    depth = np.einsum("psi,si->ps", normal, heard.ahead)
    is_known = np.isfinite(heard.path_m)
    for receiver in range(n_sensors):
        rows = heard.rows.get(receiver)
        is_heard = is_known if rows is None or not len(rows) else is_known[rows]  # Silence shows no emitters.
        counts[:, receiver] &= is_heard.any(axis=0) & (rows is not None)
        if receiver not in heard.flat:
            counts[:, receiver] &= depth[:, receiver, None] > 0
    n_pairs = counts.sum(axis=(1, 2))
    least = min(_N_LEAST, n_sensors)
    needed = np.maximum(np.minimum(n_pairs, _N_SURE), _PART * n_pairs // 1).clip(least)
    is_behind = _behind(heard, range_m, normal, depth)
    # The normal of a wall is the direction from the sensor that faces it.
    facing = np.array([*heard.rows], np.int64)
    across = normal[:, facing].swapaxes(0, 1)
    beyond_m = np.einsum("psi,wpi->wps", away_m, across)
    image_m = heard.sensor_m + 2 * beyond_m[..., None] * across[:, :, None]
    point_m = np.broadcast_to(place_m[:, None], (1, *away_m.shape))
    found = _confirming(heard, np.concatenate([point_m, image_m]), range_m, counts)
    found[1:] &= (depth[:, facing] > _FACING).T[..., None, None]
    is_enough, n_echoes = _is_enough(heard, found, needed, is_behind), _n_echoes(found)
    as_point, as_wall = is_enough[0], is_enough[1:].any(axis=0)
    best, every = np.argmax(n_echoes[1:], axis=0), np.arange(len(place_m))
    point, wall = found[0], found[1 + best, every]
    number = np.flatnonzero(n_echoes[1 + best, every] >= np.maximum(least, n_echoes[0]))
    toward, near_m = across[best, every], range_m[every, facing[best]]
    walls = Walls(
        number,
        toward[number],
        np.einsum("wi,wi->w", toward[number], place_m[number]),
        4 * reflectivity[number] / near_m[number] ** 2,
    )
    twice = reflected_twice(heard, place_m, walls, reflectivity, members)
    is_free = ~twice.is_explained[..., None]
    is_joined = np.array([len(each) >= least for each in members], np.bool_)
    as_point &= is_joined & (_n_echoes(point & is_free) >= least)
    is_sure = as_point | (as_wall & (_n_echoes(wall & is_free) >= least))
    is_ghost = twice.is_ghost | _mirrored(place_m, heard.sensor_m, np.argmax(depth, axis=1))
    hidden = np.flatnonzero(np.isfinite(heard.path_m).any(axis=0) & ~np.isin(np.arange(n_sensors), [*heard.rows]))
    if len(hidden):
        best = np.where((as_point & (_n_echoes(point) >= _n_echoes(wall)))[:, None, None], point, wall)
        is_sure &= _is_agreed(heard, best, best & is_free, n_pairs)
        best &= is_sure[:, None, None]
        is_ghost |= over_hidden_walls(heard, place_m, walls, best, hidden, is_ghost)
    return Confirmation(np.asarray(is_sure & ~is_ghost), np.asarray(as_wall), n_pairs)


def _is_agreed(heard: EchoPaths, confirming: Flags, free: Flags, n_pairs: Numbers) -> Flags:
    """Return True for reflectors that two images show, and most pairs: (reflector,) bool."""
    n_receivers = sum(free[:, rows].any(axis=(1, 2)).astype(np.int64) for rows in heard.rows.values())
    return np.asarray((n_receivers >= _N_IMAGES) & (_n_echoes(confirming) >= _AGREED * n_pairs))


def _n_echoes(confirming: Flags) -> Numbers:
    """Return the number of echoes that confirm reflectors, each once: (…, reflector) int64."""
    return np.asarray(confirming.any(axis=-1).sum(axis=-1))


def _is_enough(heard: EchoPaths, confirming: Flags, needed: Floats, is_behind: Flags) -> Flags:
    """Return True for reflectors that enough pairs hear, not only from the directions of nearer ones."""
    several = [confirming[..., rows, :].any(axis=-2).sum(axis=-1) for rows in heard.rows.values()]
    n_confirming = np.stack(several, axis=-1)
    is_ahead = (n_confirming > 0) & ~is_behind[:, [*heard.rows]]
    return np.asarray((n_confirming.sum(axis=-1) >= needed) & is_ahead.any(axis=-1))


def _behind(heard: EchoPaths, range_m: Floats, toward: Floats, depth: Floats) -> Flags:
    """Return True where a receiver hears a reflector from the direction of a nearer one: (reflector, receiver).

    Sound that a wall and the nearer one reflect arrives from there as well.
    """
    toward = toward - 2 * np.where(heard.is_flat, np.minimum(depth, 0.0), 0.0)[..., None] * heard.ahead
    cosine = np.einsum("psi,qsi->pqs", toward, toward)
    is_nearer = range_m + _MIN_APART_M < range_m[:, None]
    return np.asarray((is_nearer & (cosine > math.cos(_SAME_RAD))).any(axis=1))


def _mirrored(place_m: Floats, sensor_m: Floats, facing: NDArray[np.int64]) -> Flags:
    """Return True for places that sound over a nearer reflector and a wall at another one shows.

    Sound that the wall reflects on both ways comes from the mirror image of the nearer reflector. Sound that it
    reflects on one way comes from the same direction, after the way from the receiver or from the sensor that faces the
    nearer reflector to the latter. Both imply a wall.
    """
    found = np.zeros(len(place_m), np.bool_)
    heard_m = sensor_m[facing]
    from_m = np.linalg.norm(place_m[:, None] - heard_m, axis=2)  # (nearer reflector, ghost)
    range_m = np.linalg.norm(place_m - heard_m, axis=1)
    toward = (place_m - heard_m) / np.maximum(range_m, NEAREST_M)[:, None]
    is_nearer = from_m + _MIN_APART_M < range_m
    images_m = np.broadcast_to(range_m, from_m.shape), 2 * range_m - from_m, 2 * range_m - range_m[:, None]
    image_m = heard_m + np.stack(images_m)[..., None] * toward
    offset_m = image_m - place_m[:, None]
    between_m = np.linalg.norm(offset_m, axis=3)
    normal = offset_m / np.maximum(between_m, NEAREST_M)[..., None]
    depth_m = np.einsum("wpgi,wpgi->wpg", (image_m + place_m[:, None]) / 2 - heard_m, normal)
    way, nearer, ghost = np.nonzero(is_nearer & (between_m > 2 * _MIN_APART_M) & (depth_m > _MIN_APART_M))
    normal = normal[way, nearer, ghost]
    wall_m = place_m[:, None] - (heard_m[ghost] + depth_m[way, nearer, ghost, None] * normal)
    off_m = np.abs(np.einsum("wki,ki->wk", wall_m, normal))
    is_wall = (off_m < _PLANE_M) & (np.linalg.norm(wall_m, axis=2) < _FOOT_M)
    numbers = np.arange(len(place_m))[:, None]
    is_wall &= (numbers != nearer) & (numbers != ghost)
    found[ghost[is_wall.any(axis=0)]] = True
    return found


def _confirming(heard: EchoPaths, origin_m: Floats, sent_m: Floats, counts: Flags) -> Flags:
    """Return the echoes that confirm reflectors, (way, reflector, echo, emitter), by apparent origins of their sound.

    Sound of the first way has paths ``sent_m`` to the reflectors, and that of the others comes from mirror images.
    """
    found = np.zeros((*origin_m.shape[:2], *heard.path_m.shape), np.bool_)
    paths_m = np.concatenate([sent_m, np.zeros(((len(origin_m) - 1) * len(sent_m), sent_m.shape[1]))])
    source, emitter, echo = heard.arriving(
        origin_m.reshape(len(paths_m), *origin_m.shape[2:]), paths_m, _PATH_M, _ANGLE_RAD
    )
    way, reflector = np.divmod(source, len(sent_m))
    found[way, reflector, echo, emitter] = counts[reflector, heard.receiver[echo], emitter]
    return found
