"""Poses of several sensors, from simulated recordings of reflectors that they hear in common."""

import dataclasses
import json

import numpy as np
import pytest
from ertis_cli._calibrate_poses import write_poses
from ertis_cli._mountings import mountings
from scipy.spatial.transform import Rotation

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.calibration.pose_fit import PoseProblem, WaveTable
from ertis_numba.calibration.pose_result import PoseCalibration, SensorPose
from ertis_numba.calibration.poses import calibrate_poses
from ertis_numba.calibration.spherical_waves import fit_wave, wave_lags, wave_slopes
from ertis_numba.calibration.wave_finder import find_waves
from ertis_numba.settings import Array, Call, Recording
from ertis_numba.simulation import Emitter, Point, Scene, Sensor
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.sensors import Electronics
from ertis_numba.storage import write_recording
from tests.scenes import SPEED_M_S, only, vector

EFFECTS = (
    *("propagation", "spreading", "absorption", "emitter_directivity"),
    *("cross_emission", "sync_delay", "microphone_noise"),
)
FORWARD = {
    "front": ("eRTIS_v3D1", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "left": ("uRTIS_v1", (-0.05, 0.16, 0.01), (30.0, 3.0, -4.0)),
    "right": ("eRTIS_v2", (-0.04, -0.17, -0.02), (-28.0, -2.0, 5.0)),
    "top": ("eRTIS_v3D1", (0.03, 0.02, 0.15), (4.0, 6.0, 2.0)),
}
AROUND = {
    "front": ("eRTIS_v3D1", (0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "left": ("eRTIS_v3D1", (-0.05, 0.12, 0.0), (90.0, 0.0, 0.0)),
    "back": ("eRTIS_v3D1", (-0.2, 0.0, 0.02), (180.0, 2.0, 0.0)),
}
"""Layout, position, and yaw, pitch and roll of each sensor."""


def sensors(rig, level_db=-22.0):
    return tuple(
        Sensor(
            name=name,
            array=Array(layout=layout),
            call=Call(start_frequency_hz=80e3, stop_frequency_hz=20e3),
            recording=Recording(n_samples=52_000),
            position_m=place,
            yaw_deg=yaw,
            pitch_deg=pitch,
            roll_deg=roll,
            emitter=Emitter(level_db=level_db, diameter_m=0.006),
            electronics=Electronics(noise_dbfs=-60.0),
        )
        for name, (layout, place, (yaw, pitch, roll)) in rig.items()
    )


def measured(rig, places, *, seed=1, more=(), **options):
    """Measurements of each sensor, one for each place of the reflector; None leaves the reflector out."""
    made = {name: [] for name in rig}
    for pulse, place in enumerate(places):
        points = () if place is None else (Point(position_m=vector(place), strength_db=-12.0),)
        scene = Scene(seed=1000 * seed + pulse, sensors=sensors(rig, **options), points=(*more, *points))
        for name in rig:
            found = Simulator(scene, sensor=name, plan=only(*EFFECTS)).render()
            stamp = dataclasses.replace(found.stamp, sequence=pulse, sync_count=pulse)
            made[name].append(dataclasses.replace(found, stamp=stamp))
    return made


def placed(rng, count, azimuth_deg=(-35.0, 35.0)):
    """Random places of a reflector, at evenly spaced azimuths."""
    azimuth = np.radians(rng.permutation(np.linspace(*azimuth_deg, count)))
    elevation, range_m = np.radians(rng.uniform(-25, 25, count)), rng.uniform(0.6, 1.5, count)
    return np.column_stack(
        [
            range_m * np.cos(elevation) * np.cos(azimuth),
            range_m * np.cos(elevation) * np.sin(azimuth),
            range_m * np.sin(elevation),
        ]
    )


def errors(found, rig):
    """Errors of position in metres and of rotation vectors in radians, relative to the first sensor."""
    truth = {sensor.name: sensor for sensor in sensors(rig)}
    first = truth[found.reference]
    made = {}
    for name, pose in found.poses.items():
        place = first.rotation().T @ (np.array(truth[name].position_m) - np.array(first.position_m))
        turn = pose.rotation.T @ first.rotation().T @ truth[name].rotation()
        made[name] = np.concatenate([pose.translation_m - place, Rotation.from_matrix(turn).as_rotvec()])
    return made


def require_accurate(found, rig):
    for error in errors(found, rig).values():
        assert np.linalg.norm(error[:3]) < 0.01
        assert np.degrees(np.linalg.norm(error[3:])) < 0.5


@pytest.fixture(scope="module")
def forward():
    """Four sensors, with reflectors at rest, one measurement without the other reflector, and missing ones."""
    places = [*placed(np.random.default_rng(3), 9)]
    places.insert(4, None)
    at_rest = (
        Point(position_m=(1.7, 0.6, 0.2), strength_db=-8.0),
        Point(position_m=(1.5, -0.7, -0.3), strength_db=-8.0),
    )
    made = measured(FORWARD, places, more=at_rest)
    del made["left"][2]
    del made["right"][7:]
    made["top"].reverse()
    return made


@pytest.fixture(scope="module")
def calibration(forward):
    return calibrate_poses(forward)


def test_poses_of_four_sensors_are_within_1_cm_and_half_a_degree(calibration):
    assert calibration.reference == "front"
    assert list(calibration.poses) == list(FORWARD)
    require_accurate(calibration, FORWARD)


def test_intervals_contain_the_errors_and_are_not_too_wide(calibration):
    inside = []
    for name, error in errors(calibration, FORWARD).items():
        pose = calibration.poses[name]
        half = np.concatenate([pose.translation_interval_m, np.radians(pose.rotation_interval_deg)])
        if name == "front":
            assert not half.any()
            continue
        assert np.all(half < np.repeat([0.01, np.radians(0.5)], 3))
        inside.append(np.abs(error) < half)
    assert np.mean(inside) > 0.8


def test_bad_measurements_are_left_out_and_reflectors_counted(calibration):
    assert calibration.unused == (4,)
    assert calibration.n_measurements == 10
    assert not calibration.not_observable
    assert 9 <= len(calibration.reflectors_m) <= 13
    assert all(pose.n_reflectors >= 7 for pose in calibration.poses.values())
    assert all(pose.residual_m < 5e-3 for pose in calibration.poses.values())


def test_sensors_around_a_platform_are_linked_by_the_one_between():
    rng = np.random.default_rng(5)
    places = placed(rng, 15, (-10.0, 190.0))
    found = calibrate_poses(measured(AROUND, places, seed=2), reference="left")
    assert found.reference == "left"
    assert not found.not_observable
    require_accurate(found, AROUND)


def pair(count=6, **options):
    rig = {name: FORWARD[name] for name in ("front", "top")}
    return measured(rig, placed(np.random.default_rng(7), count), **options)


@pytest.fixture(scope="module")
def two():
    return pair()


def test_too_few_sensors_are_refused(two):
    with pytest.raises(ArgumentError, match=r"poses of 1 sensor are wanted, but mountings need at least two"):
        calibrate_poses({"front": two["front"]})


def test_unknown_reference_is_refused(two):
    with pytest.raises(ArgumentError, match=r"reference 'back' is unknown; known are front, top"):
        calibrate_poses(two, reference="back")


def test_different_pulses_are_refused(two):
    with pytest.raises(ArgumentError, match=r"front, top have no SYNC pulse in common; record them together"):
        calibrate_poses({"front": two["front"][:1], "top": two["top"][1:2]})


def test_too_few_common_reflectors_are_refused(two):
    with pytest.raises(
        DataError, match=r"sensor top has fewer than 3 reflectors in common with front; place one small"
    ):
        calibrate_poses({name: each[:2] for name, each in two.items()})


def test_recordings_without_echoes_are_refused():
    rig = {name: FORWARD[name] for name in ("front", "top")}
    with pytest.raises(DataError, match=r"sensor front heard no echo that stands out in 1 measurements; place a small"):
        calibrate_poses(measured(rig, [None]))


def test_saturated_recordings_are_refused():
    with pytest.raises(DataError, match=r"sensor \w+: \d+ of 32 channels are saturated; lower the emission"):
        calibrate_poses(pair(1, level_db=10.0))


def test_reflectors_on_a_line_leave_a_rotation_and_write_nothing(tmp_path):
    rig = {name: FORWARD[name] for name in ("front", "left")}
    made = measured(rig, [(1.0, 0.1, z) for z in (-0.4, -0.25, -0.1, 0.05, 0.2, 0.35)])
    found = calibrate_poses(made)
    assert "left" in found.not_observable[0]
    assert "place the reflector at more places" in found.not_observable[0]
    path = write_recording(tmp_path / "run.h5", [each for several in made.values() for each in several])
    with pytest.raises(DataError, match=r"the recordings do not determine .*left.*; nothing is written"):
        write_poses([path], None, tmp_path / "rig.toml")
    assert not (tmp_path / "rig.toml").exists()


def test_mounting_file_is_read_by_capture(two, tmp_path, capsys):
    path = write_recording(tmp_path / "run.h5", [each for several in two.values() for each in several])
    target = tmp_path / "rig.toml"
    write_poses([path], ["front", "top"], target)
    shown = capsys.readouterr()
    assert "relative to front, from 6 reflectors in 6 measurements" in shown.out
    assert "ertis capture --mounting" in shown.err
    found = calibrate_poses(two)
    for name, (place_m, quaternion) in mountings(target, ["front", "top"]).items():
        assert np.allclose(place_m, found.poses[name].translation_m, atol=1e-6)
        assert np.allclose(quaternion, found.poses[name].rotation_xyzw, atol=1e-6)
    with pytest.raises(ArgumentError, match="exists; choose another name"):
        write_poses([path], None, target)
    write_poses([path], None, None, as_json=True)
    report = json.loads(capsys.readouterr().out)
    assert report["mounting"] is None
    assert [each["sensor"] for each in report["sensors"]] == ["front", "top"]


def test_recordings_of_several_runs_are_combined(two, tmp_path, capsys):
    paths = []
    for run, half in enumerate((slice(0, 3), slice(3, 6))):
        parts = [
            dataclasses.replace(each, stamp=dataclasses.replace(each.stamp, sync_count=place, sequence=place))
            for several in two.values()
            for place, each in enumerate(several[half])
        ]
        paths.append(write_recording(tmp_path / f"run{run}.h5", parts))
    write_poses(paths, None, None)
    assert "from 6 reflectors in 6 measurements" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("sensors_", "target", "message"),
    [
        (["front", "back"], "rig.toml", r"do not contain sensor 'back'; choose from front, top"),
        (["front", "front"], "rig.toml", r"--sensors names front 2 times; name each sensor once"),
        (None, "rig.h5", r"does not end in \.toml; mounting files do, so name it rig\.toml"),
    ],
)
def test_wrong_options_are_refused(two, tmp_path, sensors_, target, message):
    path = write_recording(tmp_path / "run.h5", [each for several in two.values() for each in several[:1]])
    with pytest.raises(ArgumentError, match=message):
        write_poses([path], sensors_, tmp_path / target)


def test_waves_have_the_paths_and_directions_of_echoes(two):
    front, top = sensors({name: FORWARD[name] for name in ("front", "top")})
    reflector_m = placed(np.random.default_rng(7), 6)[0]
    inside_m = front.rotation().T @ (reflector_m - np.array(front.position_m))
    range_m = np.linalg.norm(inside_m)
    own = min(find_waves(two["front"][0]), key=lambda wave: abs(wave.path_m - 2 * range_m))
    assert own.path_m == pytest.approx(2 * range_m, abs=4e-3)
    assert own.parameters[2:4] == pytest.approx(inside_m[1:] / range_m, abs=2e-3)
    assert own.parameters[4] == pytest.approx(1 / range_m, abs=0.1)
    other_m = range_m + np.linalg.norm(reflector_m - np.array(top.position_m)) + 400e-9 * SPEED_M_S
    assert min(abs(wave.path_m - other_m) for wave in find_waves(two["front"][0])) < 4e-3


def test_jacobian_of_the_fit_equals_finite_differences():
    rng = np.random.default_rng(0)
    receiver, emitter, reflector = rng.integers(0, 4, 30), rng.integers(0, 4, 30), rng.integers(0, 5, 30)
    reflector[(rng.random(30) < 0.3) & (receiver != emitter)] = -1
    waves = WaveTable(
        *(receiver, emitter, reflector),
        *(rng.normal(size=(30, 5)), rng.normal(size=(30, 5, 5)), 1e-4 * rng.normal(size=30)),
    )
    turns = Rotation.random(4, random_state=1).as_matrix()
    problem = PoseProblem(waves, turns, rng.normal(size=(4, 3)), 2 + rng.normal(size=(5, 3)), 1)
    unknown = 0.3 * rng.normal(size=problem.n_unknown)
    slopes = [
        (problem.residuals(unknown + step) - problem.residuals(unknown - step)) / 2e-6 for step in 1e-6 * np.eye(33)
    ]
    assert np.allclose(problem.jacobian(unknown), np.transpose(slopes), atol=1e-6)


def test_lags_of_waves_are_differences_of_distances():
    rng = np.random.default_rng(2)
    positions_m, source_m = 0.08 * rng.normal(size=(9, 3)), np.array([0.9, -0.4, 0.3])
    range_m = np.linalg.norm(source_m)
    wanted = np.linalg.norm(source_m - positions_m, axis=1) - range_m
    assert np.allclose(wave_lags(source_m / range_m, np.array(1 / range_m), positions_m), wanted)
    wave = np.array([2.0, *(source_m / range_m), 1 / range_m])
    slopes = [
        (
            wave_lags((wave + step)[1:4], (wave + step)[4], positions_m)
            + step[0]
            - wave_lags((wave - step)[1:4], (wave - step)[4], positions_m)
            + step[0]
        )
        / 2e-6
        for step in 1e-6 * np.eye(5)
    ]
    assert np.allclose(wave_slopes(wave[1:4], wave[4], positions_m), np.transpose(slopes), atol=1e-7)
    found, _ = fit_wave(2 + wanted, positions_m, wave + 0.02, 0.01, n_rounds=20)
    assert np.allclose(found, wave, atol=1e-4)


@pytest.mark.parametrize("angles_deg", [(30.0, -20.0, 10.0), (-170.0, 80.0, -95.0), (15.0, 90.0, 0.0)])
def test_angles_of_a_pose_are_those_of_a_scene(angles_deg):
    yaw, pitch, roll = angles_deg
    sensor = Sensor(yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)
    spread = np.diag([0.0, 0.0, 0.0, 1e-6, 4e-6, 9e-6])
    pose = SensorPose(np.zeros(3), sensor.quaternion(), spread, 0.0, 3, 9)
    assert pose.yaw_pitch_roll_deg == pytest.approx(angles_deg, abs=1e-6)
    assert np.allclose(pose.rotation, sensor.rotation())
    if pitch == 90.0:
        return
    step = 1e-6
    slopes = []
    for axis in np.eye(3):
        turned = Rotation.from_matrix(pose.rotation @ Rotation.from_rotvec(step * axis).as_matrix()).as_quat()
        other = SensorPose(np.zeros(3), turned, spread, 0.0, 3, 9)
        slopes.append((np.radians(other.yaw_pitch_roll_deg) - np.radians(pose.yaw_pitch_roll_deg)) / step)
    wanted = 1.96 * np.sqrt(np.sum(np.transpose(slopes) ** 2 * np.diag(spread)[3:], axis=1))
    assert np.allclose(np.radians(pose.yaw_pitch_roll_interval_deg), wanted, rtol=1e-4)


def test_mounting_of_a_calibration_has_positions_and_quaternions():
    pose = SensorPose(np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((6, 6)), 0.0, 3, 9)
    found = PoseCalibration("front", {"front": pose}, np.zeros((3, 3)), 3, (), ())
    assert found.mounting["front"] == (pose.translation_m, pose.rotation_xyzw)
    assert "position_m = [0.100000, 0.200000, 0.300000]" in found.to_toml()
