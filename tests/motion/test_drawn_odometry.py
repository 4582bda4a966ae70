"""Drawn scenes: images show reflectors and walls where closed forms place them, and odometry is rated by errors."""

import math

import numpy as np
import pytest
from ertis_bench.platform_trials import drawn_odometry, motion
from ertis_bench.platform_trials.drawn_images import (
    DrawnImager,
    DrawnMounting,
    DrawnPath,
    DrawnReflectors,
    DrawnScene,
    DrawnWall,
)
from ertis_bench.platform_trials.drawn_scenes import KINDS, drawn_scene

import ertis_numba as ertis
from ertis_numba.geometry import Grid

SPEED_M_S = 1.5
NO_REFLECTORS = DrawnReflectors(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def points_of(reflectors, walls=(), twist=(0.0, 0.0, 0.0)):
    """Return the points of one sensor at the origin, nearest first."""
    path = DrawnPath(np.array([0.0, 1.0]), np.array([twist, twist]))
    scene = DrawnScene({"front": DrawnMounting(0, 0, 0)}, ("front",), reflectors, walls, path, np.zeros(1), 1e-5, 0.0)
    (image,) = DrawnImager()(scene, 0, np.random.default_rng(1))
    points = ertis.PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad))(image)
    return points.replace(
        **{name: getattr(points, name)[np.argsort(points.position_m[:, 0])] for name in ("position_m", "amplitude")},
        uncertainty_m=None,
    )


def test_images_show_reflectors_and_walls_at_their_places():
    reflectors = DrawnReflectors(np.array([[1.2, 0.5], [2.0, -0.7]]), np.zeros((2, 2)), np.zeros(2))
    found = points_of(reflectors, (DrawnWall((1.0, 0.0), 3.0, (-1.0, 1.0), 6.0),))
    assert found.position_m[:3] == pytest.approx(np.array([[1.2, 0.5, 0], [2.0, -0.7, 0], [3.0, 0, 0]]), abs=4e-3)


def test_images_of_a_moving_platform_are_compensated_by_its_velocity():
    reflectors = DrawnReflectors(np.array([[2.0, 0.4]]), np.zeros((1, 2)), np.zeros(1))
    moving = points_of(reflectors, twist=(SPEED_M_S, 0.0, math.radians(30)))
    assert np.abs(moving.position_m[0, :2] - [2.0, 0.4]).max() > 8e-3
    at_rest = ertis.compensate_motion(moving, (SPEED_M_S, 0.0, 0.0), math.radians(30))
    assert at_rest.position_m[0, :2] == pytest.approx([2.0, 0.4], abs=3e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_of_a_seed_are_the_same(kind):
    (one, _), (other, _) = drawn_scene(kind, 3), drawn_scene(kind, 3)
    assert np.array_equal(one.reflectors.place_m, other.reflectors.place_m)
    assert np.array_equal(one.path.at(one.pulses_s), other.path.at(other.pulses_s))
    assert set(one.names) <= set(one.mountings)


def test_rating_counts_measured_and_refused_steps():
    report = drawn_odometry.run(count=1, seed=100, say=str, kinds=("four", "noise"))
    measured, refused = report["scenes"]["rows"]
    assert (measured["steps"], measured["measured"], measured["far"]) == (7, 7, 0)
    assert 0.1 < measured["nees"] < 4
    assert (refused["measured"], refused["few_echoes"], refused["nees"]) == (0, 7, None)
    assert "0 of 7 measured steps are more than 5" in motion.form(report)
