"""Selection of the effects that a scene needs."""

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation import target_validity
from ertis_numba.simulation.cache import Cache
from ertis_numba.simulation.effects import ASKED_FOR, EFFECTS, INDISPENSABLE, module
from ertis_numba.simulation.estimates import Estimate
from ertis_numba.simulation.image_estimate import Sight
from ertis_numba.simulation.loudness import LOUD, may_be_loud, peak_bound
from ertis_numba.simulation.scene import Scene
from ertis_numba.simulation.snapshot import Snapshot, snapshot
from ertis_numba.simulation.source_paths import AnySource, SourceInScene, all_sources
from ertis_numba.simulation.sources import Sonar

__all__ = ["EffectPlan", "Verdict", "change_of_sources", "make_plan"]

ABRender = Callable[[int, str, frozenset[str], str], float | None]
RenderAB = Callable[[], ABRender]
Shots = list[tuple[int, Snapshot]]

_INSTANTS, _MAX_CORNERS = 9, 40  # times at which a moving scene is examined: evenly spaced, and at waypoints
_MAX_TOO_HIGH = 20.0  # largest factor of an overestimate; side lobes that overlap make some estimates far too low
_PART_ALLOWED = 0.5  # part of the tolerance allowed in rendered measurements of a moving scene; others may change more
_MAX_RENDERED = 3  # measurements of a moving scene that are rendered for one verdict
_ROUNDS = 6  # two usually suffice; effects that depend on each other take more


Floats = NDArray[np.float64]
_ON_SOURCES = frozenset(each.name for each in EFFECTS.values() if {"views", "gain", "emission"} & {*each.places})
_INAUDIBLE = 2.0**-20  # rounding of the modulators' input
_MAX_FREQUENCIES = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Decision about one effect."""

    # `forced` by the scene; `ab_rendered`, because the estimate was close to the tolerance; `coupled` with another
    # effect. `estimate_db` is None if the effect cannot be left out or does not apply.

    name: str
    on: bool
    reason: str
    estimate_db: float | None = None
    forced: bool = False
    ab_rendered: bool = False
    coupled: bool = False


@dataclass(frozen=True, slots=True)
class EffectPlan:
    """Effects that are simulated for a scene, with reasons, and ``notes`` on validity limits that the scene exceeds."""

    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...] = ()

    @property
    def active(self) -> frozenset[str]:
        """The effects that are on."""
        return frozenset(verdict.name for verdict in self.verdicts if verdict.on)

    @property
    def left_out(self) -> tuple[str, ...]:
        """The effects that are off although they change the image."""
        return tuple(verdict.name for verdict in self.verdicts if not verdict.on and verdict.estimate_db)


def make_plan(scene: Scene) -> EffectPlan:
    """Decide for each effect whether it changes any image by more than the scene's tolerance."""
    # docs/explanation/simulator.md describes the choice. Raise ArgumentError if a surface touches or encloses a
    # microphone or an emitter, or the scene exceeds a limit.
    indices = _indices(scene)
    cache = Cache()
    shots = [
        (index, snapshot(scene, sensor, index / scene.rate_hz, cache)) for index in indices for sensor in scene.sensors
    ]
    for _, shot in shots:
        target_validity.require_clear(shot)
    notes = tuple(dict.fromkeys(note for _, shot in shots for note in target_validity.notes(shot)))
    verdicts: dict[str, Verdict] = {}
    render_ab = functools.cache(lambda: _ab_render_of(scene))
    # The first round renders nothing, because its images would lack the effects that are not decided yet. Decisions
    # repeat while the other effects stay the same.
    decided = functools.cache(
        lambda name, others, *, measure: _decided(scene, name, others, shots, render_ab if measure else None)
    )
    rounds = [_active(verdicts)]
    for number in range(_ROUNDS):
        for name in EFFECTS:
            verdicts[name] = decided(name, _active(verdicts) - {name}, measure=number > 0)
        rounds.append(_active(verdicts))
        if rounds[-1] == rounds[-2]:
            return EffectPlan(tuple(verdicts.values()), notes)
    # The decisions oscillate: one effect matters only with the other, and the other only without the first.
    circle = frozenset.union(*rounds[2:]) - frozenset.intersection(*rounds[2:])
    kept = (_kept_on(verdict) if verdict.name in circle else verdict for verdict in verdicts.values())
    return EffectPlan(tuple(kept), notes)


def _kept_on(verdict: Verdict) -> Verdict:
    if verdict.forced:
        return verdict
    return replace(
        verdict, on=True, coupled=True, reason=f"{verdict.reason}; stays on, because other effects depend on it"
    )


def _indices(scene: Scene) -> list[int]:
    """Return the measurements to estimate: the first, some in motion, and the last before a SYNC if clocks drift."""
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
    shots: Shots,
    render_ab: RenderAB | None,
) -> Verdict:
    """Return the verdict on one effect, given the others; without A/B renders, the estimate decides."""
    if name in INDISPENSABLE:
        return Verdict(name=name, on=True, reason=INDISPENSABLE[name])
    given = scene.effects.get(name)
    forced = True if given is None and (name in ASKED_FOR or not scene.tolerance_db) else given
    estimates = _estimates(name, others, shots)
    of_sources = _of_sources(name, others, shots)
    if not estimates and of_sources is None:
        reason = f"it applies to nothing in the scene: {EFFECTS[name].summary}"
        return Verdict(name=name, on=bool(given), reason=reason, forced=given is not None)
    worst = _greatest(of_sources, estimates)
    if forced is not None:
        return Verdict(name=name, on=forced, reason=worst.reason, estimate_db=worst.change_db, forced=True)
    if of_sources is not None and of_sources.change_db > scene.tolerance_db:
        return Verdict(name=name, on=True, reason=worst.reason, estimate_db=worst.change_db)
    measured_db, moves = None, scene.moves and scene.count > 1
    if render_ab is not None and worst.change_db / min(worst.sure, _MAX_TOO_HIGH) < scene.tolerance_db:
        unsure = [shot for estimate, shot in estimates if estimate.change_db * estimate.sure > scene.tolerance_db]
        indices = [index for index, _ in unsure[:_MAX_RENDERED]] + _loudest(name, others, shots)
        # Sensors with certain estimates count as well, because their images may contain more echoes than estimated.
        chosen = [shot for index in dict.fromkeys(indices) for _, shot in estimates if shot[0] == index]
        measured_db = _measured_db(scene, render_ab, chosen, others, name)
    change_db = worst.change_db if measured_db is None else measured_db
    return Verdict(
        name=name,
        on=change_db > (_PART_ALLOWED if measured_db is not None and moves else 1.0) * scene.tolerance_db,
        reason=worst.reason if measured_db is None else f"{worst.reason}; change measured by A/B renders",
        estimate_db=change_db,
        ab_rendered=measured_db is not None,
    )


def _estimates(name: str, active: frozenset[str], shots: Shots) -> list[tuple[Estimate, tuple[int, Snapshot]]]:
    """Return the estimates of all snapshots, greatest change first."""
    if not shots or not EFFECTS[name].may_apply(shots[0][1].scene):
        return []
    found = [(module(name).estimate(Sight.of(shot, active)), (index, shot)) for index, shot in shots]
    return sorted(
        ((estimate, shot) for estimate, shot in found if estimate is not None), key=lambda each: -each[0].change_db
    )


def _of_sources(name: str, active: frozenset[str], shots: Shots) -> Estimate | None:
    """Return the greatest change of the sound of a source in any snapshot."""
    found = [change_of_sources(name, shot, active) for _, shot in shots]
    return max((each for each in found if each is not None), key=lambda each: each.change_db, default=None)


def _greatest(of_sources: Estimate | None, estimates: list[tuple[Estimate, tuple[int, Snapshot]]]) -> Estimate:
    """Return the estimate of the greatest change of an image, or of a source if that changes more."""
    of_images = [estimates[0][0]] if estimates else []
    of_both = of_images if of_sources is None else [*of_images, of_sources]
    return max(of_both, key=lambda each: each.change_db)


def _loudest(name: str, active: frozenset[str], shots: Shots) -> list[int]:
    """Return the index of the measurement with the highest amplitude bound, if within 6 dB of full scale."""
    peaks = [
        (max(peak_bound(shot, active), peak_bound(shot, active | {name})), index)
        for index, shot in shots
        if may_be_loud(shot, active)
    ]
    loudest, index = max(peaks, default=(0.0, 0))
    return [index] if loudest >= LOUD else []


def _measured_db(scene: Scene, render_ab: RenderAB, shots: Shots, others: frozenset[str], name: str) -> float | None:
    """Return the greatest change of some images, up to the first that exceeds the tolerance."""
    worst_db: float | None = None
    for index, shot in shots:
        change_db = render_ab()(index, shot.sensor.name, others, name)
        if change_db is not None:
            worst_db = max(change_db, worst_db or 0.0)
            if worst_db > scene.tolerance_db:
                break
    return worst_db


def _ab_render_of(scene: Scene) -> ABRender:
    # Imported here because it loads the whole signal chain, and most scenes are decided without it.
    from ertis_numba.simulation.ab_render import ABRender  # noqa: PLC0415

    return functools.cache(ABRender(scene).change_db)


def _active(verdicts: dict[str, Verdict]) -> frozenset[str]:
    return frozenset(verdict.name for verdict in verdicts.values() if verdict.on)


def change_of_sources(name: str, shot: Snapshot, active: frozenset[str]) -> Estimate | None:
    """Return the greatest change by an effect of any source's sound at the array centre; None if there is none."""
    # It is `20 log10(1 + |after - before| / level)`, path by path, where the level is the higher of both.
    scene = shot.scene
    if name not in _ON_SOURCES or scene.effects.get("interference") is False or not EFFECTS[name].may_apply(scene):
        return None
    middle = shot.at_centre()
    pairs = zip(all_sources(middle, active - {name}), all_sources(middle, active | {name}), strict=True)
    ratio, loudest = max(((_ratio(*pair), pair[0].name) for pair in pairs), default=(0.0, ""))
    if not ratio:
        return None
    change_db = 20 * math.log10(1 + ratio)
    return Estimate(
        change_db=change_db, reason=f"the sound of {loudest} at the sensor changes by {change_db:.2f} dB", sure=1.0
    )


def _ratio(before: SourceInScene[AnySource], after: SourceInScene[AnySource]) -> float:
    """Return the change of the sound of a source relative to its level, 0 to about 1."""
    frequency_hz, power = before.spectrum
    every = -(-len(power) // _MAX_FREQUENCIES)
    frequency_hz, power = frequency_hz[::every], power[::every] * every
    (level, delays), (new_level, new_delays) = (_heard(each, frequency_hz) for each in (before, after))
    none, total, ways = np.zeros(len(frequency_hz)), np.zeros((2, len(frequency_hz))), level.keys() | new_level.keys()
    change = np.zeros(len(frequency_hz))
    for way in sorted(ways):
        one, other = level.get(way, none), new_level.get(way, none)
        change += np.abs(other - one)
        if way in delays and way in new_delays:
            apart_s = float(np.abs(np.subtract(delays[way], new_delays[way])).max())
            turn_rad = np.minimum(2 * math.pi * frequency_hz * apart_s, math.pi)
            change += 2 * np.sin(turn_rad / 2) * np.minimum(one, other)
        total += np.array([one, other]) ** 2
    reference = math.sqrt(float(np.max(total @ power)))
    return math.sqrt(float(change**2 @ power)) / max(reference, _INAUDIBLE)


def _heard(
    source: SourceInScene[AnySource], frequency_hz: Floats
) -> tuple[dict[str, Floats], dict[str, tuple[float, float]]]:
    """Return the amplitude of each path, and its delays at the beginning and at the end of the call or the record."""
    if not len(source.paths):
        return {}, {}
    response = np.abs(source.response(frequency_hz)[:, 0])
    lasts_s = (
        source.source.call.duration_s if isinstance(source.source, Sonar) else source.shot.sensor.recording.duration_s
    )
    early_s, late_s = (source.arrival(sent_s)[0][:, 0] - sent_s for sent_s in (0.0, lasts_s))
    names = source.paths.names
    return (
        dict(zip(names, response, strict=True)),
        dict(zip(names, zip(early_s.tolist(), late_s.tolist(), strict=True), strict=True)),
    )
