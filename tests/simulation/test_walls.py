"""Wall images, occlusion and boxes, compared with constructions by hand."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.simulation import Box, Electronics, Emitter, Point, Sphere, Wall
from ertis_numba.simulation.effects._piston import piston
from tests.scenes import (
    BAND_HZ,
    EAR,
    RATE_HZ,
    SENSOR,
    SPEED_M_S,
    error_db,
    filtered,
    heard,
    listener_and_emitter,
    scene_of,
    seen,
    sorted_ways,
    vector,
    ways,
    written_out,
)

FRONT = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0), reflection_db=-3)
SIDE = Wall(position_m=(0.0, 1.0, 0.0), facing_deg=(-90.0, 0.0), reflection_db=-6)


def lengths_m(*ways_m):
    """Lengths of paths, each a row of places."""
    return np.array([np.sum(np.linalg.norm(np.diff(np.asarray(way, dtype=float), axis=0), axis=1)) for way in ways_m])


# ---- where images are ------------------------------------------------------------------------------


def test_one_wall_gives_three_more_echoes_of_a_point_and_its_own():
    point_m = (0.8, 0.4, -0.2)
    scene = scene_of(Point(position_m=point_m, strength_db=0), sensor=EAR, walls=(FRONT,))
    delay_s, amplitude = sorted_ways(scene, "walls", "spreading")
    direct_m, by_wall_m = lengths_m([(0, 0, 0), point_m], [(3.0, 0, 0), point_m])  # from the emitter and its image
    wall = 10 ** (-3 / 20)
    wanted = [
        (2 * direct_m, 1 / direct_m**2),
        (direct_m + by_wall_m, wall / (direct_m * by_wall_m)),  # emitter, wall, point
        (direct_m + by_wall_m, wall / (direct_m * by_wall_m)),  # point, wall, microphone
        (2 * by_wall_m, wall**2 / by_wall_m**2),
        (3.0, wall / 3.0),
    ]
    wanted.sort()
    assert_allclose(delay_s * SPEED_M_S, [length for length, _ in wanted], atol=1e-9)
    assert_allclose(sorted(amplitude), sorted(level for _, level in wanted), rtol=1e-9)


def test_every_microphone_has_its_own_image():
    sensor = SENSOR.replace(yaw_deg=30, pitch_deg=10)
    places_m = microphones(sensor.array).positions_m @ sensor.rotation().T
    [echo] = ways(scene_of(sensor=sensor, walls=(FRONT,)), "walls", "spreading")
    way_m = np.linalg.norm(places_m - (3.0, 0.0, 0.0), axis=1)
    assert_allclose(echo.delay_s, [way_m / SPEED_M_S], atol=1e-12)
    assert_allclose(echo.amplitude[..., 0], [10 ** (-3 / 20) / way_m])


@pytest.mark.parametrize("facing_deg", [(180.0, 0.0), (0.0, 0.0), (160.0, 0.0), (-150.0, 20.0), (30.0, -45.0)])
def test_mirror_source_lies_behind_an_oblique_wall(facing_deg):
    normal = unit_vectors(*np.radians(facing_deg))
    scene = scene_of(sensor=EAR, walls=(Wall(position_m=(1.2, 0.3, -0.4), facing_deg=facing_deg),))
    [reflector] = seen(scene, "walls")
    foot_m = normal @ (1.2, 0.3, -0.4) * normal
    assert reflector.name == "walls[0]"
    assert reflector.range_m == pytest.approx(np.linalg.norm(foot_m))
    found = reflector.range_m * unit_vectors(*np.radians((reflector.azimuth_deg, reflector.elevation_deg)))
    assert_allclose(found, foot_m, atol=1e-9)


def test_second_order_images_between_two_walls():
    """Between parallel walls at 1.5 m and -1 m, the path over both is 5 m, in either order."""
    back = Wall(position_m=(-1.0, 0.0, 0.0), facing_deg=(0.0, 0.0))
    scene = scene_of(sensor=EAR, walls=(FRONT, back))
    delay_s, amplitude = sorted_ways(scene, "walls", "spreading")
    wall = 10 ** (-3 / 20)
    assert_allclose(delay_s * SPEED_M_S, [2.0, 3.0, 5.0, 5.0], atol=1e-9)
    assert_allclose(amplitude, [1 / 2.0, wall / 3.0, wall / 5.0, wall / 5.0])
    third = scene.replace(max_reflections=3)
    assert_allclose(sorted_ways(third, "walls")[0] * SPEED_M_S, [2.0, 3.0, 5.0, 5.0, 7.0, 8.0], atol=1e-9)


def test_corner_image_occurs_once():
    """With separate emitter and microphone, one of the two orders of the walls is possible."""
    scene = listener_and_emitter((0.0, 0.0, 0.0), (0.3, -0.5, 0.1), walls=(FRONT, SIDE))
    delay_s, amplitude = sorted_ways(scene, "walls", "spreading", "cross_emission")
    receiver_m = (0.0, 0.0, 0.0)
    wanted_m = lengths_m(
        *([image_m, receiver_m] for image_m in ((0.3, -0.5, 0.1), (0.3, 2.5, 0.1), (2.7, -0.5, 0.1), (2.7, 2.5, 0.1)))
    )
    order = np.argsort(wanted_m)
    walls = 10 ** (np.array([0, -6, -3, -9]) / 20)
    assert_allclose(delay_s * SPEED_M_S, wanted_m[order], atol=1e-9)
    assert_allclose(amplitude, (walls / wanted_m)[order])


@pytest.mark.parametrize("place_m", [(0.0, 0.0, 0.0), (0.2, -0.7, 0.3)])
def test_a_corner_returns_the_sound_to_where_it_came_from(place_m):
    """A right angle returns all rays, so the edge gives one echo over both walls."""
    scene = scene_of(sensor=EAR.replace(position_m=place_m), walls=(FRONT, SIDE))
    edge_m = np.hypot(1.5 - place_m[0], 1.0 - place_m[1])
    delay_s, amplitude = sorted_ways(scene, "walls", "spreading")
    wanted_m = np.sort([2 * (1.5 - place_m[0]), 2 * (1.0 - place_m[1]), 2 * edge_m])
    assert_allclose(delay_s * SPEED_M_S, wanted_m, atol=1e-9)
    assert amplitude[-1] == pytest.approx(10 ** (-9 / 20) / (2 * edge_m))


def test_a_room_has_all_its_second_images_for_a_sensor_that_hears_itself():
    """Six walls, six paths between opposite ones, twelve edges."""
    box = Box(position_m=(0.1, 0.2, 0.3), size_m=(3.0, 4.0, 2.5))
    assert len(seen(scene_of(sensor=EAR, boxes=(box,)), "walls", "occlusion")) == 6 + 6 + 12


def test_number_of_reflections_is_limited():
    point = Point(position_m=(0.8, 0.2, 0.1))
    counts = [
        len(sorted_ways(scene_of(point, sensor=EAR, walls=(FRONT,), max_reflections=largest), "walls")[0])
        for largest in range(3)
    ]
    assert counts == [1, 4, 5]
    assert len(sorted_ways(scene_of(point, sensor=EAR, walls=(FRONT,)))[0]) == 1  # the effect is off


# ---- where they are not ----------------------------------------------------------------------------


@pytest.mark.parametrize(("aside_m", "there"), [(0.0, True), (0.49, True), (0.51, False), (2.0, False)])
@pytest.mark.parametrize("axis", [1, 2])
def test_wall_reflects_only_within_its_extent(aside_m, there, axis):
    """The mirror point of the sensor is straight ahead; the wall is 1 m wide and high."""
    place_m = [1.5, 0.0, 0.0]
    place_m[axis] = aside_m
    wall = Wall(position_m=vector(place_m), facing_deg=(180.0, 0.0), size_m=(1.0, 1.0))
    assert len(seen(scene_of(sensor=EAR, walls=(wall,)), "walls")) == there


def test_width_lies_level_and_height_upright():
    wide = Wall(position_m=(1.5, 0.8, 0.0), facing_deg=(180.0, 0.0), size_m=(2.0, 0.2))
    assert seen(scene_of(sensor=EAR, walls=(wide,)), "walls")
    assert not seen(scene_of(sensor=EAR, walls=(wide.replace(size_m=(0.2, 2.0)),)), "walls")
    floor = Wall(position_m=(0.8, 0.0, -1.0), facing_deg=(0.0, 90.0), size_m=(0.2, 2.0))
    assert seen(scene_of(sensor=EAR, walls=(floor,)), "walls")  # its height lies along x, its width across
    assert not seen(scene_of(sensor=EAR, walls=(floor.replace(size_m=(2.0, 0.2)),)), "walls")
    assert seen(scene_of(sensor=EAR, walls=(floor.replace(size_m=(2.0, 0.2), facing_deg=(90.0, 90.0)),)), "walls")


def test_wall_between_sensor_and_emitter_reflects_nothing():
    scene = listener_and_emitter((0.0, 0.0, 0.0), (2.5, 0.2, 0.0), walls=(FRONT,))
    assert len(sorted_ways(scene, "walls", "cross_emission")[0]) == 1  # straight, for want of occlusion


def test_walls_mirror_on_both_sides():
    behind = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(0.0, 0.0), reflection_db=-3)
    assert_allclose(
        heard(scene_of(sensor=EAR, walls=(behind,)), "walls"), heard(scene_of(sensor=EAR, walls=(FRONT,)), "walls")
    )


# ---- with other effects ----------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["emitter", "microphone"])
def test_patterns_are_mirrored(end):
    """The emitter radiates towards the mirror point; its image is mirrored, not only moved."""
    sensor = EAR.replace(
        yaw_deg=40,
        emitter=Emitter(diameter_m=0.02 if end == "emitter" else 0.0),
        electronics=Electronics(microphone_diameter_m=0.02 if end == "microphone" else 0.0),
    )
    scene = scene_of(sensor=sensor, walls=(SIDE,))  # 50° off the axis
    argument = math.pi * 0.02 * BAND_HZ / SPEED_M_S * math.sin(math.radians(50))
    found = filtered(heard(scene, "walls"), heard(scene, "walls", f"{end}_directivity"))
    assert_allclose(found, np.abs(piston(argument)), atol=0.005)


@pytest.mark.parametrize("end", ["emitter", "microphone"])
def test_patterns_apply_at_both_ends_of_a_reflected_path(end):
    """Of the two paths with one reflection, one leaves the emitter to the wall, the other to the point."""
    sensor = EAR.replace(
        yaw_deg=20, emitter=Emitter(diameter_m=0.02), electronics=Electronics(microphone_diameter_m=0.02)
    )
    scene = scene_of(Point(position_m=(0.6, -0.3, 0.2)), sensor=sensor, walls=(SIDE,), max_reflections=1)
    plain, patterned = (
        np.concatenate([entry.amplitude[:, 0] for entry in ways(scene, *names, frequency_hz=BAND_HZ)])
        for names in (("walls",), ("walls", f"{end}_directivity"))
    )
    axis = np.array([math.cos(math.radians(20)), math.sin(math.radians(20)), 0.0])
    of_point, of_image = (
        piston(math.pi * 0.02 * BAND_HZ / SPEED_M_S * math.sqrt(1 - (axis @ place_m) ** 2 / (place_m @ place_m)))
        for place_m in (np.array([0.6, -0.3, 0.2]), np.array([0.6, 2.3, 0.2]))
    )
    straight, wall_last, wall_first, _ = patterned / plain
    by_wall = (wall_first, wall_last) if end == "emitter" else (wall_last, wall_first)
    assert_allclose(straight, of_point, rtol=1e-9)
    assert_allclose(by_wall, (of_image, of_point), rtol=1e-9)


def test_signals_contain_all_images():
    """Rendered signals are compared with calls at the positions of the images."""
    floor = Wall(position_m=(0.0, 0.0, -0.4), facing_deg=(0.0, 90.0), reflection_db=-2)
    sphere = Sphere(position_m=(0.85, 0.1, 0.0), radius_m=0.3)  # so large that it is a mirror at all frequencies
    scene = scene_of(Point(position_m=(0.5, -0.2, 0.1)), walls=(floor,), spheres=(sphere,))
    names = ("walls", "occlusion", "spreading", "target_size")
    found = ways(scene, *names)
    assert sum(len(entry.delay_s) for entry in found) == 2 * 4 + 1
    n_samples = scene.sensors[0].recording.n_samples
    wanted = sum(written_out(SENSOR.call, entry.delay_s, entry.amplitude[..., 0], n_samples) for entry in found)
    assert max(entry.delay_s.max() for entry in found) * RATE_HZ < n_samples
    assert error_db(heard(scene, *names), wanted) < -85
