"""Fusion of images of several sensors: foreign echoes, positions, geometry and bad input."""

import csv
import dataclasses
import functools
import json
import math

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_bench.platform_trials.platform_scenes import platform_scene, random_reflectors
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.fusion.pairs import hypothesis, pair_of
from ertis_numba.fusion.polar_grid import PolarGrid, close_directions
from ertis_numba.fusion.receivers import Receiver
from ertis_numba.fusion.rig import Emitters, mounted_sensors
from ertis_numba.fusion.tables import FusionTables
from ertis_numba.geometry.air import absorption_db_m
from ertis_numba.settings import Call, Processing
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from ertis_numba.viewer._choices import Choices
from ertis_numba.viewer._scene import ViewedScene
from ertis_numba.viewer._shapes import Pose, ReceivedImage
from tests.pages import commands_in, page, python_in, run_code_here, run_here
from tests.scenes import only

YAWS = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
PLACES_M = ((1.5, 0.3), (1.1, 1.0), (-0.4, 1.6), (-1.7, -0.9), (0.5, -1.2))


@functools.cache
def scene(*, diameter_m=0.012):
    sensors = tuple(
        Sensor(
            name=name,
            position_m=(0.2 * math.cos(math.radians(yaw)), 0.2 * math.sin(math.radians(yaw)), 0.4),
            yaw_deg=yaw,
            processing=Processing(range_m=(0.3, 2.5), directions="90"),
            emitter=Emitter(level_db=-24.0, diameter_m=diameter_m),
            electronics=Electronics(noise_dbfs=-60.0),
        )
        for name, yaw in YAWS.items()
    )
    points = tuple(Point(position_m=(x, y, 0.4), strength_db=-6.0) for x, y in PLACES_M)
    return Scene(seed=5, sensors=sensors, points=points)


@functools.cache
def images():
    found = {}
    for sensor in scene().sensors:
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            found[sensor.name] = pipeline.process(ertis.render(scene(), sensor=sensor.name))
    return found


def mountings():
    return {sensor.name: (sensor.position_m, sensor.quaternion()) for sensor in scene().sensors}


@functools.cache
def fused():
    return ertis.fuse(images().values(), mountings())


def highest(image, x, y, within_m=0.06):
    """Return the highest amplitude near a place on the platform."""
    place = image.range_m[:, None] * np.exp(1j * image.azimuth_rad)
    return float(image.amplitude.T[np.abs(place - complex(x, y)) < within_m].max())


def foreign_places():
    """Return the places at which single images show foreign echoes, far from all reflectors."""
    found = []
    for sensor in scene().sensors:
        for echo in ertis.Simulator(scene(), sensor=sensor.name).reflectors():
            # A flat array shows sound from behind in front.
            azimuth_deg = echo.azimuth_deg if abs(echo.azimuth_deg) <= 90 else 180 - echo.azimuth_deg
            turn = math.radians(azimuth_deg + sensor.yaw_deg)
            x = sensor.position_m[0] + echo.range_m * math.cos(turn)
            y = sensor.position_m[1] + echo.range_m * math.sin(turn)
            is_apart = all(
                abs(math.hypot(x, y) - math.hypot(*place)) > 0.12
                or abs(np.angle(complex(x, y) / complex(*place))) > math.radians(25)
                for place in PLACES_M
            )
            if echo.emitter and echo.level_db > -12 and 0.4 < echo.range_m < 2.4 and is_apart:
                found.append((sensor, azimuth_deg, echo.range_m, x, y))
    return found


def test_fused_image_suppresses_foreign_echoes():
    places = foreign_places()
    assert len(places) >= 4
    reference = max(highest(fused().image, *place) for place in PLACES_M)
    shown = []
    for sensor, azimuth_deg, range_m, x, y in places:
        single = images()[sensor.name].select(
            azimuth_deg=(azimuth_deg - 4, azimuth_deg + 4), range_m=(range_m - 0.05, range_m + 0.05)
        )
        # The same echo at 1 m, if it were the sensor's own.
        shown.append((highest(fused().image, x, y), float(single.amplitude.max()) * range_m**2))
    levels = np.array(shown)
    assert np.all(levels[:, 0] < 10 ** (-15 / 20) * reference)
    assert np.sum(levels[:, 0] ** 2) < 10 ** (-20 / 10) * np.sum(levels[:, 1] ** 2)


def test_peaks_of_the_fused_image_are_its_points():
    fused = ertis.fuse(list(images().values()), mountings())
    listed = fused.points.strongest(10, -30.0)
    peaks = ertis.find_peaks(fused.image)
    assert [peak.range_m for peak in peaks] == pytest.approx(np.hypot(*listed.position_m[:, :2].T).tolist())


def test_power_of_a_pixel_counts_once(monkeypatch):
    """Power that no reflector explains is no echo of several emitters at once."""
    kept = []
    monkeypatch.setattr(FusionTables, "pulse_reflectors", lambda *given: kept.append(given[2].shares))
    monkeypatch.setattr(FusionTables, "points", lambda *_: None)
    _ = ertis.fuse(images().values(), mountings()).points
    for receiver in range(len(YAWS)):
        total = sum(share for (_, number), share in kept[0].items() if number == receiver)
        assert total.max() == pytest.approx(1, abs=1e-6)


def test_fused_points_are_the_reflectors():
    positions_m = fused().points.position_m
    for place in PLACES_M:
        offset_m = np.hypot(*(positions_m[:, :2] - place).T)
        nearest = int(np.argmin(offset_m))
        assert offset_m[nearest] < 0.02
        assert abs(positions_m[nearest, 2] - 0.4) < 0.05
    assert len(positions_m) == len(PLACES_M)


DELAYS_S = {"front": 0.0, "left": 3e-3, "back": 6e-3, "right": 9e-3}


@functools.cache
def sequence():
    """A scene whose sensors emit in sequence, and their images."""
    sensors = tuple(each.replace(call=each.call.replace(delay_s=DELAYS_S[each.name])) for each in scene().sensors)
    made, found = scene().replace(sensors=sensors), {}
    for sensor in sensors:
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            found[sensor.name] = pipeline.process(ertis.render(made, sensor=sensor.name))
    return made, found


def test_echoes_of_calls_in_sequence_have_the_ranges_of_the_truth():
    sensors = tuple(
        Sensor(
            name=name,
            position_m=(0.0, y, 0.0),
            call=Call(delay_s=delay_s),
            processing=Processing(range_m=(0.4, 2.5), directions="90"),
            emitter=Emitter(level_db=-24.0),
        )
        for name, y, delay_s in (("first", 0.15, 0.0), ("second", -0.15, 3e-3))
    )
    made = Scene(sensors=sensors, points=(Point(position_m=(1.3, 0.1, 0.0)),))
    for sensor, way in zip(sensors, (1, -1), strict=True):
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            image = pipeline.process(ertis.render(made, sensor=sensor.name))
        echoes = [each for each in ertis.Simulator(made, sensor=sensor.name).reflectors() if "points" in each.name]
        own, foreign = echoes
        assert foreign.range_m - own.range_m == pytest.approx(way * 3e-3 * 343.4 / 2, abs=0.02)
        for echo in (own, foreign):
            along = image.select(azimuth_deg=(echo.azimuth_deg - 3, echo.azimuth_deg + 3)).amplitude.max(axis=0)
            near = np.abs(image.range_m - echo.range_m) < 0.05
            assert image.range_m[near][along[near].argmax()] == pytest.approx(echo.range_m, abs=0.004)


def test_calls_in_sequence_are_fused_by_their_delays_in_the_settings():
    _, found = sequence()
    fuser = ertis.Fuser(mountings())
    result = fuser(found.values())
    for place in PLACES_M:
        assert np.hypot(*(result.points.position_m[:, :2] - place).T).min() < 0.02
    assert len(result.points) == len(PLACES_M)
    assert result.unheard == ()
    assert ghosts(result.image) < 0.1 * ghosts(fuser(without_delays(found)).image)
    assert np.array_equal(fuser(found.values()).image.amplitude, result.image.amplitude)


def test_process_fuses_calls_in_sequence_like_python(tmp_path):
    made, found = sequence()
    names = "front", "left"
    places = {name: mountings()[name] for name in names}
    measurements = [ertis.render(made, sensor=name) for name in names]
    write_recording(tmp_path / "two.h5", measurements, mounting=places)
    arguments = ["fuse", str(tmp_path / "two.h5"), "-o", str(tmp_path / "fused.h5"), "-q"]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.output
    with open_energyscapes(tmp_path / "fused.h5") as reader:
        amplitude = reader[0].amplitude
    expected = ertis.fuse([found[name] for name in names], places).image.amplitude
    np.testing.assert_allclose(amplitude, expected, rtol=1e-5)


def test_delay_of_a_sensor_that_appears_later_is_used():
    _, found = sequence()
    fuser = ertis.Fuser(mountings())
    fuser([found["front"], found["left"]])
    result = fuser(found.values())
    whole = ertis.fuse(found.values(), mountings())
    np.testing.assert_array_equal(result.image.amplitude, whole.image.amplitude)


def without_delays(found):
    for image in found.values():
        yield image.replace(settings=image.settings.replace(call=image.settings.call.replace(delay_s=0.0)))


def ghosts(image):
    """Return the power of a fused image apart from the reflectors, relative to that near them."""
    place = image.range_m * np.exp(1j * image.azimuth_rad)[:, None]
    is_near = np.zeros(place.shape, bool)
    for x, y in PLACES_M:
        apart = np.abs(np.angle(place / complex(x, y))) < math.radians(25)
        is_near |= apart & (np.abs(np.abs(place) - math.hypot(x, y)) < 0.12)
    power = image.amplitude.astype(np.float64) ** 2
    return power[~is_near].sum() / power[is_near].sum()


def test_points_seen_by_two_sensors_are_more_precise():
    """The point at 42° lies between two sensors, and its distance from both determines its direction."""
    alone = ertis.fuse([images()["front"]], {"front": mountings()["front"]}).points
    across_m = []
    for cloud in (fused().points, alone):
        here = int(np.argmin(np.hypot(*(cloud.position_m[:, :2] - PLACES_M[1]).T)))
        across_m.append(cloud.uncertainty_m[here, 1])
    assert across_m[0] < 0.8 * across_m[1]


def test_echoes_from_behind_of_an_opposite_emitter_make_points_more_precise():
    """Two back-to-back sensors hear the same call; the difference of their ranges also shows the elevation."""
    alone = scene().replace(
        sensors=tuple(sensor for sensor in scene().sensors if sensor.name in {"front", "back"}),
        points=(Point(position_m=(1.5, 0.0, 0.4), strength_db=-6.0),),
    )
    shown = {}
    for sensor in alone.sensors:
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            shown[sensor.name] = pipeline.process(ertis.render(alone, sensor=sensor.name))
    places = {name: each for name, each in mountings().items() if name in shown}
    both, one = ertis.fuse(shown.values(), places).points, ertis.fuse([shown["front"]], places).points
    assert len(both) == len(one) == 1
    assert 1e-4 < both.uncertainty_m[0, 0] < 1.1 * one.uncertainty_m[0, 0] / math.sqrt(2)
    assert abs(both.position_m[0, 0] - 1.5) < 3 * both.uncertainty_m[0, 0]


def test_amplitude_does_not_depend_on_the_number_of_sensors():
    levels_db = 20 * np.log10([highest(fused().image, *place) for place in PLACES_M])
    between = 1  # The second reflector lies between two sensors, whose echoes of both calls interfere.
    assert np.ptp(np.delete(levels_db, between)) < 1.0  # All strengths are equal.
    assert abs(levels_db[between] - np.median(levels_db)) < 6.0


def test_missing_sensor_is_reported_and_still_emits():
    three = [image for name, image in images().items() if name != "left"]
    result = ertis.fuse(three, mountings())
    assert (result.sensors, result.missing) == (("front", "back", "right"), ("left",))
    assert 20 * math.log10(highest(result.image, *PLACES_M[0]) / highest(fused().image, *PLACES_M[0])) > -3


SCENES = (1000, 1001, 1002, 1003)


@functools.cache
def recorded(seed, diameter_m):
    """Images of a random platform scene, with the mountings and places of its reflectors."""
    made, group, plan = platform_scene(seed, random_reflectors(seed), diameter_m), [], only(*EFFECTS)
    for sensor in made.sensors:
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            group.append(pipeline.process(ertis.Simulator(made, sensor=sensor.name, plan=plan).render()))
    return group, {sensor.name: (sensor.position_m, sensor.quaternion()) for sensor in made.sensors}


@pytest.mark.parametrize("diameter_m", [0.0, 0.012])
@pytest.mark.parametrize("seed", SCENES)
def test_sensor_without_an_image_is_not_unheard(seed, diameter_m):
    group, mounted = recorded(seed, diameter_m)
    fuser = ertis.Fuser(mounted)
    for missing in group:
        heard = [image for image in group if image is not missing]
        assert fuser(heard).unheard == (), missing.stamp.sensor


def test_order_of_images_does_not_matter():
    other = ertis.fuse(reversed(list(images().values())), mountings())
    np.testing.assert_array_equal(other.image.amplitude, fused().image.amplitude)


def test_fuser_repeats_its_result():
    fuser = ertis.Fuser(mountings())
    first, second = fuser(images().values()), fuser(images().values())
    np.testing.assert_array_equal(first.image.amplitude, second.image.amplitude)


def test_silent_sensors_only_listen():
    fuser = ertis.Fuser(mountings(), silent=["front", "left", "back", "right"])
    assert not fuser(images().values()).image.amplitude.any()


def test_passive_measurement_is_no_emission():
    """The image of a sensor that did not emit shows foreign echoes only."""
    group = [
        image.replace(stamp=dataclasses.replace(image.stamp, behaviour="passive" if name == "left" else "active"))
        for name, image in images().items()
    ]
    result = ertis.fuse(group, mountings())
    silent = ertis.Fuser(mountings(), silent=["left"])(images().values())
    np.testing.assert_array_equal(result.image.amplitude, silent.image.amplitude)


def test_emitter_that_nobody_hears_hides_no_reflector():
    """Missing echoes of a broken emitter must not show that its surroundings are empty."""
    whole = scene(diameter_m=0.0)
    broken = whole.replace(
        sensors=tuple(
            sensor.replace(emitter=sensor.emitter.replace(silent=sensor.name == "left")) for sensor in whole.sensors
        )
    )
    group = []
    for sensor in broken.sensors:
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            image = pipeline.process(ertis.render(broken, sensor=sensor.name))
        group.append(image.replace(stamp=dataclasses.replace(image.stamp, behaviour="active")))  # as it believes
    result = ertis.fuse(group, mountings(), emitter_diameter_m=0.0)
    assert result.unheard == ("left",)
    assert fused().unheard == ()
    beside = 1  # The reflector between front and left.
    assert 20 * math.log10(highest(result.image, *PLACES_M[beside]) / highest(fused().image, *PLACES_M[beside])) > -6


def test_ghosts_do_not_make_a_sensor_unheard():
    """In this scene, only ghosts are strong where others should hear the front sensor, which emits first."""
    made = platform_scene(1003, random_reflectors(1003), 0.012)
    sensors = tuple(
        each.replace(call=each.call.replace(delay_s=4e-3 * place)) for place, each in enumerate(made.sensors)
    )
    made, group = made.replace(sensors=sensors), []
    for sensor in made.sensors:
        with ertis.Pipeline(sensor.settings(), predict=False) as pipeline:
            group.append(pipeline.process(ertis.render(made, sensor=sensor.name)))
    mounted = {sensor.name: (sensor.position_m, sensor.quaternion()) for sensor in made.sensors}
    assert ertis.fuse(group, mounted).unheard == ()


def test_calls_that_differ_are_not_mixed_up():
    group = dict(images())
    other = group["left"].settings
    group["left"] = group["left"].replace(
        settings=other.replace(call=other.call.replace(start_frequency_hz=25e3, stop_frequency_hz=50e3))
    )
    fuser = ertis.Fuser(mountings())
    result = fuser(group.values())
    assert result.sensors == ("front", "left", "back", "right")
    assert highest(result.image, *PLACES_M[2]) > 0


def render_with(settings, sensor):
    measurement = ertis.render(scene(), sensor=sensor)
    return ertis.Measurement(measurement.data, settings, measurement.stamp)


def test_images_in_three_dimensions_are_fused():
    group = []
    for sensor in scene().sensors[:2]:
        settings = sensor.settings().replace(
            processing=Processing(range_m=(0.3, 2.5), directions="3d:400", elevation_limits_deg=(-40.0, 40.0))
        )
        with ertis.Pipeline(settings, predict=False) as pipeline:
            group.append(pipeline.process(render_with(settings, sensor.name)))
    result = ertis.Fuser(mountings(), spacing_deg=6.0, range_step_m=0.04)(group)
    assert not result.image.is_planar
    best = np.unravel_index(np.argmax(result.image.amplitude), result.image.amplitude.shape)
    assert abs(result.image.elevation_deg[best[0]]) < 10
    assert result.missing == ("back", "right")


@pytest.mark.parametrize("emitter", [0, 1, 2])
@pytest.mark.parametrize("seed", range(3))
def test_pixels_of_a_reflector_lead_back_to_its_cell(emitter, seed):
    """Positions to pixels, and pixels to positions, are inverse to each other."""
    sensors = mounted_sensors(mountings())
    image = images()["front"]
    receiver = Receiver(sensors[0], image, 0.015)
    emitters = Emitters(image.settings, [0.0] * 4)
    grid = PolarGrid.around(1.0, 0.015, 2.9, is_planar=True, height_m=0.4)
    draws = np.random.default_rng(seed)
    azimuth_rad = draws.uniform(-1.2, 1.2, 50)
    places_m = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad), np.zeros(50)], axis=1)
    places_m = places_m * draws.uniform(0.8, 2.0, (50, 1)) + sensors[0].translation_m
    deaf = np.zeros(receiver.n_steps, dtype=bool)
    pair = pair_of(places_m, sensors, emitters, receiver, emitter=emitter, number=0, late_m=0.0, deaf=deaf)
    back = hypothesis(grid, sensors, emitters, receiver, emitter=emitter, late_m=0.0, is_mirrored=False)
    nearest = np.where(pair.share > 0.5, pair.second, pair.first)
    cells_m = grid.positions_m[back.cell[nearest]]
    assert len(pair.cell) == 50
    assert np.max(np.linalg.norm(cells_m - places_m[pair.cell], axis=1)) < 0.09  # half a direction at 2 m, and a step


@pytest.mark.parametrize("diameter_m", [0.0, 0.012])
def test_fusion_uses_the_emitters_of_the_settings(diameter_m):
    """Images of scenes carry the diameter of the emitter, and a given one replaces it."""
    group = [of_emitter(image, diameter_m) for image in images().values()]
    found, told = ertis.fuse(group, mountings()), ertis.fuse(group, mountings(), emitter_diameter_m=diameter_m)
    other = ertis.fuse(group, mountings(), emitter_diameter_m=0.012 - diameter_m)
    np.testing.assert_array_equal(found.image.amplitude, told.image.amplitude)
    assert not np.array_equal(found.image.amplitude, other.image.amplitude)
    assert all(image.settings.array.emitter_diameter_m == 0.012 for image in images().values())


def test_fuser_follows_a_change_of_emitters():
    fuser = ertis.Fuser(mountings())
    for diameter_m in (0.012, 0.0, None):
        group = [of_emitter(image, diameter_m) for image in images().values()]
        assert not fuser.has_tables(group) or diameter_m is None
        wanted = ertis.fuse(group, mountings(), emitter_diameter_m=0.012 if diameter_m is None else diameter_m)
        np.testing.assert_array_equal(fuser(group).image.amplitude, wanted.image.amplitude)
        assert fuser.has_tables(group)


def test_emitters_of_one_platform_may_differ():
    """The front sensor does not hear the call of a piston that faces away, but that of an omnidirectional emitter."""
    emitters = Emitters(images()["front"].settings, [0.012, 0.012, 0.0, 0.012])
    power = [float(emitters.power(np.array(-1.0), number)) for number in range(4)]
    assert np.round(power, 3).tolist() == [0.001, 0.001, 1.0, 0.001]


def of_emitter(image, diameter_m):
    return image.replace(settings=image.settings.replace("array.emitter_diameter_m", diameter_m))


def test_cell_of_is_the_inverse_of_positions():
    for is_planar in (True, False):
        grid = PolarGrid.around(5.0, 0.1, 2.0, is_planar=is_planar, height_m=0.3)
        np.testing.assert_array_equal(grid.cell_of(grid.positions_m), np.arange(grid.n_cells))


def test_close_directions_contain_the_direction_itself():
    directions = np.eye(3)
    np.testing.assert_array_equal(close_directions(directions, 0.1), [[0], [1], [2]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: [], "images is empty"),
        (lambda group: [group[0], group[0]], "two of sensor 'front'"),
        (
            lambda group: [group[0].replace(stamp=ertis.Stamp(sensor="roof"))],
            "images has sensor 'roof', whose mounting is unknown",
        ),
        (
            lambda group: [group[0], group[1].replace(stamp=ertis.Stamp(sensor="left", sync_count=7))],
            "not from the same pulse: SYNC counts 0 and 7",
        ),
        (
            lambda group: [
                group[0],
                group[1].replace(stamp=ertis.Stamp(sensor="left", timestamp_ns=10**12)),
            ],
            "1e.03 s apart",
        ),
        (
            lambda group: [group[0], group[1].replace(elevation_rad=group[1].elevation_rad + 0.1)],
            "is planar, unlike that of",
        ),
        (lambda _: [3], "images"),
    ],
)
def test_fuser_refuses_images_that_do_not_fit(change, message):
    with pytest.raises((ArgumentError, DataError), match=message):
        ertis.fuse(change(list(images().values())), mountings())


def test_fuser_adapts_to_other_ranges():
    fuser = ertis.Fuser(mountings())
    fuser(images().values())
    near = [image.select(range_m=(0.5, 1.5)) for image in images().values()]
    result = fuser(near)
    assert result.image.range_m[-1] < 1.8
    np.testing.assert_array_equal(result.image.amplitude, ertis.fuse(near, mountings()).image.amplitude)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"silent": ["roof"]}, "silent has sensor 'roof'"),
        ({"emitter_diameter_m": -1.0}, "emitter_diameter_m"),
    ],
)
def test_fuser_refuses_impossible_options(options, message):
    with pytest.raises(ArgumentError, match=message):
        ertis.Fuser(mountings(), **options)


def test_fuser_needs_mountings():
    with pytest.raises(ArgumentError, match="mountings is empty"):
        ertis.Fuser({})


def test_fused_image_of_sensors_far_apart_is_refused():
    far = {name: ((1e6 + number, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) for number, name in enumerate(mountings())}
    with pytest.raises(ArgumentError, match=r"would reach 1e\+06 m and have \d+ cells, .*; correct the mountings"):
        ertis.Fuser(far)(images().values())


@pytest.mark.parametrize(("name", "value"), [("spacing_deg", 0.0), ("range_step_m", 1e-3), ("spacing_deg", math.nan)])
def test_fuser_refuses_grids_that_are_too_fine(name, value):
    with pytest.raises(ArgumentError, match=name):
        ertis.Fuser(mountings(), **{name: value})(images().values())


# ---- command and page ------------------------------------------------------------------------------


def run(*arguments):
    result = CliRunner().invoke(cli, [str(each) for each in arguments])
    return result.exit_code, result.output


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Recordings of one measurement: one of each sensor, and one of all sensors."""
    folder = tmp_path_factory.mktemp("fusion")
    measurements = [ertis.render(scene(), sensor=sensor.name) for sensor in scene().sensors]
    for measurement in measurements:
        name = measurement.stamp.sensor
        write_recording(folder / f"{name}.h5", [measurement], mounting={name: mountings()[name]})
    write_recording(folder / "all.h5", measurements, mounting=mountings())
    write_recording(folder / "unmounted.h5", measurements)
    return folder


def test_process_fuses_all_sensors(recordings):
    code, output = run("fuse", recordings / "all.h5", "--json", "-q")
    assert code == 0
    assert '"pulses": 1' in output
    with open_energyscapes(recordings / "all.fused.h5") as stored:
        np.testing.assert_array_equal(stored[0].amplitude, fused().image.amplitude)
        assert (stored.sensor, stored.translation_m.tolist()) == ("base_link", [0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def fused_file(recordings):
    path = recordings / "points.h5"
    assert run("fuse", recordings / "all.h5", "-o", path, "-q")[0] == 0
    return path


def test_fused_files_keep_the_points_of_the_fusion(fused_file):
    located = fused().points
    with open_energyscapes(fused_file) as stored:
        image = stored[0]
        assert stored.has_points
        assert stored.points_note is None
    for name in ("position_m", "amplitude", "uncertainty_m", "confirmed"):
        np.testing.assert_array_equal(getattr(image.points, name), getattr(located, name))
    assert located.confirmed.all()
    assert image.points.stamp == image.stamp


def test_amplitudes_of_points_are_those_of_echoes_at_1_m():
    # The call has -24 dB at 1 m, and the reflectors -6 dB; air absorbs the echo on 2 m of path.
    lost_db = 2 * np.mean(absorption_db_m(ertis.Settings().air, np.linspace(25e3, 50e3, 50)))
    located = fused().points.only(fused().points.confirmed)
    assert len(located) == len(PLACES_M)
    np.testing.assert_allclose(20 * np.log10(located.amplitude), -30.0 - lost_db, atol=1.5)


def test_comparison_of_fused_images_names_the_remedy(fused_file):
    code, output = run("compare", fused_file)
    assert code == 1
    assert "contains no ground truth; fuse simulated recordings of one scene with 'ertis fuse'" in output


def test_peaks_plots_and_exports_of_fused_files_show_the_points_of_the_fusion(fused_file, tmp_path):
    located = fused().points.strongest(None, -20.0)
    path = fused_file
    code, output = run("peaks", path, "--json", "--top", "100", "--min-level", "-20")
    assert code == 0
    rows = json.loads(output.splitlines()[-1])["peaks"]
    listed = [(row["range_m"], row["azimuth_deg"]) for row in rows]
    wanted = zip(np.hypot(*located.position_m[:, :2].T), np.degrees(located.azimuth_rad), strict=True)
    np.testing.assert_allclose(listed, [*wanted], atol=1e-3)
    sd_m = [(row["range_sd_m"], row["range_m"] * np.radians(row["angle_sd_deg"])) for row in rows]
    np.testing.assert_allclose(sd_m, located.uncertainty_m, rtol=1e-2)
    assert run("export", path, "-o", tmp_path / "points.csv", "-q")[0] == 0
    with (tmp_path / "points.csv").open() as file:
        exported = [[float(row[f"{axis}_m"]) for axis in "xyz"] for row in csv.DictReader(file)]
    np.testing.assert_allclose(exported, located.position_m, atol=1e-6)
    assert run("plot", path, "-o", tmp_path / "fused.svg", "--kind", "polar")[0] == 0


@pytest.mark.parametrize("option", [["--detector", "cfar"], ["--all"]])
def test_peaks_refuses_searches_of_images_with_points(fused_file, option):
    code, output = run("peaks", fused_file, *option)
    assert code == 2
    assert "has the points of a fusion; leave both out" in output.replace("\n", " ")


def test_fused_files_without_points_are_noted(tmp_path):
    path = write_energyscapes(tmp_path / "old.h5", [fused().image.replace(points=None)])
    with open_energyscapes(path) as stored:
        assert not stored.has_points
    for line in (["peaks", path], ["plot", path, "-o", tmp_path / "a.svg"], ["export", path, "-o", tmp_path / "a.csv"]):
        code, output = run(*line)
        assert (code, "without the points of the fusion" in output) == (0, True), line


def test_find_peaks_refuses_bins_for_images_with_points():
    image = fused().image
    with pytest.raises(ArgumentError, match="where selects bins, but the image has the points of a fusion"):
        ertis.find_peaks(image, where=image.amplitude > 0)


def test_parts_of_fused_images_keep_only_their_points():
    image = fused().image
    x_m, y_m, _ = image.points.position_m.T
    chosen = (np.hypot(x_m, y_m) <= 2.0) & (np.abs(np.degrees(np.arctan2(y_m, x_m))) <= 60.0)
    assert 0 < np.count_nonzero(chosen) < len(chosen)
    part = image.select(azimuth_deg=(-60.0, 60.0), range_m=(0.1, 2.0))
    np.testing.assert_array_equal(part.points.position_m, image.points.position_m[chosen])


def test_export_notes_that_scans_of_single_sensors_contain_foreign_echoes(recordings, fused_file, tmp_path):
    noted = "scans of single sensors contain echoes of the other sensors' calls"
    for source, options, is_noted in (
        (recordings / "all.h5", ("--sensor", "front", "--topic", "scan"), True),
        (recordings / "all.h5", ("--sensor", "front", "--topic", "points"), False),
        (recordings / "front.h5", ("--topic", "scan"), False),
        (fused_file, ("--topic", "scan"), False),
    ):
        code, output = run("export", source, "-o", tmp_path / "scans.mcap", "--force", *options)
        assert code == 0, output
        assert (noted in output) == is_noted


def test_view_draws_the_points_of_the_fusion():
    view = ViewedScene()
    for name, image in images().items():
        view.take(ReceivedImage(image, Pose(*map(tuple, mountings()[name])), 0.0, 10.0))
    frame = view.draw(Choices(threshold_db=-20.0))
    drawn_m = np.concatenate([drawn.position_m for drawn in frame.sensors.values()])
    wanted = fused().points
    wanted = wanted.only(wanted.amplitude >= 0.1 * wanted.amplitude.max())
    np.testing.assert_allclose(drawn_m, wanted.position_m, atol=1e-5)
    saved_m = np.concatenate([cloud.position_m for _, cloud, _ in view.latest(Choices(threshold_db=-20.0))])
    np.testing.assert_array_equal(saved_m, drawn_m)


def test_images_with_and_without_points_are_refused_in_one_file(tmp_path):
    image = fused().image
    for several in ([image, image.replace(points=None)], [image.replace(points=None), image]):
        with pytest.raises(ArgumentError, match="pass points with all images of a sensor, or with none"):
            write_energyscapes(tmp_path / "mixed.h5", several)


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda group: group.__delitem__("point_amplitude"), "points of images lack point_amplitude"),
        (lambda group: group["point_count"].__setitem__(0, 3), "point_count does not match the number of points"),
    ],
)
def test_damaged_points_are_refused(tmp_path, change, reported):
    path = write_energyscapes(tmp_path / "damaged.h5", [fused().image])
    with h5py.File(path, "r+") as file:
        change(file["sensors/base_link"])
    with pytest.raises(DamagedError, match=reported):
        open_energyscapes(path)


def test_process_fuses_several_recordings(recordings):
    paths = [recordings / f"{name}.h5" for name in YAWS]
    code, output = run("fuse", *paths, "-o", recordings / "several.h5")
    assert code == 0, output
    with open_energyscapes(recordings / "several.h5") as stored:
        np.testing.assert_array_equal(stored[0].amplitude, fused().image.amplitude)


def test_process_leaves_out_pulses_without_a_call(recordings, tmp_path):
    given = []
    for name in YAWS:
        with open_recording(recordings / f"{name}.h5") as recording:
            (measurement,) = recording
        for number, behaviour in enumerate(("passive", "active" if name == "front" else "passive")):
            stamp = dataclasses.replace(
                measurement.stamp,
                sequence=number,
                sync_count=number,
                timestamp_ns=measurement.stamp.timestamp_ns + number * 10**9,
                behaviour=behaviour,
            )
            given.append(dataclasses.replace(measurement, stamp=stamp))
    write_recording(tmp_path / "mixed.h5", given, mounting=mountings())
    code, output = run("fuse", tmp_path / "mixed.h5", "--json")
    assert code == 0, output
    assert '"left_out": 1' in output
    assert "note: 1 of 2 pulses left out, because no sensor emitted its call" in output
    with open_energyscapes(tmp_path / "mixed.fused.h5") as stored:
        assert [stamp.sync_count for stamp in stored.stamps()] == [1]


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["front.h5"], 2, "fusion needs at least two sensors, but there is only front"),
        (["front.h5", "all.h5"], 2, "contain the same sensor 'front'"),
        (["unmounted.h5"], 1, "the mounting of sensor 'front' is unknown; add its mounting with --mounting"),
        (["all.h5", "--sensor", "left"], 2, "No such option '--sensor'"),
        (["all.h5", "-o", "all.png"], 2, "all.png is not an energyscape file"),
        (["all.h5", "--emitter-diameter", "9"], 2, "0.0<=x<=0.2"),
    ],
)
def test_fuse_explains_what_cannot_be_fused(recordings, monkeypatch, arguments, status, message):
    monkeypatch.chdir(recordings)
    code, output = run("fuse", *arguments)
    assert (code, message in output) == (status, True), output


def test_commands_and_code_of_the_page_run(tmp_path):
    text = page("fusion")
    for command in commands_in(text):
        run_here(tmp_path, command)
        if command == "example platform":
            scene_file = tmp_path / "platform.toml"
            scene_file.write_text(scene_file.read_text("utf-8").replace("count = 30", "count = 2"), "utf-8")
    assert (tmp_path / "platform.fused.png").stat().st_size > 10_000
    (code,) = python_in(text)
    assert run_code_here(tmp_path, code).strip().endswith("()")


def test_image_with_nan_is_refused_by_the_name_of_its_sensor():
    settings = ertis.Settings().replace(**{"processing.directions": "2d:9", "processing.range_m": (0.5, 1.0)})
    amplitude = np.full((9, 50), 1e-4, np.float32)
    amplitude[3, 7] = np.nan
    azimuth_rad, range_m = np.radians(np.linspace(-80.0, 80.0, 9)), np.arange(50) * 0.01 + 0.5
    image = ertis.Energyscape(amplitude, azimuth_rad, np.zeros(9), range_m, settings, ertis.Stamp(sensor="left"))
    with pytest.raises(ertis.DataError, match="the image of sensor 'left' contains NaN or infinity"):
        ertis.fuse([image], {"left": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))})
