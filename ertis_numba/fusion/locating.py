"""Positions of reflectors by least squares, with the errors of echoes that overlap."""

import math
from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.overlaps import Overlap, PredictedEchoes, overlap, summed_m2
from ertis_numba.fusion.sensor_echoes import PulseEchoes
from ertis_numba.fusion.sight import Viewers

__all__ = ["NEAREST_M", "OUTLIER", "LocatedReflector", "Locator", "median_of"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

NEAREST_M: Final = 0.05
"""Least distance of a reflector from a sensor."""
OUTLIER: Final = 2.0
"""Residual with half weight, in standard deviations."""

_DISTURBED: Final = 0.25  # Power of overlapping echoes relative to one that they explain.
_TINY: Final = 1e-30
_ROUNDS: Final = 8
_NONE: Final = np.empty((0, 2))
_RESOLUTION_M: Final = 0.014  # Difference of paths that separates two echoes.
# Between emitter and receiver, the path does not depend on the position, which may then be anywhere within 10 m.
_LEAST_INFORMATION_1_M2: Final = 1 / 10.0**2


class LocatedReflector(NamedTuple):
    """Located reflector, and the echoes (member,) that locate it, with emitters and deviations of their calls."""

    place_m: Floats
    covariance_m2: Floats
    reflectivity: float
    echo: Numbers
    emitter: Numbers
    deviation: Floats


class Locator:
    """Locator of reflectors by their echoes, with widths (sensor,) of pulses and main lobes as in `overlap`."""

    def __init__(self, echoes: PulseEchoes, viewers: Viewers, pulse_m: Floats, beam: Floats) -> None:
        self._echoes, self._viewers, self._pulse_m, self._beam = echoes, viewers, pulse_m, beam
        self.heard, self._locate = echoes.matched(), kernels.load_fusion().locate_reflector

    def located(
        self, members: Numbers, emitter: Numbers, place_m: Floats, added: Floats = _NONE
    ) -> tuple[Floats, Floats]:
        """Return the position of a reflector and its covariance; ``added`` are more variances, (member, 2)."""
        position_m, covariance_m2, is_alone = place_m.copy(), np.empty((3, 3)), len(members) == 1
        self._locate(
            self._viewers.sensor_m,
            self._viewers.ahead,
            self.heard,
            members,
            emitter,
            added,
            _LEAST_INFORMATION_1_M2,
            NEAREST_M,
            math.inf if is_alone else OUTLIER,
            1 if is_alone else _ROUNDS,
            position_m,
            covariance_m2,
        )
        return position_m, covariance_m2

    def measured(self, found: Sequence[LocatedReflector]) -> list[LocatedReflector]:
        """Return reflectors with the power at 1 m that fits their echoes best, by least squares.

        Calls of emitters at about the same distance arrive together, with unknown phases.
        """
        if not found:
            return []
        number, echo, emitter = _members(found)
        sight = self._viewers.sight(np.array([each.place_m for each in found]))
        together = np.exp(-((_late_m(sight, number, emitter) / _RESOLUTION_M) ** 2))
        together[~np.isfinite(self._echoes.path_m[echo])] = 0.0
        gain = np.sum(self._viewers.echo_powers(sight, number, self._echoes.receiver[echo]) * together, axis=1)
        squares = np.maximum(np.bincount(number, gain * gain), _TINY**2)
        reflectivity = np.bincount(number, self._echoes.power[echo] * gain) / squares
        return [each._replace(reflectivity=float(power)) for each, power in zip(found, reflectivity, strict=True)]

    def refined(self, found: list[LocatedReflector]) -> list[LocatedReflector]:
        """Return reflectors located with the errors of echoes that overlap, without those that overlaps explain."""
        if not found:
            return found
        found = sorted(found, key=lambda each: -len(each.echo))
        number, echo, emitter = _members(found)
        sight = self._viewers.sight(np.array([each.place_m for each in found]))
        overlap = self.overlap(found, echo, number)
        rows = [slice(*ends) for ends in pairwise(np.searchsorted(number, np.arange(len(found) + 1)).tolist())]
        is_kept = np.zeros(len(found), np.bool_)
        for place, row in enumerate(rows):
            is_kept[place] = median_of(overlap.power[row][:, is_kept].sum(axis=1)) <= _DISTURBED
        disturbed, summed_m2 = overlap.by(is_kept), self._summed_m2(found, sight, number, echo, emitter)
        beside_m = sight.beside_m[number, emitter]
        path_m2 = disturbed.path_m2 + summed_m2 + beside_m**2
        added = np.stack([path_m2, disturbed.angle_rad2], axis=1)
        slope = sight.toward[number, emitter] + sight.toward[number, self._echoes.receiver[echo]]
        slope /= (self._echoes.deviation[echo, 0] ** 2 + path_m2)[:, None]
        # Sums of calls shift all echoes of a reflector alike, and an emitter beside its beam those of its call.
        summed, sent = np.sqrt(summed_m2)[:, None] * slope, beside_m[:, None] * slope
        refined = []
        for place in np.flatnonzero(is_kept).tolist():
            each, row = found[place], rows[place]
            place_m, covariance_m2 = self.located(each.echo, each.emitter, each.place_m, added[row])
            alike = [summed[row].sum(axis=0), *(sent[row][each.emitter == one].sum(axis=0) for one in {*each.emitter})]
            shifts_m = np.array(alike) @ covariance_m2
            covariance_m2 += shifts_m.T @ shifts_m
            deviation = np.sqrt(self._echoes.deviation[each.echo] ** 2 + added[row])
            refined.append(each._replace(place_m=place_m, covariance_m2=covariance_m2, deviation=deviation))
        return refined

    def _summed_m2(
        self,
        found: Sequence[LocatedReflector],
        sight: kernels.SeenPlaces,
        number: Numbers,
        echo: Numbers,
        emitter: Numbers,
    ) -> Floats:
        """Return path variances (echo,) by other emitters' calls over the same reflectors, alike at all receivers."""
        receiver = self._echoes.receiver[echo]
        power = sight.gain[number, receiver] * np.array([each.reflectivity for each in found])[number, None]
        power[~np.isfinite(self._echoes.path_m[echo])] = 0.0
        late_m = np.abs(_late_m(sight, number, emitter))
        return summed_m2(late_m, power / self._echoes.power[echo, None], self._pulse_m[receiver, None])

    def overlap(self, found: Sequence[LocatedReflector], echo: Numbers, number: Numbers | None = None) -> Overlap:
        """Return how much the echoes of reflectors disturb some echoes, except those of the same reflector."""
        predicted = self.predicted(found)
        is_other = np.ones((len(echo), len(found), len(self._viewers.sensor_m)), np.bool_)
        if number is not None:
            is_other[np.arange(len(echo)), number] = False
        return overlap(
            predicted,
            self._echoes.receiver[echo],
            self._echoes.path_m[echo],
            self._echoes.direction[echo],
            self._echoes.power[echo],
            is_other,
            ahead=self._viewers.ahead,
            pulse_m=self._pulse_m,
            beam=self._beam,
        )

    def disturbance(self, predicted: PredictedEchoes, delay_m: Floats, silent: Collection[int]) -> Floats:
        """Return the power of other echoes at predicted ones, relative to these: (reflector, receiver, emitter).

        ``delay_m`` (receiver, emitter) are the paths of sound between their emissions, NaN for those that a receiver
        does not hear. Echoes of ``silent`` emitters disturb none.
        """
        found = np.zeros_like(predicted.power)
        of, receiver, emitter = np.nonzero(np.broadcast_to(np.isfinite(delay_m), found.shape))
        paths_m = predicted.path_m[of, receiver, emitter, None] + delay_m[receiver, emitter, None] - delay_m[receiver]
        is_other = np.ones((len(of), len(found), found.shape[2]), np.bool_)
        is_other[np.arange(len(of)), of, emitter] = False
        heard = predicted.power.copy()
        heard[..., [*silent]] = 0.0
        found[of, receiver, emitter] = overlap(
            predicted._replace(power=heard),
            receiver,
            paths_m,
            predicted.direction[of, receiver],
            np.maximum(predicted.power[of, receiver, emitter], _TINY),
            is_other,
            ahead=self._viewers.ahead,
            pulse_m=self._pulse_m,
            beam=self._beam,
        ).power.sum(axis=1)
        return found

    def predicted(self, found: Sequence[LocatedReflector]) -> PredictedEchoes:
        """Return the echoes that reflectors cause."""
        sight = self._viewers.sight(np.array([each.place_m for each in found]).reshape(-1, 3))
        return PredictedEchoes(
            sight.apart_m[:, :, None] + sight.apart_m[:, None],
            sight.gain * np.array([each.reflectivity for each in found])[:, None, None],
            sight.seen,
        )


def median_of(values: Floats) -> float:
    """Return the median of some numbers; `numpy.median` takes ten times as long."""
    ordered = np.sort(values)
    return float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)


def _members(found: Sequence[LocatedReflector]) -> tuple[Numbers, Numbers, Numbers]:
    """Return the reflector, echo and emitter of all members."""
    number = np.repeat(np.arange(len(found)), [len(each.echo) for each in found])
    return number, np.concatenate([each.echo for each in found]), np.concatenate([each.emitter for each in found])


def _late_m(sight: kernels.SeenPlaces, number: Numbers, emitter: Numbers) -> Floats:
    """Return the paths from all emitters to the reflectors of echoes, relative to the echoes' own: (echo, emitter)."""
    apart_m = sight.apart_m[number]
    return np.asarray(apart_m - np.take_along_axis(apart_m, emitter[:, None], axis=1))
