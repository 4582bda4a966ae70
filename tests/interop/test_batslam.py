"""Data sets for BatSLAM 2.0: a reader made from the format page alone, poses, ears, and bad input."""

import json
import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.signals import signals_of
from ertis_numba.frames import Measurement, Trajectory
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.interop import Drive, _batslam
from ertis_numba.interop._virtual_ears import VirtualEars
from ertis_numba.settings import Array
from ertis_numba.storage import add_poses, write_recording
from tests.files import SMALL, image, line, noise
from tests.pages import commands_in, page, python_in, run_code_here, run_here

PAGE = page("batslam-format")
COUNT = 4
TURN_RAD = math.radians(10.0)  # of the sensor on the platform of the scene
SCENE = """
seed = 5
rate_hz = 10.0
count = 4

[platform]
waypoints = [[0.0, 1.0, 2.0, 0.0, 169.0], [1.0, 0.0, 2.2, 0.0, 189.0]]

[[sensors]]
name = "front"
position_m = [0.2, 0.0, 0.4]
yaw_deg = 10.0
processing.range_m = [0.4, 3.0]
processing.directions = "90"
emitter.level_db = -24.0
electronics.noise_dbfs = -60.0

[[points]]
position_m = [-0.3, 1.3, 0.4]
strength_db = -6.0

[[points]]
position_m = [-0.6, 2.9, 0.4]
strength_db = -10.0

[[points]]
position_m = [-0.9, 1.7, 0.4]
strength_db = -8.0

[[points]]
position_m = [-0.2, 2.5, 0.4]
strength_db = -8.0

[[points]]
position_m = [-1.1, 2.6, 0.4]
strength_db = -8.0

[[points]]
waypoints = [[0.0, -1.5, 2.0, 0.4], [1.0, -1.5, 1.9, 0.4]]

[[spheres]]
position_m = [-1.4, 2.2, 0.4]
radius_m = 0.2

[[walls]]
position_m = [-2.0, 2.0, 0.0]
facing_deg = [0.0, 0.0]

[[walls]]
position_m = [0.0, 4.0, 0.0]
facing_deg = [-90.0, 0.0]
size_m = [3.0, 2.0]

[[walls]]
position_m = [0.0, 0.0, 0.0]
facing_deg = [0.0, 90.0]
reflection_db = -40.0
"""


@dataclass
class BatslamReader:
    """Reader of the tables on the page: variables as they are, and structures as dicts."""

    variables: dict
    meta: dict
    reflectors: dict

    @classmethod
    def of(cls, path):
        loaded = scipy.io.loadmat(path)
        variables = {name: value for name, value in loaded.items() if not name.startswith("__")}
        structures = [
            {name: variables[key][name][0, 0] for name in variables[key].dtype.names} for key in ("meta", "reflectors")
        ]
        return cls(variables, *structures)

    def __getitem__(self, name):
        return self.variables[name]

    def echoes(self, pulse):
        """Return the signals at the left and the right ear."""
        scale = self["echo_scale"][pulse, 0]
        return tuple(self[f"echo_{side}"][pulse] * scale for side in ("left", "right"))

    def number(self, name):
        return self.meta[name].item()


def names_on_page(heading):
    table = PAGE[PAGE.index(f"| {heading} | shape") :].split("\n\n", 1)[0].splitlines()[2:]
    return [name for row in table for name in re.findall(r"`(\w+)`", row.split("|")[1])]


def planar(trajectory, offset_m=0.2):
    """Return the pose of the sensor of the scene: x, y and heading."""
    heading = 2 * np.arctan2(trajectory.rotation_xyzw[:, 2], trajectory.rotation_xyzw[:, 3])
    x, y = trajectory.position_m[:, 0], trajectory.position_m[:, 1]
    sensor = np.column_stack([x + offset_m * np.cos(heading), y + offset_m * np.sin(heading), heading + TURN_RAD])
    sensor[:, 2] = np.angle(np.exp(1j * sensor[:, 2]))
    return sensor


def walked(start, deltas):
    """Return the poses that deltas lead to."""
    poses = [start]
    for forward, left, turn in deltas:
        x, y, heading = poses[-1]
        c, s = math.cos(heading), math.sin(heading)
        poses.append((x + c * forward - s * left, y + s * forward + c * left, heading + turn))
    return np.array(poses)


def straight(count=3, step_m=0.1, start_ns=1_700_000_000_123_456_789, step_ns=50_000_000):
    """Return a straight trajectory at the times of `noise`."""
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    position_m = np.outer(np.arange(count) * step_m, [1.0, 0.0, 0.0])
    return Trajectory(start_ns + step_ns * np.arange(count), position_m, identity, source="application")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A simulated drive with its scene, true poses and odometry of a wheel."""
    place = tmp_path_factory.mktemp("batslam")
    (place / "scene.toml").write_text(SCENE)
    scene = ertis.load_scene(place / "scene.toml")
    simulator = ertis.Simulator(scene)
    measurements = [simulator.render(index) for index in range(COUNT)]
    sensor = scene.sensors[0]
    write_recording(place / "drive.h5", measurements, mounting={"front": (sensor.position_m, sensor.quaternion())})
    ertis.write_tum(place / "true.tum", scene.platform.trajectory(np.arange(COUNT) / 10))
    return place


@pytest.fixture(scope="module")
def exported(folder):
    run("drive.h5", "-o", "set.mat", "--poses", "true.tum", "--scene", "scene.toml", folder=folder)
    return BatslamReader.of(folder / "set.mat")


def run(*arguments, folder, code=0):
    paths = [str(folder / each) if re.search(r"\.(h5|mat|tum|toml)$", str(each)) else str(each) for each in arguments]
    done = CliRunner().invoke(cli, ["export", *paths])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def test_data_set_has_the_names_of_the_page(exported):
    assert sorted(exported.variables) == sorted(names_on_page("name"))
    assert sorted(exported.meta) == sorted(names_on_page("field of `meta`"))
    assert sorted(exported.reflectors) == sorted(names_on_page("field of `reflectors`"))
    assert tuple(exported.variables) == ertis.interop.FORMATS["batslam"].fields


def test_data_set_has_the_shapes_and_types_of_the_page(exported):
    n_samples = exported["echo_left"].shape[1]
    shapes = {name: exported[name].shape for name in exported.variables if name not in {"meta", "reflectors"}}
    assert shapes == {
        "gt_pose": (COUNT, 3),
        "gt_delta": (COUNT - 1, 3),
        "odom_delta": (COUNT - 1, 3),
        "t": (COUNT, 1),
        "lap": (COUNT, 1),
        "echo_left": (COUNT, n_samples),
        "echo_right": (COUNT, n_samples),
        "echo_scale": (COUNT, 1),
    }
    assert {name for name in shapes if exported[name].dtype == np.int16} == {"echo_left", "echo_right"}
    assert {exported[name].dtype.kind for name in shapes if not name.startswith("echo_")} == {"f"}
    numbers = ("fs", "speed_of_sound", "max_range", "odom_bias_rot", "odom_bias_scale", "beam_azimuth", "ear_baseline")
    assert {exported.meta[name].shape for name in numbers} == {(1, 1)}
    assert exported.meta["odom_sigma"].shape == (1, 3)
    n_reflectors = len(exported.reflectors["type"])
    vectors, columns = ("position", "endpoint1", "endpoint2"), ("radius", "reflectivity", "has_signature")
    assert {exported.reflectors[name].shape for name in vectors} == {(n_reflectors, 3)}
    assert {exported.reflectors[name].shape for name in columns} == {(n_reflectors, 1)}


def test_data_set_describes_sensor_and_call(folder, exported):
    with ertis.open_recording(folder / "drive.h5") as recording:
        settings = recording.settings
    assert exported.number("fs") == settings.signal_rate_hz
    assert exported.number("speed_of_sound") == sound_speed_m_s(settings.air)
    assert exported.number("max_range") == 3.0
    np.testing.assert_array_equal(exported.meta["call"], call_samples(settings.call, rate_hz=225_000.0)[None])
    texts = {name: exported.meta[name].tolist() for name in ("lap_names", "sensor", "layout")}
    assert texts == {"lap_names": ["session 1"], "sensor": ["front"], "layout": ["eRTIS_v3D1"]}
    sources = [exported.meta[name].tolist() for name in ("pose_source", "odometry_source")]
    assert sources == [["file"], ["odometry"]]
    # The last sample is late enough for the whole echo at the largest range.
    latest_s = 2 * 3.0 / exported.number("speed_of_sound") + settings.call.duration_s
    assert exported["echo_left"].shape[1] >= latest_s * exported.number("fs")
    assert exported.number("beam_azimuth") == pytest.approx(math.radians(30))
    assert 0.02 < exported.number("ear_baseline") < 0.06


def test_poses_are_those_of_the_sensor(folder, exported):
    true = planar(ertis.load_scene(folder / "scene.toml").platform.trajectory(np.arange(COUNT) / 10))
    np.testing.assert_allclose(exported["gt_pose"], true, atol=1e-9)
    assert np.ptp(exported["gt_pose"][:, 2]) > math.pi  # The heading passes half a turn.
    rebuilt = walked(true[0], exported["gt_delta"])
    np.testing.assert_allclose(rebuilt[:, :2], true[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * rebuilt[:, 2]), np.exp(1j * true[:, 2]), atol=1e-9)
    np.testing.assert_allclose(exported["gt_delta"][:, 2], math.radians(2.0), atol=1e-9)
    np.testing.assert_allclose(exported["t"][:, 0], np.arange(COUNT) / 10, atol=1e-9)
    np.testing.assert_array_equal(exported["lap"], np.ones((COUNT, 1)))


def test_odometry_is_computed_from_echoes(exported):
    np.testing.assert_allclose(exported["odom_delta"], exported["gt_delta"], atol=0.03)
    assert not np.array_equal(exported["odom_delta"], exported["gt_delta"])


def test_rows_use_the_full_scale_of_their_integers(folder, exported):
    with ertis.open_recording(folder / "drive.h5") as recording:
        ears = VirtualEars(recording.settings, 30.0)
        for pulse, measurement in enumerate(recording):
            rows = exported["echo_left"][pulse].astype(int), exported["echo_right"][pulse].astype(int)
            assert np.max(np.abs(rows)) == 32767
            expected = ears(measurement)
            np.testing.assert_allclose(
                exported.echoes(pulse), expected, rtol=0, atol=0.5001 * exported["echo_scale"][pulse, 0]
            )


@pytest.mark.parametrize("azimuth_deg", [30.0, 0.0])
def test_ears_follow_the_formula_of_the_page(folder, azimuth_deg):
    """The reference delays each microphone in the time domain."""
    with ertis.open_recording(folder / "drive.h5") as recording:
        measurement, settings = recording[0], recording.settings
    ears = VirtualEars(settings, azimuth_deg)
    found = ears(measurement)
    position_m = microphones(settings.array).enabled_positions_m
    signals = signals_of(measurement)[:, : ears.n_samples]
    fine = scipy.signal.resample(signals, 32 * ears.n_samples, axis=1)
    time_s = np.arange(ears.n_samples) / ears.rate_hz
    fine_s = np.arange(fine.shape[1]) / (32 * ears.rate_hz)
    order = np.argsort(-position_m[:, 1], kind="stable")
    for side, mics, signal in ((1, order[:16], found.left), (-1, order[16:], found.right)):
        azimuth_rad = side * math.radians(azimuth_deg)
        delay_s = -(position_m[mics] @ [math.cos(azimuth_rad), math.sin(azimuth_rad), 0]) / sound_speed_m_s(
            settings.air
        )
        away_m = np.linalg.norm(position_m[mics] - position_m[mics].mean(axis=0), axis=1)
        weights = np.exp(-0.5 * away_m**2 / np.mean(away_m**2))
        expected = sum(
            weight * np.interp(time_s + late_s, fine_s, fine[mic])
            for mic, weight, late_s in zip(mics, weights / weights.sum(), delay_s, strict=True)
        )
        inner = slice(200, -200)  # A record has no samples beyond its ends.
        error = np.linalg.norm(signal[inner] - expected[inner]) / np.linalg.norm(expected[inner])
        assert error < 0.01


def test_echoes_lie_at_their_range_and_on_their_side(exported):
    """The reader applies the matched filter, as the front end of BatSLAM does."""
    call = exported.meta["call"][0]
    speed_m_s, rate_hz = exported.number("speed_of_sound"), exported.number("fs")
    x, y, heading = exported["gt_pose"][0]
    for point, louder in ((0, 0), (1, 1)):
        away = exported.reflectors["position"][point, :2] - [x, y]
        azimuth_rad = np.angle(np.exp(1j * (math.atan2(away[1], away[0]) - heading)))
        assert (azimuth_rad > 0) == (louder == 0)
        start = 2 * math.hypot(*away) / speed_m_s * rate_hz
        envelopes = []
        for signal in exported.echoes(0):
            n_fft = 2 ** math.ceil(math.log2(len(signal) + len(call)))
            spectrum = np.fft.fft(signal, n_fft) * np.conj(np.fft.fft(call, n_fft)) / np.sum(call**2)
            spectrum[n_fft // 2 :] = 0
            envelopes.append(2 * np.abs(np.fft.ifft(spectrum)))
        near = slice(round(start) - 30, round(start) + 31)
        peak = near.start + int(np.argmax(envelopes[louder][near]))
        assert (peak - start) * speed_m_s / rate_hz / 2 == pytest.approx(0.0, abs=0.003)
        assert envelopes[louder][near].max() > 2 * envelopes[1 - louder][near].max()


def test_reflectors_are_those_of_the_scene(exported):
    reflectors = exported.reflectors
    assert [str(kind).strip() for kind in reflectors["type"]] == [*["point"] * 5, "circle", "wall", "wall"]
    np.testing.assert_allclose(
        reflectors["position"][[0, 1, 5]], [[-0.3, 1.3, 0.4], [-0.6, 2.9, 0.4], [-1.4, 2.2, 0.4]]
    )
    np.testing.assert_allclose(reflectors["radius"][:, 0], [0, 0, 0, 0, 0, 0.2, 0, 0])
    np.testing.assert_allclose(reflectors["reflectivity"][:, 0], [10**-0.3, 10**-0.5, *[10**-0.4] * 3, 1, 1, 1])
    assert not reflectors["has_signature"].any()
    assert np.isnan(reflectors["endpoint1"][:6]).all()
    np.testing.assert_allclose(reflectors["position"][7], [0, 4, 0], atol=1e-9)
    ends = np.stack([reflectors[name][7] for name in ("endpoint1", "endpoint2")])
    np.testing.assert_allclose(np.sort(ends[:, 0]), [-1.5, 1.5], atol=1e-9)
    ends = np.sort([reflectors[name][6, 1] for name in ("endpoint1", "endpoint2")])
    y = exported["gt_pose"][:, 1]
    np.testing.assert_allclose(ends, [y.min() - 3.0, y.max() + 3.0], atol=1e-9)


def test_odometry_of_a_file_and_poses_of_the_recording_are_used(folder, tmp_path):
    scene = ertis.load_scene(folder / "scene.toml")
    true = scene.platform.trajectory(np.arange(COUNT) / 10)
    add_poses(folder / "drive.h5", true, output=tmp_path / "posed.h5")
    ertis.write_tum(tmp_path / "wheel.tum", straight(COUNT, start_ns=0, step_ns=100_000_000))
    done = run("posed.h5", "-o", "set.mat", "--odometry", "wheel.tum", "--json", folder=tmp_path)
    assert json.loads(done.stdout)["measurements"] == COUNT
    found = BatslamReader.of(tmp_path / "set.mat")
    np.testing.assert_allclose(found["gt_pose"], planar(true), atol=1e-9)
    expected = [0.1 * math.cos(TURN_RAD), -0.1 * math.sin(TURN_RAD), 0.0]
    np.testing.assert_allclose(found["odom_delta"], np.tile(expected, (COUNT - 1, 1)), atol=1e-9)
    assert found.meta["pose_source"].tolist() == ["scene"]
    assert len(found.reflectors["type"]) == 0
    assert found.reflectors["position"].size == 0


def test_measurements_are_chosen_by_index(folder, tmp_path):
    target = tmp_path / "set.mat"
    run(
        "drive.h5",
        "-o",
        target,
        "--poses",
        "true.tum",
        "--scene",
        "scene.toml",
        "-m",
        "1:2",
        "--beam-azimuth",
        "0",
        folder=folder,
    )
    found = BatslamReader.of(target)
    assert found["echo_left"].shape[0] == 2
    assert found.number("beam_azimuth") == 0.0
    np.testing.assert_allclose(found["t"][:, 0], [0, 0.1])


def test_noise_model_is_that_of_the_odometry():
    random = np.random.default_rng(7)
    true = np.column_stack([random.uniform(0.1, 0.2, 4000), random.normal(0, 0.02, 4000), random.normal(0, 0.1, 4000)])
    distance_m = np.hypot(true[:, 0], true[:, 1])
    spread = np.sqrt(distance_m)[:, None] * random.normal(size=(4000, 3)) * [0.03, 0.01, 0.02]
    measured = true * [1.02, 1, 1] + np.outer(0.05 * distance_m, [0, 0, 1]) + spread
    found = _batslam.noise_model(true, measured)
    assert found["odom_bias_scale"] == pytest.approx(0.02, abs=5e-3)
    assert found["odom_bias_rot"] == pytest.approx(0.05, abs=3e-3)
    assert found["odom_sigma"][0] == pytest.approx([0.03, 0.01, 0.02], rel=0.05)


def test_sessions_are_laps(tmp_path):
    measurements = [
        replace(each, stamp=replace(each.stamp, session_id=session))
        for each, session in zip(noise(count=3), (5, 5, 9), strict=True)
    ]
    drive = Drive(poses=straight(), odometry=straight())
    ertis.export(tmp_path / "set.mat", measurements, drive=drive)
    found = BatslamReader.of(tmp_path / "set.mat")
    assert found["lap"][:, 0].tolist() == [1, 1, 2]
    assert found.meta["lap_names"].tolist() == ["session 1", "session 2"]
    np.testing.assert_allclose(found["gt_delta"], [[0.1, 0, 0], [0.1, 0, 0]])
    assert found.number("odom_bias_scale") == 0.0


def test_platform_at_rest_has_no_odometry_noise(tmp_path):
    drive = Drive(poses=straight(step_m=0.0), odometry=straight(step_m=0.0))
    ertis.export(tmp_path / "set.mat", noise(), drive=drive)
    assert not BatslamReader.of(tmp_path / "set.mat").meta["odom_sigma"].any()


def test_times_just_outside_a_trajectory_get_its_end(tmp_path):
    """Text files round times, and clocks of sensors differ by microseconds."""
    late = straight(start_ns=1_700_000_000_123_456_789 + 900_000)
    ertis.export(tmp_path / "set.mat", noise(), drive=Drive(poses=late, odometry=late))
    pose = BatslamReader.of(tmp_path / "set.mat")["gt_pose"]
    assert pose[0, 0] == 0.0


def at(number, **stamp):
    each = noise()[number]
    return replace(each, stamp=replace(each.stamp, **stamp))


VERTICAL = SMALL.replace(array=Array(layout="line", positions_m=tuple((0.0, 0.0, 0.004 * each) for each in range(8))))
SINGLE = line(1, 8)
LATE = straight(start_ns=1_700_000_001_000_000_000)
UNUSABLE = {
    "no measurement": ([], {}, "needs at least 2 measurements, but no is given"),
    "one measurement": (noise(count=1), {}, "needs at least 2 measurements, but one is given; record a drive"),
    "an image": ([image()], {}, "Energyscape is given, but format 'batslam' holds the signals of measurements"),
    "two sensors": ([noise()[0], at(1, sensor="left")], {}, "sensors eRTIS-7 and left are given"),
    "order": (noise()[::-1], {}, r"measurement \[1\] is not later than the one before"),
    "other arrays": ([noise()[0], noise(line(8, 8))[1]], {}, "measurement 11 has another array than the first"),
    "poses": (noise(), {"poses": LATE}, "poses: 3 of 3 times .* lie outside the trajectory"),
    "odometry": (noise(), {"odometry": LATE}, "odometry: 3 of 3 times .* lie outside the trajectory"),
    "vertical array": (noise(VERTICAL), {}, "array.layout is 'line', whose microphones lie on one vertical line"),
    "one microphone": (noise(SINGLE), {}, "the array has one enabled microphone; virtual ears need at least 2"),
}


@pytest.mark.parametrize("name", UNUSABLE)
def test_unusable_drives_are_explained(tmp_path, name):
    items, given, message = UNUSABLE[name]
    drive = Drive(**({"poses": straight(), "odometry": straight()} | given))
    with pytest.raises(ArgumentError, match=message):
        ertis.export(tmp_path / "set.mat", items, drive=drive)
    assert list(tmp_path.iterdir()) == []


def test_export_needs_a_drive(tmp_path):
    with pytest.raises(ArgumentError, match=r"format 'batslam' needs poses and odometry; pass drive=Drive"):
        ertis.export(tmp_path / "set.mat", noise())
    with pytest.raises(ArgumentError, match="odometry is of type int; pass a Trajectory of the platform"):
        Drive(poses=straight(), odometry=3)
    with pytest.raises(ArgumentError, match="beam_azimuth_deg is 91"):
        Drive(poses=straight(), odometry=straight(), beam_azimuth_deg=91)


def test_variables_beyond_the_limit_of_matlab_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(_batslam, "_MAX_BYTES", 1000)
    with pytest.raises(ArgumentError, match="exceed the 2 GiB of a variable in MATLAB v7; choose fewer"):
        ertis.export(tmp_path / "set.mat", noise(), drive=Drive(poses=straight(), odometry=straight()))


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Recordings of noise of two sensors, in one file and in two."""
    place = tmp_path_factory.mktemp("rig")
    by_name = {
        name: [Measurement(each.data, SMALL, replace(each.stamp, sensor=name)) for each in noise()]
        for name in ("left", "right")
    }
    for name, given in by_name.items():
        write_recording(place / f"{name}.h5", given)
    write_recording(place / "both.h5", [*by_name["left"], *by_name["right"]])
    silent = [replace(each, stamp=replace(each.stamp, behaviour="passive")) for each in by_name["left"]]
    write_recording(place / "silent.h5", silent)
    write_recording(place / "mixed.h5", [by_name["left"][0], silent[1], by_name["left"][2]])
    write_recording(place / "img.h5", noise())
    ertis.write_tum(place / "way.tum", straight())
    return place


def test_one_of_several_sensors_is_chosen(rig):
    given = ("--poses", "way.tum", "--odometry", "way.tum", "--sensor", "right")
    run("both.h5", "-o", "a.mat", *given, folder=rig)
    done = run("left.h5", "right.h5", "-o", "b.mat", *given, folder=rig)
    assert "the mounting of sensor right is unknown" in done.stderr
    one, two = (BatslamReader.of(rig / name) for name in ("a.mat", "b.mat"))
    np.testing.assert_array_equal(one["echo_left"], two["echo_left"])
    assert one.meta["sensor"].tolist() == ["right"]


def test_measurements_without_a_call_are_left_out(rig):
    done = run("mixed.h5", "-o", "mixed.mat", "--poses", "way.tum", "--odometry", "way.tum", folder=rig)
    assert "note: 1 measurement without a call left out" in done.stderr
    found = BatslamReader.of(rig / "mixed.mat")
    np.testing.assert_allclose(found["t"][:, 0], [0, 0.1])
    assert found["echo_left"].shape[0] == 2


REFUSED = {
    "no call": (
        "silent.h5 -o x.mat --poses way.tum --odometry way.tum",
        1,
        "all chosen measurements of sensor left are passive and have no echoes",
    ),
    "no poses": ("left.h5 -o x.mat", 1, "left.h5 has no poses; add the true poses with --poses TRAJ,"),
    "several sensors": (
        "both.h5 -o x.mat --poses way.tum",
        2,
        "format batslam holds the echoes of one sensor, but there are left, right; choose one (--sensor)",
    ),
    "unknown sensor": ("both.h5 -o x.mat --sensor top", 2, "no recording has sensor 'top'; choose one of left, right"),
    "same sensor": ("both.h5 left.h5 -o x.mat --sensor left", 2, "contain the same sensor 'left';"),
    "poses of images": (
        "left.h5 -o x.csv --poses way.tum",
        2,
        "option --poses is given, but format 'csv' does not have it; leave",
    ),
    "ears of images": (
        "left.h5 -o x.csv --beam-azimuth 3",
        2,
        "option --beam-azimuth is given, but format 'csv' does not have it",
    ),
    "ears behind": ("left.h5 -o x.mat --beam-azimuth 95", 2, "-90.0<=x<=90.0"),
    "several files": ("left.h5 right.h5 -o x.csv", 2, "format csv exports one recording, but 2 are given; choose one"),
    "points": (
        "left.h5 -o x.mat --top 3 --poses way.tum --odometry way.tum",
        2,
        "option --top is given, but format 'batslam' does not have it",
    ),
    "no trajectory": ("left.h5 -o x.mat --poses none.tum", 1, "none.tum does not exist"),
    "mountings": (
        "both.h5 -o x.mat --poses way.tum --sensor left",
        1,
        "the mounting of sensor 'left' is unknown; add its mounting with --mounting FILE",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_export_command_explains_what_it_cannot_use(rig, name):
    arguments, code, message = REFUSED[name]
    done = run(*arguments.split(), folder=rig, code=code)
    assert message in done.stderr
    assert not (rig / "x.mat").exists()


def test_commands_and_code_of_the_format_page_run(folder, tmp_path):
    for name, source in {"DRIVE.h5": "drive.h5", "TRUE.tum": "true.tum", "WHEELS.tum": "true.tum"}.items():
        (tmp_path / name).symlink_to(folder / source)
    (tmp_path / "HALL.toml").symlink_to(folder / "scene.toml")
    (command,) = commands_in(PAGE)
    run_here(tmp_path, command)
    assert len(BatslamReader.of(tmp_path / "SET.mat").reflectors["type"]) == 8
    (code,) = python_in(PAGE)
    run_code_here(tmp_path, code)
    found = BatslamReader.of(tmp_path / "SET.mat")
    assert len(found.reflectors["type"]) == 0
    np.testing.assert_allclose(np.hypot(*found["odom_delta"][:, :2].T), np.hypot(*found["gt_delta"][:, :2].T))
