"""Images in level directions: a tilted sensor shows a reflector where it is relative to the horizontal plane."""

import json
import re
import warnings
from dataclasses import replace

import h5py
import numba
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from hypothesis import given, settings as hypothesis_settings, strategies as st
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba import figures, kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.memory import require_images
from ertis_numba.geometry import Grid, levelled_grid, unit_vectors
from ertis_numba.network.processing.shared_pipeline import SharedPipeline
from ertis_numba.passive import AcousticCamera
from ertis_numba.pipeline import verification
from ertis_numba.settings import Accuracy, Processing
from ertis_numba.simulation import Electronics, Point, Scene, Sensor
from ertis_numba.storage import open_energyscapes, open_recording, write_recording
from ertis_numba.storage.variables import to_python
from tests.publishing import results_of

pytestmark = pytest.mark.usefixtures("sound_unchecked")

TILTS_DEG = ((25.0, 0.0), (0.0, -15.0), (-20.0, 18.0))  # roll, pitch
YAW_DEG = 70.0
UNTURNED = (0.0, 0.0, 0.0, 1.0)
AZIMUTH_DEG, ELEVATION_DEG, RANGE_M = 24.0, 9.0, 1.6
GRID_STEP_DEG = 2.0


def attitude(roll_deg, pitch_deg, yaw_deg=YAW_DEG):
    """Rotation of a tilted sensor in the world; positive pitch turns the nose down."""
    return Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True)


def heard(roll_deg, pitch_deg, *, directions="3d:2000"):
    """Measurement of a reflector at a known level direction, by a tilted sensor at the origin."""
    level = unit_vectors(np.radians([AZIMUTH_DEG]), np.radians([ELEVATION_DEG]))[0]
    world = Rotation.from_euler("z", YAW_DEG, degrees=True).apply(RANGE_M * level)
    seen = attitude(roll_deg, pitch_deg).inv().apply(world)  # The scene is in the frame of the sensor.
    processing = Processing(
        directions=directions, azimuth_limits_deg=(-60.0, 60.0), elevation_limits_deg=(-45.0, 45.0), range_m=(1.2, 2.0)
    )
    sensor = Sensor(name="front", processing=processing, electronics=Electronics(noise_dbfs=-70.0))
    return ertis.render(Scene(seed=3, sensors=(sensor,), points=(Point(position_m=tuple(seen.tolist())),)))


def levelled(given):
    """Settings of a measurement or a recording, with level directions."""
    return given.settings.replace("processing.level_directions", True)  # noqa: FBT003  a value of a setting


def strongest(image):
    """Azimuth and elevation of the strongest echo in degrees, and its range."""
    direction, place = np.unravel_index(np.argmax(image.amplitude), image.amplitude.shape)
    return image.azimuth_deg[direction], image.elevation_deg[direction], image.range_m[place]


def angle_off_deg(image):
    azimuth_deg, elevation_deg, _ = strongest(image)
    found, true = unit_vectors(np.radians([azimuth_deg, AZIMUTH_DEG]), np.radians([elevation_deg, ELEVATION_DEG]))
    return float(np.degrees(np.arccos(np.clip(found @ true, -1.0, 1.0))))


def cell_deg(grid):
    """Side of the cells of an image in degrees."""
    area = np.ptp(grid.azimuth_rad) * np.ptp(np.sin(grid.elevation_rad))
    return float(np.degrees(np.sqrt(area / len(grid))))


@pytest.mark.parametrize("device", ["cpu", "numpy"])
@pytest.mark.parametrize("tilt_deg", TILTS_DEG)
def test_reflector_appears_in_its_level_direction(tilt_deg, device):
    """The strongest direction is less than a cell away, on the processor and for the definition in NumPy."""
    measurement = heard(*tilt_deg)
    with ertis.Pipeline(levelled(measurement), device, predict=False) as pipeline:
        image = pipeline.process(measurement, attitude_xyzw=attitude(*tilt_deg).as_quat())
        grid = pipeline.grid
    with ertis.Pipeline(measurement.settings, device, predict=False) as plain:
        untouched = plain.process(measurement)
    assert angle_off_deg(image) < cell_deg(grid)
    assert angle_off_deg(untouched) > 4 * cell_deg(grid)
    assert strongest(image)[2] == pytest.approx(RANGE_M, abs=0.02)
    assert image.settings.processing.level_directions
    assert np.array_equal(image.azimuth_rad, untouched.azimuth_rad)


@pytest.mark.parametrize("device", ["cpu", "numpy"])
def test_method_of_the_paper_is_levelled_as_well(device):
    measurement = heard(*TILTS_DEG[2], directions="3d:500")
    settings = levelled(measurement).replace("processing.method", "paper")
    with ertis.Pipeline(settings, device, predict=False) as pipeline:
        image = pipeline.process(measurement, attitude_xyzw=attitude(*TILTS_DEG[2]).as_quat())
        tilted = pipeline.process(measurement, attitude_xyzw=UNTURNED)
        assert angle_off_deg(image) < cell_deg(pipeline.grid) < angle_off_deg(tilted)


def test_plane_of_a_tilted_sensor_becomes_horizontal():
    """A planar image of a sensor that looks down 15° misses an echo at its own height, unless it is levelled."""
    level = unit_vectors(np.radians([AZIMUTH_DEG]), np.zeros(1))[0] * RANGE_M
    seen = attitude(0.0, 15.0, 0.0).inv().apply(level)
    sensor = Sensor(name="front", processing=Processing(directions="2d:91", range_m=(1.2, 2.0)))
    measurement = ertis.render(Scene(sensors=(sensor,), points=(Point(position_m=tuple(seen.tolist())),)))
    with ertis.Pipeline(levelled(measurement), "cpu", predict=False) as pipeline:
        image = pipeline.process(measurement, attitude_xyzw=attitude(0.0, 15.0).as_quat())
        tilted = pipeline.process(measurement, attitude_xyzw=UNTURNED)
    assert image.is_planar
    assert strongest(image)[0] == pytest.approx(AZIMUTH_DEG, abs=GRID_STEP_DEG)
    assert image.amplitude.max() > 1.5 * tilted.amplitude.max()


METHODS = {
    "16 bits": {},
    "plane of directions": {"processing.directions": "2d:700"},
    "single precision": {"accuracy": Accuracy(precision="float32", oversampling=4, delay_taps=2, beam_taps=4)},
    "exact delays": {"accuracy.delay_taps": 0},
    "spherical wavefronts": {"processing.wavefront": "spherical"},
    "DMAS": {"processing.beamformer": "dmas"},
    "coherence factor": {"processing.weighting": "coherence_factor"},
    "Capon": {"processing.beamformer": "capon"},
    "DMAS of all microphones": {
        "processing.beamformer": "dmas",
        "accuracy": Accuracy(precision="float32", delay_taps=1, beam_taps=0),
    },
    "paper": {"processing.method": "paper"},
}
DEVICES = [name for name in kernels.usable() if name != "numpy"]


def turned_directions(grid, attitude_xyzw):
    """Level directions in the frame of the sensor, as the setting lists them."""
    turned, _ = levelled_grid(grid, attitude_xyzw)
    return np.column_stack([turned.azimuth_deg, turned.elevation_deg])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("method", METHODS)
def test_one_pipeline_levels_images_as_one_pipeline_per_attitude(method, device):
    """The reference computes all tables from the turned directions; both images stay within the error budget.

    The attitudes alternate, so that tables left over from another attitude would change the image.
    """
    measurement = heard(*TILTS_DEG[2], directions="3d:300")
    settings = levelled(measurement).replace("processing.range_m", (1.4, 1.75)).replace(**METHODS[method])
    budget_db = settings.accuracy.max_error_db
    turn, other_turn = (attitude(*tilt).as_quat() for tilt in TILTS_DEG[1:])
    with ertis.Pipeline(settings, device, predict=False) as pipeline:
        image, _, again = (
            pipeline.process(measurement, attitude_xyzw=each).amplitude for each in (turn, other_turn, turn)
        )
        grid = pipeline.grid
    assert np.array_equal(image, again)
    listed = settings.replace(
        **{"processing.level_directions": False, "processing.directions": turned_directions(grid, turn)}
    )
    with ertis.Pipeline(listed, device, predict=False) as reference:
        wanted = reference.process(measurement).amplitude
    tolerance = 1e-5 if method == "paper" else 10 ** (budget_db / 20)
    assert np.linalg.norm(image - wanted) < tolerance * np.linalg.norm(wanted)


@pytest.mark.parametrize("directions", ["2d:700", "3d:900"])
def test_levelled_images_keep_the_budget_at_a_small_tilt(directions):
    """Level directions of ``2d`` lie on one row of the beam grid, tilted ones between rows."""
    measurement = heard(*TILTS_DEG[2], directions=directions)
    settings = levelled(measurement).replace("processing.range_m", (1.4, 1.75))
    with ertis.Pipeline(settings, "cpu", predict=False) as pipeline:
        budget_db, grid = pipeline.settings.accuracy.max_error_db, pipeline.grid
        turn = attitude(0.5, 1.5).as_quat()
        image, (turned, _) = pipeline.process(measurement, attitude_xyzw=turn), levelled_grid(grid, turn)
    in_frame = image.replace(azimuth_rad=turned.azimuth_rad, elevation_rad=turned.elevation_rad)
    assert verification.measure(in_frame, measurement).error_db < budget_db


@pytest.mark.parametrize("method", ["16 bits", "exact delays", "DMAS"])
def test_streamed_measurement_has_the_same_level_image(method):
    measurement = heard(*TILTS_DEG[2], directions="3d:300")
    settings = levelled(measurement).replace(**METHODS[method])
    turns = [attitude(*tilt).as_quat() for tilt in TILTS_DEG]
    words = measurement.data
    with ertis.Pipeline(settings, "cpu", predict=False) as pipeline:
        stream = pipeline.stream()
        for turn in turns:
            for first in range(0, len(words), 20_000):
                stream.add(first, words[first : first + 20_000])
            image = pipeline.process(measurement, stream=stream, attitude_xyzw=turn)
            wanted = pipeline.process(measurement, attitude_xyzw=turn)
            assert np.array_equal(image.amplitude, wanted.amplitude)
        with (
            ertis.Pipeline(settings, "cpu", predict=False) as other,
            pytest.raises(ertis.ArgumentError, match="stream belongs to another pipeline"),
        ):
            other.process(measurement, stream=stream, attitude_xyzw=turns[0])


def test_words_that_differ_from_a_stream_cause_no_second_computation_of_tables(monkeypatch):
    measurement = heard(*TILTS_DEG[2], directions="3d:300")
    turn = attitude(*TILTS_DEG[0]).as_quat()
    with ertis.Pipeline(levelled(measurement), "cpu", predict=False) as pipeline:
        wanted = pipeline.process(measurement, attitude_xyzw=turn)
        stream, turned = pipeline.stream(), results_of(monkeypatch, FastChain, "_turned")
        stream.add(0, ~measurement.data[:20_000])
        image = pipeline.process(measurement, stream=stream, attitude_xyzw=turn)
    assert np.array_equal(image.amplitude, wanted.amplitude)
    assert len(turned) == 1


@pytest.mark.parametrize(("device", "chosen"), [("numpy", "numpy"), ("cpu", "auto")])
def test_tables_are_computed_by_the_kernels_and_threads_of_the_pipeline(device, chosen, monkeypatch):
    """Without this limit, kernels could run in several threads at once, which Numba's workqueue refuses."""
    measurement, used = heard(*TILTS_DEG[2], directions="3d:300"), []

    def load(name="auto"):
        steering = kernels.load_steering(name)

        def sum_polynomials(places, coefficients, out):
            used.append((name, numba.get_num_threads() if name == "auto" else 1))
            steering.sum_polynomials(places, coefficients, out)

        return replace(steering, sum_polynomials=sum_polynomials)

    monkeypatch.setattr("ertis_numba.chain.fast_chain.load_steering", load)
    settings = levelled(measurement).replace("processing.range_m", (1.4, 1.75))
    with ertis.Pipeline(settings, device, predict=False) as pipeline:
        pipeline.process(measurement, attitude_xyzw=attitude(*TILTS_DEG[0]).as_quat(), threads=1)
    assert set(used) == {(chosen, 1)}


@pytest.mark.parametrize("tilt_deg", [TILTS_DEG[2], (30.0, 60.0)])
@pytest.mark.parametrize("method", ["16 bits", "Capon", "coherence factor"])
def test_error_of_a_level_image_is_predicted_for_its_directions_in_the_sensor_frame(method, tilt_deg):
    """Errors computed for level directions, or for directions behind the sensor, would cause a false warning."""
    measurement = heard(*TILTS_DEG[2], directions="3d:300")
    settings = levelled(measurement).replace("processing.range_m", (1.4, 1.75)).replace(**METHODS[method])
    settings = settings.replace("processing.azimuth_limits_deg", (-90.0, 90.0))
    with ertis.Pipeline(settings, "cpu") as pipeline, warnings.catch_warnings():
        warnings.simplefilter("error", ertis.ErrorBudgetWarning)
        pipeline.process(measurement, attitude_xyzw=attitude(*tilt_deg).as_quat())
        prediction = pipeline.prediction
    assert prediction.predicted_error_db < settings.accuracy.max_error_db


def test_pipeline_refuses_graphs_that_it_cannot_record():
    settings = levelled(heard(0.0, 0.0, directions="90"))
    for wrong, message in (
        (True, r"^graphs is True, but with processing\.level_directions"),
        ("yes", "^graphs is 'yes'; pass True, False or None$"),
    ):
        with pytest.raises(ertis.ArgumentError, match=message):
            ertis.Pipeline(settings, "cpu", graphs=wrong)


angles_deg = st.floats(-80.0, 80.0)


@hypothesis_settings(max_examples=100, derandomize=True, deadline=None)
@given(angles_deg, angles_deg, st.floats(-180.0, 180.0))
def test_turned_directions_point_to_the_same_places(roll_deg, pitch_deg, yaw_deg):
    """Each direction, turned into the world by the sensor, is the level direction turned by its heading alone."""
    rng = np.random.default_rng(1)
    grid = Grid(rng.uniform(-np.pi, np.pi, 50), rng.uniform(-1.5, 1.5, 50))
    rotation = attitude(roll_deg, pitch_deg, yaw_deg)
    turned, is_behind = levelled_grid(grid, rotation.as_quat())
    level = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    seen = unit_vectors(turned.azimuth_rad, turned.elevation_rad)
    heading = Rotation.from_euler("z", yaw_deg, degrees=True)
    np.testing.assert_allclose(rotation.apply(seen), heading.apply(level), atol=1e-9)
    assert np.array_equal(is_behind, (level[:, 0] >= -1e-9) & (seen[:, 0] < -1e-9))


def test_directions_behind_a_tilted_sensor_are_silent():
    """A planar array that looks up 30° would show echoes from above in directions far below the horizon."""
    measurement = heard(0.0, -30.0)
    settings = levelled(measurement).replace("processing.elevation_limits_deg", (-90.0, 90.0))
    with ertis.Pipeline(settings, "cpu", predict=False) as pipeline:
        image = pipeline.process(measurement, attitude_xyzw=attitude(0.0, -30.0).as_quat())
    is_behind = np.tan(image.elevation_rad) < -np.sqrt(3) * np.cos(image.azimuth_rad)
    assert 0 < is_behind.sum() < len(is_behind)
    assert not image.amplitude[is_behind].any()
    assert image.amplitude[~is_behind].any(axis=1).all()


MISSING = {
    "no attitude": lambda pipeline, measurement: pipeline.process(measurement),
    "batch": lambda pipeline, measurement: pipeline.process_batch([measurement]),
    "many": lambda pipeline, measurement: pipeline.process_many([measurement]),
}


@pytest.mark.parametrize("case", MISSING)
def test_pipeline_requires_an_attitude_for_level_directions(case):
    measurement = heard(0.0, 0.0, directions="90")
    with (
        ertis.Pipeline(levelled(measurement), "cpu", predict=False) as pipeline,
        pytest.raises(ertis.ArgumentError, match=r"level_directions is true, but no attitude is passed; pass the"),
    ):
        MISSING[case](pipeline, measurement)


def test_pipeline_refuses_attitudes_that_cannot_be_used():
    measurement = heard(0.0, 0.0, directions="90")
    with (
        ertis.Pipeline(measurement.settings, "cpu", predict=False) as pipeline,
        pytest.raises(ertis.ArgumentError, match=r"attitude_xyzw is given, but processing\.level_directions is false"),
    ):
        pipeline.process(measurement, attitude_xyzw=UNTURNED)
    with ertis.Pipeline(levelled(measurement), "cpu", predict=False) as pipeline:
        for wrong, message in (
            ((0, 0, 0, 2), "^attitude_xyzw has length 2; use a unit quaternion$"),
            ((0, 0, 1), r"^attitude_xyzw has shape \(3,\); pass shape \(4,\)$"),
            ((0, 0, 0, np.nan), r"^attitude_xyzw holds nan at \[3\]; pass finite numbers$"),
            ("level", "^attitude_xyzw is not made of numbers"),
            (attitude(0.0, 90.0).as_quat(), "looks straight up or down, so its images have no level"),
        ):
            with pytest.raises(ertis.ArgumentError, match=message):
                pipeline.process(measurement, attitude_xyzw=wrong)


def test_parts_that_need_the_frame_of_the_sensor_refuse_level_images():
    measurement = heard(0.0, 0.0, directions="90")
    settings = levelled(measurement)
    with ertis.Pipeline(settings, "cpu", predict=False) as pipeline:
        image = pipeline.process(measurement, attitude_xyzw=UNTURNED)
        with pytest.raises(ertis.ArgumentError, match="but beams are computed in the frame of the sensor"):
            pipeline.beams(measurement)
    mountings = {"front": ((0.0, 0.0, 0.0), UNTURNED)}
    with pytest.raises(ertis.ArgumentError, match="but fusion needs directions of each sensor"):
        ertis.Fuser(mountings)([image])
    with pytest.raises(ertis.ArgumentError, match="but odometry needs directions of each sensor"):
        ertis.Odometry(mountings).add([image])
    with pytest.raises(ertis.ArgumentError, match="but the ground truth is in the frame of the sensor"):
        ertis.compare(image, [])
    with pytest.raises(ertis.ArgumentError, match="but a mounting applies to directions in the frame of the sensor"):
        ertis.PointExtractor(settings)(image).on_platform_m()
    with pytest.raises(ertis.ArgumentError, match="but acoustic maps are means over measurements at several poses"):
        AcousticCamera(settings, "cpu")
    for refused in (require_images, lambda given: SharedPipeline(given.to_toml(), "cpu")):
        with pytest.raises(ertis.ArgumentError, match="but a central node does not know the poses of measurements"):
            refused(settings)
    with pytest.raises(ertis.ArgumentError, match=r"but the delays of processing\.delay_matrix cannot be turned"):
        Processing(level_directions=True, delay_matrix=((0.0,),), directions=((0.0, 0.0),))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording of three measurements by a sensor that tilts, with poses and a mounting that is turned as well."""
    path = tmp_path_factory.mktemp("level") / "tilted.h5"
    mounting = Rotation.from_euler("z", 30.0, degrees=True)
    measured = [
        replace(each, stamp=ertis.Stamp(sensor="front", sequence=number, timestamp_ns=100_000_000 * number))
        for number, each in enumerate(heard(*tilt) for tilt in TILTS_DEG)
    ]
    poses = ertis.Trajectory(
        [each.stamp.timestamp_ns for each in measured],
        np.zeros((3, 3)),
        [(attitude(*tilt) * mounting.inv()).as_quat() for tilt in TILTS_DEG],
    )
    return write_recording(path, measured, mounting={"front": ((0.1, 0.0, 0.0), mounting.as_quat())}, poses=poses)


def process(path, *options, code=0):
    done = CliRunner().invoke(cli, ["process", str(path), *options, "--device", "cpu"])
    assert done.exit_code == code, done.output
    return done


def test_command_levels_the_images_of_a_recording(recording, tmp_path):
    process(recording, "--level", "-o", str(tmp_path / "level.h5"), "--json")
    process(recording, "-o", str(tmp_path / "plain.h5"), "-q")
    with open_energyscapes(tmp_path / "level.h5") as images, open_energyscapes(tmp_path / "plain.h5") as plain:
        assert images.settings.processing.level_directions
        assert [angle_off_deg(image) < 2.4 for image in images] == [True] * 3
        assert [angle_off_deg(image) < 10.0 for image in plain] == [False] * 3
    with h5py.File(tmp_path / "level.h5") as level, h5py.File(tmp_path / "plain.h5") as plain:
        for name in ("azimuth", "elevation"):
            comment = to_python(level["sensors/front"][name].attrs["comment"])
            assert (
                comment
                == "relative to the horizontal plane and to the heading of the sensor (processing.level_directions)"
            )
            assert "comment" not in plain["sensors/front"][name].attrs


def test_picture_states_that_directions_are_level():
    measurement = heard(0.0, 0.0, directions="90")
    with ertis.Pipeline(levelled(measurement), "cpu", predict=False) as pipeline:
        image = pipeline.process(measurement, attitude_xyzw=UNTURNED)
    plain = image.replace(settings=measurement.settings)
    for each, is_stated in ((image, True), (plain, False)):
        texts = " ".join(text.get_text() for text in figures.plot(each).texts)
        assert ("directions relative to the horizontal" in texts) == is_stated


def test_fused_images_cannot_be_levelled(recording, tmp_path):
    done = CliRunner().invoke(cli, ["fuse", str(recording), "--level", "-o", str(tmp_path / "fused.h5")])
    assert done.exit_code == 2
    assert "No such option '--level'" in done.stderr


def test_setting_of_the_recording_levels_its_images(recording, tmp_path):
    with open_recording(recording) as reader:
        own = write_recording(tmp_path / "own.h5", reader, settings=levelled(reader))
    process(own, "-o", str(tmp_path / "level.h5"), "-q")
    process(own, "--no-level", "-o", str(tmp_path / "plain.h5"), "-q")
    with open_energyscapes(tmp_path / "level.h5") as images, open_energyscapes(tmp_path / "plain.h5") as plain:
        assert angle_off_deg(images[2]) < 2.4
        assert angle_off_deg(plain[2]) > 10.0


def test_checks_of_the_plan_apply_to_levelled_images(recording, tmp_path):
    options = ["--directions", "3d:300", "--verify", "--explain", "-o", str(tmp_path / "level.h5"), "--json"]
    done = process(recording, "--level", *options)
    report = json.loads(done.stdout)
    with open_energyscapes(tmp_path / "level.h5") as images:
        budget_db = images.settings.accuracy.max_error_db
    assert report["sensors"][0]["verified"]["error_db"] < budget_db


def test_command_names_measurements_without_pose_once(recording, tmp_path):
    with open_recording(recording) as reader:
        poses = ertis.Trajectory([-1, 150_000_000], np.zeros((2, 3)), [UNTURNED] * 2, max_gap_s=1.0)
        place = {"front": (reader.translation_m, reader.rotation_xyzw)}
        part = write_recording(tmp_path / "part.h5", list(reader), poses=poses, mounting=place)
        none = write_recording(tmp_path / "none.h5", list(reader), mounting=place)
        unmounted = write_recording(tmp_path / "unmounted.h5", list(reader), poses=reader.trajectory)
    for path, message in (
        (part, "part.h5: sensor front has no pose at 1 of 3 measurements; add poses with 'ertis import poses'"),
        (none, "none.h5: sensor front has no pose at 3 of 3 measurements; add poses with 'ertis import poses'"),
        (
            unmounted,
            "unmounted.h5: sensor front has no mounting, so its attitude is unknown; add its mounting (--mounting)",
        ),
    ):
        done = process(path, "--level", "-o", str(tmp_path / "out.h5"), code=1)
        assert len(re.findall(re.escape(message), done.stderr)) == 1, done.stderr
        assert not (tmp_path / "out.h5").exists()


def test_levelled_file_has_no_ground_truth_of_another_frame(tmp_path):
    (tmp_path / "scene.toml").write_text("[[points]]\nrange_m = 1.5\n")
    path = tmp_path / "rec.h5"
    done = CliRunner().invoke(cli, ["simulate", str(tmp_path / "scene.toml"), "-o", str(path), "-q"])
    assert done.exit_code == 0, done.output
    with open_recording(path) as reader:
        assert reader.truth is not None
        time_ns = reader[0].stamp.timestamp_ns
    ertis.add_poses(path, ertis.Trajectory([time_ns - 1, time_ns + 10**10], np.zeros((2, 3)), [UNTURNED] * 2))
    process(path, "--level", "-o", str(tmp_path / "img.h5"), "-q")
    for arguments, message in (
        (
            ["compare"],
            "but the ground truth is in the frame of the sensor; process again without levelled directions",
        ),
        (["export", "-o", str(tmp_path / "img.mcap")], "but messages of ROS are in the frame of the sensor"),
    ):
        done = CliRunner().invoke(cli, [arguments[0], str(tmp_path / "img.h5"), *arguments[1:]])
        assert done.exit_code == 1
        assert message in done.stderr
