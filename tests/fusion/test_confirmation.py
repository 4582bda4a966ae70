"""Confirmation of reflectors: points and mirror-like walls, and ghosts of sound that a wall reflects as well."""

import numpy as np
import pytest

import ertis_numba as ertis
from ertis_numba.fusion.confirmation import confirmation
from ertis_numba.fusion.echo_paths import EchoPaths

YAW_RAD = np.radians([0.0, 90.0, 180.0, -90.0])
AHEAD = np.stack([np.cos(YAW_RAD), np.sin(YAW_RAD), np.zeros(4)], axis=1)
HEIGHT_M = 0.4
SENSOR_M = 0.2 * AHEAD + [0.0, 0.0, HEIGHT_M]
POST_M = np.array([1.2, 0.9, HEIGHT_M])
WALL_M = np.array([-1.6, 0.0, HEIGHT_M])  # A wall across x.


def echo(receiver, from_m, path_m):
    """An echo of a flat array: a direction in front of it, and the path for each emitter."""
    toward = (from_m - SENSOR_M[receiver]) / np.linalg.norm(from_m - SENSOR_M[receiver])
    depth = toward @ AHEAD[receiver]
    return receiver, toward - 2 * min(depth, 0.0) * AHEAD[receiver], path_m


def mirrored(place_m):
    return place_m * [-1.0, 1.0, 1.0] + [2 * WALL_M[0], 0.0, 0.0]


def echoes_of_post(place_m):
    for receiver, heard_m in enumerate(SENSOR_M):
        for sent_m in SENSOR_M:
            yield echo(receiver, place_m, np.linalg.norm(place_m - sent_m) + np.linalg.norm(place_m - heard_m))


def echoes_of_wall():
    for receiver, heard_m in enumerate(SENSOR_M):
        for sent_m in SENSOR_M:
            yield echo(receiver, mirrored(sent_m), np.linalg.norm(mirrored(sent_m) - heard_m))


def echoes_over_wall(place_m):
    """Sound that meets the post first and the wall then."""
    for receiver, heard_m in enumerate(SENSOR_M):
        for sent_m in SENSOR_M:
            path_m = np.linalg.norm(place_m - sent_m) + np.linalg.norm(mirrored(place_m) - heard_m)
            yield echo(receiver, mirrored(place_m), path_m)


def heard_by(echoes, flat=range(4), with_image=range(4)):
    """Echoes of equal power, whose paths are known for all emitters."""
    receiver, direction, path_m = zip(*echoes, strict=True)
    rows = {number: np.flatnonzero(np.array(receiver) == number) for number in with_image}
    paths_m = np.repeat(np.array(path_m)[:, None], 4, axis=1)
    return EchoPaths(SENSOR_M, AHEAD, rows, flat, np.array(direction), paths_m, np.ones(len(receiver)))


def confirmed(heard, places_m, members=None, strength=100.0):
    """Confirmation of places that all echoes locate, or some."""
    n_places, n_sensors = len(places_m), len(heard.sensor_m)
    located = [np.arange(len(heard.path_m))] * n_places if members is None else members
    gain = np.ones((n_places, n_sensors, n_sensors))
    return confirmation(heard, np.array(places_m), gain, np.full(n_places, strength), located).is_confirmed.tolist()


def found(echoes, *places_m, flat=range(4), with_image=range(4)):
    return confirmed(heard_by([*echoes], flat, with_image), places_m)


def test_reflectors_are_confirmed_by_echoes_of_all_sensors():
    assert found(echoes_of_post(POST_M), POST_M, POST_M + 0.1) == [True, False]


def test_a_reflector_that_few_sensors_hear_is_not_confirmed():
    most = [each for each in echoes_of_post(POST_M) if each[0] in (0, 1)]
    assert found(most, POST_M) == [False]
    assert found([*most, *(each for each in echoes_of_post(POST_M) if each[0] == 2)], POST_M) == [True]
    assert found(most, POST_M, with_image=(0, 1)) == [True]


def test_arrays_that_are_not_flat_need_no_echo_from_behind():
    ahead = [each for each in echoes_of_post(POST_M) if each[0] in (0, 1)]
    assert found(ahead, POST_M, flat=()) == [True]


def test_a_mirror_like_wall_is_confirmed_by_the_images_of_all_emitters():
    assert found(echoes_of_wall(), WALL_M) == [True]
    assert found(echoes_of_wall(), WALL_M - [0.13, 0.0, 0.0]) == [False]


@pytest.mark.parametrize("seed", range(24))
def test_sound_over_a_wall_confirms_no_reflector(seed):
    rng = np.random.default_rng(seed)
    place_m = np.array([rng.uniform(0.5, 2.0), rng.uniform(-2.0, 2.0), HEIGHT_M])
    # The place that the sensor behind derives from its own call.
    path_m = np.linalg.norm(place_m - SENSOR_M[2]) + np.linalg.norm(mirrored(place_m) - SENSOR_M[2])
    toward = (mirrored(place_m) - SENSOR_M[2]) / np.linalg.norm(mirrored(place_m) - SENSOR_M[2])
    ghost_m = SENSOR_M[2] + path_m / 2 * toward
    echoes = [*echoes_of_post(place_m), *echoes_of_wall(), *echoes_over_wall(place_m)]
    assert found(echoes, place_m, WALL_M, ghost_m) == [True, True, False]


def test_mirror_images_behind_a_wall_are_not_confirmed():
    """Sound that the wall reflects on both ways fits the mirror image at all sensors."""
    echoes = [*echoes_of_post(POST_M), *echoes_of_wall(), *echoes_of_post(mirrored(POST_M))]
    assert found(echoes, POST_M, WALL_M, mirrored(POST_M)) == [True, True, False]


def test_a_second_place_beside_a_reflector_does_not_make_it_a_mirror_image():
    beside_m = POST_M * [0.99, 0.99, 1.0] + [0.02, -0.03, 0.0]
    assert np.linalg.norm(beside_m) < np.linalg.norm(POST_M)
    assert found(echoes_of_post(POST_M), POST_M, beside_m)[0]


def test_a_lone_echo_confirms_nothing_on_a_platform_with_several_sensors():
    own = echo(0, np.array([2.0, 0.0, HEIGHT_M]), 3.6)
    place_m = np.array([[2.0, 0.0, HEIGHT_M]])
    rows = {0: np.array([0])}
    paths_m = np.array([[3.6, np.nan, np.nan, np.nan]])
    heard = EchoPaths(SENSOR_M, AHEAD, rows, range(4), own[1][None], paths_m, np.ones(1))
    gain = np.zeros((1, 4, 4))
    gain[0, 0, 0] = 1.0
    assert confirmation(heard, place_m, gain, np.ones(1), [rows[0]]).is_confirmed.tolist() == [False]
    alone = EchoPaths(SENSOR_M[:1], AHEAD[:1], rows, range(1), own[1][None], np.array([[3.6]]), np.ones(1))
    assert confirmed(alone, place_m) == [True]


def test_a_point_that_a_single_echo_locates_is_not_confirmed():
    heard = heard_by(echoes_of_post(POST_M))
    assert confirmed(heard, [POST_M], [np.arange(2)]) == [True]
    assert confirmed(heard, [POST_M], [np.arange(1)]) == [False]


@pytest.mark.parametrize(("with_image", "is_confirmed"), [((0,), False), ((0, 1), True), ((0, 1, 2, 3), True)])
def test_two_images_confirm_a_reflector_if_another_one_is_missing(with_image, is_confirmed):
    assert found(echoes_of_post(POST_M), POST_M, with_image=with_image) == [is_confirmed]


@pytest.mark.parametrize(("n_echoes", "is_confirmed"), [(8, True), (6, True), (5, False)])
def test_most_pairs_confirm_a_reflector_if_an_image_is_missing(n_echoes, is_confirmed):
    echoes = [each for each in echoes_of_post(POST_M) if each[0] in (0, 1)][:n_echoes]
    assert found(echoes, POST_M, with_image=(0, 1)) == [is_confirmed]


def test_no_reflectors_are_no_error():
    none = EchoPaths(SENSOR_M, AHEAD, {}, range(4), np.empty((0, 3)), np.empty((0, 4)), np.empty(0))
    assert confirmation(none, np.empty((0, 3)), np.empty((0, 4, 4)), np.empty(0), []).is_confirmed.tolist() == []


@pytest.mark.parametrize("seed", range(12))
def test_sound_over_a_slanting_wall_shows_no_reflector(seed):
    """The wall is located between the feet of two sensors, so its normal is not the direction from either one."""
    rng = np.random.default_rng([seed, 1])
    turn_rad = np.radians(rng.uniform(20.0, 60.0))
    normal, away_m = np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0]), rng.uniform(1.4, 2.4)
    along = np.array([-normal[1], normal[0], 0.0])
    wall_m = away_m * normal + rng.uniform(-0.12, 0.12) * along + [0.0, 0.0, HEIGHT_M]
    place_m = rng.uniform(0.3, 0.8) * normal + rng.choice([-1, 1]) * rng.uniform(0.7, 1.4) * along + [0, 0, HEIGHT_M]
    image_m = place_m + 2 * (away_m - place_m @ normal) * normal
    sensor_m = SENSOR_M[np.argmax([(image_m - each) @ ahead for each, ahead in zip(SENSOR_M, AHEAD, strict=True)])]
    path_m = np.linalg.norm(place_m - sensor_m) + np.linalg.norm(image_m - sensor_m)
    ghost_m = sensor_m + path_m / 2 * (image_m - sensor_m) / np.linalg.norm(image_m - sensor_m)
    echoes = [*echoes_of_post(place_m), *echoes_of_post(ghost_m)]
    assert found(echoes, place_m, ghost_m) == [True, True]
    assert found(echoes, place_m, ghost_m, wall_m)[:2] == [True, False]


def test_reflectors_behind_a_nearer_one_in_all_directions_are_not_confirmed():
    """Sound that a wall and the nearer reflector send back arrives from the direction of the nearer one."""
    behind_m = POST_M + 0.8 * (POST_M - SENSOR_M[0])
    echoes = [each for each in echoes_of_post(behind_m) if each[0] == 0]
    near = [each for each in echoes_of_post(POST_M) if each[0] in (0, 1)]
    heard = heard_by(sorted([*near, *echoes], key=lambda each: each[0]), with_image=(0, 1))
    assert confirmed(heard, [POST_M, behind_m]) == [True, False]


@pytest.mark.parametrize(
    ("confirmed", "shown"),
    [(None, [0, 1, 2, 3]), ([False, True, False, True], [1, 2, 3]), ([False] * 4, [2]), ([True] * 4, [0, 1, 2, 3])],
)
def test_the_strongest_points_are_confirmed_or_the_nearest(confirmed, shown):
    position_m = np.array([[3.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0], [2.5, 0, 0]], np.float32)
    amplitude = np.array([40.0, 1.0, 0.8, 0.5], np.float32)
    flags = None if confirmed is None else np.array(confirmed)
    cloud = ertis.PointCloud(position_m, amplitude, ertis.Settings(), confirmed=flags)
    assert cloud.strongest(None, -40.0).amplitude.tolist() == amplitude[shown].tolist()
    assert len(cloud.strongest(1, -40.0)) == 1
