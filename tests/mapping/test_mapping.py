"""Occupancy maps: evidence of echoes and of free space, decay, growth, files, and arguments that are refused."""

import dataclasses
import functools
import itertools
import math
from pathlib import Path

import h5py
import numpy as np
import pytest
from ertis_bench.platform_trials import mapping
from ertis_bench.platform_trials.furnished_rooms import Motion, PlatformImager, mountings
from plyfile import PlyData
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba import figures
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.fusion.rig import mounted_sensors
from ertis_numba.mapping import sensor_model
from ertis_numba.mapping.cell_grid import CellGrid
from ertis_numba.mapping.coverage import Coverage, directions_around
from ertis_numba.mapping.echoes import UsualAmplitude, View, echoes_of
from ertis_numba.mapping.sensor_model import add_evidence
from ertis_numba.simulation import Box, Point

UNTURNED = (0.0, 0.0, 0.0, 1.0)
AHEAD = {"sensor": ((0.0, 0.0, 0.0), UNTURNED)}
POSTS_M = ((1.5, 0.2), (-0.3, 1.4), (-1.6, -0.5), (0.4, -1.7))
HEIGHT_M = 0.4
REFLECTORS = Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5"
START_NS = 1_700_000_000_000_000_000


def turned(yaw_deg):
    half_rad = math.radians(yaw_deg) / 2
    return (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))


@functools.cache
def views():
    """Images of four posts from three poses of a platform with four sensors, and the poses."""
    posts = tuple(Point(position_m=(*place, HEIGHT_M), strength_db=-6.0) for place in POSTS_M)
    imager = PlatformImager((posts, ()), 4, max_range_m=2.5)
    found = []
    for number, (x_m, y_m, yaw_deg) in enumerate([(0.0, 0.0, 0.0), (0.2, -0.1, 50.0), (-0.1, 0.2, 190.0)]):
        motion = Motion(x_m, y_m, math.radians(yaw_deg), 0.0, 0.0, 0.0)
        found.append((imager(motion, number, number / 10), ((x_m, y_m, 0.0), turned(yaw_deg))))
    imager.close()
    return found


@functools.cache
def room_map():
    mapper = ertis.Mapper(mountings())
    for images, pose in views():
        mapper.add(images, pose)
    return mapper.map


def test_map_shows_reflectors_and_free_space_at_their_place():
    found = room_map()
    assert found.n_groups == 3
    for place in POSTS_M:
        assert np.hypot(*(found.occupied_m - place).T).min() < 0.05
    # Every occupied cell is near a post.
    away_m = np.hypot(*(found.occupied_m[:, None] - np.array(POSTS_M)).transpose(2, 0, 1)).min(axis=1)
    assert away_m.max() < 0.08
    for azimuth_deg in range(0, 360, 15):
        near = 0.75 * np.array([math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))])
        assert found.log_odds_at(near) < 0


def test_cells_behind_a_reflector_stay_unknown():
    found = room_map()
    for place in np.array(POSTS_M):
        behind = place * (1 + 0.3 / np.linalg.norm(place))
        assert abs(found.log_odds_at(behind)) < 0.3


def test_silence_shows_no_free_space_far_away():
    """Oblique walls return no echo, so cells without echoes beyond 1 m stay unknown."""
    found = room_map()
    assert found.log_odds_at((-1.3, 1.5)) == 0
    assert found.log_odds_at((1.5, 1.5)) == 0


def test_trajectory_is_interpolated_at_the_time_of_the_images():
    images, (translation_m, rotation) = views()[1]
    time_ns = images[0].stamp.timestamp_ns
    offset_m = np.array([0.3, 0.0, 0.0])
    path = ertis.Trajectory(  # at 3 mm/s
        [time_ns - 10**11, time_ns + 10**11], [translation_m - offset_m, translation_m + offset_m], [rotation, rotation]
    )
    by_pose, by_path = ertis.Mapper(mountings()), ertis.Mapper(mountings())
    by_pose.add(images, (translation_m, rotation))
    by_path.add(images, path)
    np.testing.assert_allclose(by_path.map.log_odds, by_pose.map.log_odds, atol=0.02)
    assert by_path.map.origin_m == by_pose.map.origin_m
    with pytest.raises(ArgumentError, match="outside the trajectory"):
        by_path.add(images, path.replace(time_ns=path.time_ns + 10**12))


def middle_m(found):
    """Mean place of the evidence for occupied space."""
    rows, columns = np.nonzero(found.log_odds > 0)
    places_m = np.array(found.origin_m) + (np.stack([columns, rows], axis=1) + 0.5) * found.cell_m
    return np.average(places_m, axis=0, weights=found.log_odds[rows, columns])


def test_velocity_of_a_trajectory_compensates_the_motion_during_a_measurement():
    post_m = np.array([2.2, 0.0])
    posts = (Point(position_m=(*post_m.tolist(), HEIGHT_M), strength_db=-6.0),)
    imager = PlatformImager((posts, ()), 4, names=["front"], max_range_m=2.5)
    images = imager(Motion(0.0, 0.0, 0.0, 1.4, 0.0, math.radians(60.0)), 0, 0.0)
    imager.close()
    time_ns = images[0].stamp.timestamp_ns
    path = ertis.Trajectory(
        [time_ns - 10**8, time_ns, time_ns + 10**8],
        [(-0.14, 0.0, 0.0), (0.0, 0.0, 0.0), (0.14, 0.0, 0.0)],
        [turned(-6.0), UNTURNED, turned(6.0)],
    )
    still, moving = (ertis.Mapper(mountings(["front"]), cell_m=0.01) for _ in range(2))
    still.add(images, ((0.0, 0.0, 0.0), UNTURNED))
    moving.add(images, path)
    before_m, after_m = (np.linalg.norm(middle_m(each.map) - post_m) for each in (still, moving))
    assert before_m > 0.025
    assert after_m < 0.01


def test_map_is_the_same_for_a_world_frame_moved_by_whole_cells():
    moved = ertis.Mapper(mountings())
    for images, ((x_m, y_m, z_m), rotation) in views():
        moved.add(images, ((x_m + 400.0, y_m - 100.0, z_m), rotation))
    # Rounding moves single cells over the edge of a direction.
    np.testing.assert_allclose(moved.map.log_odds, room_map().log_odds, atol=0.02)
    np.testing.assert_allclose(np.subtract(moved.map.origin_m, room_map().origin_m), [400.0, -100.0], atol=1e-9)


def test_evidence_decays_with_the_half_life():
    images, pose = views()[0]
    mapper = ertis.Mapper(mountings(), half_life_s=1.0)
    mapper.add(images, pose)
    before = mapper.map
    far = ((50.0, 0.0, 0.0), UNTURNED)
    mapper.add(delayed(images, 2.0), far)
    place = POSTS_M[0]
    assert mapper.map.log_odds_at(place) == pytest.approx(float(before.log_odds_at(place)) / 4, rel=1e-5)
    with pytest.raises(DataError, match="2 s before those added last; add groups in the order of their times"):
        mapper.add(images, pose)


@functools.cache
def space():
    """Images with elevations of a post above and of one below the sensors, and the mountings of these."""
    posts = tuple(Point(position_m=place, strength_db=-6.0) for place in POSTS_IN_SPACE_M)
    imager = PlatformImager((posts, ()), 4, names=["front", "left"], max_range_m=2.0, directions="3d:1000")
    images = [imager(Motion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), number, number / 10) for number in range(2)]
    imager.close()
    return images, mountings(["front", "left"])


POSTS_IN_SPACE_M = ((1.225, 0.125, 1.025), (0.125, 1.225, -0.125))  # middles of cells


def test_map_of_space_shows_the_heights_of_reflectors_and_the_pose_of_the_platform():
    images, mounted = space()
    mapper = ertis.Mapper(mounted, dimensions=3)
    # The platform has turned by 90° and is rolled by 180°, and so are the reflectors around it.
    place_m, turn = np.array([3.0, -2.0, 1.0]), Rotation.from_euler("zx", [90.0, 180.0], degrees=True)
    with pytest.warns(ertis.PoseWarning, match="its −z axis points up"):
        mapper.add(images[0], (place_m, turn.as_quat()))
    for group in images[1:]:
        mapper.add(group, (place_m, turn.as_quat()))
    found = mapper.map
    assert found.n_dimensions == 3
    wanted_m = turn.apply(POSTS_IN_SPACE_M) + place_m
    away_m = np.linalg.norm(found.occupied_m[:, None] - wanted_m, axis=2)
    assert away_m.min(axis=0).max() < 0.05
    assert away_m.min(axis=1).max() < 0.1
    assert (found.log_odds_at(place_m + 0.5 * (wanted_m - place_m)) < 0).all()
    assert found.log_odds_at(place_m + 1.4 * (wanted_m - place_m)).tolist() == [0.0, 0.0]


def test_map_of_space_has_cells_within_the_limits_of_height_only():
    images, mounted = space()
    mapper = ertis.Mapper(mounted, dimensions=3, height_m=(0.5, 2.0))
    for group in images:
        mapper.add(group, ((0.0, 0.0, 0.0), UNTURNED))
    assert mapper.map.limits_m[2][0] >= 0.5 - 1e-9
    assert np.linalg.norm(mapper.map.occupied_m - POSTS_IN_SPACE_M[0], axis=1).max() < 0.1
    assert not ertis.Mapper(mounted, dimensions=3, height_m=(5.0, 6.0)).map.is_occupied.any()


def test_map_of_space_refuses_planar_images():
    images, pose = views()[0]
    with pytest.raises(ArgumentError, match="planar image, but a map of three dimensions needs directions over elev"):
        ertis.Mapper(mountings(), dimensions=3).add(images, pose)


def with_covariance(pose, images, covariance):
    """Poses at rest around the time of images."""
    time_ns = images[0].stamp.timestamp_ns + np.array([-(10**8), 0, 10**8])
    return ertis.Trajectory(
        time_ns, [pose[0]] * 3, [pose[1]] * 3, None if covariance is None else np.array([covariance] * 3)
    )


def covariance_of(position_sd_m, yaw_sd_rad):
    return np.diag([position_sd_m, position_sd_m, position_sd_m, 0.0, 0.0, yaw_sd_rad]) ** 2


@pytest.mark.parametrize("dimensions", [2, 3])
def test_errors_of_poses_turn_places_about_the_origin_of_the_platform(dimensions):
    """Draws of poses move places by their covariance, also if the sensors are high above the origin."""
    random = np.random.default_rng(9)
    mixing = np.diag([0.01, 0.02, 0.03, 0.02, 0.03, 0.01]) @ random.standard_normal((6, 6))
    covariance, origin_m = mixing @ mixing.T, np.array([1.0, -2.0, 0.4])
    turn = Rotation.from_euler("ZYX", [40, 0, 0] if dimensions == 2 else [40, 12, -8], degrees=True)
    places_m = turn.apply([[1.5, 0.3, 0.8], [-0.4, 2.0, 0.8]])
    draws = random.multivariate_normal(np.zeros(6), covariance, 100_000)
    mapper = ertis.Mapper({"high": ((0.1, 0.0, 0.8), UNTURNED)}, dimensions=dimensions)
    view = mapper._view(  # noqa: SLF001  no public name has the covariance
        origin_m, turn.as_matrix(), covariance
    )
    found = view.covariance_at_m2(origin_m + places_m - view.place_m)
    for place_m, each in zip(places_m, found, strict=True):
        true = np.cov((draws[:, :3] + np.cross(draws[:, 3:], place_m)).T)[:dimensions, :dimensions]
        assert each[:dimensions, :dimensions] == pytest.approx(true, abs=0.02 * true.max())


@pytest.mark.parametrize("dimensions", [2, 3])
def test_exact_poses_have_no_influence_on_maps(dimensions):
    images, mounted = (views()[1][0], mountings()) if dimensions == 2 else (space()[0][0], space()[1])
    pose = (0.2, -0.1, 0.0), turned(50.0)
    found = []
    for covariance in (None, np.zeros((6, 6))):
        mapper = ertis.Mapper(mounted, dimensions=dimensions)
        mapper.add(images, with_covariance(pose, images, covariance))
        found.append(mapper.map.log_odds)
    assert np.array_equal(*found)


def test_uncertain_poses_make_maps_less_certain():
    """The more uncertain a pose is, the less sure are free cells, and the surest occupied ones."""
    found = []
    for position_sd_m, yaw_sd_rad in ((0.0, 0.0), (0.02, 0.0), (0.02, 0.05), (0.1, 0.05), (0.5, 0.5)):
        mapper = ertis.Mapper(mountings())
        for images, pose in views():
            mapper.add(images, with_covariance(pose, images, covariance_of(position_sd_m, yaw_sd_rad)))
        grid = mapper.map.log_odds_at(np.stack(np.meshgrid(*[np.arange(-2.5, 2.5, 0.05) + 0.025] * 2), axis=-1))
        found.append((grid, mapper.map.is_occupied.sum()))
    for (sharp, _), (soft, _) in itertools.pairwise(found):
        assert (soft >= np.minimum(sharp, 0.0) - 1e-6).all()
        assert soft.max() < sharp.max()
    assert found[0][1] > 0
    assert found[-1][1] == 0
    assert found[-1][0].min() >= 0


@pytest.mark.parametrize("n_dimensions", [2, 3])
@pytest.mark.parametrize("strength", [1.0, 0.6])
def test_uncertain_pose_spreads_the_evidence_of_an_echo(monkeypatch, n_dimensions, strength):
    """Its sum remains, and its spread is that of position, and of heading times range."""
    monkeypatch.setattr(sensor_model, "_FREE", 0.0)
    monkeypatch.setattr(sensor_model, "_REACH_SD", 5.0)
    echoes = echoes_of(np.array([[0.0, 1.0, 0.0]]), np.array([[0.05, 0.05]]), np.full(1, strength))
    found = []
    for covariance in (np.zeros((6, 6)), covariance_of(0.06, 0.1)):
        window = CellGrid(0.02, n_dimensions).window(np.zeros(3), 1.8)
        add_evidence(window, ORIGIN._replace(covariance=covariance), echoes, everywhere(n_dimensions), near_m=0.0)
        evidence = window.log_odds.astype(np.float64)
        sd_m = [
            math.sqrt((evidence * (offset_m - middle_m) ** 2).sum() / evidence.sum())
            for offset_m, middle_m in zip(axes_m(window)[:n_dimensions], (0.0, 1.0, 0.0)[:n_dimensions], strict=True)
        ]
        found.append((evidence.sum(), evidence.max(), np.array(sd_m)))
    (sharp, highest, sharp_m), (soft, lower, soft_m) = found
    assert soft == pytest.approx(sharp, rel=0.01)
    own_m = np.full(3, math.hypot(0.05, 0.01, 0.02 / math.sqrt(12)))
    more_m = np.sqrt(own_m**2 + np.array([math.hypot(0.06, 0.1), 0.06, 0.06]) ** 2)
    assert lower / highest == pytest.approx((own_m / more_m)[:n_dimensions].prod(), rel=0.02)
    assert soft_m / sharp_m == pytest.approx((more_m / own_m)[:n_dimensions], rel=0.02)


def delayed(images, time_s):
    return [
        image.replace(
            stamp=dataclasses.replace(image.stamp, timestamp_ns=image.stamp.timestamp_ns + round(time_s * 1e9))
        )
        for image in images
    ]


def test_height_limits_leave_out_floor_and_ceiling():
    images, pose = views()[0]
    mapper = ertis.Mapper(mountings(), height_m=(1.0, 2.0))
    mapper.add(images, pose)
    assert not mapper.map.is_occupied.any()


def test_passive_measurements_are_refused():
    images, pose = views()[0]
    passive = [image.replace(stamp=dataclasses.replace(image.stamp, behaviour="passive")) for image in images]
    with pytest.raises(DataError, match="no sensor emitted"):
        ertis.Mapper(mountings()).add(passive, pose)


ORIGIN = View(np.zeros(3), np.eye(3), np.zeros((6, 6)))


def everywhere(n_dimensions=2, reach_m=3.0, step_m=0.05):
    """Coverage of sensors that hear everything."""
    grid = directions_around(n_dimensions, reach_m, step_m)
    return Coverage(grid, *np.ones((2, grid.n_directions, grid.n_ranges)))


def limit_nothing(monkeypatch, **trust):
    """Let an echo add all of its evidence."""
    free = {
        number: each._replace(**{"clear": 30.0, "cell": 1e6, "missed": 0.0, **trust})
        for number, each in sensor_model.TRUST.items()
    }
    monkeypatch.setattr(sensor_model, "TRUST", free)


def axes_m(window):
    """Centres of the cells along x, y and z, which broadcast against the log-odds."""
    z_m, y_m, x_m = (
        (np.arange(size) + first + 0.5) * window.cell_m
        for size, first in zip(window.log_odds.shape, window.first[::-1], strict=True)
    )
    return x_m[None, None, :], y_m[None, :, None], z_m[:, None, None]


@pytest.mark.parametrize("n_dimensions", [2, 3])
def test_evidence_of_a_point_is_that_of_its_ellipse(monkeypatch, n_dimensions):
    """The sum over all cells is that of one echo, and its spread that of the point's uncertainty."""
    monkeypatch.setattr(sensor_model, "_FREE", 0.0)
    limit_nothing(monkeypatch)
    monkeypatch.setattr(sensor_model, "MAX_LOG_ODDS", math.inf)
    echoes = echoes_of(np.array([[1.0, 0.0, 0.0]]), np.array([[0.05, 0.1]]), np.ones(1))
    window = CellGrid(0.02, n_dimensions).window(np.zeros(3), 1.5)
    add_evidence(window, ORIGIN, echoes, everywhere(n_dimensions), near_m=0.0)
    total = float(window.log_odds.sum())
    assert total == pytest.approx(sensor_model.TRUST[n_dimensions].total, rel=0.02)
    spread = [
        math.sqrt(float((window.log_odds * (offset_m - middle_m) ** 2).sum()) / total)
        for offset_m, middle_m in zip(axes_m(window)[:n_dimensions], (1.0, 0.0, 0.0)[:n_dimensions], strict=True)
    ]
    along_m, across_m = echoes.sd_m[0].tolist()
    assert spread == pytest.approx([along_m, across_m, across_m][:n_dimensions], rel=0.05)


@pytest.mark.parametrize(
    ("n_dimensions", "strength", "weight", "n_pulses"),
    [(2, 0.99, 1.0, 1), (2, 0.9, 1.0, 2), (3, 0.9, 1.0, 1), (3, 0.9, 0.2, 3)],
)
def test_doubtful_echoes_must_repeat_until_a_cell_is_occupied(n_dimensions, strength, weight, n_pulses):
    """Doubtful echoes are weak in a plane, and beside the sensors in space."""
    grid, coverage = CellGrid(0.05, n_dimensions), everywhere(n_dimensions)
    coverage = coverage._replace(weight=weight * coverage.weight)
    echoes = echoes_of(np.array([[2.0, 0.0, 0.0]]), np.zeros((1, 2)), np.full(1, strength), n_dimensions)
    found = []
    for number in range(n_pulses):
        grid.view_from(np.array([0.1 * number, 0.0, 0.0]), np.eye(3), 0.0)
        window = grid.window(np.zeros(3), 3.0)
        add_evidence(window, ORIGIN, echoes, coverage, near_m=0.0)
        found.append(ertis.OccupancyMap(window.log_odds, (0.0, 0.0, 0.0), 0.05).is_occupied.any())
    assert found == [False] * (n_pulses - 1) + [True]


@pytest.mark.parametrize("n_dimensions", [2, 3])
def test_cells_lose_evidence_in_pulses_without_their_echo(n_dimensions):
    """They become unknown again, and not free. Hidden cells and those at unknown poses keep their evidence."""
    no_echo, far_m, hidden_m = echoes_of(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0)), 2.0, 2.5
    window = CellGrid(0.05, n_dimensions).window(np.zeros(3), 3.0)
    x_m, y_m, z_m = axes_m(window)
    is_near = np.hypot(y_m, z_m) < 0.2
    for place_m, log_odds in ((far_m, 1.0), (far_m + 0.1, 4.0), (hidden_m, 1.0)):
        window.log_odds[is_near & (np.abs(x_m - place_m) < 0.05)] = log_odds
    window.before[:] = window.log_odds

    def after(n_pulses, view):
        for _ in range(n_pulses):
            add_evidence(window, view, no_echo, everywhere(n_dimensions), near_m=0.0)
        return [float(window.log_odds[is_near & (np.abs(x_m - place_m) < 0.05)].max()) for place_m in (far_m, hidden_m)]

    lost = sensor_model.TRUST[n_dimensions].missed
    assert after(1, ORIGIN._replace(covariance=covariance_of(100.0, 0.0))) == pytest.approx([1.0, 1.0], abs=1e-6)
    assert after(2, ORIGIN) == pytest.approx([1.0 - 2 * lost, 1.0], abs=1e-6)
    assert after(math.ceil(1.0 / lost), ORIGIN) == [0.0, 1.0]


@pytest.mark.parametrize("n_dimensions", [2, 3])
@pytest.mark.parametrize(("moved_m", "turned_deg"), [(0.0, 0.0), (0.009, 1.0), (0.0, 360.0)])
def test_echoes_from_one_viewpoint_are_one_observation(n_dimensions, moved_m, turned_deg):
    """A ghost repeats at the same place while the platform stands still, or moves by less than 10 cm in all."""
    echoes = echoes_of(np.array([[2.0, 0.0, 0.0]]), np.zeros((1, 2)), np.full(1, 0.85), n_dimensions)
    grid, highest = CellGrid(0.05, n_dimensions), []
    for number in range(9):
        turn = Rotation.from_euler("z", number * turned_deg, degrees=True).as_matrix()
        grid.view_from(np.array([moved_m * number, 0.0, 0.0]), turn, 0.2)
        window = grid.window(np.zeros(3), 3.0)
        add_evidence(window, ORIGIN, echoes, everywhere(n_dimensions), near_m=0.0)
        highest.append(float(window.log_odds.max()))
    most = highest[0] * sensor_model.TRUST[n_dimensions].repeats
    assert highest[1:] == pytest.approx([most] * 8)
    assert highest[0] > 0


@pytest.mark.parametrize(("moved_m", "turned_deg"), [(0.1, 0.0), (0.0, 60.0), (0.05, 30.0)])
def test_echoes_from_several_viewpoints_add_up(moved_m, turned_deg):
    echoes = echoes_of(np.array([[2.0, 0.0, 0.0]]), np.zeros((1, 2)), np.full(1, 0.85))
    grid, highest = CellGrid(0.05), []
    for number in range(3):
        turn = Rotation.from_euler("z", number * turned_deg, degrees=True).as_matrix()
        grid.view_from(np.array([moved_m * number, 0.0, 0.0]), turn, 0.2)
        window = grid.window(np.zeros(3), 3.0)
        add_evidence(window, ORIGIN, echoes, everywhere(), near_m=0.0)
        highest.append(float(window.log_odds.max()))
    assert highest == pytest.approx([highest[0], 2 * highest[0], 3 * highest[0]])


@pytest.mark.parametrize("moves", [False, True])
def test_objects_that_arrive_occupy_free_cells(moves):
    """Also in front of a platform at rest, which has seen these cells free."""
    wall, post = (echoes_of(np.array([[away_m, 0.0, 0.0]]), np.zeros((1, 2)), np.ones(1)) for away_m in (2.5, 1.5))
    grid = CellGrid(0.05)
    for number, echoes in enumerate([wall] * 9 + [post] * 6):
        grid.view_from(np.array([0.2 * number * moves, 0.0, 0.0]), np.eye(3), 0.2)
        window = grid.window(np.zeros(3), 3.0)
        add_evidence(window, ORIGIN, echoes, everywhere(), near_m=0.0)
        if number == 8:
            assert window.log_odds[0, 60, 90] < -2.0
    assert window.log_odds[0, 59:61, 89:91].max() > 1.0


@pytest.mark.parametrize("n_dimensions", [2, 3])
def test_unconfirmed_points_occupy_no_cell_alone(n_dimensions):
    """Points that appear again from other viewpoints occupy cells."""
    place_m = np.array([[2.0, 0.0, 0.0]])
    echoes = echoes_of(place_m, np.zeros((1, 2)), np.ones(1), n_dimensions, np.zeros(1, np.bool_))
    grid, found = CellGrid(0.05, n_dimensions), []
    for number in range(4):
        grid.view_from(np.array([0.1 * number, 0.0, 0.0]), np.eye(3), 0.2)
        window = grid.window(np.zeros(3), 3.0)
        add_evidence(window, ORIGIN, echoes, everywhere(n_dimensions), near_m=0.0)
        found.append(bool(ertis.OccupancyMap(window.log_odds, (0.0, 0.0, 0.0), 0.05).is_occupied.any()))
    assert not found[0]
    assert found[-1]


def share_behind(monkeypatch, obstacle_m, known, n_dimensions=2, **trust):
    """Evidence for an echo at 2 m, in a map and with an echo of an obstacle, relative to that without them."""
    monkeypatch.setattr(sensor_model, "_FREE", 0.0)
    limit_nothing(monkeypatch, **trust)
    monkeypatch.setattr(sensor_model, "MAX_LOG_ODDS", math.inf)
    found = []
    for places_m in ([obstacle_m, (2.0, 0.0)], [(2.0, 0.0)]):
        window = CellGrid(0.05, n_dimensions).window(np.zeros(3), 3.0)
        x_m, y_m, z_m = axes_m(window)
        window.log_odds[:] = known(x_m, y_m + 0 * z_m) if len(places_m) == 2 else 0.0
        before = window.log_odds.copy()
        window.before[:] = before
        offset_m = np.column_stack([places_m, np.zeros(len(places_m))])
        echoes = echoes_of(offset_m, np.full((len(places_m), 2), 0.01), np.ones(len(places_m)))
        add_evidence(window, ORIGIN, echoes, everywhere(n_dimensions), near_m=0.0)
        is_near = (np.abs(x_m - 2.0) < 0.3) & (np.abs(y_m) < 0.3)
        found.append(float(((window.log_odds - before) * is_near).sum()))
    return found[0] / found[1]


@pytest.mark.parametrize("n_dimensions", [2, 3])
def test_clear_echo_in_unknown_space_hides_echoes_behind_it(monkeypatch, n_dimensions):
    """It may be part of a wall that fills the beam."""
    assert share_behind(monkeypatch, (1.0, 0.0), lambda x_m, y_m: 0 * x_m + 0 * y_m, n_dimensions) == 0


def test_post_in_free_space_hides_the_directions_that_it_covers(monkeypatch):
    """Of the directions around 0°, from -4.5° to 5.5°, a post from 3° to 9° covers 3 of 11."""

    def known(x_m, y_m):
        return np.where((np.abs(x_m - 1.0) < 0.05) & (np.abs(y_m - 0.1) < 0.05), 4.0, -2.0)

    # With so much evidence, all cells of an echo have the largest one, which is proportional to the log-odds.
    share = share_behind(monkeypatch, (1.0, 0.1), known, clear=10.0, strength=0.0, hidden=4.0, cell=1.0, total=1e9)
    assert share == pytest.approx(1 - 0.4 * (1 - (8 / 11) ** 2))


def test_mapped_wall_hides_echoes_behind_it_but_not_its_own(monkeypatch):
    def share(wall_m):
        return share_behind(
            monkeypatch, (0.5, 2.0), lambda x_m, _: np.where(np.abs(x_m - wall_m) < 0.05, 4.0, -2.0 * (x_m < wall_m))
        )

    assert share(1.8) == 0
    assert share(2.0) == pytest.approx(1.0)


def test_strength_of_points_grows_with_their_amplitude_relative_to_the_usual_one():
    strength = UsualAmplitude().strength(np.array([0.0, 0.08, 1.0, 1.0, 1.0], np.float32))
    assert strength[:2] == pytest.approx([0.0, 0.5], abs=1e-6)
    assert strength[2] > 0.95


def test_coverage_is_that_of_the_emitters_beam_and_of_the_ranges():
    coverage = Coverage.of(mounted_sensors(AHEAD), [(0.4, 4.0)], ertis.Settings(), [0.012], 0.05, heard_m=[9.0])
    ahead, beside, behind = (coverage.weight[180 + azimuth_deg] for azimuth_deg in (0, 80, -180))
    assert ahead[4] == 0  # at 0.2 m, before the first range
    assert ahead[12] > 0.8 > ahead[40] > ahead[70] > 0
    assert beside.max() < 0.3
    assert behind.max() == 0


@pytest.mark.parametrize("n_dimensions", [2, 3])
def test_grid_keeps_values_as_it_grows_in_all_directions(n_dimensions):
    grid = CellGrid(0.1, n_dimensions)
    grid.window(np.full(3, 0.05), 0.04).log_odds[:] = 3.0
    for centre_m in ((10.0, 0.0, 0.0), (-10.0, 5.0, 0.0), (0.0, 10.0, 4.0), (0.0, -10.0, -4.0)):
        grid.window(np.array(centre_m), 1.0)
    log_odds, origin_m = grid.used()
    assert log_odds.shape == (1,) * n_dimensions
    assert log_odds.item() == 3.0
    assert origin_m == pytest.approx((0.0,) * n_dimensions)
    with pytest.raises(ArgumentError, match=r"use larger cells \(cell_m\), or poses closer"):
        grid.window(np.array([1e5, 0.0, 0.0]), 1.0)


def test_map_without_evidence_has_one_unknown_cell():
    assert ertis.Mapper(AHEAD).map.log_odds.tolist() == [[0.0]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cell_m": 0.0}, "cell_m is 0; use a number from 0.005 to 1"),
        ({"dimensions": 4}, "dimensions is 4; use a whole number from 2 to 3"),
        ({"half_life_s": 0.0}, "half_life_s is 0; use a number above 0"),
        ({"height_m": (2.0, 1.0)}, "height_m runs from 2 to 1"),
        ({"emitter_diameter_m": 1.0}, "emitter_diameter_m is 1"),
    ],
)
def test_mapper_refuses_invalid_options(options, message):
    with pytest.raises(ArgumentError, match=message):
        ertis.Mapper(AHEAD, **options)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (3.0, "pose is 3.0; pass a position and a unit quaternion, or a Trajectory"),
        (((0.0, 0.0), UNTURNED), "translation_m of sensor platform"),
        (((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0)), "platform"),
    ],
)
def test_mapper_refuses_invalid_poses(pose, message):
    with pytest.raises(ArgumentError, match=message):
        ertis.Mapper(mountings()).add(views()[0][0], pose)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"log_odds": np.zeros(3)}, r"log_odds has shape \(3,\)"),
        ({"log_odds": np.zeros((0, 3))}, r"log_odds has shape \(0, 3\)"),
        ({"log_odds": np.array([[np.nan]])}, "log_odds holds nan"),
        ({"log_odds": np.zeros((1, 1, 1))}, "origin_m has shape"),
        ({"origin_m": (0.0,)}, "origin_m has shape"),
        ({"origin_m": (0.0, math.inf)}, "origin_m is inf"),
        ({"cell_m": 0.0}, "cell_m is 0"),
        ({"n_groups": -1}, "n_groups is -1"),
        ({"size": 3}, "an occupancy map has no field 'size'"),
    ],
)
def test_occupancy_map_refuses_invalid_fields(changes, message):
    with pytest.raises(ArgumentError, match=message):
        small().replace(**changes)


def small():
    log_odds = np.array([[-3.0, 0.0, 0.5], [2.0, -1.0, 4.0]])
    return ertis.OccupancyMap(log_odds, (-1.0, 2.0), 0.5, n_groups=7, time_ns=START_NS)


def test_occupancy_map_places_its_cells_in_the_world():
    found = small()
    assert found.occupied_m.tolist() == [[-0.75, 2.75], [0.25, 2.75]]
    assert found.is_free.tolist() == [[True, False, False], [False, False, False]]
    assert found.limits_m == ((-1.0, 0.5), (2.0, 3.0))
    assert found.log_odds_at([[-0.9, 2.1], [0.4, 2.9], [0.6, 2.9], [-1.1, 2.1]]).tolist() == [-3.0, 4.0, 0.0, 0.0]
    with pytest.raises(ArgumentError, match="use x and y along the last axis"):
        found.log_odds_at([1.0, 2.0, 3.0])


def test_map_file_round_trip(tmp_path):
    assert ertis.write_map(tmp_path / "m.h5", small()) == (tmp_path / "m.h5",)
    read = ertis.read_map(tmp_path / "m.h5")
    assert np.array_equal(read.log_odds, small().log_odds)
    assert (read.origin_m, read.cell_m, read.n_groups, read.time_ns) == ((-1.0, 2.0), 0.5, 7, START_NS)
    with pytest.raises(ArgumentError, match="exists"):
        ertis.write_map(tmp_path / "m.h5", small())
    ertis.write_map(tmp_path / "m.h5", small(), overwrite=True)


def test_map_file_is_a_netcdf_file_with_axes(tmp_path):
    xarray = pytest.importorskip("xarray")
    ertis.write_map(tmp_path / "m.h5", small())
    with xarray.open_dataset(tmp_path / "m.h5", engine="h5netcdf") as found:
        assert found["log_odds"].dims == ("y", "x")
        assert found["x"].values.tolist() == [-0.75, -0.25, 0.25]
        assert float(found["log_odds"].sel(x=0.25, y=2.75)) == 4.0


def voxels():
    log_odds = np.zeros((2, 3, 4))
    log_odds[1, 2, 3], log_odds[0, 1, 0] = 3.0, -2.0
    return ertis.OccupancyMap(log_odds, (-1.0, 2.0, 0.5), 0.1, n_groups=7, time_ns=START_NS)


def test_map_of_space_places_its_cells_in_the_world():
    assert voxels().limits_m == pytest.approx(np.array([(-1.0, -0.6), (2.0, 2.3), (0.5, 0.7)]))
    assert voxels().occupied_m == pytest.approx(np.array([[-0.65, 2.25, 0.65]]))
    assert voxels().log_odds_at([[-0.65, 2.25, 0.65], [-0.95, 2.15, 0.55], [-0.65, 2.25, 0.75]]).tolist() == [3, -2, 0]
    with pytest.raises(ArgumentError, match="use x, y and z along the last axis"):
        voxels().log_odds_at([1.0, 2.0])


def test_map_of_space_is_written_as_hdf5_and_ply(tmp_path):
    ertis.write_map(tmp_path / "m.h5", voxels())
    read = ertis.read_map(tmp_path / "m.h5")
    assert np.array_equal(read.log_odds, voxels().log_odds)
    assert (read.origin_m, read.n_groups, read.time_ns) == ((-1.0, 2.0, 0.5), 7, START_NS)
    ertis.write_map(tmp_path / "m.ply", voxels())
    vertices = PlyData.read(str(tmp_path / "m.ply"))["vertex"]
    assert [vertices[name][0] for name in "xyz"] == pytest.approx([-0.65, 2.25, 0.65])
    for suffix in ("pgm", "mcap"):
        with pytest.raises(
            ArgumentError, match=r"but the map has three dimensions; choose a name that ends in .h5 or .ply"
        ):
            ertis.write_map(tmp_path / f"m.{suffix}", voxels())


def test_file_of_a_map_of_space_has_axes(tmp_path):
    xarray = pytest.importorskip("xarray")
    ertis.write_map(tmp_path / "m.h5", voxels())
    with xarray.open_dataset(tmp_path / "m.h5", engine="h5netcdf") as found:
        assert found["log_odds"].dims == ("z", "y", "x")
        assert float(found["log_odds"].sel(x=-0.65, y=2.25, z=0.65, method="nearest")) == 3.0


def test_figure_of_a_map_of_space_shows_it_from_above_and_from_the_side():
    above, beside = figures.occupancy(voxels()).axes
    assert (above.get_ylabel(), beside.get_ylabel()) == ("y (m)", "z (m)")
    for axes, place in ((above, (2, 3)), (beside, (1, 3))):
        shown = axes.images[0].get_array()
        assert np.argwhere(shown > 0.5).tolist() == [list(place)]
        assert (shown < 0.5).sum() == 1


def test_figure_of_a_map_shows_path_heading_and_sensors():
    turned = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))  # looks along y
    trajectory = ertis.Trajectory(
        time_ns=np.array([0, 10**9]),
        position_m=np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.2]]),
        rotation_xyzw=np.array([(0.0, 0.0, 0.0, 1.0), turned]),
    )
    found = ertis.OccupancyMap(np.zeros((20, 20)), (-1.0, -1.0), 0.1)
    figure = figures.occupancy(
        found, trajectory=trajectory, mountings={"front": ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
    )
    (axes,) = figure.axes
    path, sensors = axes.lines
    np.testing.assert_allclose(path.get_xydata(), trajectory.position_m[:, :2])
    np.testing.assert_allclose(sensors.get_xydata(), [[1.0, 0.6]], atol=1e-12)
    (arrow,) = axes.texts
    np.testing.assert_allclose(np.subtract(arrow.xy, arrow.xyann), [0.0, 0.12], atol=1e-12)
    assert axes.get_xlim() == (-1.0, 1.0)
    assert "path and last heading" in " ".join(text.get_text() for text in figure.texts)


def test_damaged_map_file_is_refused(tmp_path):
    path = tmp_path / "m.h5"
    ertis.write_map(path, small())
    content = bytearray(path.read_bytes())
    place = content.index(np.float32(4.0).tobytes())
    content[place + 3] ^= 1
    path.write_bytes(content)
    with pytest.raises(DamagedError, match="SHA-256"):
        ertis.read_map(path)


@pytest.mark.parametrize("name", ["cell_m", "origin_x_m", "origin_y_m", "n_groups", "time_ns"])
def test_map_file_with_another_place_or_count_is_refused(tmp_path, name):
    ertis.write_map(tmp_path / "m.h5", small())
    with h5py.File(tmp_path / "m.h5", "r+") as file:
        file.attrs.modify(name, file.attrs[name] + type(file.attrs[name])(1))
    with pytest.raises(DamagedError, match="SHA-256"):
        ertis.read_map(tmp_path / "m.h5")


def test_map_and_recording_are_told_apart(tmp_path):
    ertis.write_map(tmp_path / "m.h5", small())
    with pytest.raises(DataError, match=r"m.h5 is an occupancy map; choose a recording"):
        ertis.open_recording(tmp_path / "m.h5")
    with pytest.raises(DataError, match="not an occupancy map; choose a file of 'ertis map'"):
        ertis.read_map(REFLECTORS)
    with pytest.raises(DataError, match="choose an occupancy map"):
        ertis.read_map(tmp_path / "none.h5")


def test_ply_holds_the_occupied_cells(tmp_path):
    ertis.write_map(tmp_path / "m.ply", small())
    vertices = PlyData.read(str(tmp_path / "m.ply"))["vertex"]
    assert np.stack([vertices["x"], vertices["y"]], axis=1).tolist() == small().occupied_m.tolist()
    assert vertices["z"].tolist() == [0.0, 0.0]
    assert vertices["probability"] == pytest.approx(small().probability[small().is_occupied])


def test_unknown_format_of_a_map_is_refused(tmp_path):
    with pytest.raises(ArgumentError, match=r"ends in '.png'; choose a name that ends in .h5"):
        ertis.write_map(tmp_path / "m.png", small())


def test_map_of_a_furnished_room_shows_its_walls():
    """`ertis bench map` measures maps of many rooms, with more poses."""
    report = mapping.run(count=1, poses=12, length_m=0.0, rate_hz=2.5, seed=1, say=lambda _: None)
    (row,) = report["rows"]
    assert row["found"] > 0.5
    assert row["false"] < 0.06
    assert "| room 1 | 12 |" in mapping.form(report)


def test_distances_in_a_place_are_those_to_walls_posts_and_boxes():
    box = Box(position_m=(1.0, 0.0, 0.4), size_m=(0.4, 0.2, 0.8), yaw_deg=90.0)
    walls = tuple(Point(position_m=(3.0, y_m, 0.4)) for y_m in (-1.5, 0.0, 1.5))
    place = mapping.MappedPlace((*walls, Point(position_m=(-1.0, 0.5, 0.4))), (box,), (3.0, 2.0))
    away_m = place.away_m(np.array([[2.8, 0.0], [3.1, 0.0], [-1.0, 0.4], [1.0, 0.0], [1.3, 0.0], [0.0, 1.5]]))
    assert away_m == pytest.approx([0.2, 0.1, 0.1, 0.1, 0.2, 0.5])
    assert place.wall_points_m.tolist() == [[3.0, -1.5], [3.0, 0.0], [3.0, 1.5]]
    assert place.sees(np.zeros(2), place.wall_points_m).tolist() == [True, False, True]
    cells = np.zeros((80, 120))
    cells[40, 119], cells[40, 90] = 4.0, 4.0  # one at the wall at y = 0.025 m, and one in the middle of nowhere
    shares = mapping.rated(ertis.OccupancyMap(cells, (-3.0, -2.0), 0.05), place, np.array([[2.0, 1.0]]))
    assert (shares["walls"], shares["occupied"]) == (3, 2)
    assert (shares["found"], shares["false"]) == pytest.approx((1 / 3, 0.5))
