"""Directivity of emitters, microphones, arrays and discs in rendered signals, compared with closed forms."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing, Recording
from ertis_numba.simulation import Electronics, Emitter, Point, Wall
from ertis_numba.simulation.effects._piston import piston
from ertis_numba.simulation.render import Simulator
from tests.scenes import (
    BAND_HZ,
    EAR,
    NARROW,
    SENSOR,
    SPEED_M_S,
    error_db,
    filtered,
    heard,
    line_array,
    only,
    scene_of,
    ways,
)

# ---- pistons ---------------------------------------------------------------------------------------


def test_piston_has_known_zeros_and_side_lobe():
    argument = np.linspace(3.9, 7.0, 10_000)
    side_lobe = np.abs(piston(argument)).max()
    assert piston(np.array([1.6163]))[0] ** 2 == pytest.approx(0.5, abs=1e-4)
    assert abs(piston(np.array([3.8317]))[0]) < 1e-5
    assert 20 * np.log10(side_lobe) == pytest.approx(-17.57, abs=0.005)
    assert_allclose(piston(np.array([0.0, 1e-9])), 1.0)


def pattern_at(azimuth_deg, diameter_m, frequency_hz):
    argument = math.pi * diameter_m * frequency_hz / SPEED_M_S * math.sin(math.radians(azimuth_deg))
    return np.abs(piston(argument))


@pytest.mark.parametrize("end", ["emitter", "microphone"])
@pytest.mark.parametrize(("azimuth_deg", "diameter_m"), [(0, 0.02), (20, 0.02), (50, 0.02), (-85, 0.01), (35, 0.05)])
def test_piston_directivity_filters_off_axis_echoes(end, azimuth_deg, diameter_m):
    emitter = Emitter(diameter_m=diameter_m if end == "emitter" else 0.0)
    electronics = Electronics(microphone_diameter_m=diameter_m if end == "microphone" else 0.0)
    scene = scene_of(
        Point(azimuth_deg=azimuth_deg, range_m=0.5), sensor=EAR.replace(emitter=emitter, electronics=electronics)
    )
    found = filtered(heard(scene), heard(scene, f"{end}_directivity"))
    assert_allclose(found, pattern_at(azimuth_deg, diameter_m, BAND_HZ), atol=0.005)


def test_emitter_and_microphone_patterns_multiply():
    sensor = EAR.replace(emitter=Emitter(diameter_m=0.02), electronics=Electronics(microphone_diameter_m=0.01))
    scene = scene_of(Point(azimuth_deg=30, elevation_deg=20, range_m=0.5), sensor=sensor)
    found = filtered(heard(scene), heard(scene, "emitter_directivity", "microphone_directivity"))
    off_deg = math.degrees(math.acos(unit_vectors(np.radians(30), np.radians(20))[0]))
    assert_allclose(found, pattern_at(off_deg, 0.02, BAND_HZ) * pattern_at(off_deg, 0.01, BAND_HZ), atol=0.005)


def test_emitter_and_microphone_directivity_are_reciprocal():
    """By reciprocity, a piston emitter with a point microphone equals a point emitter with a piston microphone."""
    point = Point(azimuth_deg=40, range_m=0.5)
    sends = scene_of(point, sensor=EAR.replace(emitter=Emitter(diameter_m=0.02)))
    hears = scene_of(point, sensor=EAR.replace(electronics=Electronics(microphone_diameter_m=0.02)))
    assert_allclose(heard(sends, "emitter_directivity"), heard(hears, "microphone_directivity"), atol=1e-15)


@pytest.mark.parametrize("end", ["emitter", "microphone"])
def test_piston_emits_and_receives_nothing_behind(end):
    sensor = EAR.replace(emitter=Emitter(diameter_m=0.01), electronics=Electronics(microphone_diameter_m=0.01))
    behind = scene_of(Point(azimuth_deg=120, range_m=0.5), sensor=sensor)
    assert heard(behind).any()
    assert not heard(behind, f"{end}_directivity").any()


def test_piston_axis_turns_with_the_sensor():
    sensor = EAR.replace(emitter=Emitter(diameter_m=0.03), electronics=Electronics(microphone_diameter_m=0.03))
    scene = scene_of(
        Point(azimuth_deg=-70, elevation_deg=40, range_m=0.5), sensor=sensor.replace(yaw_deg=-70, pitch_deg=40)
    )
    both = heard(scene, "emitter_directivity", "microphone_directivity")
    assert_allclose(both, heard(scene), atol=1e-12)


def test_wall_echo_straight_ahead_is_on_the_piston_axis():
    sensor = SENSOR.replace(array=line_array(75, 0.002), emitter=Emitter(diameter_m=0.02))
    scene = scene_of(sensor=sensor, walls=(Wall(position_m=(0.25, 0.0, 0.0), facing_deg=(180.0, 0.0)),))
    [plain], [patterned] = ways(scene, "walls"), ways(scene, "walls", "emitter_directivity", frequency_hz=(80e3,))
    assert patterned.amplitude[0, 37, 0] == pytest.approx(plain.amplitude[0, 37, 0])  # the middle microphone


# ---- arrays ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_mics", [8, 16])
@pytest.mark.parametrize("azimuth_deg", [0.0, 25.0])
def test_line_array_image_follows_the_array_pattern(n_mics, azimuth_deg):
    """``sin(N ψ / 2) / (N sin(ψ / 2))`` with ``ψ = k d (sin θ - sin θ₀)``, through one-bit samples and pipeline."""
    spacing_m, range_m = 0.004, 3.0  # so far that the wave is planar over the array
    sensor = SENSOR.replace(
        array=line_array(n_mics, spacing_m),
        call=NARROW,
        recording=Recording(n_samples=98_304),
        processing=Processing(directions="2d:721", range_m=(range_m - 0.2, range_m + 0.2)),
    )
    scene = scene_of(Point(azimuth_deg=azimuth_deg, range_m=range_m, strength_db=0), sensor=sensor)
    pipeline = Pipeline(sensor.settings())
    amplitude = pipeline.process(Simulator(scene, plan=only("spreading")).render()).amplitude
    found = amplitude[:, np.argmax(amplitude.max(axis=0))] / amplitude.max()
    azimuth_rad = pipeline.grid.azimuth_rad
    wave = 2 * math.pi * 40e3 / SPEED_M_S
    half = wave * spacing_m * (np.sin(azimuth_rad) - math.sin(math.radians(azimuth_deg))) / 2
    wanted = np.abs(np.sinc(n_mics * half / math.pi) / np.sinc(half / math.pi))
    assert_allclose(found, wanted, atol=0.025)
    if not azimuth_deg:
        above = np.degrees(azimuth_rad[found**2 > 0.5])
        width_deg = math.degrees(0.886 * SPEED_M_S / 40e3 / (n_mics * spacing_m))
        assert np.ptp(above) == pytest.approx(width_deg, abs=0.5)


def test_line_array_first_side_lobe_has_known_level():
    """The level is −13.26 dB for many microphones and −13.15 dB for 16."""
    sensor = SENSOR.replace(
        array=line_array(16, 0.004),
        call=NARROW,
        recording=Recording(n_samples=98_304),
        processing=Processing(directions="2d:721", range_m=(2.8, 3.2)),
    )
    scene = scene_of(Point(range_m=3.0, strength_db=0), sensor=sensor)
    amplitude = Pipeline(sensor.settings()).process(Simulator(scene, plan=only("spreading")).render()).amplitude
    cut = amplitude[:, np.argmax(amplitude.max(axis=0))]
    inner = cut[1:-1]
    lobes = np.sort(inner[(inner > cut[:-2]) & (inner >= cut[2:])])[::-1]
    assert 20 * np.log10(lobes[1] / lobes[0]) == pytest.approx(-13.15, abs=0.2)


# ---- targets with an orientation -------------------------------------------------------------------


@pytest.mark.parametrize("turned_deg", [0, 5, 15, 30, 60])
def test_disc_reflects_with_a_piston_pattern(turned_deg):
    """Both paths lie on one line, so the phase across the disc doubles: v = π d f · 2 sin θ / c."""
    disc = Point(range_m=1.0, diameter_m=0.02, facing_deg=(180 - turned_deg, 0))
    scene = scene_of(disc, sensor=EAR)
    found = filtered(heard(scene), heard(scene, "target_size"))
    argument = 2 * math.pi * 0.02 * BAND_HZ / SPEED_M_S * math.sin(math.radians(turned_deg))
    assert_allclose(found, np.abs(piston(argument)), atol=0.005)


def test_disc_reflects_most_in_the_mirror_direction():
    """Transmitter and receiver are on opposite sides of the normal of the disc."""
    receiver = EAR.replace(emitter=Emitter(silent=True))
    transmitter = EAR.replace(name="mouth", position_m=(0.0, 0.5, 0.0))

    def level(facing_deg):
        disc = Point(position_m=(0.5, 0.25, 0.0), diameter_m=0.05, facing_deg=(facing_deg, 0))
        scene = scene_of(disc, sensor=receiver).replace(sensors=(receiver, transmitter))
        return abs(ways(scene, "target_size", "cross_emission")[0].amplitude[0, 0, 0])

    levels = {facing_deg: level(facing_deg) for facing_deg in (160, 170, -180, -170, -160)}
    assert max(levels, key=levels.get) == -180
    assert levels[170] == pytest.approx(levels[-170])


def test_disc_reflects_nothing_from_its_back():
    scene = scene_of(Point(range_m=0.5, diameter_m=0.02, facing_deg=(0, 0)), sensor=EAR)
    assert heard(scene).any()
    assert not heard(scene, "target_size").any()


def test_disc_faces_the_origin_by_default():
    disc = Point(azimuth_deg=40, elevation_deg=20, range_m=0.5, diameter_m=0.1)
    facing, turned = (disc.replace(facing_deg=facing_deg) for facing_deg in ((-140.0, -20.0), (-130.0, -20.0)))
    found, wanted, other = (heard(scene_of(each, sensor=EAR), "target_size") for each in (disc, facing, turned))
    assert_allclose(found, wanted, atol=1e-12)
    assert error_db(other, wanted) > -10
