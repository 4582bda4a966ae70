"""Emitters beside their array and resonant transducers, compared with geometry and closed forms."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ertis_numba.analysis.compare import compare
from ertis_numba.geometry import microphones
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Processing
from ertis_numba.simulation import Electronics, Emitter, Point, Wall
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.render import Simulator
from tests.scenes import (
    BAND_HZ,
    EAR,
    RATE_HZ,
    SENSOR,
    SPEED_M_S,
    error_db,
    filtered,
    heard,
    only,
    scene_of,
    seen,
    sorted_ways,
    ways,
    written_out,
)

OFFSET_M = (0.01, -0.05, 0.03)
BESIDE = SENSOR.replace(emitter=Emitter(position_m=OFFSET_M, direct_sound_db=-30.0))

# ---- an emitter beside its array -------------------------------------------------------------------


def test_emitter_offset_makes_paths_bistatic():
    """The sensor is rotated: paths run from the emitter to the target, and from there to each microphone."""
    sensor = BESIDE.replace(position_m=(0.2, 0.1, -0.1), yaw_deg=70.0, pitch_deg=20.0, roll_deg=-30.0)
    target_m = np.array([0.5, 0.6, 0.2])
    scene = scene_of(Point(position_m=(0.5, 0.6, 0.2), strength_db=0.0), sensor=sensor)
    transmitter_m = np.array([0.2, 0.1, -0.1]) + sensor.rotation() @ np.array(OFFSET_M)
    mics_m = np.array([0.2, 0.1, -0.1]) + microphones(sensor.array).positions_m @ sensor.rotation().T
    first_m, second_m = np.linalg.norm(target_m - transmitter_m), np.linalg.norm(target_m - mics_m, axis=1)
    [echo] = ways(scene, "spreading", "emitter_offset")
    assert_allclose(echo.delay_s, [(first_m + second_m) / SPEED_M_S], atol=2e-12)
    assert_allclose(echo.amplitude[..., 0], [1 / (first_m * second_m)])
    signals = heard(scene, "spreading", "emitter_offset")
    assert error_db(signals, written_out(sensor.call, echo.delay_s, echo.amplitude[..., 0], 40_000)) < -85


def test_emitter_offset_moves_the_direct_sound():
    way_m = np.linalg.norm(microphones(BESIDE.array).positions_m - np.array(OFFSET_M), axis=1)
    [direct] = ways(scene_of(sensor=BESIDE), "spreading", "direct_sound", "emitter_offset")
    assert_allclose(direct.delay_s, [way_m / SPEED_M_S], atol=1e-12)


def test_emitter_offset_moves_the_mirror_image_in_a_wall():
    """The path over a wall at the side starts at the mirror image of the emitter."""
    wall = Wall(position_m=(0.0, 0.4, 0.0), facing_deg=(90.0, 0.0))
    scene = scene_of(sensor=EAR.replace(emitter=Emitter(position_m=OFFSET_M)), walls=(wall,))
    delay_s, _ = sorted_ways(scene, "walls", "emitter_offset")
    image_m = np.array([OFFSET_M[0], 0.8 - OFFSET_M[1], OFFSET_M[2]])
    assert_allclose(delay_s, np.linalg.norm(image_m) / SPEED_M_S, atol=1e-12)


def test_truth_accounts_for_the_emitter_position():
    """Image, ground truth and comparison use half of the bistatic path as range."""
    sensor = SENSOR.replace(
        array=SENSOR.array.replace(layout="eRTIS_v3D1", positions_m=None, word_bits=32),
        emitter=Emitter(position_m=(0.0, 0.1, 0.0)),
        processing=Processing(directions="2d:91", range_m=(0.3, 0.9)),
    )
    scene = scene_of(Point(azimuth_deg=60, range_m=0.6, strength_db=0.0), sensor=sensor)
    names = ("spreading", "emitter_offset")
    [reflector] = seen(scene, *names)
    target_m = 0.6 * np.array([math.cos(math.pi / 3), math.sin(math.pi / 3), 0.0])
    assert reflector.range_m == pytest.approx((0.6 + np.linalg.norm(target_m - [0.0, 0.1, 0.0])) / 2, abs=1e-9)
    assert reflector.range_m < 0.56
    assert reflector.azimuth_deg == pytest.approx(60.0)
    image = Pipeline(sensor.settings()).process(Simulator(scene, plan=only(*names)).render())
    [match] = compare(image, [reflector]).matched
    assert abs(match.peak.range_m - reflector.range_m) < 1e-3
    [centred] = compare(image, seen(scene, "spreading")).matched
    assert centred.range_m < -0.04


# ---- a resonant transducer -------------------------------------------------------------------------


@pytest.mark.parametrize(("resonance_hz", "quality_factor"), [(40e3, 3.0), (40e3, 20.0), (30e3, 8.0), (60e3, 5.0)])
def test_transducer_filters_as_a_resonant_circuit(resonance_hz, quality_factor):
    emitter = Emitter(resonance_hz=resonance_hz, quality_factor=quality_factor)
    scene = scene_of(Point(range_m=0.5), sensor=EAR.replace(emitter=emitter))
    found = filtered(heard(scene), heard(scene, "emitter_response"))
    detuned = quality_factor * (BAND_HZ / resonance_hz - resonance_hz / BAND_HZ)
    assert_allclose(found, 1 / np.sqrt(1 + detuned**2), atol=2e-3)


@pytest.mark.parametrize("quality_factor", [10.0, 30.0, 100.0])
def test_transducer_rings_at_its_resonance_and_decays_exponentially(quality_factor):
    """After the call, the amplitude follows ``exp(-π f₀ t / Q)`` at f₀."""
    emitter = Emitter(resonance_hz=40e3, quality_factor=quality_factor)
    scene = scene_of(Point(range_m=0.3, strength_db=0.0), sensor=EAR.replace(emitter=emitter))
    [signal] = heard(scene, "emitter_response")
    over = math.ceil((0.6 / SPEED_M_S + EAR.call.duration_s + 5e-5) * RATE_HZ)
    turn = 2 * math.pi * 40e3 / RATE_HZ
    part = signal[over:]
    carrier = part * np.exp(-1j * turn * np.arange(len(part)))
    period = round(RATE_HZ / 40e3 * 2)
    swing = 2 * np.abs(carrier[: len(carrier) // period * period].reshape(-1, period).mean(axis=1))
    times_s = np.arange(len(swing)) * period / RATE_HZ
    kept = swing > 1e-3 * swing[0]
    decay_s = -1 / np.polyfit(times_s[kept], np.log(swing[kept]), 1)[0]
    assert decay_s == pytest.approx(quality_factor / (math.pi * 40e3), rel=0.02)


def test_ringing_continues_across_synthesis_blocks(monkeypatch):
    emitter = Emitter(resonance_hz=40e3, quality_factor=60.0, direct_sound_db=-30.0)
    scene = scene_of(Point(range_m=0.7), sensor=EAR.replace(emitter=emitter))
    names = ("emitter_response", "direct_sound")
    whole = heard(scene, *names)
    monkeypatch.setattr("ertis_numba.simulation.synthesis.BLOCK", 4099)
    assert error_db(heard(scene, *names), whole) < -100


def test_ringing_of_moving_target_is_doppler_shifted():
    """The echo of a receding target stretches the ringing together with the call."""
    emitter = Emitter(resonance_hz=40e3, quality_factor=10.0)
    scene = scene_of(
        Point(position_m=(0.4, 0.0, 0.0), velocity_m_s=(20.0, 0.0, 0.0)), sensor=EAR.replace(emitter=emitter)
    )
    found = filtered(heard(scene, "doppler"), heard(scene, "doppler", "emitter_response"))
    factor = (SPEED_M_S + 20.0) / (SPEED_M_S - 20.0)
    detuned = 10.0 * (BAND_HZ * factor / 40e3 - 40e3 / BAND_HZ / factor)
    assert_allclose(found, 1 / np.sqrt(1 + detuned**2), atol=5e-3)


# ---- decisions -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "sensor"),
    [
        ("emitter_offset", BESIDE),
        ("emitter_response", SENSOR.replace(emitter=Emitter(resonance_hz=40e3, quality_factor=4.0))),
        ("clock_drift", SENSOR.replace(electronics=Electronics(clock_drift_ppm=1000.0))),
    ],
)
def test_plan_enables_effects_only_where_relevant(name, sensor):
    point = Point(azimuth_deg=30, range_m=0.7, strength_db=-15)
    assert name not in make_plan(scene_of(point)).active
    assert name in make_plan(scene_of(point, sensor=sensor)).active
