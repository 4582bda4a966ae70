"""Trials of verdicts on effects with random scenes. Images with and without each effect are compared."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench.simulation_trials.random_scenes import varied_scene
from ertis_numba import kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.simulation import Scene, Sensor
from ertis_numba.simulation.ab_render import image_change_db
from ertis_numba.simulation.effect_plan import EffectPlan, make_plan
from ertis_numba.simulation.image_estimate import SAME_RANGE_M, Sight
from ertis_numba.simulation.loudness import LOUD
from ertis_numba.simulation.render import Simulator
from ertis_numba.simulation.snapshot import Snapshot, snapshot

__all__ = ["Trial", "run", "with_one"]

_MIN_LEVEL_TO_NOISE = 300  # Relative to the noise of modulators, which changes such a reflector by less than 0.03 dB.
_PLAN = Accuracy(
    precision="float32",
    oversampling=4,
    delay_taps=2,
    beam_taps=0,
    beam_density=2.0,
    stopband_attenuation_db=60.0,
    focal_zones=1,
)


def run(*, count: int, say: Callable[[str], None], first: int = 0) -> dict[str, Any]:
    """Check the verdicts on some random scenes."""
    tried, rendered, wrong = 0, 0, []
    for seed in range(first, first + count):
        say(f"scene {seed}")
        scene = varied_scene(seed)
        plan = make_plan(scene)
        tried += sum(verdict.estimate_db is not None for verdict in plan.verdicts)
        rendered += sum(verdict.ab_rendered for verdict in plan.verdicts)
        index = int(np.random.default_rng(seed).integers(scene.count))
        found = Trial(scene, index).left_out(plan)
        wrong += [{"scene": seed, **each} for each in found if each["change_db"] > scene.tolerance_db]
    return {"scenes": count, "verdicts": tried, "rendered": rendered, "wrong": wrong}


def with_one(plan: EffectPlan, name: str, *, on: bool) -> EffectPlan:
    """Return a plan with another verdict on one effect."""
    return EffectPlan(
        tuple(dataclasses.replace(verdict, on=on) if verdict.name == name else verdict for verdict in plan.verdicts)
    )


class Trial:
    """Comparison of images of one measurement of a scene with different effects."""

    def __init__(self, scene: Scene, index: int = 0) -> None:
        self.scene, self.index = scene, index
        self._signals = functools.lru_cache(maxsize=8)(self._render_signals)
        self._image = functools.lru_cache(maxsize=8)(self._render_image)

    def left_out(self, plan: EffectPlan) -> list[dict[str, Any]]:
        """Return the change of the images in dB by each effect that the plan omits."""
        return [
            {
                "effect": verdict.name,
                "measurement": self.index,
                "estimate_db": verdict.estimate_db,
                "ab_rendered": verdict.ab_rendered,
                "change_db": self.total_change_db(plan, verdict.name),
            }
            for verdict in plan.verdicts
            if not verdict.on and verdict.estimate_db is not None
        ]

    def total_change_db(self, plan: EffectPlan, name: str) -> float:
        """Return the change of the images by an effect in dB.

        Images of loud signals are also compared after modulation.
        """
        changed_db = self.change_db(plan, name)
        other = with_one(plan, name, on=name not in plan.active)
        if max(self.loudest(each) for each in (plan, other)) < LOUD:
            return changed_db
        return max(changed_db, *(self.reflector_change_db(sensor, plan, other) for sensor in self.scene.sensors))

    def loudest(self, plan: EffectPlan) -> float:
        """Return the highest amplitude that modulators or converters receive."""
        return max(float(np.abs(self._signals(sensor.name, plan)).max()) for sensor in self.scene.sensors)

    def change_db(self, plan: EffectPlan, name: str) -> float:
        """Return the change of images in dB by an effect before modulators, whose noise differs in each render."""
        other = with_one(plan, name, on=name not in plan.active)
        changes_db = []
        for sensor in self.scene.sensors:
            before, after = (self._image(sensor.name, each) for each in (plan, other))
            shot = self._shot(sensor)
            floor = min(Sight(shot, plan.active | {name}).floor, Sight(shot, plan.active - {name}).floor)
            spacing_m = shot.speed_m_s / 2 / sensor.settings().output_rate_hz
            changes_db.append(image_change_db(before, after, spacing_m=spacing_m, floor=floor))
        return max(changes_db)

    def reflector_change_db(self, sensor: Sensor, one: EffectPlan, other: EffectPlan) -> float:
        """Return the change of the levels in dB of reflectors far above the noise, in images from words.

        A change that another realisation of the noise also causes is subtracted.
        """
        pipeline = Pipeline(sensor.settings(), predict=False)
        shown = Sight(self._shot(sensor), one.active)
        sure = shown.shown & (shown.heard.level > _MIN_LEVEL_TO_NOISE * shown.noise)
        ranges_m = shown.heard.delay_s[sure] * shown.shot.speed_m_s / 2

        def levels_db(seed: int, plan: EffectPlan) -> NDArray[np.float64]:
            scene = self.scene.replace(seed=seed)
            words = Simulator(scene, sensor=sensor.name, plan=plan).render(self.index)
            image = pipeline.process(words).amplitude
            near = [np.abs(pipeline.range_m - range_m) < SAME_RANGE_M for range_m in ranges_m]
            return np.array([20 * math.log10(image[:, places].max()) for places in near if places.any()])

        seed = self.scene.seed
        before, after, again = (levels_db(*each) for each in ((seed, one), (seed, other), (seed + 1, one)))
        return float(np.max(np.abs(after - before) - np.abs(again - before), initial=0.0))

    def _shot(self, sensor: Sensor) -> Snapshot:
        return snapshot(self.scene, sensor, self.index / self.scene.rate_hz)

    def _render_signals(self, name: str, plan: EffectPlan) -> NDArray[np.float64]:
        signals = Simulator(self.scene, sensor=name, plan=plan).signals(self.index)
        dbfs = self.scene.sensor(name).electronics.noise_dbfs
        if "microphone_noise" in plan.active and dbfs is not None:
            signals += 10 ** (dbfs / 20) * _white_noise(self.scene.seed, signals.shape)
        return signals

    def _render_image(self, name: str, plan: EffectPlan) -> NDArray[np.float32]:
        chain = _chain(self.scene.sensor(name).settings())
        image = np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32)
        chain.process_signals(self._signals(name, plan), image)
        return image


@functools.lru_cache(maxsize=4)
def _chain(settings: Settings) -> FastChain:
    kernel_set = kernels.load("cpu")
    return FastChain(settings.replace(accuracy=_PLAN), kernel_set, threads=kernel_set.max_threads)


@functools.lru_cache(maxsize=2)
def _white_noise(seed: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    return np.random.default_rng(seed).standard_normal(shape)
