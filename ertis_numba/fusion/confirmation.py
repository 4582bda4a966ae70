"""Confirmation of located reflectors by the echoes of all pairs of emitter and receiver.

Sound that two surfaces reflect has a longer path than that over either one, and shows reflectors that do not exist.
Its echoes at the other pairs do not fit the same place, unlike those of a reflector.
"""

import math
from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["EchoPaths", "confirmed"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_PATH_M: Final = 0.012  # Largest difference between the path of an echo and the predicted one.
_ANGLE_RAD: Final = math.radians(4.0)  # Largest difference of directions ahead of a receiver.
_LEAST_COSINE: Final = 0.25  # Directions are less certain beside a flat array, by up to this factor.
_COUNTS_FROM: Final = 0.1  # Gain relative to the highest of all pairs, from which a pair should hear a reflector.
_FACING: Final = 0.3  # Cosine from which a sensor may show the surface of a wall.
_NEAREST_M: Final = 1e-9
_PART: Final = 0.6
_MIRROR_M: Final = 0.06  # Largest distance between a ghost and the place where a wall shows it.
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


def confirmed(heard: EchoPaths, place_m: Floats, gain: Floats) -> Flags:
    """Return True for the reflectors that enough echoes confirm, each as a point or as a mirror-like wall.

    At least 60 % of the pairs that should hear a reflector must do so, rounded down, and four if there are as many. A
    platform with several sensors needs two. A reflector at the mirror image of another one is not confirmed.

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
    as_point = _n_confirming(heard, np.repeat(place_m[:, None], len(heard.sensor_m), axis=1), counts) >= needed
    as_wall = np.zeros_like(as_point)
    for facing in heard.rows:  # The normal of a wall is the direction from the sensor that faces it.
        toward = normal[:, facing]
        away_m = np.einsum("psi,pi->ps", place_m[:, None] - heard.sensor_m, toward)
        image_m = heard.sensor_m + 2 * away_m[..., None] * toward[:, None]
        n_confirming = _n_confirming(heard, image_m, counts, is_image=True)
        as_wall |= (depth[:, facing] > _FACING) & (n_confirming >= needed)
    facing, centred_m = np.argmax(depth, axis=1), place_m - heard.sensor_m.mean(axis=0)
    return np.asarray((as_point | as_wall) & ~_mirrored(centred_m, normal[np.arange(len(normal)), facing]))


def _mirrored(place_m: Floats, normal: Floats) -> Flags:
    """Return True for places where a wall at another reflector mirrors a third one, or halfway to its mirror image.

    Sound that the wall reflects on both ways comes from the mirror image. On one way, its path is half as much longer.

    Parameters
    ----------
    place_m, normal : (reflector, axis) float64
        Reflectors relative to the platform, and the normals that walls there would have.
    """
    offset_m = place_m[:, None] - place_m  # (reflector, wall, axis)
    image_m = place_m[:, None] - 2 * np.einsum("pwi,wi->pw", offset_m, normal)[..., None] * normal
    range_m, there_m = np.linalg.norm(place_m, axis=1), np.linalg.norm(image_m, axis=2)
    once_m = image_m * ((1 + range_m[:, None] / np.maximum(there_m, _NEAREST_M)) / 2)[..., None]
    is_nearer = np.maximum(range_m[:, None], range_m) + _MIRROR_M < range_m[:, None, None]
    is_nearer &= ~np.eye(len(place_m), dtype=np.bool_)  # A reflector is no wall that mirrors itself.
    found = np.zeros(len(place_m), np.bool_)
    for each_m in (image_m, once_m):
        apart_m = np.linalg.norm(place_m[:, None, None] - each_m, axis=3)
        found |= ((apart_m < _MIRROR_M) & is_nearer).any(axis=(1, 2))
    return found


def _n_confirming(heard: EchoPaths, origin_m: Floats, counts: Flags, *, is_image: bool = False) -> NDArray[np.int64]:
    """Return the number of pairs that hear each reflector: (reflector,) int64.

    Parameters
    ----------
    heard : EchoPaths
    origin_m : (reflector, emitter, axis) float64
        Place from which the sound of each emitter arrives: that of the reflector, or the mirror image of the emitter.
    counts : (reflector, receiver, emitter) bool
    is_image : bool
        Sound comes from mirror images, so that its path begins there.
    """
    found = np.zeros(len(origin_m), np.int64)
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
        found += (near.any(axis=2) & counts[:, receiver]).sum(axis=1)
    return found
