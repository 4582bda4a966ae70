"""Tests of requested and omitted effects of a scene, and of the reports about them."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.settings import Recording
from ertis_numba.simulation import Ambient, Electronics, Emitter, Noise, Point, Scene, Sonar, Tone
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.effects import ASKED_FOR, EFFECTS
from ertis_numba.simulation.render import Simulator
from ertis_numba.storage import open_recording
from tests.scenes import SENSOR, scene_of

LOUD = Point(range_m=0.6, strength_db=-3.0)
AWAY = {"position_m": (0.0, 300.0, 0.0)}


def sensor(**electronics):
    return SENSOR.replace(electronics=Electronics(**electronics))


def emitter(**changes):
    return SENSOR.replace(emitter=Emitter(**changes))


ASKING = {
    "emitter_offset": Scene(sensors=(emitter(position_m=(0.0, 1e-9, 0.0)),), points=(LOUD,)),
    "clock_drift": Scene(sensors=(sensor(clock_drift_ppm=1e-6),), points=(LOUD,)),
    "emitter_response": Scene(sensors=(emitter(resonance_hz=40e3, quality_factor=1e-6),), points=(LOUD,)),
    "emitter_directivity": Scene(sensors=(emitter(diameter_m=1e-6),), points=(LOUD,)),
    "microphone_directivity": Scene(sensors=(sensor(microphone_diameter_m=1e-6),), points=(LOUD,)),
    "direct_sound": Scene(sensors=(emitter(direct_sound_db=-200.0),), points=(LOUD,)),
    "interference": Scene(sensors=(SENSOR,), points=(LOUD,), tones=(Tone(frequency_hz=1e3, level_db=-200, **AWAY),)),
    "ambient_noise": Scene(sensors=(SENSOR,), points=(LOUD,), ambient=Ambient(level_dbfs=-150.0)),
    "microphone_noise": Scene(sensors=(sensor(noise_dbfs=-150.0),), points=(LOUD,)),
    "microphone_spread": Scene(sensors=(sensor(gain_spread_db=1e-9),), points=(LOUD,)),
    "microphone_faults": Scene(sensors=(sensor(dead_channels=(1,)),)),
}


def test_each_effect_with_its_own_key_is_listed():
    assert set(ASKING) == ASKED_FOR


@pytest.mark.parametrize("name", ASKING)
def test_requested_effect_is_simulated_although_no_image_shows_it(name):
    verdict = next(verdict for verdict in make_plan(ASKING[name]).verdicts if verdict.name == name)
    assert verdict.on
    assert verdict.forced
    off = make_plan(ASKING[name].replace(effects={name: False}))
    assert name not in off.active
    assert name not in make_plan(scene_of(LOUD)).active


@pytest.mark.parametrize(
    "scene",
    [
        Scene(sensors=(SENSOR,), points=(LOUD,), noises=(Noise(level_db=-200.0, **AWAY),)),
        Scene(sensors=(SENSOR,), points=(LOUD,), sonars=(Sonar(level_db=-200.0, **AWAY),)),
    ],
)
def test_other_sources_are_simulated_although_no_image_shows_them(scene):
    assert "interference" in make_plan(scene).active


def test_recorded_noise_has_the_level_of_the_scene():
    quiet = sensor(noise_dbfs=-60.0).replace(recording=Recording(n_samples=40_000, encoding="float32"))
    far = Point(range_m=0.35, strength_db=-3.0)  # over before the second half of the record
    simulator = Simulator(Scene(sensors=(quiet,), points=(far,)))
    rest = simulator.render().data[30_000:]
    assert 20 * np.log10(np.sqrt(np.mean(np.square(rest, dtype=np.float64)))) == pytest.approx(-60.0, abs=0.2)


def test_tolerance_of_zero_keeps_every_effect():
    point = Point(range_m=0.6, velocity_m_s=(1e-9, 0.0, 0.0), diameter_m=1e-4)
    plan = make_plan(scene_of(point, tolerance_db=0.0))
    assert {"spreading", "absorption", "doppler", "target_size"} <= plan.active
    assert plan.left_out == ()
    acted_on = {verdict.name for verdict in plan.verdicts if verdict.estimate_db is not None}
    assert acted_on <= plan.active
    assert plan.active < set(EFFECTS)  # not those on which the scene has nothing to act


def test_omitted_effects_are_in_the_summary_and_in_the_file(tmp_path):
    path = tmp_path / "scene.toml"
    point = Point(range_m=0.6, velocity_m_s=(1e-4, 0.0, 0.0))
    path.write_text(scene_of(point).to_toml(), encoding="utf-8")
    done = CliRunner().invoke(cli, ["simulate", str(path), "--json"])
    assert done.exit_code == 0
    assert "doppler; --explain gives the reasons, --tolerance-db 0 keeps all effects\n" in done.stderr
    assert json.loads(done.stdout)["left_out"] == ["doppler"]
    with open_recording(path.with_suffix(".h5")) as recording:
        assert recording.truth.left_out == ("doppler",)
    done = CliRunner().invoke(cli, ["simulate", str(path), "--tolerance-db", "0", "--force"])
    assert "left out" not in done.stderr
    with open_recording(path.with_suffix(".h5")) as recording:
        assert recording.truth.left_out == ()
