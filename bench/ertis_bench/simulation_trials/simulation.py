"""Cost of a simulated measurement with the relevant effects of its scene, and with all effects."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ertis_bench import machine, timing
from ertis_bench.machine import sentence
from ertis_bench.markdown import table
from ertis_numba.base.errors import DataError
from ertis_numba.pipeline import Pipeline
from ertis_numba.simulation import (
    Ambient,
    Electronics,
    Emitter,
    Noise,
    Point,
    Scene,
    Sensor,
    Sonar,
    Sphere,
    Tone,
    Wall,
)
from ertis_numba.simulation.ab_render import image_change_db
from ertis_numba.simulation.effect_plan import EffectPlan, make_plan
from ertis_numba.simulation.effects import ASKED_FOR, EFFECTS
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.snapshot import snapshot

__all__ = ["FORMS", "form", "free_field", "run"]

_NEGLIGIBLE_DB = -180.0
_ALL_EFFECTS = [name for name in EFFECTS if name != "microphone_faults"]  # A missing microphone is always relevant.


def free_field() -> Scene:
    """Return a scene of ten points before a default eRTIS sensor, with a negligible source of every effect."""
    weak = _NEGLIGIBLE_DB
    points = tuple(
        Point(azimuth_deg=-60.0 + 12 * n, range_m=0.8 + 0.35 * n, strength_db=-20.0 + 2 * n) for n in range(9)
    )
    still_moving = Point(
        azimuth_deg=48.0, range_m=3.95, strength_db=-2.0, diameter_m=1e-4, velocity_m_s=(0.0, 0.0, 1e-7)
    )
    sensor = Sensor(
        emitter=Emitter(
            diameter_m=1e-5,
            direct_sound_db=weak,
            position_m=(0.0, 0.0, 1e-9),
            resonance_hz=40_000.0,
            quality_factor=1e-6,
        ),
        electronics=Electronics(
            noise_dbfs=-150.0, gain_spread_db=1e-7, microphone_diameter_m=1e-5, clock_drift_ppm=1e-6
        ),
    )
    return Scene(
        sensors=(sensor, Sensor(name="far", position_m=(300.0, 0.0, 0.0), emitter=Emitter(level_db=weak))),
        points=(*points, still_moving),
        spheres=(Sphere(position_m=(3.0, 1.0, 0.0), radius_m=0.01, reflection_db=weak),),
        walls=tuple(Wall(position_m=(0.0, y, 0.0), facing_deg=(90.0, 0.0), reflection_db=weak) for y in (-4.0, 4.0)),
        tones=(Tone(position_m=(2.0, 0.0, 0.0), frequency_hz=40_000.0, level_db=weak),),
        noises=(Noise(position_m=(2.0, 1.0, 0.0), level_db=weak),),
        sonars=(Sonar(position_m=(2.0, -1.0, 0.0), level_db=weak),),
        ambient=Ambient(level_dbfs=weak),
    )


def run(*, count: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure the time of measurements of `free_field`, including modulators."""
    scene = free_field()
    say("choosing the effects")
    # Keys of the scene request most of these effects, which would keep them on. Here, only the change of the image
    # must decide.
    plan = make_plan(scene.replace(effects=dict.fromkeys(ASKED_FOR, False)))
    everything = make_plan(scene.replace(effects=dict.fromkeys(_ALL_EFFECTS, True)))
    say("comparing the images")
    change_db = _change_db(scene, plan, everything)
    allowed_db = scene.tolerance_db * len(everything.active - plan.active)
    if change_db > allowed_db:
        raise DataError(
            f"omitted effects change the image by {change_db:.2f} dB; the limit is {allowed_db:.1f} dB. "
            "Do not use these times"
        )
    say(f"timing {count} of each")
    simulators = {"relevant effects": Simulator(scene, plan=plan), "all effects": Simulator(scene, plan=everything)}
    for simulator in simulators.values():
        simulator.render()
        simulator.clock.cost_ms.clear()
    rendered = dict.fromkeys(simulators, 0)

    def render(name: str) -> None:
        simulators[name].render(rendered[name] % 2)
        rendered[name] += 1

    times_ms = timing.round_robin({name: functools.partial(render, name) for name in simulators}, count=count)
    medians_ms = [float(np.median(times_ms[name])) for name in simulators]
    rows = [
        {
            "effects": name,
            "on": sorted(simulator.plan.active, key=list(EFFECTS).index),
            **timing.summary(times_ms[name]),
            "cost_ms": {
                effect: round(cost_ms / rendered[name], 3) for effect, cost_ms in simulator.clock.cost_ms.items()
            },
        }
        for name, simulator in simulators.items()
    ]
    return {
        "machine": machine.describe(),
        "rows": rows,
        "count": count,
        "words": scene.sensors[0].recording.n_samples,
        "change_db": round(change_db, 4),
        "times_faster": round(medians_ms[1] / medians_ms[0], 2),
    }


def _change_db(scene: Scene, plan: EffectPlan, everything: EffectPlan) -> float:
    """Return the difference between the images of both plans in dB."""
    sensor = scene.sensors[0]
    pipeline = Pipeline(sensor.settings())
    images = [pipeline.process(Simulator(scene, plan=each).render()).amplitude for each in (plan, everything)]
    shot = snapshot(scene, sensor, 0.0)
    spacing_m = float(pipeline.range_m[1] - pipeline.range_m[0])
    return image_change_db(images[0], images[1], spacing_m=spacing_m, floor=Sight(shot, plan.active).floor)


def form(report: dict[str, Any]) -> str:
    """Return the times of a measurement with the relevant effects and with all effects, and the cost of each effect."""
    needed, everything = report["rows"]
    rows = [
        [row["effects"], f"{len(row['on'])}", timing.in_words(**row), f"{1e3 / row['median_ms']:.1f}"]
        for row in (needed, everything)
    ]
    costs = [
        [f"`{name}`", f"{needed['cost_ms'].get(name, 0.0):.1f}" if name in needed["on"] else "off", f"{cost_ms:.1f}"]
        for name, cost_ms in sorted(everything["cost_ms"].items(), key=lambda item: -item[1])
    ]
    return "\n\n".join(
        [
            table(["simulated", "effects", "ms, mean ± std (median)", "measurements per second"], rows),
            f"Time with all effects / time with the relevant effects: {report['times_faster']:.1f}.",
            table(["ms per measurement", "relevant effects", "all effects"], costs),
            f"Measured on {sentence(report['machine'])}",
            _scene_conditions(report),
        ]
    )


def _scene_conditions(report: dict[str, Any]) -> str:
    return (
        f"{report['count']} measurements each, in turns of {timing.BURST}: {report['words']:,} words of 32 "
        "microphones, ten points in free field, and in the same scene a second sensor, walls, a sphere, a disc, "
        "motion, tones, noise, another sonar and unequal microphones, all too weak to matter. Times include everything "
        "from the scene to the words in memory. They exclude the choice of the effects, compilation, and warm-up "
        f"calls. The images of both differ by at most {report['change_db']:.2g} dB. `propagation` counts "
        "the transforms that all echoes share."
    )


FORMS = {"simulation": form}
"""Forms of the table, by the name in its markers."""
