"""Confirmation of located reflectors by the echoes of all pairs of emitter and receiver.

Sound that two surfaces reflect has a longer path than that over either one, and shows reflectors that do not exist.
Its echoes at the other pairs do not fit the same place, unlike those of a reflector.
"""

import math
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Confirmation", "EchoPaths", "confirmation"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_PATH_M: Final = 0.012  # Largest difference between the path of an echo and the predicted one.
_ANGLE_RAD: Final = math.radians(4.0)  # Largest difference of directions ahead of a receiver.
_LEAST_COSINE: Final = 0.25  # Directions are less certain beside a flat array, by up to this factor.
_COUNTS_FROM: Final = 0.1  # Gain relative to the highest of all pairs, from which a pair should hear a reflector.
_FACING: Final = 0.3  # Cosine from which a sensor may show the surface of a wall.
_NEAREST_M: Final = 1e-9
_PART: Final = 0.6
_MIN_APART_M: Final = 0.06  # Least difference of ranges of a ghost and a nearer reflector.
_PLANE_M: Final = 0.04  # Largest distance of a located wall from the plane that a ghost implies, …
_FOOT_M: Final = 0.4  # … and from the foot of the perpendicular to it.
_SAME_RAD: Final = math.radians(2.5)  # Difference of directions below which a nearer reflector may send the sound.
_N_LEAST: Final = 2  # Echoes without which an own echo may be that of another sensor's call.
_N_SURE: Final = 4  # Echoes that two reflections hardly cause at the right paths.


class EchoPaths(NamedTuple):
    """Echoes of all receivers, and the geometry of their sensors.

    Attributes
    ----------
    sensor_m, ahead : (sensor, axis) float64
        Positions and axes of the sensors.
    rows : mapping of int to (echo,) int64
        Echoes of each receiver that has an image.
    flat : collection of int
        Receivers that do not distinguish front and back.
    direction : (echo, axis) float64
    path_m : (echo, emitter) float64
        Path of each echo if the emitter's call caused it; NaN for emitters that the receiver does not hear.
    """

    sensor_m: Floats
    ahead: Floats
    rows: Mapping[int, NDArray[np.int64]]
    flat: Collection[int]
    direction: Floats
    path_m: Floats


class Confirmation(NamedTuple):
    """Confirmation of reflectors.

    Attributes
    ----------
    is_confirmed : (reflector,) bool
        True if enough echoes confirm a reflector, as a point or as a mirror-like wall.
    is_wall : (reflector,) bool
        True if enough echoes confirm a mirror-like wall.
    n_pairs : (reflector,) int64
        Pairs of emitter and receiver that should hear it.
    """

    is_confirmed: Flags
    is_wall: Flags
    n_pairs: NDArray[np.int64]


def confirmation(heard: EchoPaths, place_m: Floats, gain: Floats) -> Confirmation:
    """Return the confirmation of reflectors, each as a point or as a mirror-like wall.

    At least 60 % of the pairs that should hear a reflector must do so, rounded down, and four if there are as many. A
    platform with several sensors needs two. A reflector that a nearer one and a wall explain is not confirmed.

    Parameters
    ----------
    heard : EchoPaths
    place_m : (reflector, axis) float64
    gain : (reflector, receiver, emitter) float64
        Power of its echoes relative to that ahead.
    """
    counts = gain > _COUNTS_FROM * gain.max(axis=(1, 2), initial=0.0)[:, None, None]
    away_m = place_m[:, None] - heard.sensor_m
    normal = away_m / np.maximum(np.linalg.norm(away_m, axis=2, keepdims=True), _NEAREST_M)
    depth = np.einsum("psi,si->ps", normal, heard.ahead)
    is_known = np.isfinite(heard.path_m)
    for receiver in range(len(heard.sensor_m)):
        rows = heard.rows.get(receiver)
        is_heard = is_known if rows is None or not len(rows) else is_known[rows]  # Silence shows no emitters.
        counts[:, receiver] &= is_heard.any(axis=0) & (rows is not None)
        if receiver not in heard.flat:
            counts[:, receiver] &= depth[:, receiver, None] > 0
    n_pairs = counts.sum(axis=(1, 2))
    least = min(_N_LEAST, len(heard.sensor_m))
    needed = np.maximum(np.minimum(n_pairs, _N_SURE), _PART * n_pairs // 1).clip(least)
    is_behind = _behind(heard, away_m)
    n_confirming = _n_confirming(heard, np.repeat(place_m[:, None], len(heard.sensor_m), axis=1), counts)
    as_point = _is_enough(n_confirming, needed, is_behind)
    as_wall = np.zeros_like(as_point)
    for facing in heard.rows:  # The normal of a wall is the direction from the sensor that faces it.
        toward = normal[:, facing]
        away_m = np.einsum("psi,pi->ps", place_m[:, None] - heard.sensor_m, toward)
        image_m = heard.sensor_m + 2 * away_m[..., None] * toward[:, None]
        n_confirming = _n_confirming(heard, image_m, counts, is_image=True)
        as_wall |= (depth[:, facing] > _FACING) & _is_enough(n_confirming, needed, is_behind)
    is_ghost = _mirrored(place_m, heard.sensor_m, np.argmax(depth, axis=1))
    return Confirmation(np.asarray((as_point | as_wall) & ~is_ghost), as_wall, n_pairs)


def _is_enough(n_confirming: NDArray[np.int64], needed: Floats, is_behind: Flags) -> Flags:
    """Return True for reflectors that enough pairs hear, not only from the directions of nearer ones."""
    return np.asarray((n_confirming.sum(axis=1) >= needed) & ((n_confirming > 0) & ~is_behind).any(axis=1))


def _behind(heard: EchoPaths, away_m: Floats) -> Flags:
    """Return True where a receiver hears a reflector from the direction of a nearer one: (reflector, receiver) bool.

    Sound that a wall and the nearer one reflect arrives from there as well.
    """
    range_m = np.linalg.norm(away_m, axis=2)
    toward = away_m / np.maximum(range_m, _NEAREST_M)[..., None]
    depth = np.einsum("psi,si->ps", toward, heard.ahead)
    flat = np.isin(np.arange(len(heard.sensor_m)), [*heard.flat])
    toward = toward - 2 * np.where(flat, np.minimum(depth, 0.0), 0.0)[..., None] * heard.ahead
    cosine = np.einsum("psi,qsi->pqs", toward, toward)
    is_nearer = range_m + _MIN_APART_M < range_m[:, None]
    return np.asarray((is_nearer & (cosine > math.cos(_SAME_RAD))).any(axis=1))


def _mirrored(place_m: Floats, sensor_m: Floats, facing: NDArray[np.int64]) -> Flags:
    """Return True for places that sound over a nearer reflector and a wall at another one shows.

    Sound that the wall reflects on both ways comes from the mirror image of the nearer reflector. Sound that it
    reflects on one way comes from the same direction, after the way from the receiver or from the sensor that faces the
    nearer reflector to the latter. Both imply a wall.

    Parameters
    ----------
    place_m : (reflector, axis) float64
    sensor_m : (sensor, axis) float64
    facing : (reflector,) int64
        The sensor that faces each reflector.
    """
    found = np.zeros(len(place_m), np.bool_)
    if not len(place_m):
        return found
    heard_m = sensor_m[facing]
    from_m = np.linalg.norm(place_m[:, None] - heard_m, axis=2)  # (nearer reflector, ghost)
    range_m = np.linalg.norm(place_m - heard_m, axis=1)
    toward = (place_m - heard_m) / np.maximum(range_m, _NEAREST_M)[:, None]
    is_nearer = from_m + _MIN_APART_M < range_m
    images_m = np.broadcast_to(range_m, from_m.shape), 2 * range_m - from_m, 2 * range_m - range_m[:, None]
    for image_range_m in images_m:
        image_m = heard_m + image_range_m[..., None] * toward
        offset_m = image_m - place_m[:, None]
        between_m = np.linalg.norm(offset_m, axis=2)
        normal = offset_m / np.maximum(between_m, _NEAREST_M)[..., None]
        depth_m = np.einsum("pgi,pgi->pg", (image_m + place_m[:, None]) / 2 - heard_m, normal)
        foot_m = heard_m + depth_m[..., None] * normal
        nearer, ghost = np.nonzero(is_nearer & (between_m > 2 * _MIN_APART_M) & (depth_m > _MIN_APART_M))
        wall_m = place_m[:, None] - foot_m[nearer, ghost]
        off_m = np.abs(np.einsum("wki,ki->wk", wall_m, normal[nearer, ghost]))
        is_wall = (off_m < _PLANE_M) & (np.linalg.norm(wall_m, axis=2) < _FOOT_M)
        numbers = np.arange(len(place_m))[:, None]
        is_wall &= (numbers != nearer) & (numbers != ghost)
        found[ghost[is_wall.any(axis=0)]] = True
    return found


def _n_confirming(heard: EchoPaths, origin_m: Floats, counts: Flags, *, is_image: bool = False) -> NDArray[np.int64]:
    """Return the number of pairs that hear each reflector, by receiver: (reflector, receiver) int64.

    Parameters
    ----------
    heard : EchoPaths
    origin_m : (reflector, emitter, axis) float64
        Place from which the sound of each emitter arrives: that of the reflector, or the mirror image of the emitter.
    counts : (reflector, receiver, emitter) bool
    is_image : bool
        Sound comes from mirror images, so that its path begins there.
    """
    found = np.zeros((len(origin_m), len(heard.sensor_m)), np.int64)
    for receiver, rows in heard.rows.items():
        to_m = origin_m - heard.sensor_m[receiver]
        apart_m = np.maximum(np.linalg.norm(to_m, axis=2), _NEAREST_M)
        path_m = apart_m if is_image else apart_m + np.linalg.norm(origin_m - heard.sensor_m, axis=2)
        toward = to_m / apart_m[..., None]
        depth = toward @ heard.ahead[receiver]
        seen = toward - 2 * np.minimum(depth, 0.0)[..., None] * heard.ahead[receiver]  # A flat array hears no side.
        turn = np.sqrt(np.maximum(0.0, 2 - 2 * seen @ heard.direction[rows].T))
        near = turn < (_ANGLE_RAD / np.maximum(np.abs(depth), _LEAST_COSINE))[..., None]
        near &= np.abs(heard.path_m[rows].T[None] - path_m[..., None]) < _PATH_M  # False for NaN.
        found[:, receiver] = (near.any(axis=2) & counts[:, receiver]).sum(axis=1)
    return found
