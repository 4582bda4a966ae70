"""Rendering of a scene to the raw samples that its sensors would record."""

import functools
from dataclasses import dataclass, field

import msgspec

from ertis_numba.base import checks
from ertis_numba.frames import Measurement
from ertis_numba.settings import Array, Recording
from ertis_numba.simulation.effect_plan import EffectPlan, make_plan
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.targets import Point

__all__ = ["Simulator", "compile_kernels", "render"]


class Simulator(Engine):
    """Renders the measurements of one sensor with the effects that the scene needs.

    Parameters
    ----------
    scene : Scene
    sensor : str, optional
        Name of the sensor; the first of the scene by default.
    plan : EffectPlan, optional
        Effects to simulate; `make_plan` chooses them by default.
    threads : int, optional
        Number of threads; all cores by default. The bits do not depend on it.

    Attributes
    ----------
    plan : EffectPlan
        Effects that are simulated, with reasons.

    Raises
    ------
    ArgumentError
        ``scene`` is not a `Scene`, the scene has no such sensor, or the scene exceeds a limit.

    Examples
    --------
    >>> from ertis_numba import Simulator
    >>> from ertis_numba.simulation import Point, Scene
    >>> simulator = Simulator(Scene(points=(Point(range_m=1.0),)))
    >>> [f"{reflector.range_m:.2f} m" for reflector in simulator.reflectors()]
    ['1.00 m']
    """

    def __init__(
        self, scene: Scene, *, sensor: str | None = None, plan: EffectPlan | None = None, threads: int | None = None
    ) -> None:
        checks.instance("scene", scene, Scene, "load_scene returns")
        self.plan = _plan_of(_ByValue(msgspec.msgpack.encode(scene), scene)) if plan is None else plan
        super().__init__(scene, scene.sensor(sensor), self.plan.active, threads=threads)


@dataclass(frozen=True, slots=True)
class _ByValue:
    """Scene as the key of a cache; its dictionary of effects has no hash."""

    encoded: bytes
    scene: Scene = field(compare=False)


@functools.lru_cache(maxsize=8)  # Planning takes longer than a rendering, and all sensors of a scene share its plan.
def _plan_of(key: _ByValue) -> EffectPlan:
    return make_plan(key.scene)


def render(scene: Scene, index: int = 0, *, sensor: str | None = None) -> Measurement:
    """Return one measurement of a scene; use `Simulator` for several.

    Parameters
    ----------
    scene : Scene
    index : int
        Index of the measurement; 0 by default.
    sensor : str, optional
        Name of the sensor; the first of the scene by default.

    Returns
    -------
    Measurement
        Raw samples with settings, sensor name and time stamps.

    Raises
    ------
    ArgumentError
        ``scene`` is not a `Scene`, the scene has no such sensor, or the scene exceeds a limit.

    Examples
    --------
    >>> from ertis_numba import render
    >>> from ertis_numba.simulation import Point, Scene
    >>> render(Scene(points=(Point(range_m=1.0),))).data.shape
    (163840,)
    """
    return Simulator(scene, sensor=sensor).render(index)


def compile_kernels() -> None:
    """Compile the kernels for rendering, but not those for A/B renders, so that callers can report the delay."""
    sensor = Sensor(
        array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)),
        recording=Recording(n_samples=20_000),
    )
    scene = Scene(sensors=(sensor,), points=(Point(range_m=0.25),))
    effects = frozenset({"propagation", "spreading", "modulation"})
    Engine(scene, sensor, effects).render()
