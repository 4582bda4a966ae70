"""Emitters that the sensors hear: echoes of each call at the reflectors that other calls locate."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.analysis.noise import EchoFloor
from ertis_numba.frames import Energyscape
from ertis_numba.fusion.association import Reflectors
from ertis_numba.fusion.receivers import Receiver

__all__ = [
    "EmissionCounts",
    "ExpectedEchoes",
    "PulseEvidence",
    "best_evidence",
    "cheapest",
    "doubted",
    "expected_echoes",
    "is_better",
    "is_heard",
    "is_much_better",
    "is_proven",
    "silence_ratios",
    "silent_one",
    "suspect",
    "unproven_note",
]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Logarithms of likelihood ratios of a silent emitter. One echo in fifty that an emitter should cause is missed, because
# a reflector does not exist; a third of those that a silent one should cause seem to be heard, since others are there.
_MISSED: Final = math.log(0.67 / 0.02)
_HEARD: Final = math.log(0.33 / 0.98)
_DEPENDENT: Final = 0.5  # Independent echoes per echo, as several sensors hear one reflector.
_CERTAIN: Final = math.log(1e3)
_PROVEN: Final = 4 * _DEPENDENT * _HEARD  # Four echoes that other calls predict, and none that is missed.
_ALIKE: Final = 3  # Difference of unexplained and missed echoes within which explanations are equally good.
_TIMES: Final = 1.25  # Ratio of the lengths of two descriptions, of which the longer one is wrong, …
_MORE: Final = 9  # … and their difference.
_CHEAP: Final = 0.9  # Ratio of costs below which the silence of an emitter explains echoes clearly better.
_N_UNEXPLAINED: Final = 1  # Echoes up to which no sound over several surfaces is present, …
_N_MISSING: Final = 2  # … and otherwise confirmed reflectors that must miss a call.
_N_SENSORS: Final = 3  # Emitters of which one can be told from the others.
_N_OTHERS: Final = 2  # Echoes of other calls that locate a reflector.
_RADIATED: Final = 10 ** (-16.5 / 10)  # Power to the side, below which models of emitters are uncertain.
_VISIBLE: Final = 10 ** (8.0 / 10)  # Power of an expected echo relative to noise and side lobes.
_SIDE_LOBES: Final = 10 ** (-17.0 / 10)  # Power relative to the strongest echo of any direction at a similar range.
_DISTURBED: Final = 10 ** (-8.0 / 10)  # Power of other echoes relative to one, from which they may hide it.
_LOST: Final = 10 ** (-5.0 / 10)  # Power relative to an expected echo that others weaken, below which it is missed.
_WITHIN: Final = math.cos(math.radians(4.0))  # Directions in which an echo may appear.
_NEAR_M: Final = 0.008  # Ranges in which it may appear, …
_BESIDE_M: Final = 0.03  # … and those with its side lobes.


class ExpectedEchoes(NamedTuple):
    """Echoes to be heard, (reflector, receiver, emitter); neither heard nor missed if noise or others hide them."""

    is_heard: Flags
    is_missed: Flags


class EmissionCounts(NamedTuple):
    """Numbers (emitter,) of heard and missed echoes of each call in one pulse."""

    heard: NDArray[np.int64]
    missed: NDArray[np.int64]

    @classmethod
    def of(cls, expected: ExpectedEchoes, reflectors: Reflectors, judged: Collection[int]) -> "EmissionCounts":
        """Return the counts of ``judged`` emitters, with images, at reflectors that echoes of other calls locate."""
        numbers = np.arange(expected.is_heard.shape[2])
        n_others = np.array([(each.emitter[:, None] != numbers).sum(axis=0) for each in reflectors.located])
        counts = (n_others.reshape(-1, len(numbers)) >= _N_OTHERS) & np.isin(numbers, [*judged])
        counts &= reflectors.radiated > _RADIATED
        return cls(*((each & counts[:, None]).sum(axis=(0, 1)) for each in expected))


def silence_ratios(pulses: Sequence[EmissionCounts]) -> Floats:
    """Return the logarithm of how much better silence of each emitter explains the pulses than emission: (emitter,)."""
    heard, missed = np.sum(pulses, axis=0)
    return np.asarray(_DEPENDENT * (missed * _MISSED + heard * _HEARD))


def suspect(pulses: Sequence[EmissionCounts], known: Collection[int] = ()) -> int | None:
    """Return the emitter, except known ones, that seems silent with a likelihood ratio of 1000 or more, or None."""
    ratio = silence_ratios(pulses)
    ratio[[*known]] = -math.inf
    best = int(ratio.argmax())
    return best if ratio[best] > _CERTAIN else None


def silent_one(
    suspected: int, joint: EmissionCounts, costs: Mapping[int, int], counts: Mapping[int, EmissionCounts]
) -> int | None:
    """Return the emitter whose silence explains the echoes best, or None if that of several does about equally well.

    Echoes of one emitter fit another one that is silent, at slightly shifted places. The wrong explanation usually
    leaves more echoes unexplained, and misses more of those that it predicts. Emitters that ``joint``, the evidence if
    all emit, shows are rivals of the suspected one only if their silence explains clearly more. ``costs`` are
    unexplained and missed echoes if an emitter is silent.
    """
    shown = silence_ratios([joint])
    likely = []
    for number, cost in costs.items():
        ratio = silence_ratios([counts[number]])
        is_rival = ratio[suspected] <= 0 and (shown[number] >= 0 or is_better(cost, costs[suspected]))
        if (number == suspected or is_rival) and ratio[number] > 0:
            likely.append(number)
    least = min((costs[each] for each in likely), default=0)
    best = [each for each in likely if not is_better(least, costs[each])]
    return best[0] if len(best) == 1 else None


def doubted(emitters: Collection[int], counts: EmissionCounts, cost: int) -> frozenset[int]:
    """Return emitters that no echo shows to work, if the explanation, at its ``cost``, leaves room for a better one."""
    if len(emitters) < _N_SENSORS or cost <= _ALIKE:
        return frozenset()
    return frozenset(number for number in emitters if not is_heard(counts, number))


def cheapest(joint: int, costs: Mapping[int, int]) -> int | None:
    """Return the emitter whose silence explains the echoes clearly better than anything else, or None.

    If all are assumed to emit, the echoes may explain so few reflectors that none of them shows the silent one. This
    applies to omnidirectional emitters. The calls of pistons reach few reflectors in common, so that a wrong one may
    explain their echoes as well. Costs are numbers of unexplained and missed echoes.
    """
    ascending = sorted(costs, key=lambda number: costs[number])
    if not ascending:
        return None
    least, others = costs[ascending[0]], [joint, *(costs[each] for each in ascending[1:])]
    return ascending[0] if all(is_better(least, each) and least < _CHEAP * each for each in others) else None


def is_proven(number: int, expected: ExpectedEchoes, reflectors: Reflectors) -> bool:
    """Return True if echoes show that a piston is silent; ``reflectors`` explain them without it.

    Sound over several surfaces seems to come from reflectors that do not exist, and miss the calls of working emitters.
    """
    misses = expected.is_missed[:, :, number].any(axis=1) & ~expected.is_heard[:, :, number].any(axis=1)
    misses &= reflectors.confirmed & (reflectors.radiated[:, number] > _RADIATED)
    return reflectors.n_unexplained <= _N_UNEXPLAINED or int(misses.sum()) >= _N_MISSING


def is_heard(counts: EmissionCounts, number: int) -> bool:
    """Return True if echoes at reflectors that other calls locate show that an emitter works."""
    return bool(silence_ratios([counts])[number] <= _PROVEN)


def is_better(cost: int, other: int) -> bool:
    """Return True if an explanation costs clearly less than another one."""
    return cost + _ALIKE < other


def is_much_better(length: int, other: int) -> bool:
    """Return True if a description of echoes is so much shorter that the other one is wrong."""
    return other > _TIMES * length + _MORE


def unproven_note(sensors: str, *, is_every: bool) -> str:
    """Return a note of sensors whose emission no echo proves; if they are all, their sound may be of other sources."""
    heard = "; the sound that they receive may come from another source, such as another robot" if is_every else ""
    return (
        f"no echo proves that these sensors emit: {sensors}; if an emitter is broken, obstacles ahead of it may be "
        f"missing{heard}"
    )


def expected_echoes(
    reflectors: Reflectors,
    images: Mapping[int, Energyscape],
    floors: Mapping[int, EchoFloor],
    receivers: Mapping[int, Receiver],
    late_m: Mapping[int, Mapping[int, float]],
    deaf: Mapping[int, Flags],
    silent: Collection[int] = (),
) -> ExpectedEchoes:
    """Return the echoes that reflectors should cause in images, except steps with direct sound, ``deaf`` (step,).

    ``late_m`` is the path of sound between the emissions of each receiver and of each emitter that it may hear; echoes
    of ``silent`` emitters hide no others.
    """
    predicted = reflectors.locator.predicted(reflectors.located)
    delay_m = np.full(predicted.power.shape[1:], np.nan)
    for number, delays_m in late_m.items():
        delay_m[number, [*delays_m]] = [*delays_m.values()]
    others = reflectors.locator.disturbance(predicted, delay_m, silent)
    find_maxima = kernels.load_fusion().find_maxima
    is_heard, is_missed = np.zeros((2, *predicted.power.shape), np.bool_)
    for number, image in images.items():
        receiver, senders = receivers[number], [*late_m[number]]
        power, other = predicted.power[:, number, senders], others[:, number, senders]
        arrival_m = predicted.path_m[:, number, senders] + delay_m[number, senders]
        column = np.searchsorted(image.range_m, arrival_m / 2).clip(0, len(image.range_m) - 1)
        near, beside = (math.ceil(each / float(np.diff(image.range_m[:2])[0])) for each in (_NEAR_M, _BESIDE_M))
        step = (arrival_m / 2 / receiver.step_m).astype(np.int64).clip(0, receiver.n_steps - 1)
        cosine = predicted.direction[:, number] @ receiver.mounting.rotation @ receiver.directions.T
        is_near, highest = cosine > _WITHIN, np.empty((2, *column.shape))
        find_maxima(np.ascontiguousarray(image.amplitude), is_near, column, near, beside, highest)
        shown, side = highest**2
        counts = (column >= beside) & (column < len(image.range_m) - beside) & ~deaf[number][step]
        counts &= (power > _VISIBLE * np.maximum(side * _SIDE_LOBES, floors[number].lasting ** 2)) & (
            other < _DISTURBED
        )
        counts &= is_near.any(axis=1, keepdims=True)
        is_loud = shown > _LOST * (1 - np.sqrt(np.minimum(other, 1.0))) ** 2 * power
        is_heard[:, number, senders], is_missed[:, number, senders] = counts & is_loud, counts & ~is_loud
    return ExpectedEchoes(is_heard, is_missed)


@dataclass(frozen=True, slots=True, eq=False)
class PulseEvidence:
    """Evidence of one pulse for each of the ``emitters`` that should have sent a call.

    ``proof`` returns how much better the emission of one of them explains the echoes than its silence, if this is
    obvious, and None otherwise. ``comparison`` computes it from an explanation without that emitter, as the reflectors
    of a pulse once more, which takes as long as the points.
    """

    emitters: Collection[int]
    proof: Callable[[int], float | None]
    comparison: Callable[[int], float]
    _compared: dict[int, float] = field(default_factory=dict)

    def known(self, number: int) -> float | None:
        """Return the evidence for an emitter if it is obvious or was computed before, or None."""
        return self._compared.get(number) if (found := self.proof(number)) is None else found

    def better(self, number: int) -> float:
        """Return the evidence for an emitter."""
        found = self.known(number)
        if found is None:
            found = self._compared[number] = self.comparison(number)
        return found


def best_evidence(recent: Sequence[PulseEvidence]) -> dict[int, float]:
    """Return evidence of recent pulses for each emitter of the last one, the highest of all unless it is positive.

    Any positive evidence shows that an emitter works. No more is then computed, and the last pulse is compared first.
    """
    found = {}
    for number in sorted(recent[-1].emitters):
        pulses = [each for each in reversed(recent) if number in each.emitters]
        known = [better for each in pulses if (better := each.known(number)) is not None]
        best = max(known, default=0.0)
        if not best > 0:
            best = pulses[0].better(number)
            for each in pulses[1:]:
                if best > 0:
                    break
                best = max(best, each.better(number))
        found[number] = best
    return found
