"""From a scene to the words that its sensors would record."""

from ertis_numba import checks
from ertis_numba.frames import Measurement
from ertis_numba.settings import Array, Processing, Recording
from ertis_numba.simulation.ab_render import ABRender
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.plan import EffectPlan, make_plan
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sensors import Sensor
from ertis_numba.simulation.targets import Point

__all__ = ["Simulator", "compile_kernels", "render"]


class Simulator(Engine):
    """Renders the measurements of one sensor with the effects that the scene calls for.

    Parameters
    ----------
    scene : Scene
    sensor : str, optional
        The first by default.
    plan : Plan, optional
        Which effects; what the scene calls for by default.
    threads : int, optional
        All cores by default. The bits do not depend on it.

    Attributes
    ----------
    plan : Plan
    """

    def __init__(
        self, scene: Scene, *, sensor: str | None = None, plan: EffectPlan | None = None, threads: int | None = None
    ) -> None:
        checks.instance("scene", scene, Scene, "load_scene returns")
        self.plan = make_plan(scene) if plan is None else plan
        super().__init__(scene, scene.sensor(sensor), self.plan.active, threads=threads)


def render(scene: Scene, index: int = 0, *, sensor: str | None = None) -> Measurement:
    """Return one measurement of a scene, of its first sensor by default; see `Simulator` for more of them."""
    return Simulator(scene, sensor=sensor).render(index)


def compile_kernels() -> None:
    """Compile what rendering and rehearsals need, on a scene of one point: those who wait may want to know why."""
    sensor = Sensor(
        array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)),
        recording=Recording(n_samples=20_000),
        processing=Processing(directions="2d:1", range_m=(0.2, 0.3)),
    )
    scene = Scene(sensors=(sensor,), points=(Point(range_m=0.25),))
    effects = frozenset({"propagation", "spreading", "modulation"})
    Engine(scene, sensor, effects).render()
    ABRender(scene).change_db(0, effects, "absorption")
