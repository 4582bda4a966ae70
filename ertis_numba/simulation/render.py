"""From a scene to the PDM words that its sensors would record."""

from ertis_numba.frames import Measurement
from ertis_numba.simulation.engine import Engine
from ertis_numba.simulation.plan import Plan, make_plan
from ertis_numba.simulation.scene import Scene

__all__ = ["Simulator", "render"]


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
        self, scene: Scene, *, sensor: str | None = None, plan: Plan | None = None, threads: int | None = None
    ) -> None:
        self.plan = make_plan(scene) if plan is None else plan
        super().__init__(scene, scene.sensor(sensor), self.plan.active, threads=threads)


def render(scene: Scene, index: int = 0, *, sensor: str | None = None) -> Measurement:
    """Return one measurement of a scene, of its first sensor by default; see `Simulator` for more of them."""
    return Simulator(scene, sensor=sensor).render(index)
