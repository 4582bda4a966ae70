"""Difficult scenes give finite and plausible results without warnings."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Recording
from ertis_numba.simulation import (
    Ambient,
    Box,
    Emitter,
    Noise,
    Point,
    Scene,
    Sonar,
    Sphere,
    Tone,
    Wall,
)
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.render import Simulator
from tests.hard_cases.forced import EIGHT, FULL, forced, image_of
from tests.scenes import bits_of, heard, only, scene_of, seen, sorted_ways


def test_target_moving_through_the_array_is_finite():
    point = Point(position_m=(0.01, 0.0, 0.0), velocity_m_s=(-20.0, 0.0, 0.0), strength_db=-90)
    assert np.all(np.isfinite(heard(scene_of(point), *EFFECTS)))


def test_coincident_targets_add_up():
    one = scene_of(Point(azimuth_deg=10, range_m=0.4), sensor=EIGHT)
    two = scene_of(*2 * one.points, sensor=EIGHT)
    assert_allclose(heard(two, "spreading"), 2 * heard(one, "spreading"), atol=1e-12)
    assert len(find_peaks(image_of(two), min_level_db=-20)) == 1


def test_two_targets_in_antiphase_cancel():
    """They are a quarter of a wavelength apart for one frequency, which loses energy; nothing else changes."""
    scene = scene_of(Point(range_m=0.4), Point(range_m=0.4023), sensor=EIGHT)
    assert image_of(scene).amplitude.max() > 0


@pytest.mark.parametrize("diameter_m", [0.0, 0.02])
def test_target_behind_the_array_appears_as_documented(diameter_m):
    """A planar array without directivity shows it in front; a piston emitter makes it silent."""
    scene = scene_of(
        Point(azimuth_deg=160, range_m=0.4, strength_db=-30),
        sensor=EIGHT.replace(emitter=Emitter(diameter_m=diameter_m)),
    )
    image = image_of(scene)
    assert Simulator(forced(scene)).signals().any() == (diameter_m == 0)
    if not diameter_m:
        [peak] = find_peaks(image, top=1)
        assert (peak.azimuth_deg, peak.range_m) == (pytest.approx(20, abs=2), pytest.approx(0.4, abs=0.005))


def test_scene_without_targets_is_rendered():
    image = image_of(scene_of(sensor=EIGHT))
    assert image.amplitude.max() < 1e-3  # the modulators' noise
    assert Simulator(forced(scene_of(sensor=EIGHT))).reflectors() == []


def test_forced_effects_without_objects_change_nothing():
    """Forced effects without objects to act on leave the signals unchanged."""
    scene = Scene(sensors=(EIGHT.replace(emitter=Emitter(silent=True)),))
    assert not Simulator(forced(scene)).signals().any()
    plan = make_plan(forced(scene))
    assert plan.active == set(EFFECTS)
    assert all(
        verdict.forced for verdict in plan.verdicts if verdict.estimate_db is None and verdict.name in scene.effects
    )


def test_all_effects_with_all_objects_are_finite():
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
    assert image_of(scene, index=2).amplitude.max() > 0
    assert len(seen(scene, *EFFECTS, sensor="other")) > 0


@pytest.mark.parametrize("facing_deg", [(180.0, 0.0), (0.0, 0.0), (90.0, 0.0), (0.0, 90.0)])
def test_wall_through_the_sensor_is_finite(facing_deg):
    """It reflects nothing of the sensor itself, because the path has no length."""
    scene = scene_of(
        Point(range_m=0.4, azimuth_deg=10),
        sensor=FULL,
        walls=(Wall(position_m=(0.0, 0.0, 0.0), facing_deg=facing_deg),),
    )
    image_of(scene)
    assert not {"walls[0]"} & {reflector.name for reflector in seen(scene, "walls", "occlusion", "spreading")}


@pytest.mark.parametrize("place_m", [(1.5, 2.0, 1.25), (1.5, 2.0, 0.0), (1.5, 0.0, 0.0), (1.5 - 1e-9, 2.0 - 1e-9, 0.1)])
def test_sensor_in_the_corner_of_a_box_is_finite(place_m):
    sensor = FULL.replace(position_m=place_m, yaw_deg=-140)
    scene = scene_of(
        Point(position_m=(1.3, 1.8, 0.1)),
        sensor=sensor,
        boxes=(Box(position_m=(0.0, 0.0, 0.0), size_m=(3.0, 4.0, 2.5)),),
    )
    image_of(scene)


def test_target_on_a_wall_is_finite():
    wall = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0))
    scene = scene_of(Point(position_m=(0.5, 0.1, 0.0)), sensor=FULL, walls=(wall,))
    image_of(scene)
    assert len(sorted_ways(scene, "occlusion")[0]) == 1  # what touches a wall is not behind it


def test_sensor_inside_a_sphere_is_refused():
    scene = scene_of(
        sensor=FULL,
        spheres=(Sphere(position_m=(0.0, 0.0, 0.0), radius_m=0.5), Sphere(position_m=(0.1, 0.0, 0.0), radius_m=0.5)),
    )
    with pytest.raises(ArgumentError, match=r"spheres\[0\] is 0 m from emitter of"):
        heard(scene, *EFFECTS)


def test_coincident_sensors_are_rendered():
    scene = Scene(sensors=(FULL, FULL.replace(name="twin")), points=(Point(range_m=0.4, strength_db=-40),))
    image_of(scene)


def test_coincident_walls_are_rendered():
    wall = Wall(position_m=(0.5, 0.0, 0.0), facing_deg=(180.0, 0.0))
    image_of(scene_of(Point(range_m=0.3), sensor=FULL, walls=(wall, wall)))


def test_scene_recovers_from_overload():
    """At twenty times full scale, the output remains PDM, and silence follows."""
    sensor = EIGHT.replace(recording=Recording(n_samples=40_000))
    scene = scene_of(Point(range_m=0.2, strength_db=0), sensor=sensor)
    bits = bits_of(Simulator(scene, plan=only("spreading")).render())[:8]
    assert np.all(np.abs(bits[:, 30_000:].mean(axis=1)) < 0.05)
    assert np.all(np.abs(np.cumsum(bits[:, 30_000:], axis=1)).max(axis=1) < 500)
