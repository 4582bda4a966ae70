"""Motion: positions, and the effect on the call."""

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import microphones
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Call, Recording
from ertis_numba.simulation import Box, Emitter, Noise, Point, Scene, Sonar, Sphere, Tone, Wall
from tests.scenes import (
    EAR,
    SENSOR,
    SPEED_M_S,
    error_db,
    heard,
    line_array,
    scene_of,
    seen,
    sorted_ways,
    spectrum_at,
    vector,
    ways,
    written_out,
)

TONE = Call(start_frequency_hz=40_001.0, stop_frequency_hz=40_000.0, duration_s=6e-3)
STEP_S = 1e-5
"""By how much earlier and later a sound leaves whose stretch is measured."""


def met_s(leaves_s, start_m, place_m, velocity_m_s):
    """Solve for the time at which sound from a place meets a moving object."""
    return scipy.optimize.brentq(
        lambda time_s: np.linalg.norm(place_m + time_s * velocity_m_s - start_m) - SPEED_M_S * (time_s - leaves_s),
        leaves_s,
        leaves_s + 1.0,
        xtol=1e-15,
        rtol=1e-15,
    )


def arrives_s(leaves_s, transmitter, *others):
    """Solve for the time at which sound of an emitter has met all objects, each a place and a velocity."""
    place_m = transmitter[0] + leaves_s * transmitter[1]
    for other in others:
        leaves_s = met_s(leaves_s, place_m, *other)
        place_m = other[0] + leaves_s * other[1]
    return leaves_s


def brute_force(*things):
    """Return delay and stretch of sound over objects."""
    early_s, on_time_s, late_s = (arrives_s(leaves_s, *things) for leaves_s in (-STEP_S, 0.0, STEP_S))
    return on_time_s, (late_s - early_s) / (2 * STEP_S)


# ---- retarded times --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(8))
def test_delay_and_stretch_over_a_target(seed):
    random = np.random.default_rng(seed)
    target = random.uniform(0.3, 2.0, 3), random.uniform(-8, 8, 3)
    place_m, velocity_m_s = random.uniform(-0.3, 0.3, 3), random.uniform(-4, 4, 3)
    sensor = SENSOR.replace(
        position_m=vector(place_m), velocity_m_s=vector(velocity_m_s), yaw_deg=30, pitch_deg=-20, roll_deg=10
    )
    [echo] = ways(
        scene_of(Point(position_m=vector(target[0]), velocity_m_s=vector(target[1])), sensor=sensor), "doppler"
    )
    for mic, offset_m in enumerate(microphones(SENSOR.array).positions_m @ sensor.rotation().T):
        delay_s, stretch = brute_force((place_m, velocity_m_s), target, (place_m + offset_m, velocity_m_s))
        assert abs(echo.delay_s[0, mic] - delay_s) < 2e-12
        assert echo.stretch[0, mic] == pytest.approx(stretch, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_delay_and_stretch_straight_from_another_sensor(seed):
    mouth_m, mouth_m_s, receiver_m, ear_m_s = np.random.default_rng(seed).uniform(-4, 4, (4, 3))
    receiver = EAR.replace(position_m=vector(receiver_m), velocity_m_s=vector(ear_m_s), emitter=Emitter(silent=True))
    transmitter = EAR.replace(name="mouth", position_m=vector(mouth_m), velocity_m_s=vector(mouth_m_s))
    [direct] = ways(Scene(sensors=(receiver, transmitter)), "doppler", "cross_emission")
    delay_s, stretch = brute_force((mouth_m, mouth_m_s), (receiver_m, ear_m_s))
    assert abs(direct.delay_s[0, 0] - delay_s) < 2e-12
    assert direct.stretch[0, 0] == pytest.approx(stretch, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_delay_and_stretch_over_a_wall_at_rest(seed):
    """Images of moving objects have the mirrored velocity."""
    random = np.random.default_rng(seed)
    place_m, velocity_m_s = random.uniform(-0.3, 0.3, 3), random.uniform(-5, 5, 3)
    target = random.uniform(0.3, 1.0, 3), random.uniform(-5, 5, 3)
    sensor = EAR.replace(position_m=vector(place_m), velocity_m_s=vector(velocity_m_s))
    point = Point(position_m=vector(target[0]), velocity_m_s=vector(target[1]))
    wall = Wall(position_m=(0.0, 1.5, 0.0), facing_deg=(-90.0, 0.0))
    over_point, own = ways(scene_of(point, sensor=sensor, walls=(wall,), max_reflections=1), "walls", "doppler")
    end = place_m, velocity_m_s
    image = place_m * (1, -1, 1) + (0, 3, 0), velocity_m_s * (1, -1, 1)
    ends = ((end, target, end), (end, target, image), (image, target, end), (image, end))
    delays_s, stretches = (
        np.concatenate([getattr(found, name)[:, 0] for found in (over_point, own)]) for name in ("delay_s", "stretch")
    )
    for k, things in enumerate(ends):
        delay_s, stretch = brute_force(*things)
        assert abs(delays_s[k] - delay_s) < 2e-12
        assert stretches[k] == pytest.approx(stretch, abs=1e-9)


def test_delay_and_stretch_over_a_sphere():
    """On the line of sight, its surface acts as a point."""
    sphere = Sphere(position_m=(1.1, 0.0, 0.0), radius_m=0.1, velocity_m_s=(-3.0, 0.0, 0.0))
    point = Point(position_m=(1.0, 0.0, 0.0), velocity_m_s=(-3.0, 0.0, 0.0))
    [round_echo] = ways(scene_of(sensor=EAR, spheres=(sphere,)), "doppler", "target_size")
    [echo] = ways(scene_of(point, sensor=EAR), "doppler")
    assert_allclose(round_echo.delay_s, echo.delay_s, atol=2e-12)
    assert_allclose(round_echo.stretch, echo.stretch, rtol=1e-12)


# ---- what moves, and how ---------------------------------------------------------------------------


def test_approaching_sensor_equals_an_approaching_target():
    coming = scene_of(Point(position_m=(1.0, 0.0, 0.0), velocity_m_s=(-5.0, 0.0, 0.0)), sensor=EAR)
    going = scene_of(Point(position_m=(1.0, 0.0, 0.0)), sensor=EAR.replace(velocity_m_s=(5.0, 0.0, 0.0)))
    [of_target], [of_sensor] = ways(coming, "doppler"), ways(going, "doppler")
    assert_allclose(of_target.delay_s, of_sensor.delay_s, atol=2e-12)
    assert_allclose(of_target.stretch, of_sensor.stretch, rtol=1e-12)


def test_common_motion_causes_no_shift():
    velocity_m_s = (3.0, -4.0, 1.0)
    scene = scene_of(
        Point(position_m=(1.0, 0.5, 0.2), velocity_m_s=velocity_m_s), sensor=EAR.replace(velocity_m_s=velocity_m_s)
    )
    [echo] = ways(scene, "doppler")
    assert_allclose(echo.stretch, 1.0, atol=1e-12)


def test_motion_across_the_line_of_sight_causes_no_shift():
    """A second-order term in v / c remains, because the path rotates while the sound travels."""
    across = scene_of(Point(position_m=(1.0, 0.0, 0.0), velocity_m_s=(0.0, 5.0, 0.0)), sensor=EAR)
    [echo] = ways(across, "doppler")
    assert_allclose(echo.stretch, 1.0, atol=2.1 * (5.0 / SPEED_M_S) ** 2)


@pytest.mark.parametrize("speed_m_s", [3.0, -3.0])
def test_wall_image_moves_twice_as_fast(speed_m_s):
    wall = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0), velocity_m_s=(-speed_m_s, 0.0, 0.0))
    [echo] = ways(scene_of(sensor=EAR, walls=(wall,)), "doppler", "walls")
    assert echo.stretch[0, 0] == pytest.approx(1 - 2 * speed_m_s / SPEED_M_S, abs=2.5 * (speed_m_s / SPEED_M_S) ** 2)


@pytest.mark.parametrize("speed_m_s", [3.0, -3.0])
def test_approaching_wall_echoes_at_its_momentary_position(speed_m_s):
    """At normal incidence it equals an approaching point, within 0.02 samples at 450 kHz."""
    velocity_m_s = (-speed_m_s, 0.0, 0.0)
    wall = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0), velocity_m_s=velocity_m_s)
    [over_wall] = ways(scene_of(sensor=EAR, walls=(wall,)), "doppler", "walls")
    [over_point] = ways(scene_of(Point(position_m=(1.5, 0.0, 0.0), velocity_m_s=velocity_m_s), sensor=EAR), "doppler")
    assert abs(over_wall.delay_s - over_point.delay_s) * 450e3 < 0.02
    assert_allclose(over_wall.stretch, over_point.stretch, atol=1e-5)


def test_wall_sliding_in_its_plane_changes_nothing():
    wall = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0), velocity_m_s=(0.0, 7.0, 3.0))
    still = ways(scene_of(sensor=EAR, walls=(wall.replace(velocity_m_s=(0.0, 0.0, 0.0)),)), "walls")
    moving = ways(scene_of(sensor=EAR, walls=(wall,)), "doppler", "walls")
    assert_allclose(moving[0].delay_s, still[0].delay_s, atol=2e-12)
    assert_allclose(moving[0].stretch, 1.0, atol=1e-12)


# ---- signals ---------------------------------------------------------------------------------------


def frequency_of(signal, near_hz):
    """Frequency of the maximum of a signal's spectrum."""
    width_hz = 0.5 / TONE.duration_s
    return scipy.optimize.minimize_scalar(
        lambda frequency_hz: -abs(spectrum_at(signal, np.array([frequency_hz]))[0]),
        bounds=(near_hz - width_hz, near_hz + width_hz),
        options={"xatol": 0.01},
    ).x


@pytest.mark.parametrize("speed_m_s", [1.0, -1.0, 3.0])
def test_doppler_shift_of_a_tone_matches_the_formula(speed_m_s):
    """Within 1 % of ``2 v / c``, and within 0.1 % of the exact formula."""
    sensor = EAR.replace(call=TONE)
    still, coming = (
        scene_of(Point(position_m=(0.3, 0.0, 0.0), velocity_m_s=(-speed, 0.0, 0.0)), sensor=sensor)
        for speed in (0.0, speed_m_s)
    )
    before_hz = frequency_of(heard(still, "doppler")[0], 40_000.5)
    beta = speed_m_s / SPEED_M_S
    after_hz = frequency_of(heard(coming, "doppler")[0], before_hz * (1 + 2 * beta))
    assert after_hz / before_hz - 1 == pytest.approx((1 + beta) / (1 - beta) - 1, rel=1e-3)
    assert after_hz / before_hz - 1 == pytest.approx(2 * beta, rel=0.01)


@pytest.mark.parametrize("call", [Call(), Call(start_frequency_hz=80_000.0, stop_frequency_hz=20_000.0)])
@pytest.mark.parametrize("speed_m_s", [8.0, -20.0])
def test_signals_are_stretched_calls(call, speed_m_s):
    points = (
        Point(position_m=(0.4, 0.2, 0.0), velocity_m_s=(-speed_m_s, 0.0, 2.0)),
        Point(position_m=(0.6, -0.1, 0.1)),
    )
    scene = scene_of(*points, sensor=SENSOR.replace(call=call, velocity_m_s=(1.0, 0.0, 0.0)))
    [echo] = ways(scene, "doppler", "spreading")
    wanted = sum(
        written_out(call, echo.delay_s[[path]], echo.amplitude[[path], :, 0], 40_000, echo.stretch[path][:, None])
        for path in range(2)
    )
    assert error_db(heard(scene, "doppler", "spreading"), wanted) < -80


@pytest.mark.parametrize(("spacing_m", "speed_m_s"), [(0.005, 1.0), (0.02, 5.0), (0.2, 20.0)])
def test_signals_of_many_microphones_are_stretched_calls(spacing_m, speed_m_s):
    """Near microphones share few stretched calls; distant ones have their own."""
    point = Point(position_m=(0.5, 0.3, 0.0), velocity_m_s=(-speed_m_s, speed_m_s, 0.0))
    scene = scene_of(point, sensor=SENSOR.replace(array=line_array(9, spacing_m)))
    [echo] = ways(scene, "doppler", "spreading")
    wanted = written_out(scene.sensors[0].call, echo.delay_s, echo.amplitude[:, :, 0], 40_000, echo.stretch[0][:, None])
    assert error_db(heard(scene, "doppler", "spreading"), wanted) < -80


@pytest.mark.parametrize("modulation", ["hyperbolic", "linear"])
@pytest.mark.parametrize(("start_hz", "stop_hz"), [(50e3, 25e3), (25e3, 50e3)])
def test_stretched_call_has_the_predicted_time_shift(modulation, start_hz, stop_hz):
    """The simulator judges the effect of motion by ``(s - 1) p₀ / p'``, for both kinds of sweep."""
    call = Call(start_frequency_hz=start_hz, stop_frequency_hz=stop_hz, modulation=modulation)
    rate_hz, stretch = 5e6, 1 + 2 * 1.0 / SPEED_M_S
    time_s = np.arange(40_000) / rate_hz - 2e-3
    sent, came = (np.fft.fft(call_at(call, time_s / by)) for by in (1.0, stretch))
    pulse = np.abs(np.fft.ifft(came * np.conj(sent) * (np.fft.fftfreq(len(time_s)) > 0)))
    later_s = (int(np.argmax(np.roll(pulse, 20_000))) - 20_000) / rate_hz
    growth = (1 / stop_hz - 1 / start_hz) / call.duration_s
    assert later_s == pytest.approx(-(stretch - 1) / start_hz / growth, abs=3e-7)


def test_without_motion_doppler_changes_no_signal():
    scene = scene_of(Point(azimuth_deg=20, range_m=0.6))
    assert error_db(heard(scene, "doppler"), heard(scene)) < -85


# ---- places ----------------------------------------------------------------------------------------


def test_objects_move_with_their_velocity():
    point = Point(position_m=(1.0, 0.0, 0.0), velocity_m_s=(0.5, 1.0, -2.0))
    scene = scene_of(point, sensor=EAR, rate_hz=10.0)
    assert_allclose(sorted_ways(scene, index=5)[0], 2 * np.linalg.norm([1.25, 0.5, -1.0]) / SPEED_M_S, atol=1e-12)
    [reflector] = seen(scene, index=5)
    assert reflector.range_m == pytest.approx(np.linalg.norm([1.25, 0.5, -1.0]))
    assert reflector.azimuth_deg == pytest.approx(np.degrees(np.arctan2(0.5, 1.25)))


@pytest.mark.parametrize(
    ("index", "place_m", "velocity_m_s"),
    [
        (0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (10, (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        (15, (1.5, 0.0, 0.0), (1.0, 0.0, 0.0)),
        (25, (2.0, 1.0, 0.0), (0.0, 2.0, 0.0)),
        (30, (2.0, 2.0, 0.0), (0.0, 0.0, 0.0)),
        (90, (2.0, 2.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_objects_follow_their_waypoints(index, place_m, velocity_m_s):
    """They rest before the first and after the last."""
    waypoints = ((1.0, 1.0, 0.0, 0.0), (2.0, 2.0, 0.0, 0.0), (3.0, 2.0, 2.0, 0.0))
    for thing in (Point(waypoints=waypoints), EAR.replace(waypoints=waypoints).path()):
        assert_allclose(thing.position_at(index / 10), place_m, atol=1e-12)
        assert_allclose(thing.velocity_at(index / 10), velocity_m_s, atol=1e-12)
    [reflector] = seen(scene_of(Point(waypoints=waypoints), sensor=EAR, rate_hz=10.0), index=index)
    assert reflector.range_m == pytest.approx(np.linalg.norm(place_m))
    assert_allclose(reflector.velocity_m_s, velocity_m_s, atol=1e-12)
    sensor = EAR.replace(waypoints=waypoints)
    [reflector] = seen(scene_of(Point(position_m=(5.0, 0.0, 0.0)), sensor=sensor, rate_hz=10.0), index=index)
    assert reflector.range_m == pytest.approx(np.linalg.norm(np.subtract((5.0, 0.0, 0.0), place_m)))
    assert_allclose(reflector.velocity_m_s, np.negative(velocity_m_s), atol=1e-12)


def test_velocity_is_in_the_sensor_frame():
    """For a sensor rotated left by 90°, motion along x is motion to the right."""
    sensor = EAR.replace(yaw_deg=90, velocity_m_s=(0.0, 1.0, 0.0))
    [reflector] = seen(scene_of(Point(position_m=(0.0, 2.0, 0.0), velocity_m_s=(3.0, 0.0, 0.5)), sensor=sensor))
    assert_allclose(reflector.velocity_m_s, (-1.0, -3.0, 0.5), atol=1e-12)


def test_velocity_of_a_wall_is_along_the_line_of_sight():
    wall = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0), velocity_m_s=(-2.0, 5.0, 0.0))
    [reflector] = seen(scene_of(sensor=EAR, walls=(wall,)), "walls")
    assert_allclose(reflector.velocity_m_s, (-2.0, 0.0, 0.0), atol=1e-12)


def test_box_moves_with_all_its_walls():
    box = Box(position_m=(2.0, 0.0, 0.0), size_m=(1.0, 1.0, 1.0), velocity_m_s=(1.0, 0.0, 0.0))
    [reflector] = seen(scene_of(sensor=EAR, boxes=(box,), rate_hz=10.0), "walls", "occlusion", index=5)
    assert (reflector.name, reflector.range_m) == ("boxes[0].back", pytest.approx(2.0))
    assert_allclose(reflector.velocity_m_s, (1.0, 0.0, 0.0), atol=1e-12)


def test_scene_reports_motion():
    place, velocity = {"position_m": (1.0, 0.0, 0.0)}, {"velocity_m_s": (0.0, 0.1, 0.0)}
    resting, moving = Point(**place), Point(**place, **velocity)
    assert not scene_of(resting).moves
    assert scene_of(resting, moving).moves
    assert scene_of(tones=(Tone(**place, **velocity, frequency_hz=40e3),)).moves
    assert scene_of(noises=(Noise(**place, **velocity),)).moves
    assert scene_of(sonars=(Sonar(**place, **velocity),)).moves
    assert scene_of(sensor=EAR.replace(waypoints=((0, 0, 0, 0), (1, 1, 0, 0)))).moves
    assert not scene_of(sensor=EAR.replace(waypoints=((0, 0, 0, 0),))).moves


def test_measurements_follow_the_rate_of_the_scene():
    point = Point(position_m=(0.5, 0.0, 0.0), velocity_m_s=(0.2, 0.0, 0.0))
    sensor = EAR.replace(recording=Recording(n_samples=30_000))
    later = heard(scene_of(point, sensor=sensor, rate_hz=4.0), index=2)
    assert_array_equal(later, heard(scene_of(point.replace(position_m=(0.6, 0.0, 0.0)), sensor=sensor)))


def test_negative_index_is_refused():
    with pytest.raises(ArgumentError, match="index is -2; use a whole number of at least 0"):
        heard(scene_of(), index=-2)
