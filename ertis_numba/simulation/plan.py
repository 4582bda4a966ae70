"""Which effects a scene calls for."""

from dataclasses import dataclass

import numpy as np

from ertis_numba.simulation.names import EFFECTS, INDISPENSABLE
from ertis_numba.simulation.needs import ESTIMATES, Estimate
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import snapshot

__all__ = ["Plan", "Verdict", "make_plan"]

_INSTANTS = 9  # at which a scene in motion is asked


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Whether one effect is simulated.

    Attributes
    ----------
    name : str
    on : bool
    reason : str
    estimate_db : float or None
        By how much it changes the image; None where it cannot be left out or finds nothing to act upon.
    forced : bool
        The scene decides, whatever the estimate.
    """

    name: str
    on: bool
    reason: str
    estimate_db: float | None
    forced: bool = False


@dataclass(frozen=True, slots=True)
class Plan:
    """What is simulated of a scene, and why."""

    verdicts: tuple[Verdict, ...]

    @property
    def active(self) -> frozenset[str]:
        """The effects that are on."""
        return frozenset(verdict.name for verdict in self.verdicts if verdict.on)


def make_plan(scene: Scene) -> Plan:
    """Decide for each effect whether it changes any image by more than the scene's tolerance.

    All sensors are asked, at the beginning, at the end and in between; the greatest change counts. Effects are
    decided one after the other, each in the light of those before it: geometry first, then what filters
    echoes, then what adds to them.
    """
    times_s = [0.0]
    if scene.moves and scene.count > 1:
        times_s = list(np.unique(np.linspace(0, scene.count - 1, _INSTANTS).round()) / scene.rate_hz)
    shots = [snapshot(scene, sensor, time_s) for sensor in scene.sensors for time_s in times_s]
    verdicts: list[Verdict] = []
    active: frozenset[str] = frozenset()
    for name in EFFECTS:
        if name in INDISPENSABLE:
            verdict = Verdict(name=name, on=True, reason=INDISPENSABLE[name], estimate_db=None)
        else:
            estimates = [ESTIMATES[name](Sight(shot, active)) for shot in shots]
            verdict = _verdict(name, [estimate for estimate in estimates if estimate is not None], scene)
        verdicts.append(verdict)
        if verdict.on:
            active |= {name}
    return Plan(tuple(verdicts))


def _verdict(name: str, estimates: list[Estimate], scene: Scene) -> Verdict:
    forced = scene.effects.get(name)
    if not estimates:
        return Verdict(
            name=name,
            on=bool(forced),
            reason=f"the scene has nothing for it: {EFFECTS[name]}",
            estimate_db=None,
            forced=forced is not None,
        )
    worst = max(estimates, key=lambda estimate: estimate.change_db)
    needed = worst.change_db > scene.tolerance_db
    return Verdict(
        name=name,
        on=needed if forced is None else forced,
        reason=worst.reason,
        estimate_db=worst.change_db,
        forced=forced is not None,
    )
