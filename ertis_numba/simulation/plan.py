"""Which effects a scene calls for."""

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ertis_numba.simulation import limits
from ertis_numba.simulation.loudness import LOUD, may_be_loud, peak_bound
from ertis_numba.simulation.names import ASKED_FOR, EFFECTS, INDISPENSABLE
from ertis_numba.simulation.needs import ESTIMATES, Estimate
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.sight import Sight
from ertis_numba.simulation.snapshot import Snapshot, snapshot

__all__ = ["EffectPlan", "Verdict", "make_plan"]

ABRender = Callable[[int, frozenset[str], str], float | None]
Rehearse = Callable[[], ABRender]

_INSTANTS, _MAX_CORNERS = 9, 40  # at which a scene in motion is asked, way points apart
_MAX_TOO_HIGH = 20.0  # no estimate is too high by more, while side lobes that meet make some far too low
_PART_ALLOWED = 0.5  # of the tolerance in the rendered measurements of a scene in motion, as others may change more
_MAX_RENDERED = 3  # measurements of a scene in motion that are rendered for one verdict
_ROUNDS = 6  # two are the rule; effects that wait for each other take more


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
        The scene overrides the estimate: by ``effects``, by a key that requests the effect, or by a tolerance of 0.
    rehearsed : bool
        The estimate was too close to the tolerance, so two renderings were compared: their change stands for it.
    coupled : bool
        It matters or not as another effect is on or off, and that one as this is; both are on to be safe.
    """

    name: str
    on: bool
    reason: str
    estimate_db: float | None = None
    forced: bool = False
    rehearsed: bool = False
    coupled: bool = False


@dataclass(frozen=True, slots=True)
class EffectPlan:
    """The effects that are simulated for a scene, with reasons.

    Attributes
    ----------
    verdicts : tuple of Verdict
    notes : tuple of str
        Limits of the models that the scene exceeds.
    """

    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...] = ()

    @property
    def active(self) -> frozenset[str]:
        """The effects that are on."""
        return frozenset(verdict.name for verdict in self.verdicts if verdict.on)

    @property
    def left_out(self) -> tuple[str, ...]:
        """The effects that are off, although they change the image."""
        return tuple(verdict.name for verdict in self.verdicts if not verdict.on and verdict.estimate_db)


def make_plan(scene: Scene) -> EffectPlan:
    """Decide for each effect whether it changes any image by more than the scene's tolerance.

    Effects that a key of the scene requests are on, see `names.ASKED_FOR`. With a tolerance of 0, all effects that
    apply to something in the scene are on.

    For the others, all sensors are asked, at the beginning, at the end, in between and at way points; the greatest
    change counts. Effects are estimated one after the other, each in the light of those before it: geometry first, then
    what filters echoes, then what adds to them; and again in the light of all others, until nothing changes. Where
    an estimate is not certain enough, the measurements with the greatest estimates are rendered and processed with the
    effect and without. So is the loudest measurement, because estimates do not model converters.
    """
    indices = _indices(scene)
    shots = [(index, snapshot(scene, sensor, index / scene.rate_hz)) for index in indices for sensor in scene.sensors]
    for _, shot in shots:
        limits.require_clear(shot)
    notes = tuple(dict.fromkeys(note for _, shot in shots for note in limits.notes(shot)))
    verdicts: dict[str, Verdict] = {}
    rehearse = functools.cache(lambda: _rehearsals(scene))
    rounds = [_active(verdicts)]
    for _ in range(_ROUNDS):
        for name in EFFECTS:
            verdicts[name] = _decided(scene, name, _active(verdicts) - {name}, shots, rehearse)
        rounds.append(_active(verdicts))
        if rounds[-1] == rounds[-2]:
            return EffectPlan(tuple(verdicts.values()), notes)
    # They go in a circle: one matters only with the other, which matters only without it.
    circle = frozenset.union(*rounds[2:]) - frozenset.intersection(*rounds[2:])
    kept = (_kept_on(verdict) if verdict.name in circle else verdict for verdict in verdicts.values())
    return EffectPlan(tuple(kept), notes)


def _kept_on(verdict: Verdict) -> Verdict:
    if verdict.forced:
        return verdict
    return replace(verdict, on=True, coupled=True, reason=f"{verdict.reason}; stays on, as others wait for it")


def _indices(scene: Scene) -> list[int]:
    """Return the measurements for which effects are estimated.

    These are the first; in a scene in motion, several more and those at its way points; with clock drift, the last
    before a SYNC.
    """
    last = scene.count - 1
    indices = [0]
    if scene.moves and scene.count > 1:
        corners_s = sorted({time_s for thing in scene.things() for time_s, *_ in thing.waypoints})
        between_s = [(a + b) / 2 for a, b in itertools.pairwise(corners_s)]
        corners = np.clip(np.rint(np.array([*corners_s, *between_s][:_MAX_CORNERS]) * scene.rate_hz), 0, last)
        indices = [int(index) for index in np.unique([*np.linspace(0, last, _INSTANTS).round(), *corners])]
    if any(sensor.electronics.clock_drift_ppm for sensor in scene.sensors):
        indices.append(min(last, scene.sync_every - 1))
    return sorted(set(indices))


def _decided(
    scene: Scene,
    name: str,
    others: frozenset[str],
    shots: list[tuple[int, Snapshot]],
    rehearse: Rehearse,
) -> Verdict:
    """Return the verdict on one effect beside others."""
    if name in INDISPENSABLE:
        return Verdict(name=name, on=True, reason=INDISPENSABLE[name])
    given = scene.effects.get(name)
    forced = True if given is None and (name in ASKED_FOR or not scene.tolerance_db) else given
    estimates = _estimates(name, others, shots)
    if not estimates:
        reason = f"the scene has nothing for it: {EFFECTS[name]}"
        return Verdict(name=name, on=bool(given), reason=reason, forced=given is not None)
    worst = estimates[0][0]
    if forced is not None:
        return Verdict(name=name, on=forced, reason=worst.reason, estimate_db=worst.change_db, forced=True)
    measured_db, moves = None, scene.moves and scene.count > 1
    if worst.change_db / min(worst.sure, _MAX_TOO_HIGH) < scene.tolerance_db:
        indices = [index for estimate, index in estimates if estimate.change_db * estimate.sure > scene.tolerance_db]
        indices = [*dict.fromkeys(indices[:_MAX_RENDERED]), *_loudest(name, others, shots)]
        measured_db = _measured_db(scene, rehearse, indices, others, name)
    change_db = worst.change_db if measured_db is None else measured_db
    return Verdict(
        name=name,
        on=change_db > (_PART_ALLOWED if measured_db is not None and moves else 1.0) * scene.tolerance_db,
        reason=worst.reason if measured_db is None else f"{worst.reason}; rehearsed",
        estimate_db=change_db,
        rehearsed=measured_db is not None,
    )


def _estimates(name: str, active: frozenset[str], shots: list[tuple[int, Snapshot]]) -> list[tuple[Estimate, int]]:
    """Return the estimates of all shots and the numbers of their measurements, the greatest change first."""
    found = [(ESTIMATES[name](Sight.of(shot, active)), index) for index, shot in shots]
    return sorted(
        ((estimate, index) for estimate, index in found if estimate is not None), key=lambda each: -each[0].change_db
    )


def _loudest(name: str, active: frozenset[str], shots: list[tuple[int, Snapshot]]) -> list[int]:
    """Return the measurement with the highest bound on its amplitude, if that is within 6 dB of full scale."""
    peaks = [
        (max(peak_bound(shot, active), peak_bound(shot, active | {name})), index)
        for index, shot in shots
        if may_be_loud(shot, active)
    ]
    loudest, index = max(peaks, default=(0.0, 0))
    return [index] if loudest >= LOUD else []


def _measured_db(
    scene: Scene, rehearse: Rehearse, indices: list[int], others: frozenset[str], name: str
) -> float | None:
    """Return the greatest change of some measurements, up to the first that exceeds the tolerance."""
    worst_db: float | None = None
    for index in dict.fromkeys(indices):
        change_db = rehearse()(index, others, name)
        if change_db is not None:
            worst_db = max(change_db, worst_db or 0.0)
            if worst_db > scene.tolerance_db:
                break
    return worst_db


def _rehearsals(scene: Scene) -> ABRender:
    # Loaded here because it brings in the whole signal chain, and most scenes are decided without.
    from ertis_numba.simulation.ab_render import ABRender  # noqa: PLC0415

    return functools.cache(ABRender(scene).change_db)


def _active(verdicts: dict[str, Verdict]) -> frozenset[str]:
    return frozenset(verdict.name for verdict in verdicts.values() if verdict.on)
