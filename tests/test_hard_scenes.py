"""Scenes that break simulators: the result is finite and sensible, and nothing warns."""

import tracemalloc

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Air, Array, Processing, Recording
from ertis_numba.simulation import (
    Ambient,
    Box,
    Electronics,
    Emitter,
    Noise,
    Point,
    Scene,
    Sensor,
    Sonar,
    Sphere,
    Tone,
    Wall,
)
from ertis_numba.simulation.names import EFFECTS
from ertis_numba.simulation.plan import make_plan
from ertis_numba.simulation.render import Simulator
from ertis_numba.stages.detect import find_peaks
from tests.scenes import EAR, SENSOR, bits_of, heard, line_array, only, scene_of, seen, sorted_ways

EIGHT = SENSOR.replace(
    array=line_array(8, 0.004),
    recording=Recording(n_samples=32_768),
    processing=Processing(directions="2d:91", range_m=(0.0, 0.8)),
)
ALL_OF_IT = Electronics(
    noise_dbfs=-70,
    microphone_diameter_m=0.002,
    gain_spread_db=0.5,
    delay_spread_s=5e-7,
    dead_channels=(1,),
    stuck_high=(2,),
)
FULL = EIGHT.replace(emitter=Emitter(diameter_m=0.02, direct_sound_db=-40), electronics=ALL_OF_IT)


def forced(scene):
    """The scene with every effect on."""
    return scene.replace(effects=dict.fromkeys(EFFECTS, True))


def image_of(scene, index=0):
    """The image of a scene as it would be recorded, with every effect on; all on the way is checked."""
    plan = only(*EFFECTS) if scene.boxes else make_plan(forced(scene))  # to ask about many walls takes long
    simulator = Simulator(forced(scene), plan=plan)
    signals, measurement = simulator.signals(index), simulator.render(index)
    assert np.all(np.isfinite(signals))
    for reflector in simulator.reflectors(index):
        numbers = (reflector.azimuth_deg, reflector.elevation_deg, reflector.range_m, reflector.level_db)
        assert np.all(np.isfinite((*numbers, *reflector.velocity_m_s)))
        assert reflector.level_db <= 0
        assert reflector.range_m >= 0
    image = Pipeline(simulator.sensor.settings()).process(measurement)
    assert np.all(np.isfinite(image.energy))
    return image


@pytest.mark.parametrize("range_m", [0.05, 0.1])
def test_a_target_so_near_is_found(range_m):
    """Its echo comes before the call is over."""
    scene = scene_of(Point(azimuth_deg=20, range_m=range_m, strength_db=-60), sensor=EIGHT)
    [peak] = find_peaks(image_of(scene), top=1)
    assert peak.range_m == pytest.approx(range_m, abs=0.005)
    assert peak.azimuth_deg == pytest.approx(20, abs=2)


@pytest.mark.parametrize("range_m", [0.001, 0.005])
def test_a_target_upon_the_array_is_bounded(range_m):
    scene = scene_of(Point(range_m=range_m, strength_db=-90), sensor=EIGHT)
    assert image_of(scene).energy.max() < 1
    assert np.abs(heard(scene, "spreading")).max() < 1.001 * 10 ** (-90 / 20) * 1e4


@pytest.mark.parametrize("place_m", [(0.0, 0.0, 0.0), SENSOR.array.positions_m[1]])
def test_a_target_at_emitter_or_microphone_is_bounded(place_m):
    sensor = SENSOR.replace(emitter=Emitter(diameter_m=0.02), electronics=Electronics(microphone_diameter_m=0.002))
    scene = scene_of(Point(position_m=place_m, strength_db=-90), sensor=sensor)
    signals = heard(scene, *EFFECTS)
    assert np.all(np.isfinite(signals))
    assert np.abs(signals).max() < 1.001 * 10 ** (-90 / 20) * 1e4


def test_the_truth_of_a_target_in_the_middle_of_the_array():
    [reflector] = seen(scene_of(Point(position_m=(0.0, 0.0, 0.0))), "spreading")
    assert reflector.range_m == 0
    assert np.isfinite(reflector.azimuth_deg)


def test_a_moving_target_that_flies_through_the_array():
    point = Point(position_m=(0.01, 0.0, 0.0), velocity_m_s=(-20.0, 0.0, 0.0), strength_db=-90)
    assert np.all(np.isfinite(heard(scene_of(point), *EFFECTS)))


def test_two_targets_in_one_place_add_up():
    one = scene_of(Point(azimuth_deg=10, range_m=0.4), sensor=EIGHT)
    two = scene_of(*2 * one.points, sensor=EIGHT)
    assert_allclose(heard(two, "spreading"), 2 * heard(one, "spreading"), atol=1e-12)
    assert len(find_peaks(image_of(two), min_level_db=-20)) == 1


def test_two_targets_in_antiphase_cancel():
    """They stand a quarter of a wavelength apart for one frequency; energy is missing, and nothing else happens."""
    scene = scene_of(Point(range_m=0.4), Point(range_m=0.4023), sensor=EIGHT)
    assert image_of(scene).energy.max() > 0


@pytest.mark.parametrize("diameter_m", [0.0, 0.02])
def test_a_target_behind_the_array(diameter_m):
    """A planar array without patterns shows it in front; behind a piston there is nothing."""
    scene = scene_of(
        Point(azimuth_deg=160, range_m=0.4, strength_db=-30),
        sensor=EIGHT.replace(emitter=Emitter(diameter_m=diameter_m)),
    )
    image = image_of(scene)
    assert Simulator(forced(scene)).signals().any() == (diameter_m == 0)
    if not diameter_m:
        [peak] = find_peaks(image, top=1)
        assert (peak.azimuth_deg, peak.range_m) == (pytest.approx(20, abs=2), pytest.approx(0.4, abs=0.005))


@pytest.mark.parametrize("humidity_percent", [0, 100])
@pytest.mark.parametrize("temperature_c", [-40, 60])
def test_extreme_air(temperature_c, humidity_percent):
    air = Air(temperature_c=temperature_c, humidity_percent=humidity_percent)
    scene = scene_of(Point(azimuth_deg=-10, range_m=0.5, strength_db=-20), sensor=EIGHT.replace(air=air))
    [peak] = find_peaks(image_of(scene), top=1)
    assert peak.range_m == pytest.approx(0.5, abs=0.005)
    assert peak.azimuth_deg == pytest.approx(-10, abs=2)


def test_thin_air():
    air = Air(temperature_c=60, humidity_percent=100, pressure_pa=10_000)
    assert image_of(scene_of(Point(range_m=0.4), sensor=EIGHT.replace(air=air))).energy.max() > 0


def test_one_microphone():
    scene = scene_of(Point(range_m=0.4, strength_db=-20), sensor=EIGHT.replace(array=EAR.array))
    [peak] = find_peaks(image_of(scene), top=1)
    assert peak.range_m == pytest.approx(0.4, abs=0.005)


def test_1024_microphones():
    """In memory for 128 of them at a time."""
    sensor = EIGHT.replace(array=line_array(1024, 1e-3), recording=Recording(n_samples=40_000))
    scene = scene_of(Point(range_m=0.5, azimuth_deg=30, strength_db=-20), sensor=sensor)
    simulator = Simulator(scene, plan=only("spreading", "absorption"))
    tracemalloc.start()
    measurement = simulator.render()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert measurement.words.shape == (40_000, 16)
    assert peak < 250e6  # the signals alone would take 330 MB
    ones = np.unpackbits(measurement.words[::16].view(np.uint8), axis=1).mean(axis=0)
    assert np.all(np.abs(ones - 0.5) < 0.1)


def test_microphones_in_one_place():
    array = Array(layout="pair", positions_m=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), word_bits=8)
    scene = scene_of(Point(azimuth_deg=40, range_m=0.3), sensor=SENSOR.replace(array=array))
    first, second = heard(scene, *EFFECTS)
    assert_allclose(first, second)


def test_no_targets_at_all():
    image = image_of(scene_of(sensor=EIGHT))
    assert image.energy.max() < 1e-3  # the modulators' noise
    assert Simulator(forced(scene_of(sensor=EIGHT))).reflectors() == []


def test_every_effect_with_nothing_there():
    """Forced on, effects that find nothing to act upon do nothing."""
    scene = Scene(sensors=(EIGHT.replace(emitter=Emitter(silent=True)),))
    assert not Simulator(forced(scene)).signals().any()
    plan = make_plan(forced(scene))
    assert plan.active == set(EFFECTS)
    assert all(
        verdict.forced for verdict in plan.verdicts if verdict.estimate_db is None and verdict.name in scene.effects
    )


def test_every_effect_with_everything_there():
    scene = Scene(
        seed=3,
        sensors=(
            FULL,
            FULL.replace(name="other", position_m=(1.0, 0.3, 0.0), yaw_deg=170, velocity_m_s=(0.0, 1.0, 0.0)),
        ),
        points=(Point(range_m=0.5), Point(azimuth_deg=30, range_m=0.6, diameter_m=0.05, velocity_m_s=(-1.0, 0.0, 0.0))),
        spheres=(Sphere(position_m=(0.6, -0.3, 0.0), radius_m=0.05),),
        walls=(Wall(position_m=(0.0, 0.0, -0.4), facing_deg=(0.0, 90.0)),),
        boxes=(Box(position_m=(0.7, 0.4, 0.0), size_m=(0.1, 0.1, 0.3), yaw_deg=20),),
        tones=(Tone(range_m=1.0, frequency_hz=40_000.0),),
        noises=(Noise(range_m=2.0),),
        sonars=(Sonar(range_m=1.5, azimuth_deg=70),),
        ambient=Ambient(),
        count=3,
    )
    assert image_of(scene, index=2).energy.max() > 0
    assert len(seen(scene, *EFFECTS, sensor="other")) > 0


@pytest.mark.parametrize("facing_deg", [(180.0, 0.0), (0.0, 0.0), (90.0, 0.0), (0.0, 90.0)])
def test_a_wall_through_the_sensor(facing_deg):
    """It mirrors nothing of the sensor itself, since no sound goes to it and back."""
    scene = scene_of(
        Point(range_m=0.4, azimuth_deg=10),
        sensor=FULL,
        walls=(Wall(position_m=(0.0, 0.0, 0.0), facing_deg=facing_deg),),
    )
    image_of(scene)
    assert not {"walls[0]"} & {reflector.name for reflector in seen(scene, "walls", "occlusion", "spreading")}


@pytest.mark.parametrize("place_m", [(1.5, 2.0, 1.25), (1.5, 2.0, 0.0), (1.5, 0.0, 0.0), (1.5 - 1e-9, 2.0 - 1e-9, 0.1)])
def test_a_sensor_in_the_corner_of_a_box(place_m):
    sensor = FULL.replace(position_m=place_m, yaw_deg=-140)
    scene = scene_of(
        Point(position_m=(1.3, 1.8, 0.1)),
        sensor=sensor,
        boxes=(Box(position_m=(0.0, 0.0, 0.0), size_m=(3.0, 4.0, 2.5)),),
    )
    image_of(scene)


def test_a_target_upon_a_wall():
    wall = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0))
    scene = scene_of(Point(position_m=(0.5, 0.1, 0.0)), sensor=FULL, walls=(wall,))
    image_of(scene)
    assert len(sorted_ways(scene, "occlusion")[0]) == 1  # what touches a wall is not behind it


def test_a_sensor_inside_a_sphere():
    scene = scene_of(
        sensor=FULL,
        spheres=(Sphere(position_m=(0.0, 0.0, 0.0), radius_m=0.5), Sphere(position_m=(0.1, 0.0, 0.0), radius_m=0.5)),
    )
    assert np.all(np.isfinite(heard(scene, *EFFECTS)))


def test_two_sensors_in_one_place():
    scene = Scene(sensors=(FULL, FULL.replace(name="twin")), points=(Point(range_m=0.4, strength_db=-40),))
    image_of(scene)


def test_two_walls_in_one_place():
    wall = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0))
    image_of(scene_of(Point(range_m=0.3), sensor=FULL, walls=(wall, wall)))


def test_a_scene_in_overload_recovers():
    """Twenty times full scale: the bits stay bits, and quiet follows."""
    sensor = EIGHT.replace(recording=Recording(n_samples=40_000))
    scene = scene_of(Point(range_m=0.2, strength_db=0), sensor=sensor)
    bits = bits_of(Simulator(scene, plan=only("spreading")).render())[:8]
    assert np.all(np.abs(bits[:, 30_000:].mean(axis=1)) < 0.05)
    assert np.all(np.abs(np.cumsum(bits[:, 30_000:], axis=1)).max(axis=1) < 500)


@pytest.mark.parametrize("n_samples", [1, 100, 4097])
def test_records_shorter_than_the_call(n_samples):
    sensor = Sensor(array=EAR.array, recording=Recording(n_samples=n_samples), emitter=FULL.emitter)
    assert Simulator(
        forced(scene_of(Point(range_m=0.05), sensor=sensor)), plan=only(*EFFECTS)
    ).render().words.shape == (n_samples,)
