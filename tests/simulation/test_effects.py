"""Effects on levels and spectra of rendered signals, compared with closed forms."""

import math

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import absorption_db_m, sound_speed_m_s
from ertis_numba.settings import Air, Recording
from ertis_numba.simulation import Electronics, Emitter, Point, Sphere, Wall
from ertis_numba.simulation.render import Simulator
from tests.scenes import (
    BAND_HZ,
    EAR,
    SENSOR,
    SPEED_M_S,
    bits_of,
    error_db,
    filtered,
    heard,
    line_array,
    only,
    scene_of,
    seen,
    sorted_ways,
    ways,
    written_out,
)


def amplitude_of(signal, call, delay_s):
    """Amplitude of a call in a signal, found by projection."""
    replica = written_out(call, np.array([[delay_s]]), 1.0, len(signal))[0]
    return signal @ replica / (replica @ replica)


# ---- spreading -------------------------------------------------------------------------------------


@pytest.mark.parametrize("range_m", [0.2, 0.4, 0.8, 1.2])
def test_point_echo_falls_with_the_square_of_range(range_m):
    scene = scene_of(Point(range_m=range_m, strength_db=-6), sensor=EAR)
    found = amplitude_of(heard(scene, "spreading")[0], EAR.call, 2 * range_m / SPEED_M_S)
    assert found == pytest.approx(10 ** (-6 / 20) / range_m**2, rel=1e-4)


@pytest.mark.parametrize("range_m", [0.2, 0.4, 0.8, 1.2])
def test_wall_echo_falls_with_the_path_length(range_m):
    wall = Wall(position_m=(range_m, 0.0, 0.0), facing_deg=(180.0, 0.0), reflection_db=-3)
    scene = scene_of(sensor=EAR, walls=(wall,))
    found = amplitude_of(heard(scene, "spreading", "walls")[0], EAR.call, 2 * range_m / SPEED_M_S)
    assert found == pytest.approx(10 ** (-3 / 20) / (2 * range_m), rel=1e-4)


def test_doubled_range_costs_points_12_db_and_walls_6_db():
    points = [sorted_ways(scene_of(Point(range_m=r), sensor=EAR), "spreading")[1] for r in (2.0, 4.0)]
    walls = [
        sorted_ways(
            scene_of(sensor=EAR, walls=(Wall(position_m=(r, 0, 0), facing_deg=(180, 0)),)), "spreading", "walls"
        )[1]
        for r in (2.0, 4.0)
    ]
    for (near, far), wanted_db in ((points, 12.04), (walls, 6.02)):
        assert_allclose(20 * np.log10(near / far), wanted_db, atol=0.01)


@pytest.mark.parametrize(("radius_m", "range_m"), [(0.15, 0.5), (0.3, 1.0), (10.0, 0.4)])
def test_sphere_echo_has_closed_form_amplitude(radius_m, range_m):
    """The amplitude is ``a / (2 r (r + a))``, where r is the distance to the surface."""
    sphere = Sphere(position_m=(range_m + radius_m, 0.0, 0.0), radius_m=radius_m, reflection_db=-2)
    scene = scene_of(sensor=EAR, spheres=(sphere,))
    delay_s, amplitude = sorted_ways(scene, "spreading", "target_size")
    assert_allclose(delay_s, 2 * range_m / SPEED_M_S, atol=2e-12)
    wanted = 10 ** (-2 / 20) * radius_m / (2 * range_m * (range_m + radius_m))
    assert_allclose(amplitude, wanted, rtol=1e-9)
    found = amplitude_of(heard(scene, "spreading", "target_size")[0], EAR.call, 2 * range_m / SPEED_M_S)
    assert found == pytest.approx(wanted, rel=1e-4)


def test_sphere_echo_approaches_wall_and_point():
    def amplitude(radius_m):
        sphere = Sphere(position_m=(1.0 + radius_m, 0.0, 0.0), radius_m=radius_m)
        return float(sorted_ways(scene_of(sensor=EAR, spheres=(sphere,)), "spreading", "target_size")[1][0])

    assert amplitude(1000.0) == pytest.approx(1 / 2, rel=2e-3)  # a wall
    assert amplitude(0.1) == pytest.approx(0.1 / 2 / 1.1, rel=2e-3)  # a point with half the radius, 5 cm deeper
    without_surface = scene_of(sensor=EAR, spheres=(Sphere(position_m=(1.0, 0.0, 0.0), radius_m=0.001),))
    assert_allclose(sorted_ways(without_surface, "spreading")[1], 0.001 / 2)


def shortest_m(transmitter_m, receiver_m, centre_m, radius_m):
    """Length of the path over a sphere by Fermat's principle: the minimum over surface points seen from both ends."""
    to_receiver, to_transmitter = receiver_m - centre_m, transmitter_m - centre_m
    first = to_transmitter / np.linalg.norm(to_transmitter)
    second = to_receiver - (to_receiver @ first) * first
    second /= np.linalg.norm(second)

    def length_m(angle):
        corner_m = centre_m + radius_m * (math.cos(angle) * first + math.sin(angle) * second)
        return np.linalg.norm(corner_m - transmitter_m) + np.linalg.norm(receiver_m - corner_m)

    return scipy.optimize.minimize_scalar(length_m, bounds=(0.0, 1.5), options={"xatol": 1e-9}).fun


def test_sphere_path_satisfies_fermats_principle():
    """With emitter and microphone 40 cm apart, the path is accurate to 0.02 samples at 450 kHz."""
    other = EAR.replace(name="other", position_m=(0.0, 0.4, 0.0))
    sphere = Sphere(position_m=(1.0, 0.3, 0.1), radius_m=0.06)
    scene = scene_of(sensor=EAR.replace(emitter=Emitter(silent=True)), spheres=(sphere,))
    scene = scene.replace(sensors=(*scene.sensors, other))
    delay_s, _ = sorted_ways(scene, "spreading", "target_size", "cross_emission")
    wanted_m = shortest_m(np.array([0.0, 0.4, 0.0]), np.zeros(3), np.array([1.0, 0.3, 0.1]), 0.06)
    assert abs(delay_s[1] - wanted_m / SPEED_M_S) * 450e3 < 0.02


# ---- absorption ------------------------------------------------------------------------------------


@pytest.mark.parametrize("air", [Air(), Air(temperature_c=40, humidity_percent=20), Air(temperature_c=-20)])
def test_absorption_of_rendered_echo_follows_the_standard(air):
    scene = scene_of(Point(range_m=0.9), sensor=EAR.replace(air=air))
    found = filtered(heard(scene), heard(scene, "absorption"))
    assert_allclose(-20 * np.log10(found), 1.8 * absorption_db_m(air, BAND_HZ), rtol=0.005)


def test_absorption_covers_the_whole_path_over_walls():
    wall = Wall(position_m=(0.7, 0.0, 0.0), facing_deg=(180.0, 0.0))
    scene = scene_of(sensor=EAR, walls=(wall,))
    found = filtered(heard(scene, "walls"), heard(scene, "walls", "absorption"))
    assert_allclose(-20 * np.log10(found), 1.4 * absorption_db_m(EAR.air, BAND_HZ), rtol=0.005)


# ---- signals besides echoes ------------------------------------------------------------------------


def test_direct_sound_takes_the_straight_path():
    """The level of the direct sound does not depend on the pattern of the emitter."""
    sensor = SENSOR.replace(emitter=Emitter(level_db=10, diameter_m=0.05, direct_sound_db=-40))
    scene = scene_of(sensor=sensor)
    names = ("spreading", "direct_sound", "emitter_directivity", "absorption")
    way_m = np.linalg.norm(microphones(sensor.array).positions_m, axis=1)
    [direct] = ways(scene, *names)
    assert_allclose(direct.delay_s, [way_m / SPEED_M_S], atol=1e-12)
    assert_allclose(direct.amplitude[..., 0], [0.01 / np.maximum(way_m, 0.01)])
    assert error_db(heard(scene, *names), written_out(sensor.call, way_m[None] / SPEED_M_S, 0.01 / way_m, 40_000)) < -85


@pytest.mark.parametrize("noise_dbfs", [-20, -30])
def test_microphone_noise_has_the_specified_level(noise_dbfs):
    sensor = SENSOR.replace(
        recording=Recording(n_samples=200_000), electronics=Electronics(noise_dbfs=noise_dbfs, dither=0)
    )
    bits = bits_of(Simulator(scene_of(sensor=sensor), plan=only("microphone_noise")).render())[:3]
    spectrum = np.abs(np.fft.rfft(bits)) ** 2 / bits.shape[1]  # white noise of level σ: σ² in every bin
    low = spectrum[:, int(0.002 * bits.shape[1]) : int(0.01 * bits.shape[1])]
    assert_allclose(10 * np.log10(low.mean(axis=1)), noise_dbfs, atol=0.3)
    assert abs(np.corrcoef(bits)[0, 1]) < 0.02  # noise of microphones is independent


def spread_of(scene, index=0):
    """Gains in decibels and delays of the microphones of a scene, relative to their calibration."""
    [plain], [spread] = ways(scene, index=index), ways(scene, "microphone_spread", index=index)
    gain_db = 20 * np.log10(spread.amplitude / plain.amplitude)[0, :, 0]
    return gain_db, (spread.delay_s - plain.delay_s)[0]


def test_microphone_spread_has_specified_standard_deviations():
    sensor = SENSOR.replace(
        array=line_array(1024, 1e-4), electronics=Electronics(gain_spread_db=1.5, delay_spread_s=2e-6)
    )
    scene = scene_of(Point(range_m=0.7), sensor=sensor)
    gain_db, late_s = spread_of(scene)
    assert np.std(gain_db) == pytest.approx(1.5, rel=0.08)  # 3.5 standard errors
    assert np.std(late_s) == pytest.approx(2e-6, rel=0.08)
    assert abs(np.mean(gain_db)) < 0.2
    assert abs(np.mean(late_s)) < 0.25e-6
    assert abs(np.corrcoef(gain_db, late_s)[0, 1]) < 0.1
    assert_allclose(spread_of(scene, index=5), (gain_db, late_s), atol=3e-12)  # the spread of a sensor is constant
    others = (
        scene.replace(seed=8),
        scene.replace(sensors=(sensor.replace(name="other"),)),
    )
    for other in others:
        assert abs(np.corrcoef(spread_of(other)[0], gain_db)[0, 1]) < 0.15


def test_microphone_spread_affects_echoes_and_direct_sound():
    sensor = SENSOR.replace(electronics=Electronics(gain_spread_db=3), emitter=Emitter(direct_sound_db=-20))
    scene = scene_of(Point(range_m=0.5), sensor=sensor)
    gain_db, _ = spread_of(scene_of(Point(range_m=0.7), sensor=sensor))
    for names in ((), ("direct_sound",)):
        plain, spread = heard(scene, *names), heard(scene, *names, "microphone_spread")
        assert_allclose(spread, 10 ** (gain_db[:, None] / 20) * plain, atol=1e-9)


def test_faulty_channels_are_silent_or_stuck():
    electronics = Electronics(dead_channels=(1,), stuck_low=(3,), stuck_high=(4,))
    sensor = SENSOR.replace(array=line_array(6, 0.004), electronics=electronics)
    simulator = Simulator(scene_of(Point(range_m=0.3), sensor=sensor), plan=only("microphone_faults"))
    signals, bits = simulator.signals(), bits_of(simulator.render())
    assert_array_equal(signals.any(axis=1), [True, False, True, False, False, True])
    assert np.all(bits[3] == -1)
    assert np.all(bits[4] == 1)
    assert set(bits[1]) == {-1.0, 1.0}  # the modulator converts silence
    healthy = bits_of(Simulator(simulator.scene, plan=only()).render())
    assert_array_equal(bits[[0, 2, 5]], healthy[[0, 2, 5]])


@pytest.mark.parametrize("temperature_c", [-40, 20, 60])
def test_echo_delay_follows_the_sound_speed(temperature_c):
    air = Air(temperature_c=temperature_c)
    delay_s, _ = sorted_ways(scene_of(Point(range_m=1.0), sensor=EAR.replace(air=air)))
    assert_allclose(delay_s, 2.0 / sound_speed_m_s(air), atol=1e-12)


def test_truth_levels_include_all_effects():
    sensor = EAR.replace(emitter=Emitter(diameter_m=0.02))
    points = (Point(range_m=1.0), Point(azimuth_deg=60, range_m=0.9))
    plain, filtered_too = (
        seen(scene_of(*points, sensor=sensor), *names)
        for names in (("spreading",), ("spreading", "emitter_directivity"))
    )
    assert plain[0].name == "points[1]"
    assert filtered_too[0].name == "points[0]"
    assert filtered_too[1].level_db < -5
