"""Echoes over two surfaces, compared with paths by mirror images: posts and walls around a platform."""

import numpy as np
import pytest

from ertis_numba.fusion.echo_paths import EchoPaths
from ertis_numba.fusion.reflections import Walls, over_hidden_walls, reflected_twice

YAW_RAD = np.radians([0.0, 90.0, 180.0, -90.0])
AHEAD = np.stack([np.cos(YAW_RAD), np.sin(YAW_RAD), np.zeros(4)], axis=1)
SENSOR_M = 0.2 * AHEAD
WAYS = "wall, wall", "wall, post", "post, wall", "wall, post, wall"


def mirrored(place_m, wall):
    normal, depth_m = wall
    return place_m + 2 * (depth_m - place_m @ normal)[..., None] * normal


def echoes_from(origin_m, sent_m=None):
    """Receiver, direction and path of the sound of all emitters from places, to flat arrays."""
    for receiver, heard_m in enumerate(SENSOR_M):
        for emitter, from_m in enumerate(origin_m):
            apart_m = np.linalg.norm(from_m - heard_m)
            toward = (from_m - heard_m) / apart_m
            toward = toward - 2 * min(toward @ AHEAD[receiver], 0.0) * AHEAD[receiver]
            yield receiver, toward, apart_m + (0.0 if sent_m is None else sent_m[emitter])


def room(seed):
    """Two walls and a post in front of them."""
    rng = np.random.default_rng(seed)
    turn_rad = rng.uniform(-np.pi, np.pi) + np.array([0.0, rng.uniform(1.2, np.pi)])
    normal = np.stack([np.cos(turn_rad), np.sin(turn_rad), np.zeros(2)], axis=1)
    walls = list(zip(normal, rng.uniform(0.9, 1.6, 2), strict=True))
    while True:
        place_m = np.append(rng.uniform(-1.5, 1.5, 2), 0.0)
        if np.linalg.norm(place_m) > 0.6 and all(place_m @ each < depth_m - 0.3 for each, depth_m in walls):
            return walls, place_m


def judged(seed, way, strength=100.0):
    """Ghosts among two walls, a post and a reflector that sound over two of them shows, for echoes of power 1."""
    walls, post_m = room(seed)
    images_m = [mirrored(SENSOR_M, wall) for wall in walls]
    posts_m = np.repeat(post_m[None], 4, axis=0)
    behind_m = np.repeat(mirrored(post_m[None], walls[0]), 4, axis=0)
    straight_m = np.linalg.norm(post_m - SENSOR_M, axis=1)
    over_m = np.linalg.norm(post_m - images_m[0], axis=1)
    ghost = {
        "wall, wall": (mirrored(images_m[0], walls[1]), None),
        "wall, post": (posts_m, over_m),
        "post, wall": (behind_m, straight_m),
        "wall, post, wall": (behind_m, over_m),
    }[way]
    groups = [[*echoes_from(each)] for each in images_m]
    groups += [[*echoes_from(posts_m, straight_m)], [*echoes_from(*ghost)]]
    receiver, direction, path_m = zip(*(each for group in groups for each in group), strict=True)
    rows = {number: np.flatnonzero(np.array(receiver) == number) for number in range(4)}
    paths_m = np.repeat(np.array(path_m)[:, None], 4, axis=1)
    heard = EchoPaths(SENSOR_M, AHEAD, rows, range(4), np.array(direction), paths_m, np.ones(len(receiver)))
    members = np.arange(len(receiver)).reshape(4, -1)
    own = members[3][0]  # The ghost that the first sensor's own echo shows.
    toward = np.linalg.norm(ghost[0][0] - SENSOR_M[0])
    ghost_m = SENSOR_M[0] + paths_m[own, 0] / 2 * (ghost[0][0] - SENSOR_M[0]) / toward
    places_m = np.array([*(depth_m * normal for normal, depth_m in walls), post_m, ghost_m])
    normal, depth_m = (np.array(each) for each in zip(*walls, strict=True))
    planes = Walls(np.arange(2), normal, depth_m, np.full(2, strength))
    return reflected_twice(heard, places_m, planes, np.full(4, strength), list(members))


@pytest.mark.parametrize("way", WAYS)
def test_sound_over_two_surfaces_shows_a_ghost(way):
    found = [judged(seed, way).is_ghost.tolist() for seed in range(12)]
    assert found == [[False, False, False, True]] * 12


@pytest.mark.parametrize("way", WAYS)
def test_echoes_that_are_stronger_than_the_surfaces_allow_show_reflectors(way):
    assert not judged(0, way, strength=0.01).is_explained.any()


LEFT = 1  # The sensor without an image.
POST_M = np.array([1.1, 0.2, 0.0])
WALL_ON_THE_LEFT, WALL_ON_THE_RIGHT = (np.array([0.0, 1.0, 0.0]), 1.3), (np.array([0.0, -1.0, 0.0]), 1.0)


def is_over_a_hidden_wall(origin_m, emitter, sent_m=None, *, sensor, walls=()):
    """Return True if a hidden wall explains the echoes of a call that a sensor takes for those of its own."""
    groups = [echo for number, echo in enumerate(echoes_from(origin_m, sent_m)) if number % 4 == emitter]
    receiver, direction, path_m = (np.array(each) for each in zip(*groups, strict=True))
    rows = {number: np.flatnonzero(receiver == number) for number in (0, 2, 3)}
    paths_m = np.repeat(path_m[:, None], 4, axis=1)
    heard = EchoPaths(SENSOR_M, AHEAD, rows, range(4), direction, paths_m, 1 / path_m**4)
    (own,) = np.flatnonzero(receiver == sensor)
    toward = origin_m[emitter] - SENSOR_M[sensor]
    place_m = SENSOR_M[sensor] + path_m[own] / 2 * toward / np.linalg.norm(toward)
    confirming = np.zeros((2 + len(walls), len(groups), 4), np.bool_)
    confirming[1, receiver != LEFT, sensor] = True
    places_m = np.array([POST_M, place_m, *(depth_m * normal for normal, depth_m in walls)])
    normal, depth_m = np.array([each for each, _ in walls]).reshape(-1, 3), np.array([each for _, each in walls])
    planes = Walls(np.arange(len(walls)) + 2, normal, depth_m, np.ones(len(walls)))
    none = np.zeros(len(places_m), np.bool_)
    return bool(over_hidden_walls(heard, places_m, planes, confirming, np.array([LEFT]), none)[1])


def test_sound_over_a_post_and_a_wall_that_no_image_shows_confirms_nothing():
    straight_m = np.linalg.norm(POST_M - SENSOR_M, axis=1)
    for wall, is_hidden in ((WALL_ON_THE_LEFT, True), (WALL_ON_THE_RIGHT, False)):
        behind_m = np.repeat(mirrored(POST_M[None], wall), 4, axis=0)
        assert is_over_a_hidden_wall(behind_m, 0, straight_m, sensor=0) == is_hidden


def test_the_call_of_a_sensor_without_an_image_over_two_walls_confirms_nothing():
    """The sensor on the right takes it for the echo of its own call from twice the distance."""
    origin_m = mirrored(mirrored(SENSOR_M, WALL_ON_THE_LEFT), WALL_ON_THE_RIGHT)
    assert is_over_a_hidden_wall(origin_m, LEFT, sensor=3, walls=[WALL_ON_THE_RIGHT])
    assert not is_over_a_hidden_wall(origin_m, LEFT, sensor=3)
