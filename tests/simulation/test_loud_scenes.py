"""Verdicts on effects for signals near full scale, and for a few varied scenes."""

import json

import pytest
from click.testing import CliRunner
from ertis_bench.simulation_trials import verdicts
from ertis_bench.simulation_trials.random_scenes import OCTET, varied_scene
from ertis_bench.simulation_trials.verdicts import Trial
from ertis_cli.main import cli

from ertis_numba.settings import Processing, Recording
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor
from ertis_numba.simulation.ab_render import ABRender
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.effects import EFFECTS
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.loudness import LOUD, peak_bound
from ertis_numba.simulation.snapshot import snapshot
from tests.scenes import SENSOR, only, scene_of

PDM = {"recording": Recording(n_samples=32_768), "processing": Processing(directions="2d:31", range_m=(0.25, 1.0))}
PCM = {
    "recording": Recording(encoding="int16", sample_rate_hz=450_000.0, n_samples=3_276),
    "processing": Processing(directions="2d:31", range_m=(0.25, 1.0), range_decimation=10),
}


def beside_an_emitter(direct_sound_db, kind):
    """Return a scene of points at -26 dB and an emitter beside the microphones."""
    sensor = Sensor(array=OCTET, emitter=Emitter(direct_sound_db=direct_sound_db), **kind)
    points = (
        Point(azimuth_deg=-20.0, range_m=0.3, strength_db=-26.0),
        Point(azimuth_deg=30.0, range_m=0.8, strength_db=-26.0),
    )
    return Scene(seed=4, sensors=(sensor,), points=points)


@pytest.mark.parametrize("kind", [PDM, PCM], ids=["pdm", "pcm"])
def test_direct_sound_that_overloads_converters_is_simulated(kind):
    """The direct sound ends before the image begins, but its overload of the converters lasts longer."""
    scene = beside_an_emitter(-20.0, kind)
    plan = make_plan(scene)
    assert "direct_sound" in plan.active
    changed_db = Trial(scene).reflector_change_db(
        scene.sensors[0], only("spreading"), only("spreading", "direct_sound")
    )
    assert changed_db > 0.3


def test_direct_sound_far_below_full_scale_changes_no_image():
    scene = beside_an_emitter(-75.0, PDM)
    verdict = next(each for each in make_plan(scene).verdicts if each.name == "direct_sound")
    assert verdict.estimate_db < scene.tolerance_db
    assert verdict.on  # the scene requests the effect


@pytest.mark.parametrize("noise_dbfs", [None, -30.0])
def test_signals_stay_below_their_bound(noise_dbfs):
    for seed in range(10):
        scene = varied_scene(seed).replace(count=1)
        sensor = scene.sensors[0]
        sensor = sensor.replace(electronics=Electronics(noise_dbfs=noise_dbfs))
        scene = scene.replace(sensors=(sensor, *scene.sensors[1:]), tones=(), noises=(), ambient=None)
        names = frozenset({"spreading", "walls", "cross_emission", "direct_sound", "target_size", "emitter_response"})
        names |= {"microphone_noise", "propagation", "modulation", "emitter_offset"}
        loudest = Trial(scene.replace(sensors=(sensor,))).loudest(only(*names))
        assert loudest <= 1.05 * peak_bound(snapshot(scene, sensor, 0.0), names)


def test_verdicts_of_varied_scenes_are_right():
    report = verdicts.run(count=2, say=lambda _: None, first=6)
    assert report["scenes"] == 2
    assert report["verdicts"] > 8
    assert report["wrong"] == []


def test_benchmark_fails_on_a_wrong_verdict(monkeypatch):
    monkeypatch.setattr(Trial, "total_change_db", lambda *_: 0.5)
    slow = Point(range_m=0.5, strength_db=-26.0, velocity_m_s=(1e-5, 0.0, 0.0))
    sensor = Sensor(array=OCTET, **PCM)
    monkeypatch.setattr(verdicts, "varied_scene", lambda seed: Scene(seed=seed, sensors=(sensor,), points=(slow,)))
    done = CliRunner().invoke(cli, ["bench", "simulation", "--verdicts", "2", "--json", "--quiet"])
    report = json.loads(done.stdout)
    assert report["wrong"]
    assert {row["effect"] for row in report["wrong"]} <= set(EFFECTS)
    assert done.exit_code
    refused = CliRunner().invoke(cli, ["bench", "simulation", "--verdicts", "2", "--update", __file__])
    assert "--verdicts writes no table; remove --update" in refused.stderr


def test_disc_too_near_for_its_model_is_noted():
    near, far = (Point(range_m=range_m, diameter_m=0.4) for range_m in (0.4, 1.2))
    [note] = make_plan(scene_of(near)).notes
    assert note.startswith("points[0] is a disc of 0.4 m at 0.4 m from sensor; its echo is accurate only from 0.77 m")
    assert make_plan(scene_of(far)).notes == ()


def test_loud_threshold_is_half_of_full_scale():
    assert LOUD == 0.5
    point = Point(range_m=0.5, strength_db=0.0)
    scene = scene_of(point, sensor=SENSOR.replace(emitter=Emitter(level_db=-18.0)))
    bound = peak_bound(snapshot(scene, scene.sensors[0], 0.0), frozenset({"propagation", "spreading"}))
    assert bound == pytest.approx(10 ** (-18 / 20) / 0.25, rel=0.1)


def test_ab_render_measures_change_despite_a_sensor_without_image():
    """A range window beyond the end of the record gives no image; the other sensor's change is still measured."""
    scene = beside_an_emitter(-75.0, PDM)
    [sensor] = scene.sensors
    beyond = Processing(directions="2d:31", range_m=(5.0, 6.0))
    blind = sensor.replace(name="blind", position_m=(0.0, 5.0, 0.0), processing=beyond)
    active = frozenset({"propagation", "modulation"})
    changed_db = ABRender(scene.replace(sensors=(blind, sensor))).change_db(0, sensor.name, active, "spreading")
    assert changed_db == pytest.approx(ABRender(scene).change_db(0, sensor.name, active, "spreading"))
    assert ABRender(scene.replace(sensors=(blind,))).change_db(0, blind.name, active, "spreading") is None


def test_effect_at_half_of_the_tolerance_is_kept_in_moving_scenes(monkeypatch):
    """A/B renders cover only a few measurements of a moving scene, and the other measurements may change more."""
    scene = beside_an_emitter(-75.0, PCM).replace(effects={"absorption": False}, count=9)
    moving = scene.replace(points=(*scene.points[1:], scene.points[0].replace(velocity_m_s=(0.5, 0.0, 0.0))))
    monkeypatch.setattr(ABRender, "change_db", lambda *_: 0.07)
    estimate = Estimate(change_db=0.05, reason="a test", sure=20.0)
    monkeypatch.setattr("ertis_numba.simulation.effects.doppler.estimate", lambda _: estimate)
    assert "doppler" not in make_plan(scene).active
    assert "doppler" in make_plan(moving).active
