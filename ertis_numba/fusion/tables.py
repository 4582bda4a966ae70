"""Tables of fusion: receivers, pairs and hypotheses of all sensors of a platform."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.noise import EchoFloor
from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.fusion.association import Reflectors
from ertis_numba.fusion.attribution import Attributed, Attribution, Rivalries
from ertis_numba.fusion.emissions import (
    EmissionCounts,
    ExpectedEchoes,
    PulseEvidence,
    cheapest,
    doubted,
    expected_echoes,
    is_better,
    is_heard,
    is_proven,
    silence_ratios,
    silent_one,
    suspect,
)
from ertis_numba.fusion.known_echoes import explained_shares, levelled
from ertis_numba.fusion.pairs import Hypothesis, Pair, hypothesis, pair_of
from ertis_numba.fusion.points import N_KEPT, PointFuser, joined
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import CoarseImage, Receiver
from ertis_numba.fusion.rig import Emitters, MountedSensor
from ertis_numba.fusion.sensor_echoes import SensorEchoes
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Air, Call, Settings

__all__ = ["PLATFORM", "FusionTables", "PulseReflectors"]

PLATFORM: Final = "base_link"
"""Name of the platform's frame in REP 105, and of the sensor of fused images."""

_N_PULSES: Final = 3  # Pulses that count as evidence of emitters; these may fail or recover.
_DIRECT_SOUND_M: Final = 0.1  # Range before and after direct sound in which it hides echoes.


class PulseReflectors(NamedTuple):
    """Reflectors of a group of images, associated without the emitters that are not heard.

    ``without_echo`` are sensors whose images have no echo above the floor, and ``apart`` emitters whose calls only
    their own sensors hear, as on different SYNC chains. ``pulses`` are the evidence of this pulse and of the ones
    before. ``cost`` counts echoes that reflectors do not explain, and those that they should cause but that are missed.
    """

    attributed: Attributed
    reflectors: Reflectors
    floor: dict[int, EchoFloor]
    without_echo: list[int]
    unheard: frozenset[int]
    pulses: tuple[EmissionCounts, ...]
    cost: int
    apart: frozenset[int] = frozenset()

    @property
    def length(self) -> int:
        """Length of the description: unexplained and missed echoes, and two numbers for the place of each reflector."""
        return self.cost + 2 * len(self.reflectors.located)


class _Explained(NamedTuple):
    """Explanation of the echoes of a group, with the number of unexplained and missed echoes as its cost."""

    reflectors: Reflectors
    counts: EmissionCounts
    without_echo: list[int]
    cost: int
    expected: ExpectedEchoes


class FusionTables:
    """Tables of all receivers, computed when the first image of each arrives; ``start_s`` are those of calls."""

    def __init__(
        self,
        grid: PolarGrid,
        sensors: tuple[MountedSensor, ...],
        emitting: list[int],
        start_s: Sequence[float],
        diameters_m: Sequence[float],
    ) -> None:
        self.grid = grid
        self._sensors, self._emitting, self._start_s, self._diameters_m = sensors, emitting, start_s, diameters_m
        self._positions_m = grid.positions_m
        self._receivers: dict[int, Receiver] = {}
        self._blind: tuple[tuple[int, ...], float] | None = None  # sensors heard, and the distance of `_blind_m`
        self._deaf: dict[int, NDArray[np.bool_]] = {}
        self._pairs: dict[int, list[Pair]] = {}
        self._hypotheses: dict[int, list[Hypothesis]] = {}
        self._settings: dict[int, Settings] = {}
        self._late_m: dict[int, dict[int, float]] = {}  # by receiver and emitter
        self._emitters: dict[int, Emitters] = {}
        self._models: dict[tuple[Call, Air], Emitters] = {}  # Receivers share those of equal sound.
        self._known: dict[tuple[tuple[int, ...], frozenset[int]], Attribution] = {}
        self._rivalries: Rivalries = {}
        self._points: dict[int, PointFuser] = {}
        self._coarse: dict[int, tuple[Energyscape, CoarseImage]] = {}  # by identity of the image
        self._converted: dict[str, tuple[Settings, Settings]] = {}  # The checks of settings take long.

    def fit(self, group: Mapping[int, Energyscape], diameters_m: Mapping[int, float]) -> bool:
        """Return True if images have the directions, ranges, calls and emitters of earlier ones of their sensors."""
        return all(self._diameters_m[number] == each for number, each in diameters_m.items()) and all(
            image.settings.call.start_s == self._start_s[number]
            if number not in self._receivers
            else self._receivers[number].fits(image) and image.settings.call == self._settings[number].call
            for number, image in group.items()
        )

    def cover(self, group: Mapping[int, Energyscape], diameters_m: Mapping[int, float]) -> bool:
        """Return True if all tables for a group exist."""
        return self.fit(group, diameters_m) and group.keys() <= self._receivers.keys() and _key(group) in self._known

    def prepare(self, number: int, image: Energyscape) -> None:
        """Compute the powers and the echoes of an image of a receiver whose tables exist. Threads may call it."""
        if number in self._points:
            self.coarse(number, image)
            self._points[number].find(image)

    def coarse(self, number: int, image: Energyscape) -> CoarseImage:
        """Return the powers of an image of a receiver, computed once for the latest images. Threads may call it."""
        if number not in self._receivers:
            self._add(number, image)
        known = self._coarse.get(id(image))
        if known is None:
            known = self._coarse[id(image)] = image, self._receivers[number].coarse(image, self._deaf[number])
            for earlier in [*self._coarse][: -N_KEPT * len(self._sensors)]:
                self._coarse.pop(earlier, None)
        return known[1]

    def attribution(self, group: Mapping[int, Energyscape]) -> Attribution:
        """Return the attribution of echoes in the images of a group, for pairs with equal calls that were emitted."""
        key = _, passive = _key(group)
        if key not in self._known:
            pairs = [
                pair
                for number in group
                for pair in self._pairs[number]
                if pair.emitter not in passive and self._same_call(pair.emitter, number)
            ]
            hypotheses = {
                number: [
                    each
                    for each in self._hypotheses[number]
                    if each.emitter not in passive and self._same_call(each.emitter, number)
                ]
                for number in group
            }
            self._known[key] = Attribution(self.grid, pairs, hypotheses, self._receivers, rivalries=self._rivalries)
        return self._known[key]

    @staticmethod
    def stamp(group: Mapping[int, Energyscape]) -> Stamp:
        """Return the stamp of the fused image of a group."""
        return replace(_first(group).stamp, sensor=PLATFORM)

    def _image(self, reflectivity: NDArray[np.float32], group: Mapping[int, Energyscape]) -> Energyscape:
        first = _first(group)
        known = self._converted.get(first.stamp.sensor)
        if known is None or known[0] != first.settings:
            known = self._converted[first.stamp.sensor] = first.settings, self._fused_settings(first.settings)
        return Energyscape(
            amplitude=np.sqrt(reflectivity).reshape(self.grid.n_directions, self.grid.n_ranges),
            azimuth_rad=self.grid.azimuth_rad,
            elevation_rad=self.grid.elevations_rad,
            range_m=self.grid.range_m,
            settings=known[1],
            stamp=self.stamp(group),
        )

    def pulse_reflectors(
        self,
        group: Mapping[int, Energyscape],
        attributed: Attributed,
        unheard: frozenset[int],
        pulses: tuple[EmissionCounts, ...],
    ) -> PulseReflectors:
        """Return the reflectors of a group, and the emitters that are not heard.

        ``attributed`` is the attribution without those that the pulses before have not heard, ``unheard``.
        """
        # Those that no other thread has begun are found before it waits for others.
        heard = {number: self._points[number].find(each) for number, each in group.items()}
        floor = {number: each.result().floor for number, each in heard.items()}
        explained = self._explained(group, attributed, floor, unheard)
        every = frozenset(group)
        if attributed.suspects == every and len(every) > 1:
            apart = self._without(group, every)
            rival = self._explained(group, apart, floor, every, own=True)
            if not rival.cost and is_better(rival.cost, explained.cost):  # With a silent one, some are unexplained.
                return PulseReflectors(
                    apart, rival.reflectors, floor, rival.without_echo, frozenset(), (), rival.cost, every
                )
        for number in unheard:
            others = unheard - {number}
            emitting = self._without(group, others)
            rival = self._explained(group, emitting, floor, others)
            is_shown = silence_ratios([rival.counts])[number] < 0 and not is_better(explained.cost, rival.cost)
            if is_shown or is_better(rival.cost, explained.cost):
                unheard, attributed, explained, pulses = others, emitting, rival, ()
        while (silenced := self._silenced(group, explained, floor, unheard, pulses)) is not None:
            number, attributed, explained = silenced
            unheard |= {number}
        evidence = (*pulses, explained.counts)[-_N_PULSES:]
        still = frozenset(number for number in unheard if silence_ratios(evidence)[number] > 0)
        return PulseReflectors(
            attributed, explained.reflectors, floor, explained.without_echo, still, evidence, explained.cost
        )

    def _silenced(
        self,
        group: Mapping[int, Energyscape],
        explained: _Explained,
        floor: Mapping[int, EchoFloor],
        unheard: frozenset[int],
        pulses: Sequence[EmissionCounts],
    ) -> tuple[int, Attributed, _Explained] | None:
        """Return another emitter that is silent, with attribution and explanation of the echoes without it, or None."""
        suspected = suspect((*pulses, explained.counts)[-_N_PULSES:], unheard)
        numbers = self._judged(group) - unheard
        doubts = doubted(numbers, explained.counts, explained.cost) if self._is_omnidirectional else frozenset[int]()
        rivals = {}
        for number in doubts if suspected is None else numbers:
            each = self._without(group, unheard | {number})
            rivals[number] = each, self._explained(group, each, floor, unheard | {number})
        found = cheapest(explained.cost, {number: rivals[number][1].cost for number in doubts})
        if found is None:
            likely = {
                number: each
                for number, (_, each) in rivals.items()
                if not explained.reflectors.needs(number, each.reflectors)
            }
            if suspected in likely:
                costs = {number: each.cost for number, each in likely.items()}
                counts = {number: each.counts for number, each in likely.items()}
                found = silent_one(suspected, explained.counts, costs, counts)
        if found is not None and not self._is_omnidirectional:
            silent = rivals[found][1]
            found = found if is_proven(found, silent.expected, silent.reflectors) else None
        return None if found is None else (found, *rivals[found])

    def emitters(self, group: Mapping[int, Energyscape]) -> frozenset[int]:
        """Return the sensors of a group that emitted."""
        return frozenset({*self._emitting} & group.keys() - _key(group)[1])

    def evidence(self, group: Mapping[int, Energyscape], solve: Callable[[], PulseReflectors]) -> PulseEvidence:
        """Return the evidence of a pulse on its emitters, which is computed when it is first read.

        It is how much better emission of each sensor explains the echoes than its silence; 0 if equally well. It is
        infinite for emitters that echoes prove to work, and negatively infinite for unheard ones, and for those without
        a located echo of their own call.
        """
        return PulseEvidence(
            self.emitters(group),
            lambda number: self._proof(solve(), number),
            lambda number: self._comparison(group, solve(), number),
        )

    @staticmethod
    def _proof(found: PulseReflectors, number: int) -> float | None:
        """Return the evidence for one emitter that needs no other explanation of the echoes; None without any."""
        is_unheard = number in found.unheard
        if number in found.apart or (not is_unheard and found.pulses and is_heard(found.pulses[-1], number)):
            return math.inf
        if is_unheard or number not in found.reflectors.own_emitters():
            return -math.inf
        return None

    def _comparison(self, group: Mapping[int, Energyscape], found: PulseReflectors, number: int) -> float:
        """Return how much better emission of one sensor explains the echoes than its silence."""
        silent = found.unheard | {number}
        rival = self._explained(group, self._without(group, silent), found.floor, silent)
        return math.inf if found.reflectors.proves(number, rival.reflectors) else rival.cost - found.cost

    def _without(self, group: Mapping[int, Energyscape], unheard: frozenset[int]) -> Attributed:
        """Return the attribution of a group whose sensors do not hear some emitters."""
        coarse = {number: self.coarse(number, each) for number, each in group.items()}
        return self.attribution(group).without(unheard)(coarse)

    def points(self, found: PulseReflectors, group: Mapping[int, Energyscape]) -> PointCloud:
        """Return the points of a group."""
        return joined(found.reflectors, self._image(found.attributed.reflectivity, group), self.grid)

    def image(
        self, found: PulseReflectors, group: Mapping[int, Energyscape], coarse: Mapping[int, CoarseImage]
    ) -> Energyscape:
        """Return the fused image of a group, in which no echoes of confirmed reflectors are ghosts."""
        reflectors, shares = found.reflectors, found.attributed.shares
        informed: dict[tuple[int, int], NDArray[np.float32]] = {}
        for number, each in coarse.items():
            echoes = reflectors.known_echoes(number)
            factors = echoes.amplitudes(self._receivers[number], self._late_m[number])
            informed |= explained_shares(shares, number, each, echoes, factors, reflectors.is_sure)
        attribution = self.attribution(group).without(found.attributed.unheard)
        reflectivity = attribution.informed(coarse, found.attributed, informed)
        sure = reflectors.confirmed
        reflectivity = levelled(reflectivity, self.grid, reflectors.position_m[sure], reflectors.reflectivity[sure])
        return self._image(reflectivity, group)

    def _explained(
        self,
        group: Mapping[int, Energyscape],
        attributed: Attributed,
        floor: Mapping[int, EchoFloor],
        unheard: frozenset[int],
        *,
        own: bool = False,
    ) -> "_Explained":
        """Return the reflectors that explain the echoes if some emitters are silent, or heard by their own sensors."""
        echoes = [
            each.without(unheard - {each.receiver} if own else unheard) for each in self._echoes(group, attributed)
        ]
        reflectors = Reflectors(echoes, self._sensors, self._receivers, self._emitters, self.grid, attributed.bound)
        late_m = {number: self._heard_m(group, number) for number in group}
        expected = expected_echoes(reflectors, group, floor, self._receivers, late_m, self._deaf, silent=unheard)
        counts = EmissionCounts.of(expected, reflectors, self._judged(group))
        n_missed = int(np.delete(expected.is_missed, [*unheard], axis=2).sum())
        # Dense echoes of reflectors may be unclear, too. Unclear echoes are noise only if no reflector is located.
        is_any = bool(reflectors.located)
        without_echo = [each.receiver for each in echoes if (each.is_faint | ~(each.is_clear | is_any)).all()]
        return _Explained(reflectors, counts, without_echo, reflectors.n_unexplained + n_missed, expected)

    def _echoes(self, group: Mapping[int, Energyscape], attributed: Attributed) -> list[SensorEchoes]:
        return [
            self._points[number].echoes(each, attributed.shares, self._late_m[number]) for number, each in group.items()
        ]

    def _heard_m(self, group: Mapping[int, Energyscape], number: int) -> dict[int, float]:
        """Return the path of sound between the emission of a receiver and that of each emitter that it may hear."""
        passive = _key(group)[1]
        return {
            emitter: delay_m
            for emitter, delay_m in self._late_m[number].items()
            if emitter not in passive and self._same_call(emitter, number)
        }

    @property
    def _is_omnidirectional(self) -> bool:
        """True if the call of each emitter reaches the surroundings of all others."""
        return not any(self._diameters_m)

    def _judged(self, group: Mapping[int, Energyscape]) -> frozenset[int]:
        """Return the emitters that a group may show to be silent.

        If the image of an emitter's own sensor is missing, other sensors may take the echoes of its calls for those of
        their own. No emitter is then judged.
        """
        emitting = {*self._emitting} - _key(group)[1]
        return frozenset(emitting if emitting <= group.keys() else ())

    def _same_call(self, emitter: int, number: int) -> bool:
        """Return True unless the calls are known to differ, so that the matched filter suppresses the foreign one."""
        return emitter not in self._settings or self._settings[emitter].call.sounds_like(self._settings[number].call)

    def _add(self, number: int, image: Energyscape) -> None:
        self._known.clear()
        settings = self._settings[number] = image.settings
        speed_m_s = sound_speed_m_s(settings.air)
        receiver = self._receivers[number] = Receiver(self._sensors[number], image, self.grid.step_m)
        late_m = self._late_m[number] = {
            emitter: (self._start_s[emitter] - self._start_s[number]) * speed_m_s for emitter in self._emitting
        }
        deaf = self._deaf[number] = self._direct_sound(number, receiver, late_m)
        sound = settings.call, settings.air
        emitters = self._models.setdefault(sound, Emitters(settings, self._diameters_m))
        self._emitters[number] = emitters
        common = self._sensors, emitters, receiver
        pairs = [
            pair_of(
                self._positions_m,
                *common,
                emitter=emitter,
                number=number,
                late_m=late_m[emitter],
                deaf=deaf,
            )
            for emitter in self._emitting
        ]
        self._pairs[number] = [pair for pair in pairs if len(pair.cell)]
        hypotheses = [
            hypothesis(self.grid, *common, emitter=emitter, late_m=late_m[emitter], is_mirrored=is_mirrored)
            for emitter in self._emitting
            for is_mirrored in ((False, True) if receiver.is_flat else (False,))
        ]
        seen = {pair.emitter for pair in self._pairs[number]}
        self._hypotheses[number] = [
            each for each in hypotheses if len(each.half_cell) or (each.emitter in seen and not each.is_mirrored)
        ]
        self._points[number] = PointFuser(number, self._sensors, receiver, image, deaf)

    def _direct_sound(self, number: int, receiver: Receiver, late_m: Mapping[int, float]) -> NDArray[np.bool_]:
        range_m = (np.arange(receiver.n_steps) + 0.5) * receiver.step_m
        deaf = np.zeros(receiver.n_steps, dtype=np.bool_)
        for emitter, delay_m in late_m.items():
            apart_m = np.linalg.norm(self._sensors[emitter].translation_m - self._sensors[number].translation_m)
            deaf |= np.abs(range_m - (apart_m + delay_m) / 2) <= _DIRECT_SOUND_M
        return np.asarray(deaf)

    @property
    def _blind_m(self) -> float:
        """Distance from the origin within which reflectors may be nearer to a sensor than its image."""
        # A sensor without an image so far counts like the first one, until its images begin at another range.
        heard = tuple(self._receivers)
        if self._blind is None or self._blind[0] != heard:
            known = [number if number in self._receivers else heard[0] for number in range(len(self._sensors))]
            blind_m = max(
                self._receivers[number].blind_m(self._deaf[number], sensor)
                for number, sensor in zip(known, self._sensors, strict=True)
            )
            self._blind = heard, blind_m
        return self._blind[1]

    def _fused_settings(self, settings: Settings) -> Settings:
        limit_deg = 180.0 - 180.0 / self.grid.n_azimuths
        limits = {
            "azimuth_limits_deg": (-limit_deg, limit_deg),
            "range_m": (max(self._blind_m, float(self.grid.range_m[0])), float(self.grid.range_m[-1])),
        }
        # Settings hold at most 1000 directions, so those of a three-dimensional image are named by their count only.
        kind = "2d" if self.grid.is_planar else "3d"
        directions = f"{kind}:{self.grid.n_directions}"
        return settings.replace(processing=settings.processing.replace(directions=directions, **limits))


def _first(group: Mapping[int, Energyscape]) -> Energyscape:
    return min(group.values(), key=lambda image: image.stamp.timestamp_ns)


def _key(group: Mapping[int, Energyscape]) -> tuple[tuple[int, ...], frozenset[int]]:
    """Return the sensors of a group, and those that did not emit."""
    return tuple(group), frozenset(number for number, image in group.items() if image.stamp.behaviour == "passive")
