"""Choice of effects: random scenes, each effect omitted and added, and the change of the images.

`ertis bench simulation --verdicts N` tests many more scenes.
"""

import subprocess
import sys

import numpy as np
import pytest
from ertis_bench.simulation_trials.random_scenes import random_scene
from ertis_bench.simulation_trials.verdicts import Trial, with_one

from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import Emitter, Noise, Point, Scene, Sensor, Sonar, Wall
from ertis_numba.simulation.effect_plan import make_plan
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import SAME_RANGE_M, Sight
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.snapshot import snapshot

# Of 60 scenes, those with each kind of verdict twice, and with the smallest differences from the tolerance.
SEEDS = (3, 5, 10, 11, 12, 13, 14, 15, 1009, 1014, 2000, 2006, 2008)
ON = {"absorption", "cross_emission", "doppler", "spreading", "sync_delay", "target_size", "walls"}
OFF = {"doppler", "occlusion", "sync_delay", "target_size", "walls"}


def test_omitted_effects_change_images_by_less_than_the_tolerance():
    """This is the only promise of the planner, tested through the whole chain."""
    wrong, tried = [], {True: set(), False: set()}
    for seed in SEEDS:
        scene = random_scene(seed)
        plan = make_plan(scene)
        trial = Trial(scene)
        assert trial.loudest(plan) <= 0.6  # above, the smallest change turns all bits round
        for verdict in plan.verdicts:
            if verdict.estimate_db is None:
                continue  # indispensable, or nothing in the scene that it could act upon
            if verdict.on and (verdict.coupled or verdict.forced):
                continue  # on, however little it changes
            tried[verdict.on].add(verdict.name)
            changed_db = trial.change_db(plan, verdict.name)
            if verdict.on and changed_db <= scene.tolerance_db:
                wrong.append((seed, verdict.name, "needed, yet it changes", changed_db))
            if not verdict.on and changed_db >= scene.tolerance_db:
                wrong.append((seed, verdict.name, "left out, yet it changes", changed_db))
    assert not wrong
    assert tried[True] >= ON
    assert tried[False] >= OFF


@pytest.mark.parametrize(
    ("sensor", "point", "name"),
    [
        (Sensor(), Point(range_m=5.0, strength_db=-60.0), "absorption"),
        (
            Sensor(emitter=Emitter(level_db=-20.0, diameter_m=0.02)),
            Point(azimuth_deg=60.0, range_m=1.0, strength_db=-30.0),
            "emitter_directivity",
        ),
    ],
)
def test_weak_visible_echoes_count(sensor, point, name):
    """They are about 14 and 19 dB above the modulators' noise, and change by 10 and 20 dB."""
    assert name in make_plan(Scene(sensors=(sensor,), points=(point,))).active


def test_verdicts_hold_for_pdm_images():
    """Omitted effects move no reflector in images of PDM signals; levels are high enough to be certain."""
    for seed in range(6):
        scene = random_scene(seed)
        loud = scene.replace(points=tuple(point.replace(strength_db=-12.0) for point in scene.points), spheres=())
        plan = make_plan(loud)
        if Trial(loud).loudest(plan) > 0.6:
            continue
        sensor = loud.sensors[0]
        pipeline = Pipeline(sensor.settings(), predict=False)
        bits = pipeline.process(Simulator(loud, plan=plan).render()).amplitude.astype(float)
        shown = Sight(snapshot(loud, sensor, 0.0), plan.active)
        sure = shown.shown & (shown.heard.level > 300 * shown.noise)
        echo_ranges_m = shown.heard.delay_s[sure] * shown.shot.speed_m_s / 2
        for name in {verdict.name for verdict in plan.verdicts if not verdict.on and verdict.estimate_db is not None}:
            turned = pipeline.process(Simulator(loud, plan=with_one(plan, name, on=True)).render()).amplitude
            for range_m in echo_ranges_m:
                near = np.abs(pipeline.range_m - range_m) < SAME_RANGE_M
                change_db = 20 * np.log10(turned[:, near].max() / bits[:, near].max())
                assert abs(change_db) < loud.tolerance_db, (seed, name, range_m)


def test_mutually_dependent_effects_stay_on(monkeypatch):
    """Walls matter only without the facing of discs, which matters only with the walls."""

    def of(name, matters):
        return lambda sight: Estimate(change_db=6.0 if matters(sight.active) else 0.0, reason=name)

    effects = "ertis_numba.simulation.effects"
    monkeypatch.setattr(f"{effects}.walls.estimate", of("walls", lambda active: "target_size" not in active))
    monkeypatch.setattr(f"{effects}.target_size.estimate", of("size", lambda active: "walls" in active))
    wall = Wall(position_m=(1.5, 0.0, 0.0), facing_deg=(180.0, 0.0))
    scene = Scene(points=(Point(range_m=1.0, diameter_m=0.01),), walls=(wall,))
    verdicts = {verdict.name: verdict for verdict in make_plan(scene).verdicts}
    for name in ("walls", "target_size"):
        assert verdicts[name].on
        assert verdicts[name].coupled
        assert verdicts[name].reason.endswith("stays on, because other effects depend on it")


def test_unneeded_effects_are_not_imported():
    """In a separate process, a free field loads only the effects of its plan, and draws no unused noise."""
    code = """
import sys
from ertis_numba.simulation import Point, Scene
from ertis_numba.simulation.render import Simulator
simulator = Simulator(Scene(points=(Point(range_m=1.0), Point(range_m=3.0, azimuth_deg=30.0))))
simulator.render()
prefix = "ertis_numba.simulation.effects."
print(sorted(name.removeprefix(prefix) for name in sys.modules if name.startswith(prefix)))
print(sorted(simulator.plan.active))
print(sorted(simulator.clock.cost_ms))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, active, costs = done.stdout.splitlines()
    assert loaded == "['absorption', 'propagation', 'spreading']"
    assert active == costs == "['absorption', 'modulation', 'propagation', 'spreading']"


@pytest.mark.parametrize(
    "more",
    [
        {
            "count": 20,
            "sonars": (Sonar(position_m=(2.0, -1.0, 0.0), level_db=-30.0, offset_s=0.04, period_s=0.049),),
        },
        {"noises": (Noise(position_m=(2.0, -1.0, 0.0), level_db=-30.0, band_hz=(40_000.0, 40_001.0)),)},
        {"sonars": (Sonar(position_m=(2.0, -1.0, 0.0), level_db=-85.0, offset_s=0.0),) * 30},
    ],
)
def test_interference_is_detected(more):
    """Cases: a sonar that the first measurement does not receive, very narrow noise, and many weak sources."""
    scene = Scene(points=(Point(azimuth_deg=30.0, range_m=2.0),), **more)
    assert "interference" in make_plan(scene).active


def test_events_between_waypoints_are_detected():
    """A screen blocks the path for 0.2 s out of 5 s."""
    times_s = ((0.0, -5.0), (1.3, -5.0), (1.4, 0.0), (1.5, 0.0), (1.6, 5.0), (5.0, 5.0))
    screen = Wall(
        waypoints=tuple((time_s, 1.0, y, 0.0) for time_s, y in times_s), facing_deg=(180.0, 0.0), size_m=(0.5, 0.5)
    )
    scene = Scene(count=100, points=(Point(range_m=2.0),), walls=(screen,))
    assert {"walls", "occlusion"} <= make_plan(scene).active
