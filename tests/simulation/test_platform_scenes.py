"""Platforms of scenes that carry sensors, move and turn."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Processing
from ertis_numba.simulation import Platform, Point, Scene, Sensor, Wall
from ertis_numba.simulation.arrivals import echoes
from ertis_numba.simulation.effects import doppler
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.sensors import Emitter
from ertis_numba.simulation.snapshot import snapshot
from ertis_numba.simulation.stopwatch import CostStopwatch

TURNING = Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 30.0), (1.0, 1.0, 0.5, 0.0, 120.0)))
SENSORS = (
    Sensor(name="front", position_m=(0.2, 0.0, 0.3), emitter=Emitter(position_m=(0.0, 0.05, 0.02))),
    Sensor(name="left", position_m=(0.0, 0.2, 0.3), yaw_deg=90.0, pitch_deg=10.0),
)
TARGET_M = (1.6, 1.2, 0.4)
SHORT = Processing(range_m=(0.3, 1.5), directions="2d:31")


def position_m(scene, sensor, offset_m, time_s):
    """World position of a place in the frame of a sensor, from the waypoints alone."""
    (start_s, *start), (stop_s, *stop) = scene.platform.waypoints
    x, y, z, yaw_deg = np.array(start) + (time_s - start_s) / (stop_s - start_s) * (np.array(stop) - np.array(start))
    angles_deg = [sensor.yaw_deg, -sensor.pitch_deg, sensor.roll_deg]
    on_platform_m = np.array(sensor.position_m) + Rotation.from_euler("ZYX", angles_deg, degrees=True).apply(offset_m)
    return np.array([x, y, z]) + Rotation.from_euler("z", yaw_deg, degrees=True).apply(on_platform_m)


@pytest.mark.parametrize(("emitter", "receiver"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_sound_arrives_where_the_turning_microphones_are(emitter, receiver):
    scene = Scene(platform=TURNING, sensors=SENSORS, points=(Point(position_m=TARGET_M),))
    start_s = 0.4
    sender, sensor = scene.sensors[emitter], scene.sensors[receiver]
    shot = snapshot(scene, sensor, start_s)
    (paths, *_) = echoes(shot, frozenset({"emitter_offset"}), emitter, CostStopwatch())
    arrival_s, stretch = doppler.times(shot, paths, 0.0, (np.zeros(0), None))
    speed_m_s = shot.speed_m_s

    def arrival_of(offset_m, sent_s):
        source_m = position_m(scene, sender, sender.emitter.position_m, start_s + sent_s)
        met_s = sent_s + math.dist(source_m, TARGET_M) / speed_m_s

        def late_m(time_s):
            return speed_m_s * (time_s - met_s) - math.dist(
                TARGET_M, position_m(scene, sensor, offset_m, start_s + time_s)
            )

        return brentq(late_m, met_s, met_s + 0.1, xtol=1e-14)

    layout = microphones(sensor.array)
    offsets_m = layout.enabled_positions_m
    expected_s = [arrival_of(offset_m, 0.0) for offset_m in offsets_m]
    # Velocities are constant during a measurement: the arc of the true motion departs from its tangent by 0.1 mm.
    np.testing.assert_allclose(arrival_s[0], expected_s, atol=0.1e-3 / speed_m_s)
    step_s = 1e-4
    expected_stretch = [
        (arrival_of(each, step_s) - arrival_of(each, -step_s)) / (2 * step_s) for each in offsets_m[::8]
    ]
    np.testing.assert_allclose(stretch[0, ::8], expected_stretch, atol=1e-4)


def test_mirror_images_turn_the_other_way():
    wall = Wall(position_m=(3.0, 0.0, 0.0), facing_deg=(160.0, 10.0))
    scene = Scene(platform=TURNING, sensors=SENSORS, points=(Point(position_m=TARGET_M),), walls=(wall,))
    shots = [snapshot(scene, scene.sensors[0], time_s) for time_s in (0.4, 0.4 + 1e-6)]
    moved, turning = (_paths_over_wall(shot) for shot in shots)
    ends_m = turning.receiver.positions_m - moved.receiver.positions_m
    arms_m = moved.receiver.positions_m - moved.receiver.centre_m[:, None]
    velocity_m_s = moved.receiver.velocity_m_s[:, None] + np.cross(moved.receiver.spin_rad_s[:, None], arms_m)
    np.testing.assert_allclose(velocity_m_s, ends_m / 1e-6, atol=1e-5)


def _paths_over_wall(shot):
    (paths, *_) = echoes(shot, frozenset({"walls"}), 0, CostStopwatch())
    assert any(paths.receiver.walls)
    return paths


@pytest.mark.parametrize("name", ["front", "left"])
def test_resting_platform_is_the_frame_of_its_sensors(name):
    platform = Platform(waypoints=((0.0, 0.5, -0.2, 0.1, 90.0),))
    reflectors = {"points": (Point(position_m=TARGET_M),), "walls": (Wall(position_m=(0, 3, 0), facing_deg=(-90, 0)),)}
    carried = Scene(platform=platform, sensors=SENSORS, **reflectors)
    fixed = Scene(
        sensors=(
            SENSORS[0].replace(position_m=(0.5, 0.0, 0.4), yaw_deg=90.0),
            SENSORS[1].replace(position_m=(0.3, -0.2, 0.4), yaw_deg=180.0),
        ),
        **reflectors,
    )
    assert not carried.moves
    one, other = (Simulator(scene, sensor=name).reflectors() for scene in (carried, fixed))
    assert [each.name for each in one] == [each.name for each in other]
    for a, b in zip(one, other, strict=True):
        assert (a.range_m, a.azimuth_deg, a.level_db) == pytest.approx((b.range_m, b.azimuth_deg, b.level_db))


def test_straight_platform_moves_its_sensors():
    moving = Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 0.0), (10.0, 10.0, 5.0, 0.0, 0.0)))
    points = (Point(position_m=(1.2, 0.1, 0.3)),)
    sensor = Sensor(position_m=(0.25, 0.0, 0.25), processing=SHORT)
    carried = Simulator(Scene(platform=moving, sensors=(sensor,), points=points, count=2))
    free = Simulator(Scene(sensors=(sensor.replace(velocity_m_s=(1.0, 0.5, 0.0)),), points=points, count=2))
    assert carried.reflectors(1)[0].range_m != carried.reflectors(0)[0].range_m
    assert (carried.render(1).data == free.render(1).data).mean() > 0.999


def test_turning_is_an_effect_of_motion():
    turning = Platform(waypoints=((0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0, 90.0)))
    sensor = Sensor(processing=SHORT)
    scene = Scene(platform=turning, sensors=(sensor,), points=(Point(range_m=1.3),))
    (verdict,) = [each for each in Simulator(scene).plan.verdicts if each.name == "doppler"]
    assert verdict.on
    (verdict,) = [
        each
        for each in Simulator(scene.replace(platform=turning.replace(waypoints=((0, 0, 0, 0, 0),)))).plan.verdicts
        if each.name == "doppler"
    ]
    assert not verdict.on


def test_trajectory_holds_the_way_points():
    trajectory = TURNING.trajectory(np.array([0.0, 0.5, 2.0]))
    assert trajectory.time_ns.tolist() == [0, 500_000_000, 2_000_000_000]
    np.testing.assert_allclose(trajectory.position_m, [[0, 0, 0], [0.5, 0.25, 0], [1.0, 0.5, 0]])
    yaw_deg = Rotation.from_quat(trajectory.rotation_xyzw).as_euler("ZYX", degrees=True)[:, 0]
    np.testing.assert_allclose(yaw_deg, [30.0, 75.0, 120.0])
    assert trajectory.source == "scene"


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        ((), "platform has no waypoints; write at least one"),
        (((0, 0, 0, 0, math.nan),), r"platform.waypoints\[0\] yaw_deg is nan"),
        (((0, 1e9, 0, 0, 0),), r"platform.waypoints\[0\] is 1e\+09"),
        (((0, 0, 0, 0, 0), (0, 1, 0, 0, 0)), "go from 0 s to 0 s; pass strictly increasing times"),
        (((0, 0, 0, 0, 0), (1, 1000, 0, 0, 0)), "platform.waypoints speed is 1000"),
        (((0, 0, 0, 0, 0), (0.01, 0, 0, 0, 180)), "platform.waypoints yaw rate is 18000"),
    ],
)
def test_unusable_way_points_are_refused(waypoints, message):
    with pytest.raises(ArgumentError, match=message):
        Platform(waypoints=waypoints)


@pytest.mark.parametrize("motion", [{"velocity_m_s": (1, 0, 0)}, {"waypoints": ((0, 0, 0, 0), (1, 1, 0, 0))}])
def test_sensor_on_a_platform_does_not_move_by_itself(motion):
    with pytest.raises(ArgumentError, match="sensor 'sensor' moves by itself, but the scene has a platform"):
        Scene(platform=TURNING, sensors=(Sensor(**motion),))
