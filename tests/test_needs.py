"""Only what the scene calls for: 200 random scenes, each effect left out and put in, and what the images say of it."""

import dataclasses
import functools
import math
import subprocess
import sys

import numpy as np
import pytest

from ertis_numba import kernels
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Air, Array, Call, Processing, Recording
from ertis_numba.simulation import Ambient, Electronics, Emitter, Noise, Point, Scene, Sensor, Sonar, Sphere, Tone, Wall
from ertis_numba.simulation.needs import ESTIMATES, Estimate
from ertis_numba.simulation.plan import Plan, make_plan
from ertis_numba.simulation.rehearsal import image_change_db
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.sight import SAME_RANGE_M, Sight
from ertis_numba.simulation.snapshot import snapshot
from ertis_numba.stages.fast import FastChain

OCTET = Array(
    layout="octet",
    positions_m=tuple(
        (0.0, 0.004 * (mic - 3.5) + 0.0007 * ((7 * mic) % 5 - 2), 0.004 * ((5 * mic) % 7 - 3)) for mic in range(8)
    ),
    word_bits=8,
)
BATCHES = 10


class Dice:
    """Seeded draws for scenes."""

    def __init__(self, seed):
        self.random = np.random.default_rng(seed)

    def chance(self, part):
        return self.random.random() < part

    def between(self, low, high):
        return float(self.random.uniform(low, high))

    def decades(self, low, high):
        return float(np.exp(self.random.uniform(np.log(low), np.log(high))))

    def place(self):
        return {
            "azimuth_deg": self.between(-60, 60),
            "elevation_deg": self.between(-3, 3),
            "range_m": self.between(0.35, 0.95),
        }


def random_scene(seed):
    """A scene of some of everything, from far too weak to matter to strong, that overloads no modulator."""
    dice = Dice(seed)
    points = tuple(_point(dice) for _ in range(dice.random.integers(1, 4)))
    spheres = (_sphere(dice),) if dice.chance(0.3) else ()
    walls = _walls(dice)
    sensor = _sensor(dice)
    other = sensor.replace(
        name="other",
        position_m=(dice.between(0.6, 1.1), dice.between(-0.4, 0.4), 0.0),
        yaw_deg=180.0,
        emitter=Emitter(level_db=dice.between(-100, -20)),
        electronics=Electronics(),
    )
    return Scene(
        seed=seed,
        sensors=(sensor, other) if dice.chance(0.25) else (sensor,),
        points=points,
        spheres=spheres,
        walls=walls,
        **_sources(dice),
    )


def _point(dice):
    place = dice.place()
    more = {}
    if dice.chance(0.3):
        more["velocity_m_s"] = tuple((dice.random.normal(size=3) * dice.decades(1e-3, 3)).tolist())
    if dice.chance(0.3):
        more["diameter_m"] = dice.decades(1e-3, 0.1)
    return Point(**place, strength_db=dice.between(-50, -3) + 40 * math.log10(place["range_m"]), **more)


def _sphere(dice):
    place, radius_m = dice.place(), dice.decades(2e-3, 0.2)
    echo_db = dice.between(-18, -3) + 40 * math.log10(place["range_m"]) - 20 * math.log10(radius_m / 2)
    return Sphere(**place, radius_m=radius_m, reflection_db=min(0.0, echo_db))


def _walls(dice):
    walls = []
    if dice.chance(0.3):
        place = (0.0, dice.between(0.6, 1.4) * (1 if dice.chance(0.5) else -1), 0.0)
        size_m = None if dice.chance(0.5) else (dice.decades(0.2, 3), 2.0)
        walls.append(Wall(position_m=place, facing_deg=(90, 0), reflection_db=dice.between(-65, -5), size_m=size_m))
    if dice.chance(0.2):
        place, size_m = (dice.between(0.3, 1.2), dice.between(-0.5, 0.5), 0.0), (dice.decades(0.01, 0.5), 0.5)
        walls.append(Wall(position_m=place, facing_deg=(180, 0), reflection_db=dice.between(-65, -5), size_m=size_m))
    return tuple(walls)


def _sources(dice):
    found = {}
    if dice.chance(0.2):
        tone = Tone(**dice.place(), frequency_hz=dice.decades(15e3, 90e3), level_db=dice.between(-100, -30))
        found["tones"] = (tone,)
    if dice.chance(0.2):
        found["noises"] = (Noise(**dice.place(), level_db=dice.between(-100, -30)),)
    if dice.chance(0.2):
        call = Call() if dice.chance(0.5) else Call(start_frequency_hz=80e3, stop_frequency_hz=20e3)
        level_db, offset_s = dice.between(-100, -30), dice.between(0, 0.05)
        found["sonars"] = (Sonar(**dice.place(), level_db=level_db, offset_s=offset_s, call=call),)
    if dice.chance(0.3):
        found["ambient"] = Ambient(level_dbfs=dice.between(-110, -30))
    return found


def _sensor(dice):
    electronics, emitter = {}, {"level_db": -15.0}
    if dice.chance(0.5):
        electronics["noise_dbfs"] = dice.between(-90, -20)
    if dice.chance(0.3):
        electronics["gain_spread_db"] = dice.decades(1e-3, 3)
    if dice.chance(0.2):
        electronics["delay_spread_s"] = dice.decades(1e-9, 3e-6)
    if dice.chance(0.1):
        electronics["dead_channels"] = (int(dice.random.integers(8)),)
    if dice.chance(0.4):
        electronics["microphone_diameter_m"] = dice.decades(5e-4, 8e-3)
    if dice.chance(0.4):
        emitter["diameter_m"] = dice.decades(1e-3, 0.04)
    if dice.chance(0.3):
        emitter["direct_sound_db"] = dice.between(-100, -50)
    return Sensor(
        array=OCTET,
        recording=Recording(n_samples=32_768),
        air=Air(temperature_c=dice.between(-20, 45), humidity_percent=dice.between(0, 100)),
        processing=Processing(directions="2d:61", range_m=(0.3, 1.05) if dice.chance(0.5) else (0.55, 1.05)),
        electronics=Electronics(**electronics),
        emitter=Emitter(**emitter),
    )


@functools.lru_cache(maxsize=2)
def chain(settings):
    plan = Accuracy(
        precision="float32", oversampling=4, delay_taps=2, beam_taps=0, beam_density=2.0, stop_band_db=60.0, zones=1
    )
    return FastChain(settings.replace(accuracy=plan), kernels.load("cpu"), threads=2)


@functools.lru_cache(maxsize=2)
def white_noise(seed, shape):
    return np.random.default_rng(seed).standard_normal(shape)


def signals_of(scene, plan):
    """What each sensor's modulators would receive."""
    return [Simulator(scene, sensor=sensor.name, plan=plan).signals(0) for sensor in scene.sensors]


def images(scene, plan, received):
    """One energyscape per sensor, without modulators, which add other noise each time."""
    found = []
    for sensor, silent in zip(scene.sensors, received, strict=True):
        signals, dbfs = silent, sensor.electronics.noise_dbfs
        if "microphone_noise" in plan.active and dbfs is not None:
            signals = silent + 10 ** (dbfs / 20) * white_noise(scene.seed, silent.shape)
        imaging = chain(sensor.settings())
        image = np.empty((len(imaging.grid), len(imaging.range_m)), dtype=np.float32)
        imaging.process_signals(signals, image)
        found.append(image)
    return found


def overload(received):
    """Whether a modulator is driven out of its range, where the smallest change turns all its bits round."""
    return any(np.abs(signals).max() > 0.6 for signals in received)


def with_one(plan, name, *, on):
    return Plan(
        tuple(dataclasses.replace(verdict, on=on) if verdict.name == name else verdict for verdict in plan.verdicts)
    )


def measured_db(scene, plan, name, planned):
    """By how much images change when the verdict on one effect is turned round."""
    is_on = name in plan.active
    other = with_one(plan, name, on=not is_on)
    turned = images(scene, other, signals_of(scene, other))
    changes_db = []
    for sensor, before, after in zip(scene.sensors, planned, turned, strict=True):
        shot = snapshot(scene, sensor, 0.0)
        floor = min(Sight(shot, plan.active | {name}).floor, Sight(shot, plan.active - {name}).floor)
        spacing_m = shot.speed_m_s / 2 / sensor.settings().output_rate_hz
        changes_db.append(image_change_db(before, after, spacing_m=spacing_m, floor=floor))
    return max(changes_db)


@pytest.mark.parametrize("batch", range(BATCHES))
def test_what_is_left_out_changes_less_and_what_is_needed_more(batch):
    """The one promise of the planner, on 200 scenes and through the whole chain."""
    wrong, seeds, count = [], range(batch * 1000, (batch + 1) * 1000), 0
    for seed in seeds:
        if count == 200 // BATCHES:
            break
        scene = random_scene(seed)
        plan = make_plan(scene)
        received = signals_of(scene, plan)
        if overload(received):
            continue
        count += 1
        planned = images(scene, plan, received)
        for verdict in plan.verdicts:
            if verdict.estimate_db is None:
                continue  # indispensable, or nothing in the scene that it could act upon
            if verdict.rehearsed and batch:
                continue  # measured in the same way already: the first batch shows that this is so
            change_db = measured_db(scene, plan, verdict.name, planned)
            if verdict.on and change_db <= scene.tolerance_db and not verdict.coupled:
                wrong.append((seed, verdict.name, "needed, yet it changes", change_db))
            if not verdict.on and change_db >= scene.tolerance_db:
                wrong.append((seed, verdict.name, "left out, yet it changes", change_db))
    assert not wrong


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
def test_weak_echoes_count_as_long_as_an_image_shows_them(sensor, point, name):
    """Some 14 and 19 dB above the modulators' noise, and changed by 10 and 20 dB."""
    assert name in make_plan(Scene(sensors=(sensor,), points=(point,))).active


def test_verdicts_hold_in_images_from_bits():
    """What is left out moves no reflector in images that went through the modulators, loud enough to be sure of it."""
    for seed in range(6):
        scene = random_scene(seed)
        loud = scene.replace(points=tuple(point.replace(strength_db=-12.0) for point in scene.points), spheres=())
        plan = make_plan(loud)
        if overload(signals_of(loud, plan)):
            continue
        sensor = loud.sensors[0]
        pipeline = Pipeline(sensor.settings())
        bits = pipeline.process(Simulator(loud, plan=plan).render()).energy.astype(float)
        shown = Sight(snapshot(loud, sensor, 0.0), plan.active)
        sure = shown.shown & (shown.levels(shown.heard) > 300 * shown.noise)
        echo_ranges_m = shown.heard.delay_s[sure] * shown.shot.speed_m_s / 2
        for name in {verdict.name for verdict in plan.verdicts if not verdict.on and verdict.estimate_db is not None}:
            turned = pipeline.process(Simulator(loud, plan=with_one(plan, name, on=True)).render()).energy
            for range_m in echo_ranges_m:
                near = np.abs(pipeline.range_m - range_m) < SAME_RANGE_M
                change_db = 20 * np.log10(turned[:, near].max() / bits[:, near].max())
                assert abs(change_db) < loud.tolerance_db, (seed, name, range_m)


def test_effects_that_go_in_a_circle_all_stay_on(monkeypatch):
    """Walls matter without the facing of discs only, and that only with the walls."""

    def of(name, matters):
        return lambda sight: Estimate(change_db=6.0 if matters(sight.active) else 0.0, reason=name)

    monkeypatch.setitem(ESTIMATES, "walls", of("walls", lambda active: "target_size" not in active))
    monkeypatch.setitem(ESTIMATES, "target_size", of("size", lambda active: "walls" in active))
    verdicts = {verdict.name: verdict for verdict in make_plan(Scene(points=(Point(range_m=1.0),))).verdicts}
    for name in ("walls", "target_size"):
        assert verdicts[name].on
        assert verdicts[name].coupled
        assert verdicts[name].reason.endswith("stays on, as others wait for it")


def test_what_is_not_needed_is_not_imported():
    """In a process of its own, a free field loads what its plan names, and noise of nobody is not drawn."""
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
def test_interference_is_found(more):
    """Of a sonar that the first measurement does not hear, of the narrowest noise, and of many that are weak."""
    scene = Scene(points=(Point(azimuth_deg=30.0, range_m=2.0),), **more)
    assert "interference" in make_plan(scene).active


def test_what_happens_between_way_points_is_found():
    """A screen that stands in the way for a fifth of a second out of five."""
    times_s = ((0.0, -5.0), (1.3, -5.0), (1.4, 0.0), (1.5, 0.0), (1.6, 5.0), (5.0, 5.0))
    screen = Wall(
        waypoints=tuple((time_s, 1.0, y, 0.0) for time_s, y in times_s), facing_deg=(180.0, 0.0), size_m=(0.5, 0.5)
    )
    scene = Scene(count=100, points=(Point(range_m=2.0),), walls=(screen,))
    assert {"walls", "occlusion"} <= make_plan(scene).active
