"""Occlusion by walls and boxes, compared with lines through rectangles."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

from ertis_numba.simulation import Box, Point, Wall
from tests.scenes import EAR, SPEED_M_S, listener_and_emitter, scene_of, seen, sorted_ways, vector

FRONT = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0), reflection_db=-3)

# ---- what stands in the way ------------------------------------------------------------------------


def crosses(start_m, stop_m, wall):
    """Return True if a straight line crosses a rectangle, from its intersection with the plane."""
    _, width, height = wall.axes()
    matrix = np.stack([np.subtract(stop_m, start_m), -width, -height], axis=1)
    if abs(np.linalg.det(matrix)) < 1e-12:
        return False
    share, along, up = np.linalg.solve(matrix, np.subtract(wall.position_m, start_m))
    return 0 < share < 1 and abs(along) <= wall.size_m[0] / 2 and abs(up) <= wall.size_m[1] / 2


coordinates = st.tuples(*(st.floats(-2, 2) for _ in range(3)))


@settings(max_examples=60, deadline=None)
@given(
    coordinates,
    coordinates,
    st.tuples(st.floats(-180, 180), st.floats(-90, 90)),
    st.tuples(st.floats(0.1, 3), st.floats(0.1, 3)),
)
def test_walls_hide_exactly_the_points_behind_them(point_m, wall_m, facing_deg, size_m):
    wall = Wall(position_m=wall_m, facing_deg=facing_deg, size_m=size_m)
    margin = {crosses((0, 0, 0), point_m, wall.replace(size_m=vector(np.multiply(size_m, k)))) for k in (0.999, 1.001)}
    far = np.linalg.norm(point_m) > 0.05 and abs(wall.axes()[0] @ np.subtract(point_m, wall_m)) > 1e-3
    if len(margin) == 1 and far and abs(wall.axes()[0] @ wall_m) > 1e-3:
        scene = scene_of(Point(position_m=point_m), sensor=EAR, walls=(wall,))
        assert len(sorted_ways(scene, "occlusion")[0]) == (not margin.pop())


def test_walls_hide_wall_images():
    """A screen stands between the sensor and a wall, and has its own images."""
    screen = Wall(position_m=(1.0, 0.0, 0.0), facing_deg=(180.0, 0.0), size_m=(0.4, 0.4))
    scene = scene_of(sensor=EAR, walls=(FRONT, screen))
    assert {reflector.name for reflector in seen(scene, "walls")} == {"walls[0]", "walls[1]"}
    assert [reflector.name for reflector in seen(scene, "walls", "occlusion")] == ["walls[1]"]


def test_wall_does_not_hide_its_own_images():
    point = Point(position_m=(0.8, 0.2, 0.1))
    scene = scene_of(point, sensor=EAR, walls=(FRONT,))
    assert_allclose(sorted_ways(scene, "walls", "occlusion"), sorted_ways(scene, "walls"))


def test_target_hidden_from_the_microphone_is_silent():
    """The emitter sees the target, the microphone does not."""
    screen = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0), size_m=(0.3, 0.3))
    scene = listener_and_emitter(
        (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), walls=(screen,), points=(Point(position_m=(1.0, 0.0, 0.0)),)
    )
    assert len(sorted_ways(scene, "cross_emission")[0]) == 2
    [direct_s] = sorted_ways(scene, "cross_emission", "occlusion")[0]
    assert direct_s == pytest.approx(1.0 / SPEED_M_S)


# ---- boxes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -135.0])
def test_box_equals_six_walls(yaw_deg):
    box = Box(position_m=(0.2, -0.3, 0.1), size_m=(2.0, 3.0, 4.0), yaw_deg=yaw_deg, reflection_db=-4)
    turn = math.radians(yaw_deg)
    forward, left = np.array([math.cos(turn), math.sin(turn), 0]), np.array([-math.sin(turn), math.cos(turn), 0])
    corner_m = np.zeros(3)
    for wall, normal, away_m, (across, up) in zip(
        box.walls(),
        (forward, -forward, left, -left, (0, 0, 1), (0, 0, -1)),
        (1.0, 1.0, 1.5, 1.5, 2.0, 2.0),
        ((3.0, 4.0), (3.0, 4.0), (2.0, 4.0), (2.0, 4.0), (3.0, 2.0), (3.0, 2.0)),
        strict=True,
    ):
        axes = wall.axes()
        assert_allclose(axes[0], normal, atol=1e-12)
        assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert_allclose(wall.position_m, np.add(box.position_m, np.multiply(away_m, normal)), atol=1e-12)
        assert wall.size_m == (across, up)
        assert wall.reflection_db == -4
        corner_m += axes[0] * away_m
        in_box = axes[1:] @ np.array([forward, left, (0, 0, 1)]).T
        assert_allclose(
            np.abs(in_box) @ (2.0, 3.0, 4.0), wall.size_m, atol=1e-9
        )  # width and height lie along its sides
    assert_allclose(corner_m, 0, atol=1e-12)


def test_box_ahead_shows_only_its_front():
    box = Box(position_m=(2.0, 0.0, 0.0), size_m=(1.0, 1.0, 1.0))
    points = (Point(position_m=(2.0, 0.1, 0.0)), Point(position_m=(4.0, 0.2, 0.0)), Point(position_m=(1.0, 0.2, 0.0)))
    found = seen(scene_of(*points, sensor=EAR, boxes=(box,)), "walls", "occlusion", "spreading")
    names = {reflector.name for reflector in found}
    assert {"boxes[0].back", "points[2]"} < names
    assert not any(name.startswith(("points[0]", "points[1]")) for name in names)
    assert all(set(name.split(" > ")) <= {"boxes[0].back", "points[2]"} for name in names)


def test_sensor_in_a_box_receives_six_wall_echoes():
    box = Box(position_m=(0.1, 0.2, 0.3), size_m=(3.0, 4.0, 2.5))
    scene = scene_of(sensor=EAR, boxes=(box,), max_reflections=1)
    found = {reflector.name: reflector.range_m for reflector in seen(scene, "walls", "occlusion")}
    wanted = {"front": 1.6, "back": 1.4, "left": 2.2, "right": 1.8, "top": 1.55, "bottom": 0.95}
    assert found == {f"boxes[0].{side}": pytest.approx(range_m) for side, range_m in wanted.items()}


def test_box_hides_its_content_from_outside():
    box = Box(position_m=(2.0, 0.0, 0.0), size_m=(1.0, 1.0, 1.0))
    scene = listener_and_emitter((0.0, 0.0, 0.0), (2.0, 0.1, 0.1), boxes=(box,))
    assert not len(sorted_ways(scene, "walls", "occlusion", "cross_emission")[0])
