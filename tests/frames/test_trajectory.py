"""Trajectories: interpolation and velocities of poses, and arguments that are refused."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation, Slerp

import ertis_numba as ertis

START_NS = 1_700_000_000_000_000_000  # A present-day time, at which float64 resolves only 256 ns.
IDENTITY = [0.0, 0.0, 0.0, 1.0]


def steady(velocity_m_s, rate_rad_s, *, n_poses=21, step_ns=100_000_000):
    """A platform with constant velocity and constant rotation rate in the world frame."""
    time_ns = START_NS + step_ns * np.arange(n_poses)
    elapsed_s = (time_ns - START_NS)[:, None] / 1e9
    rotation = Rotation.from_rotvec(elapsed_s * rate_rad_s).as_quat()
    return ertis.Trajectory(time_ns, elapsed_s * velocity_m_s, rotation)


def test_length_is_that_of_the_path_from_pose_to_pose():
    positions_m = [[0, 0, 0], [3, 4, 0], [3, 4, 2], [3, 4, 1]]
    assert ertis.Trajectory(range(4), positions_m, [IDENTITY] * 4).length_m == 8.0
    assert ertis.Trajectory([5], [[1, 2, 3]], [IDENTITY]).length_m == 0.0


def test_at_returns_given_poses_unchanged():
    rotation = Rotation.random(40, random_state=2).as_quat()
    given = ertis.Trajectory(np.arange(40) * 100, np.ones((40, 3)), -rotation)
    assert np.array_equal(given.at(given.time_ns).rotation_xyzw, given.rotation_xyzw)
    assert np.array_equal(given.replace(source="copy").rotation_xyzw, given.rotation_xyzw)


numbers = st.lists(st.floats(-2, 2), min_size=3, max_size=3).map(np.array)
offsets_ns = st.lists(st.integers(0, 2_000_000_000), min_size=1, max_size=20, unique=True).map(
    lambda values: np.sort(np.array(values, np.int64))
)


@given(numbers, numbers, offsets_ns)
def test_at_is_exact_for_constant_velocity_and_rotation_rate(velocity_m_s, rate_rad_s, offset_ns):
    poses = steady(velocity_m_s, rate_rad_s).at(START_NS + offset_ns)
    np.testing.assert_allclose(poses.position_m, offset_ns[:, None] / 1e9 * velocity_m_s, atol=1e-12)
    expected = Rotation.from_rotvec(offset_ns[:, None] / 1e9 * rate_rad_s)
    assert np.max((Rotation.from_quat(poses.rotation_xyzw).inv() * expected).magnitude()) < 1e-7


@given(numbers, numbers, offsets_ns)
def test_velocity_at_is_exact_for_constant_velocity_and_rotation_rate(velocity_m_s, rate_rad_s, offset_ns):
    linear_m_s, angular_rad_s = steady(velocity_m_s, rate_rad_s).velocity_at(START_NS + offset_ns)
    np.testing.assert_allclose(linear_m_s, np.broadcast_to(velocity_m_s, linear_m_s.shape), atol=1e-9)
    np.testing.assert_allclose(angular_rad_s, np.broadcast_to(rate_rad_s, angular_rad_s.shape), atol=1e-6)


def test_at_interpolates_rotations_as_scipy_does():
    rotation = Rotation.random(4, random_state=1)
    time_ns = START_NS + np.array([0, 7, 11, 20]) * 10**8
    trajectory = ertis.Trajectory(time_ns, np.zeros((4, 3)), rotation.as_quat())
    offset_ns = np.linspace(0, 2e9, 33).astype(np.int64)
    wanted = Slerp((time_ns - START_NS) / 1e9, rotation)(offset_ns / 1e9)
    poses = Rotation.from_quat(trajectory.at(START_NS + offset_ns).rotation_xyzw)
    assert np.max((poses.inv() * wanted).magnitude()) < 1e-7


def test_at_interpolates_covariances_linearly_and_keeps_the_source():
    covariance = np.stack([np.eye(6), 3 * np.eye(6)])
    trajectory = ertis.Trajectory([0, 100], np.zeros((2, 3)), [IDENTITY] * 2, covariance, "odometry")
    pose = trajectory.at([50])
    np.testing.assert_array_equal(pose.covariance[0], 2 * np.eye(6))
    assert (len(pose), pose.source) == (1, "odometry")


def test_at_returns_the_pose_of_a_trajectory_with_one():
    trajectory = ertis.Trajectory([5], [[1, 2, 3]], [IDENTITY])
    assert trajectory.at([5]).position_m.tolist() == [[1, 2, 3]]


def test_constructor_normalises_quaternions_with_few_digits():
    assert np.linalg.norm(ertis.Trajectory([0], np.zeros((1, 3)), [[0, 0, 0.7071, 0.7071]]).rotation_xyzw) == 1.0


def test_replace_changes_a_field():
    assert steady(np.zeros(3), np.zeros(3)).replace(source="file").source == "file"


REFUSED = {
    "gap": ({"max_gap_s": 0.0}, "max_gap_s is 0; use a number above 0"),
    "huge covariance": ({"covariance": np.full((2, 6, 6), 1e17)}, r"covariance reaches 1e\+17; pass square metres"),
    "huge quaternion": ({"rotation_xyzw": [[1e300] * 4] * 2}, r"rotation_xyzw has length inf at \[0\]"),
    "no pose": ({"time_ns": []}, "time_ns is empty; pass"),
    "times": ({"time_ns": [0, 0]}, "time_ns does not increase: 0 at "),
    "far future": (
        {"time_ns": [0, 2**62 + 1]},
        "time_ns runs from 0 to 4611686018427387905; use nanoseconds since 1970",
    ),
    "far past": ({"time_ns": [-(2**62) - 1, 0]}, "time_ns runs from -4611686018427387905 to 0; use nanoseconds since"),
    "seconds": ({"time_ns": [0.5, 1.5]}, "pass one dimension of whole nanoseconds"),
    "shape": ({"position_m": np.zeros((2, 2))}, "position_m has shape"),
    "text": ({"position_m": [["x"] * 3] * 2}, "position_m is not an array of numbers"),
    "nan": ({"position_m": np.full((2, 3), np.nan)}, "position_m holds nan at "),
    "length": ({"rotation_xyzw": np.ones((2, 4))}, "rotation_xyzw has length 2 at "),
    "covariance": ({"covariance": np.zeros((2, 3, 3))}, "covariance has shape"),
    "typo": ({"postion_m": 1}, "Trajectory has no field 'postion_m'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_trajectory_refuses_fields_that_cannot_be_used(case):
    changes, message = REFUSED[case]
    with pytest.raises(ertis.ArgumentError, match=message):
        ertis.Trajectory([0, 10], np.zeros((2, 3)), [IDENTITY] * 2).replace(**changes)


def test_at_names_both_intervals_if_times_lie_outside():
    trajectory = ertis.Trajectory([10**9, 2 * 10**9], np.zeros((2, 3)), [IDENTITY] * 2)
    with pytest.raises(ertis.ArgumentError, match=r"2 of 3 times from 0\.500 s to 3\.000 s .* covers 1\.000 s to 2\.0"):
        trajectory.at([5 * 10**8, 10**9, 3 * 10**9])


def test_velocity_at_refuses_a_single_pose():
    with pytest.raises(ertis.ArgumentError, match="single pose; a velocity needs at least 2"):
        ertis.Trajectory([0], np.zeros((1, 3)), [IDENTITY]).velocity_at([0])


def test_arrays_of_a_trajectory_are_read_only_copies():
    time_ns, covariance = np.array([1, 2]), np.stack([np.eye(6)] * 2)
    path = ertis.Trajectory(time_ns, np.zeros((2, 3)), [IDENTITY] * 2, covariance)
    for values in (path.time_ns, path.position_m, path.rotation_xyzw, path.covariance):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0
    time_ns[0], covariance[0] = 0, 0
    assert path.time_ns[0] == path.covariance[0, 0, 0] == 1


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.eye(6) + np.eye(6, k=1) * 0.1, r"covariance is not symmetric at \[1\]; use"),
        (np.diag([1.0, 1, 1, 1, 1, -0.1]), r"covariance has a negative eigenvalue at \[1\]; use positive"),
    ],
)
def test_covariances_must_be_symmetric_and_positive_semidefinite(wrong, message):
    with pytest.raises(ertis.ArgumentError, match=message):
        ertis.Trajectory([1, 2], np.zeros((2, 3)), [IDENTITY] * 2, [np.eye(6), wrong])


def test_covariances_may_be_singular_and_rounded():
    draws = np.random.default_rng(1).normal(size=(6, 3))
    rounded = (draws @ draws.T).astype(np.float32)
    assert ertis.Trajectory([1], [[0, 0, 0]], [IDENTITY], [rounded]).covariance.shape == (1, 6, 6)


def test_long_intervals_between_poses_are_not_interpolated():
    """Poses every 0.1 s, without those between 0.5 s and 1.5 s, and a single one at 3 s."""
    whole = steady([1.0, 0.0, 0.0], np.array([0.0, 0.0, 0.5]), n_poses=31)
    kept = np.r_[0:6, 15:21, 30]
    columns = {name: getattr(whole, name)[kept] for name in ("time_ns", "position_m", "rotation_xyzw")}
    holes = ertis.Trajectory(**columns, max_gap_s=0.9)
    times_ns = START_NS + 1_000_000 * np.arange(0, 3001, 50)
    wanted = (times_ns <= START_NS + 500_000_000) | (times_ns >= START_NS + 1_500_000_000)
    wanted &= (times_ns <= START_NS + 2_000_000_000) | (times_ns == START_NS + 3_000_000_000)
    assert holes.covers(times_ns).tolist() == wanted.tolist()
    assert holes.replace(max_gap_s=None).covers(times_ns).all()
    found = holes.at(times_ns[wanted])
    assert found.max_gap_s == 0.9
    np.testing.assert_allclose(found.position_m, whole.at(times_ns[wanted]).position_m, rtol=0, atol=1e-12)
    with pytest.raises(
        ertis.ArgumentError, match=r"1 of 1 times .* 0\.000 s to .*, except 2 intervals longer than 0\.9 s"
    ):
        holes.replace(time_ns=holes.time_ns - START_NS).at([1_000_000_000])


def test_velocity_beside_a_long_interval_is_one_sided():
    """The platform drives at 1 m/s, then jumps by 9 m while there are no poses."""
    time_ns = START_NS + 100_000_000 * np.array([0, 1, 2, 12, 13, 14])
    x_m = [0.0, 0.1, 0.2, 9.2, 9.3, 9.4]
    given = ertis.Trajectory(time_ns, [[x, 0, 0] for x in x_m], [IDENTITY] * 6, max_gap_s=0.5)
    np.testing.assert_allclose(given.velocity_at(time_ns)[0][:, 0], 1.0, rtol=1e-9)


@pytest.mark.parametrize("lone", [0, 3, 6])
def test_velocity_at_a_pose_alone_between_long_intervals_is_unknown(lone):
    """Times next to the other poses have a velocity, although the lone pose is the next one."""
    seconds = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    seconds[lone:] += 2.0 * (lone > 0)
    seconds[lone + 1 :] += 2.0
    time_ns = START_NS + (1e9 * seconds).astype(np.int64)
    rotation = Rotation.from_rotvec(seconds[:, None] * [0.0, 0.0, 0.5]).as_quat()
    path = ertis.Trajectory(time_ns, seconds[:, None] * [1.0, 0.0, 0.0], rotation, max_gap_s=1.0)
    is_known = np.arange(7) != lone
    for offset_ns in (0, 500_000):
        late = time_ns + (offset_ns if lone < 6 else -offset_ns)
        linear_m_s, angular_rad_s = path.velocity_at(late)
        np.testing.assert_allclose(linear_m_s[is_known], [[1.0, 0.0, 0.0]] * 6, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(angular_rad_s[is_known], [[0.0, 0.0, 0.5]] * 6, rtol=1e-6, atol=1e-6)
        assert np.isnan(linear_m_s[lone]).all()
        assert np.isnan(angular_rad_s[lone]).all()
    assert np.isfinite(path.replace(max_gap_s=None).velocity_at(time_ns)[0]).all()
