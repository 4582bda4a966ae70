"""Poses that are hardly those of a platform are noted, and those of robots are not."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.frames.pose_doubts import PoseWatch, pose_doubts, warn_of_poses
from ertis_numba.storage import RecordingWriter
from tests.mapping.test_platform_tilt import drive, trajectory

RANDOM = np.random.default_rng(4)


def level(yaw_deg, place_m=None):
    """Poses of a level platform along the first places of a circle, with other yaws."""
    place_m = drive(len(yaw_deg))[0] if place_m is None else place_m
    return place_m, Rotation.from_euler("z", np.reshape(yaw_deg, (-1, 1)), degrees=True)


def w_first(place_m, rotation):
    """Return quaternions in the order w, x, y, z, read as x, y, z, w."""
    return place_m, Rotation.from_quat(np.roll(rotation.as_quat(), 1, axis=1))


def ned(place_m, rotation):
    """Return poses with z down, of the platform and of the world."""
    over = Rotation.from_euler("x", 180.0, degrees=True)
    return over.apply(place_m), over * rotation * over


def y_up(place_m, rotation):
    up = Rotation.from_euler("x", -90.0, degrees=True)
    return up.apply(place_m), up * rotation * up.inv()


YAW_DEG = np.linspace(0.0, 300.0, 40)
UTM_M = np.array([458_074.6, 5_429_380.2, 162.9])
ECEF_M = np.array([4_000_000.0, 500_000.0, 4_900_000.0])


@pytest.mark.parametrize(
    ("poses", "note"),
    [
        (drive(40), None),
        (level(YAW_DEG + 180.0), None),  # backwards
        (level(YAW_DEG + 90.0 + RANDOM.normal(0, 3, 40)), None),  # sideways
        (level(np.zeros(40)), None),  # an omnidirectional platform
        (level(RANDOM.uniform(-180, 180, 40)), None),
        (drive(40, pitch_deg=20.0), None),
        (drive(40, roll_deg=25.0), None),
        ((drive(40)[0], Rotation.from_euler("x", np.full((40, 1), 25.0), degrees=True)), None),
        ((drive(40)[0] + UTM_M, drive(40)[1]), None),
        ((drive(40)[0] + (5e5, 6.35e6, 100.0), drive(40)[1]), None),  # UTM at 57° north
        (ned(*drive(40)), None),  # Nothing tells it from another drive.
        (w_first(*drive(40)), "but it is level if their order is w, x, y, z; then name the columns in a first line"),
        (w_first(*level(np.linspace(155.0, 205.0, 40))), "tilt the platform by up to 25°, but it is level"),
        (y_up(*level(np.linspace(0.0, 50.0, 40), np.zeros((40, 3)))), "turns about its y axis only, by up to 50°"),
        ((drive(40)[0] * [1, -1, 1], drive(40)[1]), "the heading turns right where the path turns left"),
        (level(-YAW_DEG), "the heading turns right where the path turns left"),
        (level(90.0 - YAW_DEG), "angles that count clockwise"),
        (level(np.radians(YAW_DEG)), "as if radians were read as degrees; if so, name the column yaw_rad"),
        ((drive(40)[0] * 1e3, drive(40)[1]), "the platform moves at up to"),
        ((np.repeat([[0.0, 0, 0], [50.0, 0, 0]], 20, axis=0), level(np.zeros(40))[1]), "from pose 20 to pose 21 of 40"),
        (
            (drive(40)[0] + ECEF_M, drive(40)[1]),
            "6345 km from the origin, as those relative to the centre of the Earth",
        ),
    ],
)
def test_doubtful_poses_are_noted(poses, note):
    found = pose_doubts(trajectory(*poses))
    assert [note in each for each in found] == ([] if note is None else [True]), found


def test_poses_of_ned_become_those_of_their_platform():
    place_m, rotation = drive(pitch_deg=12.0, roll_deg=-7.0, climb_m=0.1)
    found = trajectory(*ned(place_m, rotation)).converted("ned")
    assert found.position_m == pytest.approx(place_m)
    assert (Rotation.from_quat(found.rotation_xyzw) * rotation.inv()).magnitude() == pytest.approx(0, abs=1e-12)


def test_order_of_quaternions_is_read_from_a_first_line_as_the_note_says(tmp_path):
    poses = trajectory(*w_first(*drive(40)))
    path = tmp_path / "a.tum"
    ertis.write_tum(path, poses)
    with pytest.warns(ertis.PoseWarning, match="timestamp tx ty tz qw qx qy qz"):
        ertis.read_trajectory(path)
    path.write_text(f"timestamp tx ty tz qw qx qy qz\n{path.read_text().partition(chr(10))[2]}")
    with warnings.catch_warnings(action="error"):
        found = ertis.read_trajectory(path)
    assert (Rotation.from_quat(found.rotation_xyzw) * drive(40)[1].inv()).magnitude() == pytest.approx(0, abs=1e-6)


def test_notes_of_a_file_are_not_repeated_where_its_poses_are_used():
    poses = trajectory(*w_first(*drive(40)))
    with pytest.warns(ertis.PoseWarning, match="w, x, y, z") as caught:
        warn_of_poses(poses, stacklevel=1)
    assert caught[0].filename == __file__
    with warnings.catch_warnings(action="error"):
        warn_of_poses(poses.replace(notes=pose_doubts(poses)), stacklevel=1)


def test_writer_of_recordings_warns_of_doubtful_poses(tmp_path):
    with pytest.warns(ertis.PoseWarning, match="w, x, y, z"):
        RecordingWriter(tmp_path / "a.h5", poses={"front": trajectory(*w_first(*drive(40)))})


def test_single_poses_are_examined_together_and_noted_once():
    place_m, rotation = w_first(*drive(40))
    watch = PoseWatch()
    for number, (each_m, turn) in enumerate(zip(place_m, rotation.as_quat(), strict=True)):
        with (
            pytest.warns(ertis.PoseWarning, match="order is w")
            if not number
            else warnings.catch_warnings(action="error")
        ):
            watch(each_m, turn, stacklevel=1)
