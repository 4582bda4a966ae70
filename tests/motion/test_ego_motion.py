"""Velocity of a platform from two groups of images, and odometry."""

import functools
import math

import numpy as np
import pytest
import scipy.stats
from ertis_bench.platform_trials.furnished_rooms import PlatformImager, mountings, random_motion, random_room
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.fusion.rig import mounted_sensors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.motion.echoes import EchoExtractor
from ertis_numba.motion.flow import fit_flow
from ertis_numba.motion.planar_pose import PlanarPose
from ertis_numba.settings import Array

MOUNTINGS = {"sensor": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
TIME_NS = 100_000_000


def places_m(seed=1, count=40):
    draws = np.random.default_rng(seed)
    return np.column_stack([draws.uniform(0.8, 3, count), draws.uniform(-1.5, 1.5, count), np.zeros(count)])


def seen_from(pose, places, pulse, twist=(0.0, 0.0, 0.0), **stamp):
    """Return the point cloud of reflectors at rest, seen from a pose of the platform: x, y and yaw.

    The twist is the velocity forward, to the left and of the yaw, at which the platform moves meanwhile.
    """
    x, y, yaw_rad = pose
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    position_m = (places - [x, y, 0.0]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    cloud = ertis.PointCloud(
        position_m.astype(np.float32),
        np.ones(len(places), np.float32),
        ertis.Settings(),
        ertis.Stamp(**{"sync_count": pulse, "timestamp_ns": pulse * TIME_NS} | stamp),
    )
    forward_m_s, left_m_s, yaw_rate_rad_s = twist
    seen = cloud
    for _ in range(8):  # Points that compensation returns to their places, by iteration.
        at_rest = ertis.compensate_motion(seen, (forward_m_s, left_m_s, 0.0), yaw_rate_rad_s)
        seen = cloud.replace(position_m=seen.position_m + cloud.position_m - at_rest.position_m)
    return seen


@pytest.mark.parametrize(("x", "y", "yaw_deg"), [(0.1, 0.0, 0.0), (0.0, -0.08, 0.0), (0.05, 0.05, 5.0), (0, 0, -9.0)])
def test_ego_velocity_is_that_of_the_displacement(x, y, yaw_deg):
    turn_rad = math.radians(yaw_deg)
    # On an arc, the mean velocity in the turning frame is the displacement, turned back by half of the turn.
    half = turn_rad / 2
    along = np.array([math.cos(half) * x + math.sin(half) * y, math.cos(half) * y - math.sin(half) * x])
    along /= np.sinc(half / math.pi)
    twist = (*(along / 0.1).tolist(), turn_rad / 0.1)
    clouds = [seen_from((0, 0, 0), places_m(), 0, twist), seen_from((x, y, turn_rad), places_m(), 1, twist)]
    found = ertis.ego_velocity(clouds[:1], clouds[1:], MOUNTINGS)
    assert found.velocity_m_s == pytest.approx(along / 0.1, abs=5e-3)
    assert found.yaw_rate_rad_s == pytest.approx(turn_rad / 0.1, abs=5e-3)
    assert found.n_matches > 30


def test_moving_reflectors_are_ignored():
    places = places_m()
    walked = places.copy()
    walked[:12] += [0.0, 0.12, 0.0]
    twist = (1.0, 0.0, 0.0)
    before, after = seen_from((0, 0, 0), places, 0, twist), seen_from((0.1, 0, 0), walked, 1, twist)
    found = ertis.ego_velocity([before], [after], MOUNTINGS)
    assert found.velocity_m_s == pytest.approx([1.0, 0.0], abs=0.01)


def test_weak_echoes_from_behind_do_not_reverse_the_turn():
    """A flat array hears calls of neighbours from behind, mirrored, so that they turn the other way."""
    turn_rad = math.radians(6.0)
    twist = (0.0, 0.0, turn_rad / 0.1)
    ahead, behind = places_m(1, 10), places_m(2, 14)

    def cloud(yaw_rad, pulse):
        seen = seen_from((0, 0, yaw_rad), ahead, pulse, twist)
        mirrored = seen_from((0, 0, -yaw_rad), behind, pulse, (0.0, 0.0, -twist[2]))
        return seen.replace(
            position_m=np.concatenate([seen.position_m, mirrored.position_m]),
            amplitude=np.repeat(np.float32([1.0, 0.1]), [10, 14]),
        )

    found = ertis.ego_velocity([cloud(0.0, 0)], [cloud(turn_rad, 1)], MOUNTINGS)
    assert found.yaw_rate_rad_s == pytest.approx(twist[2], abs=0.02)
    assert found.velocity_m_s == pytest.approx([0.0, 0.0], abs=0.02)


def cloud_of(sensor, local_m, settings=None):
    """Return a point cloud in the frame of a sensor."""
    count = len(local_m)
    stamp = ertis.Stamp(sensor=sensor, sync_count=1, timestamp_ns=TIME_NS)
    return ertis.PointCloud(local_m.astype(np.float32), np.ones(count, np.float32), settings or ertis.Settings(), stamp)


def heard_m(sensor, emitter, places, *, mirrored=False):
    """Return where a sensor shows reflectors that echo the call of an emitter, after the mean of both distances."""
    local_m, from_emitter_m = sensor.local_m(places), np.linalg.norm(places - emitter.translation_m, axis=1)
    if mirrored:
        local_m = local_m * [-1, 1, 1]
    distance_m = np.linalg.norm(local_m, axis=1)
    return local_m * ((distance_m + from_emitter_m) / 2 / distance_m)[:, None]


BOWED = ertis.Settings(array=Array(positions_m=((0.0, 0.0, 0.0), (0.02, 0.01, 0.0), (0.0, 0.02, 0.01))))


@pytest.mark.parametrize(
    ("receiver", "settings", "n_foreign"),
    [("left", None, 12), ("front", None, 12), ("left", BOWED, 0)],
    ids=["behind", "nearer to another axis", "behind an array that is not flat"],
)
def test_echoes_of_calls_of_other_sensors_are_left_out(receiver, settings, n_foreign):
    """The right sensor shows reflectors, whose echoes of its call return to another sensor too."""
    given = mountings(["front", "left", "right"])
    sensors = {sensor.name: sensor for sensor in mounted_sensors(given)}
    draws = np.random.default_rng(4)
    # Azimuths in the frame of the right sensor; those to its left are ahead of the front sensor.
    angle_rad = draws.uniform(*np.radians([-50, 50] if receiver == "left" else [38, 44]), 12)
    local_m = np.linspace(1.0, 4.0, 12)[:, None] * np.column_stack([np.cos(angle_rad), np.sin(angle_rad), np.zeros(12)])
    right, other = sensors["right"], sensors[receiver]
    places = local_m @ right.rotation.T + right.translation_m
    own_m = np.linspace(1.1, 3.9, 8)[:, None] * np.array([np.cos(0.3), -np.sin(0.3), 0.0])
    foreign_m = heard_m(other, right, places, mirrored=receiver == "left")
    clouds = {
        "right": cloud_of("right", local_m),
        receiver: cloud_of(receiver, np.concatenate([own_m, foreign_m]), settings),
    }
    echoes = EchoExtractor(mounted_sensors(given))(clouds)
    assert np.sum(echoes.sensor == list(given).index("right")) == 12
    kept_m = echoes.range_m[echoes.sensor == list(given).index(receiver)]
    assert kept_m[:8] == pytest.approx(np.linalg.norm(own_m, axis=1), abs=1e-6)
    assert len(kept_m) == 8 + 12 - n_foreign


@pytest.mark.parametrize(
    ("call", "late_s", "n_kept"),
    [({"delay_s": 2e-3}, 0.0, 12), ({"delay_s": 2e-3}, 2e-3, 0), ({"stop_frequency_hz": 40e3}, 0.0, 12)],
    ids=["as if calls began together", "later call", "different call"],
)
def test_echoes_of_later_calls_are_discarded_at_their_ranges(call, late_s, n_kept):
    """An echo of a call that begins later appears farther away, by half of the way that sound travels meanwhile."""
    given = mountings(["front", "right"])
    sensors = {sensor.name: sensor for sensor in mounted_sensors(given)}
    angle_rad = np.radians(np.linspace(42.0, 44.0, 12))  # Ahead of the front sensor, too.
    local_m = np.linspace(2.5, 4.0, 12)[:, None] * np.column_stack([np.cos(angle_rad), np.sin(angle_rad), np.zeros(12)])
    right, front = sensors["right"], sensors["front"]
    foreign_m = heard_m(front, right, local_m @ right.rotation.T + right.translation_m)
    settings = ertis.Settings()
    late_m = late_s * sound_speed_m_s(settings.air) / 2
    foreign_m *= 1 + late_m / np.linalg.norm(foreign_m, axis=1)[:, None]
    other = settings.replace(call=settings.call.replace(**call))
    echoes = EchoExtractor(mounted_sensors(given))(
        {"right": cloud_of("right", local_m, other), "front": cloud_of("front", foreign_m)}
    )
    assert np.sum(echoes.sensor == list(given).index("front")) == n_kept


def test_ego_velocity_in_a_furnished_room():
    """`ertis bench motion` measures the errors of many rooms."""
    motion = random_motion(3)
    imager = PlatformImager(random_room(3), 3)
    before, after = imager(motion, 0, 0.0), imager(motion.after(0.1), 1, 0.1)
    imager.close()
    found = ertis.ego_velocity(before, after, mountings())
    assert found.velocity_m_s == pytest.approx([motion.forward_m_s, motion.left_m_s], abs=0.03)
    assert found.yaw_rate_rad_s == pytest.approx(motion.yaw_rate_rad_s, abs=math.radians(4))
    assert np.all((found.sd > 0) & (found.sd < 0.05))


def test_odometry_integrates_a_circle():
    odometry = ertis.Odometry(MOUNTINGS)
    sides = [Rotation.from_rotvec([0.0, 0.0, quarter * math.pi / 2]) for quarter in range(4)]
    places = np.concatenate([side.apply(places_m(seed, 30)) for seed, side in enumerate(sides)])
    turn_rad = math.radians(4.0)
    for pulse in range(20):
        yaw_rad = pulse * turn_rad
        x, y = 0.3 * math.sin(yaw_rad), 0.3 * (1 - math.cos(yaw_rad))
        twist = 0.3 * turn_rad / 0.1, 0.0, turn_rad / 0.1
        velocity = odometry.add([seen_from((x, y, yaw_rad), places, pulse, twist)])
        assert (velocity is None) == (pulse == 0)
    pose = odometry.poses[-1]
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((x, y, yaw_rad), abs=0.01)
    assert odometry.length_m == pytest.approx(0.3 * 19 * turn_rad, rel=0.02)
    assert all(each.is_measured for each in odometry.poses)
    path = odometry.trajectory
    assert path.source == "odometry"
    assert path.time_ns.tolist() == [pulse * TIME_NS for pulse in range(20)]
    assert path.position_m[-1] == pytest.approx([pose.x_m, pose.y_m, 0.0])
    assert 2 * np.arctan2(path.rotation_xyzw[:, 2], path.rotation_xyzw[:, 3]) == pytest.approx(
        [each.yaw_rad for each in odometry.poses]
    )
    assert path.covariance[-1][np.ix_([0, 1, 5], [0, 1, 5])] == pytest.approx(pose.covariance)
    assert not path.covariance[:, 2:5].any()


def test_covariance_of_a_path_is_that_of_its_random_errors():
    """The mean of the normalised squared error of 500 paths is its number of dimensions, within five deviations."""
    draws = np.random.default_rng(7)
    steps = draws.uniform([0.1, -0.05, -0.3], [0.2, 0.05, 0.4], (20, 3))
    covariance = np.diag([4e-6, 9e-6, 1e-4]) + 1e-5 * np.outer([1.0, -0.5, 2.0], [1.0, -0.5, 2.0])
    start = PlanarPose(0, 0.0, 0.0, 0.3, np.zeros((3, 3)))

    def end_of(displacements):
        return functools.reduce(lambda pose, step: pose.moved(step, covariance, 0), displacements, start)

    true = end_of(steps)
    squares = []
    for _ in range(500):
        pose = end_of(steps + draws.multivariate_normal(np.zeros(3), covariance, 20))
        error = np.array(pose[1:4]) - np.array(true[1:4])
        error[2] = math.remainder(error[2], 2 * math.pi)
        squares.append(error @ np.linalg.solve(true.covariance, error))
    assert np.mean(squares) == pytest.approx(3.0, abs=5 * math.sqrt(2 * 3 / 500))


def test_velocity_is_assumed_to_continue_for_at_most_a_second():
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in (0, 1, 600):
        velocity = odometry.add([seen_from((0.05 * min(pulse, 1), 0, 0), places_m(), pulse)])
    pose = odometry.poses[-1]
    assert (velocity, pose.is_measured) == (None, False)
    assert pose.x_m == pytest.approx(0.05 + 0.5, abs=0.01)
    assert np.sqrt(pose.covariance[0, 0]) > 0.5 * 59.9


@pytest.mark.parametrize(("n_measured", "first_m_s", "later_m_s"), [(1, 0.5, 0.5), (3, 0.14, 0.28)])
def test_assumed_velocity_becomes_less_certain_with_time(n_measured, first_m_s, later_m_s):
    """Groups are 0.1 s apart. After one group, no velocity has been measured yet.

    The platform keeps the velocity that it really has, so the errors of both steps add up.
    """
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in range(n_measured):
        odometry.add([seen_from((0.05 * pulse, 0, 0), places_m(), pulse, (0.5, 0.0, 0.0))])
    for pulse in range(n_measured, n_measured + 2):
        odometry.add([seen_from((0, 0, 0), np.empty((0, 3)), pulse)])
    assert [pose.is_measured for pose in odometry.poses] == [True] * n_measured + [False] * 2
    variances = [pose.covariance[0, 0] - odometry.poses[-3].covariance[0, 0] for pose in odometry.poses[-2:]]
    assert np.sqrt(variances) == pytest.approx([0.1 * first_m_s, 0.1 * (first_m_s + later_m_s)], rel=0.05)


AHEAD = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("changed", "is_measured"),
    [
        ({"sensor": ((0.0, 0.0, 0.0), AHEAD), "other": ((0.0, 0.3, 0.0), AHEAD)}, True),
        ({"sensor": ((0.1, 0.0, 0.0), AHEAD)}, False),
        ({"other": ((0.0, 0.3, 0.0), AHEAD), "sensor": ((0.0, 0.0, 0.0), AHEAD)}, False),
    ],
    ids=["added", "moved", "reordered"],
)
def test_remounted_odometry_continues_its_path(changed, is_measured):
    odometry = ertis.Odometry(MOUNTINGS, alone=True)
    for pulse in range(2):
        odometry.add([seen_from((0.05 * pulse, 0, 0), places_m(), pulse)])
    odometry.remount(changed)
    odometry.add([seen_from((0.1, 0, 0), places_m(), 2)])
    velocity = odometry.add([seen_from((0.15, 0, 0), places_m(), 3)])
    assert [pose.is_measured for pose in odometry.poses] == [True, True, is_measured, True]
    assert odometry.poses[-1].x_m == pytest.approx(0.15, abs=5e-3)
    assert velocity.velocity_m_s == pytest.approx([0.5, 0.0], abs=0.01)


@pytest.mark.parametrize("late_ns", [-300_000_000, 40_000_000, 300_000_000])
def test_clock_of_a_missing_sensor_does_not_change_the_velocity(late_ns):
    """The first sensor has another clock, and misses the middle pulse."""
    given = dict.fromkeys(("other", "sensor"), ((0.0, 0.0, 0.0), AHEAD))
    odometry, velocities = ertis.Odometry(given, alone=True), []
    for pulse in range(4):
        times_ns = {"sensor": 10**9 + pulse * TIME_NS, "other": 10**9 + pulse * TIME_NS + late_ns}
        names = ["sensor"] if pulse == 2 else ["other", "sensor"]
        pose = (0.05 * pulse, 0, 0)
        group = [seen_from(pose, places_m(), pulse, sensor=name, timestamp_ns=times_ns[name]) for name in names]
        velocities.append(odometry.add(group))
    for velocity in velocities[1:]:
        assert (velocity.time_s, *velocity.velocity_m_s) == pytest.approx((0.1, 0.5, 0.0), abs=0.01)


def test_odometry_without_groups_has_no_trajectory():
    with pytest.raises(DataError, match="there is no pose yet; add the images"):
        ertis.Odometry(MOUNTINGS).trajectory  # noqa: B018  it raises


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ([], [1], "before is empty"),
        ([0], [], "after is empty"),
        ([1], [0], "after is -0.1 s later than before"),
        ([0, 0], [1], "before has two items of sensor 'sensor'"),
        ([0], [20], "after is 2 s later"),
    ],
)
def test_ego_velocity_explains_groups_that_do_not_fit(before, after, message):
    groups = [[seen_from((0, 0, 0), places_m(), pulse) for pulse in pulses] for pulses in (before, after)]
    with pytest.raises((ArgumentError, DataError), match=message):
        ertis.ego_velocity(*groups, MOUNTINGS)


def test_ego_velocity_needs_echoes_and_mountings():
    clouds = [seen_from((0, 0, 0), places_m(count=1), pulse) for pulse in (0, 1)]
    with pytest.raises(DataError, match="too few echoes"):
        ertis.ego_velocity(clouds[:1], clouds[1:], MOUNTINGS)
    with pytest.raises(ArgumentError, match="mountings is empty"):
        ertis.ego_velocity(clouds[:1], clouds[1:], {})
    with pytest.raises(ArgumentError, match="before has a int"):
        ertis.ego_velocity([3], clouds[1:], MOUNTINGS)


def unrelated(seed, pulse, count):
    """Return a point cloud of random echoes, as images of noise have them."""
    draws = np.random.default_rng([seed, pulse])
    range_m, azimuth_rad = draws.uniform(0.4, 4, count), draws.uniform(-0.9, 0.9, count)
    return ertis.PointCloud(
        np.column_stack([range_m * np.cos(azimuth_rad), range_m * np.sin(azimuth_rad), 0 * range_m]).astype(np.float32),
        np.exp(draws.normal(0, 0.5, count)).astype(np.float32),
        ertis.Settings(),
        ertis.Stamp(sync_count=pulse, timestamp_ns=pulse * TIME_NS),
    )


def rigid_motion(before_m, after_m):
    """Return the motion of the platform that most points share: x, y and yaw.

    Every two points before, and every two after with the same distance, propose a motion. The motion with the most
    coinciding points is refined by least squares. Points are complex numbers.
    """
    first, second = (places[:, 0] + 1j * places[:, 1] for places in (before_m, after_m))
    n_best, best = 0, (0j, 1 + 0j)
    for a in range(len(first)):
        for b in range(a + 1, len(first)):
            apart = first[b] - first[a]
            turns = (second[None, :] - second[:, None]) / apart
            for c, d in np.argwhere(np.abs(np.abs(turns) * abs(apart) - abs(apart)) < 1e-3):
                turn = turns[c, d] / abs(turns[c, d])
                moved = turn * (first - first[a]) + second[c]
                n_near = np.count_nonzero(np.abs(moved[:, None] - second).min(axis=1) < 5e-3)
                if n_near > n_best:
                    n_best, best = n_near, (second[c] - turn * first[a], turn)
    shift, turn = best
    moved = turn * first + shift
    nearest = np.abs(moved[:, None] - second).argmin(axis=1)
    is_near = np.abs(moved - second[nearest]) < 5e-3
    one, other = first[is_near], second[nearest[is_near]]
    turn = np.vdot(one - one.mean(), other - other.mean())
    turn /= abs(turn)
    # Points that move by `turn` and `shift` are seen from a platform that moves the other way.
    way = -(other.mean() - turn * one.mean()) / turn
    return np.array([way.real, way.imag, -np.angle(turn)])


@pytest.mark.parametrize("seed", [0, 1, 2, 7, 15])  # A search that accepts fewer differences loses 0, 7 and 15.
def test_displacements_between_points_of_a_coarse_search_are_those_of_a_plain_one(seed):
    """Over 0.5 s, the grid of the search has steps of 12.5 cm and 7.5°; displacements lie midway between its points."""
    draws = np.random.default_rng(seed)
    pose = (draws.integers(-3, 3, 3) + 0.5) * [0.125, 0.125, math.radians(7.5)]
    places = np.column_stack([draws.uniform(1.2, 4, 30), draws.uniform(-2, 2, 30), np.zeros(30)])
    clouds = [seen_from((0, 0, 0), places, 0), seen_from(pose, places, 5)]
    sensors = mounted_sensors(MOUNTINGS)
    groups = [EchoExtractor(sensors)({"sensor": cloud}) for cloud in clouds]
    wanted = rigid_motion(*(group.position_m for group in groups))
    assert wanted == pytest.approx(pose, abs=1e-3)
    fit = fit_flow(*groups, sensors, 0.5, first_twist=np.zeros(3), second_twist=np.zeros(3))
    assert fit.displacement == pytest.approx(wanted, abs=2e-3)


@pytest.mark.parametrize("count", [40, 75])
def test_noise_is_not_a_measured_motion(count):
    """The expected number of false alarms exceeds their rate, so that the limit holds for any number of echoes."""
    sensors = mounted_sensors(MOUNTINGS)
    extract = EchoExtractor(sensors)
    seeds, found = range(60), []
    for seed in seeds:
        groups = [extract({"sensor": unrelated(seed, pulse, count)}) for pulse in (0, 1)]
        fit = fit_flow(*groups, sensors, 0.1)
        if fit is not None:
            found.append(fit)
    assert len(found) > 30
    assert not any(fit.is_significant for fit in found)
    for n_expected in (0.02, 0.1, 0.5):
        n_allowed = scipy.stats.binom.ppf(0.999, len(seeds), n_expected)
        assert sum(fit.n_false_alarms < n_expected for fit in found) <= n_allowed


def test_ego_velocity_refuses_noise():
    with pytest.raises(DataError, match="echoes of before and after match, in 4 places, as many as echoes of noise"):
        ertis.ego_velocity([unrelated(1, 0, 90)], [unrelated(1, 1, 90)], MOUNTINGS)


def test_odometry_does_not_measure_noise():
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in range(2):
        odometry.add([seen_from((0.05 * pulse, 0, 0), places_m(), pulse)])
    for pulse in range(2, 6):
        assert odometry.add([unrelated(2, pulse, 60)]) is None
    assert [pose.is_measured for pose in odometry.poses] == [True, True, *[False] * 4]


def test_ambiguous_motion_is_not_measured():
    """A turn by the spacing of equal posts around the sensor changes almost nothing."""
    angle_rad = np.radians(np.arange(0, 360, 5))
    ring = np.column_stack([2 * np.cos(angle_rad), 2 * np.sin(angle_rad), np.zeros(len(angle_rad))])
    ring = ring[np.abs(np.arctan2(ring[:, 1], ring[:, 0])) < 0.9]
    odometry = ertis.Odometry(MOUNTINGS)
    for pulse in range(2):
        velocity = odometry.add([seen_from((0, 0, 0), ring, pulse)])
    assert velocity is None
    assert not odometry.poses[-1].is_measured
    found = ertis.ego_velocity([seen_from((0, 0, 0), ring, 0)], [seen_from((0, 0, 0), ring, 1)], MOUNTINGS)
    assert found.sd[2] > math.radians(20)


def test_few_reflectors_measure_the_motion_or_do_not_claim_it():
    """Errors of up to 1 m were once accepted as measured."""
    errors_m, n_steps = [], 0
    for seed in range(20):
        places = places_m(seed, 3 + seed % 6)
        odometry = ertis.Odometry(MOUNTINGS)
        for pulse in range(3):
            x = 0.1 * pulse
            clutter = unrelated(seed, pulse, 20).position_m
            cloud = seen_from((x, 0, 0), places, pulse, (1.0, 0.0, 0.0))
            cloud = cloud.replace(
                position_m=np.concatenate([cloud.position_m, clutter]), amplitude=np.ones(len(places) + 20, np.float32)
            )
            velocity = odometry.add([cloud])
            n_steps += pulse > 0
            if velocity is not None:
                errors_m.append(np.hypot(*(velocity.velocity_m_s - [1.0, 0.0])) * velocity.time_s)
    assert 0.3 * n_steps < len(errors_m) < n_steps
    assert max(errors_m) < 0.02
