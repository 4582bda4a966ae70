"""Poses that tilt a platform, such as those of a camera, are noted and can be converted."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.frames.platform_tilt import tilt_note
from tests.mapping.test_mapping import AHEAD, UNTURNED, views

OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]).T  # columns: x right, y down, z forward
START_NS = 1_700_000_000_000_000_000


def drive(n_poses=20, *, climb_m=0.0, pitch_deg=0.0, roll_deg=0.0):
    """A circle of a platform, with its attitude: positions and rotations."""
    angle_deg = np.linspace(0.0, 300.0, n_poses)
    angle_rad = np.radians(angle_deg)
    place_m = np.stack([np.sin(angle_rad), 1 - np.cos(angle_rad), climb_m * angle_rad], axis=1)
    level = np.zeros(n_poses)
    attitude = np.stack([angle_deg, level + pitch_deg, level + roll_deg], axis=1)
    return place_m, Rotation.from_euler("ZYX", attitude, degrees=True)


def trajectory(place_m, rotation, covariance=None):
    time_ns = START_NS + 10**8 * np.arange(len(place_m))
    return ertis.Trajectory(time_ns, place_m, rotation.as_quat(), covariance)


def of_camera(place_m, rotation):
    """Return the poses of a camera that looks ahead on the platform."""
    return place_m, rotation * Rotation.from_matrix(OPTICAL)


def in_world_of_camera(place_m, rotation):
    """Return the poses of a camera relative to its first pose."""
    place_m, rotation = of_camera(place_m, rotation)
    first = Rotation.from_matrix(OPTICAL).inv()
    return first.apply(place_m), first * rotation


@pytest.mark.parametrize(
    ("poses", "note"),
    [
        (drive(), None),
        (drive(pitch_deg=29.0), None),
        (drive(pitch_deg=31.0), "its z axis is 31° from vertical; poses of the platform"),
        (drive(roll_deg=90.0), "its z axis is 90° from vertical, and its y axis points up"),
        (
            drive(roll_deg=-90.0),
            "its −y axis points up, as that of a camera does (z forward, y down); convert them with",
        ),
        (drive(pitch_deg=90.0), "its z axis is 90° from vertical, and its −x axis points up"),
        (
            drive(roll_deg=180.0),
            "and its −z axis points up; poses of the platform have x forward, y left and z up, and quaternions",
        ),
        (
            of_camera(*drive()),
            "its −y axis points up, as that of a camera does (z forward, y down); convert them with --pose",
        ),
        (
            of_camera(*drive(pitch_deg=20.0)),
            "convert them with --pose-axes camera (ertis import poses, ertis map) or Trajectory.converted('camera')",
        ),
        (
            in_world_of_camera(*drive()),
            "turns about the y axis of the world; convert them with --pose-axes camera-world (ertis import poses, ",
        ),
        (in_world_of_camera(*(each[:4] for each in drive(90))), None),
        (drive(climb_m=0.1), None),
        (drive(climb_m=1.0), "the path is 5.24 m high and 2.82 m long on the ground"),
    ],
)
def test_tilt_of_most_poses_is_noted(poses, note):
    place_m, rotation = poses
    found = tilt_note(rotation.as_quat(), place_m)
    assert (found is None) == (note is None), found
    assert (note or "") in (found or "")


def test_straight_path_in_the_world_of_a_camera_is_noted():
    place_m = np.array([[0.0, 0.0, each] for each in np.linspace(0.0, 5.0, 9)])
    found = tilt_note(np.tile(UNTURNED, (9, 1)), place_m)
    assert found.startswith("the path is 5 m high and 0 m long on the ground")


def test_minority_of_tilted_poses_is_not_noted():
    place_m, rotation = drive(21)
    turned = Rotation.concatenate([of_camera(place_m, rotation)[1][:10], rotation[10:]])
    assert tilt_note(turned.as_quat(), place_m) is None


@pytest.mark.parametrize("attitude", [{}, {"pitch_deg": 12.0, "roll_deg": -7.0}])
@pytest.mark.parametrize(("axes", "poses_of"), [("camera", of_camera), ("platform", lambda *poses: poses)])
def test_poses_of_a_camera_become_those_of_its_platform(axes, poses_of, attitude):
    place_m, rotation = drive(**attitude)
    found = trajectory(*poses_of(place_m, rotation)).converted(axes)
    assert found.position_m == pytest.approx(place_m)
    assert (Rotation.from_quat(found.rotation_xyzw) * rotation.inv()).magnitude() == pytest.approx(0, abs=1e-12)


def test_world_of_a_camera_becomes_that_of_its_platform():
    place_m, rotation = drive(pitch_deg=12.0, roll_deg=-7.0)
    random = np.random.default_rng(1).normal(size=(len(place_m), 6, 6))
    camera = trajectory(*in_world_of_camera(place_m, rotation), random @ random.transpose(0, 2, 1))
    found = camera.converted("camera-world")
    assert found.position_m == pytest.approx(place_m)
    assert (Rotation.from_quat(found.rotation_xyzw) * rotation.inv()).magnitude() == pytest.approx(0, abs=1e-12)
    along = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])  # The variance along a direction does not depend on the axes.
    seen = np.concatenate([OPTICAL.T @ along[:3], OPTICAL.T @ along[3:]])
    assert along @ found.covariance @ along == pytest.approx(seen @ camera.covariance @ seen)


@pytest.mark.parametrize("as_trajectory", [False, True])
def test_mapper_warns_once_of_poses_of_a_camera(as_trajectory):
    place_m, rotation = of_camera(*drive(4))
    images, _ = views()[0]
    path = trajectory(place_m, rotation)
    at_start = [
        each.replace(
            stamp=each.stamp.__class__(
                **{
                    **{name: getattr(each.stamp, name) for name in each.stamp.__dataclass_fields__},
                    "timestamp_ns": START_NS,
                }
            )
        )
        for each in images
    ]
    mapper = ertis.Mapper({each.stamp.sensor: ((0.0, 0.0, 0.0), UNTURNED) for each in images})
    with pytest.warns(ertis.PoseWarning, match="as that of a camera does .* convert them with --pose-axes camera "):
        mapper.add(at_start, path if as_trajectory else (place_m[0], rotation[0].as_quat()))
    mapper.add(at_start, path if as_trajectory else (place_m[1], rotation[1].as_quat()))


def test_mapper_is_silent_about_level_poses():
    images, pose = views()[0]
    mapper = ertis.Mapper({each.stamp.sensor: AHEAD["sensor"] for each in images})
    with warnings.catch_warnings(action="error"):
        mapper.add(images, pose)
