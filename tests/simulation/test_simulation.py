"""Rendered scenes against closed-form solutions: arrival times, levels, bits and their seeds."""

import hashlib
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from ertis_numba import kernels
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import load_layout, microphones, unit_vectors
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Call, Recording
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.render import Simulator, render
from tests.scenes import (
    EAR,
    NARROW,
    RATE_HZ,
    SENSOR,
    SPEED_M_S,
    arrival_s,
    bits_of,
    error_db,
    heard,
    line_array,
    only,
    scene_of,
    sorted_ways,
    ways,
    written_out,
)

SCENE = scene_of(Point(azimuth_deg=25, elevation_deg=-10, range_m=0.7, strength_db=-15))
NOISY = SCENE.replace(
    sensors=(SENSOR.replace(electronics=Electronics(noise_dbfs=-60)),), effects={"microphone_noise": True}
)
CALLS = {
    "default": (Call(), -85),
    "wide": (Call(start_frequency_hz=80_000.0, stop_frequency_hz=20_000.0), -85),
    "upward": (Call(start_frequency_hz=25_000.0, stop_frequency_hz=50_000.0), -85),
    "narrow": (NARROW, -84),
    "steep edges": (Call(duration_s=1e-3, ramp_fraction=0.02), -75),
}
"""Calls by name, and the error in decibels that is left by what a renderer drops of their spectrum's edges."""


# ---- arrivals --------------------------------------------------------------------------------------


def test_arrival_times_follow_the_sound_paths():
    [echo] = ways(SCENE, "spreading")
    point_m = 0.7 * unit_vectors(np.radians(25), np.radians(-10))
    back_m = np.linalg.norm(point_m - microphones(SENSOR.array).positions_m, axis=1)
    assert_allclose(echo.delay_s, [(0.7 + back_m) / SPEED_M_S], atol=1e-12)
    assert_allclose(echo.amplitude[..., 0], [10 ** (-15 / 20) / (0.7 * back_m)], rtol=1e-12)
    assert echo.stretch is None


def test_arrivals_include_the_calibration_of_the_layout():
    array = SENSOR.array.replace(gain=(1.0, 0.5, 2.0), delay_s=(0.0, 1e-5, -1e-6))
    [plain], [calibrated] = ways(SCENE), ways(SCENE.replace(sensors=(SENSOR.replace(array=array),)))
    assert_allclose(calibrated.delay_s - plain.delay_s, [[0.0, 1e-5, -1e-6]], atol=1e-12)
    assert_allclose((calibrated.amplitude / plain.amplitude)[..., 0], [[1.0, 0.5, 2.0]])


@settings(max_examples=30, deadline=None)
@given(azimuth_deg=st.floats(-180, 180), elevation_deg=st.floats(-90, 90), range_m=st.floats(1e-3, 1000))
def test_arrivals_are_finite_everywhere(azimuth_deg, elevation_deg, range_m):
    point = Point(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, range_m=range_m, strength_db=0)
    delay_s, amplitude = sorted_ways(scene_of(point, sensor=EAR), "spreading")  # Mic at the emitter.
    assert np.all(np.isfinite(amplitude))
    assert np.all(amplitude <= 1e4)
    assert np.all(delay_s >= 0)


@pytest.mark.parametrize("range_m", [0.3, 0.5123, 0.7])
def test_calls_arrive_on_time(range_m):
    """Arrivals before the modulators are within 1e-5 of a sample at 450 kHz."""
    scene = scene_of(Point(azimuth_deg=40, range_m=range_m, strength_db=-20))
    [echo] = ways(scene)
    for mic, signal in enumerate(heard(scene)):
        wanted_s = echo.delay_s[0, mic]
        assert abs(arrival_s(signal, SENSOR.call, wanted_s + 3e-7) - wanted_s) * 450e3 < 1e-5


def test_bits_preserve_arrival_time_and_amplitude():
    """Modulation of 4th order with dither moves an arrival by less than 0.002 of a sample at 450 kHz."""
    scene = scene_of(Point(azimuth_deg=-40, range_m=0.6, strength_db=-15))
    simulator = Simulator(scene, plan=only("spreading"))
    [echo] = ways(scene, "spreading")
    bits, clean = bits_of(simulator.render()), simulator.signals()
    for mic in range(3):
        wanted_s = echo.delay_s[0, mic]
        assert abs(arrival_s(bits[mic], SENSOR.call, wanted_s + 3e-7) - wanted_s) * 450e3 < 0.002
        assert bits[mic] @ clean[mic] / (clean[mic] @ clean[mic]) == pytest.approx(1, abs=0.01)


# ---- signals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CALLS)
def test_rendered_signals_equal_the_time_domain_sum(name):
    call, bound_db = CALLS[name]
    points = (Point(azimuth_deg=20, range_m=0.5), Point(azimuth_deg=-60, range_m=0.6321), Point(range_m=0.05))
    scene = scene_of(*points, sensor=SENSOR.replace(call=call))
    [echo] = ways(scene, "spreading")
    wanted = written_out(call, echo.delay_s, echo.amplitude[..., 0], 40_000)
    assert error_db(heard(scene, "spreading"), wanted) < bound_db


def test_fractional_delay_conserves_energy():
    """By Parseval's theorem, a delay by a fraction of a sample keeps the energy of a call."""
    step_m = SPEED_M_S / RATE_HZ / 2
    scenes = (scene_of(Point(range_m=0.5 + step_m * part), sensor=EAR) for part in (0.0, 0.1, 0.37, 0.5, 0.77, 123.4))
    amplitude = [np.sum(heard(scene) ** 2) for scene in scenes]
    assert np.ptp(amplitude) / amplitude[0] < 1e-9


@pytest.mark.parametrize("block", [4099, 16_384, 65_536])
def test_signals_are_independent_of_the_block_length(monkeypatch, block):
    sensor = SENSOR.replace(emitter=Emitter(diameter_m=0.02, direct_sound_db=-40))
    scene = scene_of(Point(azimuth_deg=30, range_m=0.7), Point(range_m=1.2), sensor=sensor)
    names = ("spreading", "absorption", "emitter_directivity", "direct_sound")
    whole = heard(scene, *names)
    monkeypatch.setattr("ertis_numba.simulation.synthesis.BLOCK", block)
    assert error_db(heard(scene, *names), whole) < -100


def test_echo_continues_in_the_next_block():
    """The call spans the boundary of the first two blocks."""
    scene = scene_of(Point(range_m=1.1), sensor=EAR)
    [echo] = ways(scene)
    assert echo.delay_s[0, 0] * RATE_HZ < 32_768 < (echo.delay_s[0, 0] + SENSOR.call.duration_s) * RATE_HZ
    assert error_db(heard(scene), written_out(SENSOR.call, echo.delay_s, echo.amplitude[..., 0], 40_000)) < -85


def test_echo_after_the_record_is_omitted():
    assert not heard(scene_of(Point(range_m=900))).any()


def test_silent_sensor_receives_no_own_echo():
    scene = scene_of(Point(range_m=0.5), sensor=SENSOR.replace(emitter=Emitter(silent=True, direct_sound_db=0)))
    assert not heard(scene, "spreading", "direct_sound").any()


def test_emitter_level_scales_the_echoes():
    quiet = SCENE.replace(sensors=(SENSOR.replace(emitter=Emitter(level_db=-12)),))
    assert_allclose(heard(quiet), heard(SCENE) * 10 ** (-12 / 20), atol=1e-15)


def test_call_spectrum_is_far_below_half_the_pdm_rate():
    """The call has no content that would alias, so it can be evaluated at the PDM rate."""
    fine = np.fft.rfft(call_at(CALLS["wide"][0], np.arange(400_000) / (8 * RATE_HZ)))
    frequency_hz = np.fft.rfftfreq(400_000, 1 / (8 * RATE_HZ))
    beyond = np.abs(fine[frequency_hz > RATE_HZ / 2]).max()
    assert 20 * np.log10(beyond / np.abs(fine).max()) < -190


# ---- bits ------------------------------------------------------------------------------------------


def test_seed_and_index_determine_every_bit():
    first = render(NOISY)
    assert_array_equal(first.data, render(NOISY).data)
    others = [render(NOISY, 1), render(NOISY.replace(seed=8)), render(SCENE)]
    for other in others:
        assert np.mean(other.data != first.data) > 0.1
    stamp = others[0].stamp
    assert (stamp.sensor, stamp.sequence, stamp.sync_count, stamp.timestamp_ns) == ("sensor", 1, 1, 50_000_000)


def test_simulated_words_equal_those_of_earlier_versions():
    """Changed bits change every shipped recording; rebuild data/synthetic and note it in the changelog."""
    words = render(NOISY).data
    assert hashlib.sha256(words.tobytes()).hexdigest()[:16] == "6ef2f5669f9743ea"


def test_sensors_of_a_scene_differ_in_their_noise():
    twins = NOISY.replace(sensors=(NOISY.sensors[0], NOISY.sensors[0].replace(name="other")), points=())
    words = [render(twins, sensor=name).data for name in ("sensor", "other")]
    assert np.mean(words[0] != words[1]) > 0.1


def test_bits_are_independent_of_the_number_of_threads():
    words = [
        Simulator(NOISY, threads=threads).render().data for threads in range(1, kernels.load("cpu").max_threads + 1)
    ]
    for other in words[1:]:
        assert_array_equal(other, words[0])


def test_measurements_are_independent_of_their_order():
    forth, back = Simulator(NOISY), Simulator(NOISY)
    words = [forth.render(index).data for index in (0, 1, 2)]
    for index in (2, 1, 0):
        assert_array_equal(back.render(index).data, words[index])


@pytest.mark.parametrize(("word_bits", "n_channels"), [(8, 1), (8, 8), (16, 17), (32, 33), (64, 64), (64, 1024)])
def test_each_channel_is_in_its_bit(word_bits, n_channels):
    array = line_array(n_channels, 1e-3).replace(word_bits=word_bits)
    sensor = SENSOR.replace(array=array, recording=Recording(n_samples=601))
    measurement = Simulator(scene_of(sensor=sensor), plan=only()).render()
    n_words = -(-n_channels // word_bits)
    assert measurement.data.shape == ((601, n_words) if n_words > 1 else (601,))
    assert measurement.data.dtype == f"u{word_bits // 8}"
    bits = bits_of(measurement)
    assert np.all(bits[n_channels:] == -1)
    assert np.all(np.abs(bits[:n_channels].mean(axis=1)) < 0.2)


def test_large_array_is_rendered_in_equal_parts():
    """Channels are rendered 128 at a time, without an effect on their signals."""
    sensor = SENSOR.replace(array=line_array(150, 1e-3), recording=Recording(n_samples=12_000))
    scene = scene_of(Point(range_m=0.2, azimuth_deg=40, strength_db=-50), sensor=sensor)
    simulator = Simulator(scene, plan=only("spreading"))
    bits, clean = bits_of(simulator.render())[:150], simulator.signals()
    assert_allclose(np.sum(bits * clean, axis=1) / np.sum(clean**2, axis=1), 1, atol=0.02)


def test_disabled_channels_hold_zeros():
    layout = load_layout("uRTIS_v1")
    sensor = Sensor(array=Array(layout="uRTIS_v1"), recording=Recording(n_samples=500))
    bits = bits_of(Simulator(Scene(sensors=(sensor,)), plan=only()).render())
    assert np.all(bits[~layout.enabled] == -1)
    assert np.all(bits[layout.enabled].max(axis=1) == 1)


@pytest.mark.parametrize("n_samples", [1, 7, 4099, 32_769])
def test_records_of_odd_length_are_rendered(n_samples):
    scene = scene_of(Point(range_m=0.05), sensor=EAR.replace(recording=Recording(n_samples=n_samples)))
    assert Simulator(scene, plan=only("spreading")).render().data.shape == (n_samples,)


def test_memory_is_independent_of_the_record_length():
    long = SCENE.replace(sensors=(SENSOR.replace(recording=Recording(n_samples=1_500_000)),))
    simulator = Simulator(long, plan=only("spreading"))
    tracemalloc.start()
    simulator.render()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 15e6  # The samples take 1.5 MB; the signals would take 36 MB.


def test_invalid_measurement_index_is_refused():
    with pytest.raises(ArgumentError, match="index is -1; use a whole number of at least 0"):
        render(SCENE, -1)


def test_unknown_sensor_is_refused():
    with pytest.raises(ArgumentError, match="sensor 'left' is unknown; known are sensor"):
        Simulator(SCENE, sensor="left")


def test_effect_plan_is_made_by_default():
    simulator = Simulator(SCENE)
    assert simulator.plan == make_plan(SCENE)
    assert "spreading" in simulator.plan.active


# ---- ground truth ----------------------------------------------------------------------------------


def test_reflectors_are_sorted_by_level():
    points = (
        Point(azimuth_deg=10, range_m=1.0, strength_db=-20),
        Point(azimuth_deg=-20, elevation_deg=5, range_m=2.0, strength_db=0),
    )
    strong, weak = Simulator(scene_of(*points, sensor=EAR), plan=only("spreading")).reflectors()
    assert (strong.name, strong.level_db) == ("points[1]", 0.0)
    assert_allclose((strong.azimuth_deg, strong.elevation_deg, strong.range_m), (-20, 5, 2.0))
    assert_allclose((weak.azimuth_deg, weak.elevation_deg, weak.range_m), (10, 0, 1.0), atol=1e-9)
    assert weak.level_db == pytest.approx(-20 + 2 * 20 * np.log10(2), abs=1e-9)
    assert Simulator(scene_of()).reflectors() == []


def test_reflectors_are_in_the_frame_of_a_rotated_sensor():
    sensor = SENSOR.replace(position_m=(1.0, 2.0, 0.5), yaw_deg=90, pitch_deg=30)
    ahead_m = np.array([1.0, 2.0, 0.5]) + 0.8 * unit_vectors(np.radians(90), np.radians(30))
    above_m = np.array([1.0, 2.0, 0.5]) + 0.9 * unit_vectors(np.radians(90), np.radians(50))
    points = tuple(Point(position_m=tuple(map(float, place))) for place in (ahead_m, above_m))
    ahead, above = Simulator(scene_of(*points, sensor=sensor), plan=only("spreading")).reflectors()
    assert_allclose((ahead.azimuth_deg, ahead.elevation_deg, ahead.range_m), (0, 0, 0.8), atol=1e-9)
    assert_allclose((above.azimuth_deg, above.elevation_deg, above.range_m), (0, 20, 0.9), atol=1e-9)


def test_roll_is_clockwise_seen_from_behind():
    """A point to the right appears above when the top of the sensor leans to the right."""
    scene = scene_of(Point(position_m=(1.0, -1.0, 0.0)), sensor=SENSOR.replace(roll_deg=90))
    [point] = Simulator(scene, plan=only("spreading")).reflectors()
    assert_allclose((point.azimuth_deg, point.elevation_deg), (0, 45), atol=1e-9)


def test_simulators_of_equal_scenes_share_a_plan(monkeypatch):
    made = []
    monkeypatch.setattr("ertis_numba.simulation.render.make_plan", lambda scene: made.append(scene) or make_plan(scene))
    scene = Scene(seed=77, sensors=(SENSOR,), points=(Point(range_m=0.5),))
    assert Simulator(scene).plan is Simulator(scene.replace(seed=77)).plan
    scene.effects["absorption"] = True
    assert "absorption" in Simulator(scene).plan.active
    assert len(made) == 2
