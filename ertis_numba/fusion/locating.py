"""Positions of reflectors by least squares, with the errors of echoes that overlap."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.overlaps import Overlap, PredictedEchoes, overlap, summed_m2
from ertis_numba.fusion.sensor_echoes import PulseEchoes
from ertis_numba.fusion.sight import Viewers, mirrored

__all__ = ["NEAREST_M", "LocatedReflector", "Locator", "median_of"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

NEAREST_M: Final = 0.05
"""Least distance of a reflector from a sensor."""

_DISTURBED: Final = 0.25  # Power of overlapping echoes relative to one that they explain.
_TINY: Final = 1e-30
_ROUNDS: Final = 8
_RESOLUTION_M: Final = 0.014  # Difference of paths that separates two echoes.
_OUTLIER: Final = 2.0  # Residual with half weight, in standard deviations.
# Between emitter and receiver, the path does not depend on the position, which may then be anywhere within 10 m.
_LEAST_INFORMATION_1_M2: Final = 1 / 10.0**2


class LocatedReflector(NamedTuple):
    """Located reflector.

    Attributes
    ----------
    place_m : (axis,) float64
    covariance_m2 : (axis, axis) float64
    reflectivity : float
    echo, emitter : (member,) int64
        Echoes that locate it, and the emitters of their calls.
    """

    place_m: Floats
    covariance_m2: Floats
    reflectivity: float
    echo: Numbers
    emitter: Numbers


class Locator:
    """Locator of reflectors by their echoes.

    Parameters
    ----------
    echoes : PulseEchoes
    viewers : Viewers
    pulse_m, beam : (sensor,) float64
        Widths of the compressed pulses and of the main lobes, as in `overlap`.
    """

    def __init__(self, echoes: PulseEchoes, viewers: Viewers, pulse_m: Floats, beam: Floats) -> None:
        self._echoes, self._viewers, self._pulse_m, self._beam = echoes, viewers, pulse_m, beam
        self._locate = kernels.load_fusion().locate_reflector

    def located(
        self,
        members: Numbers,
        emitter: Numbers,
        place_m: Floats,
        disturbed: Overlap | None = None,
        beside_m: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """Return the position of a reflector and its covariance: (axis,) and (axis, axis) float64."""
        deviation = self._echoes.deviation[members]
        if disturbed is not None and beside_m is not None:
            added = np.stack([disturbed.path_m2 + beside_m[emitter] ** 2, disturbed.angle_rad2], axis=1)
            deviation = np.sqrt(deviation**2 + added)
        receiver, axes = self._echoes.receiver[members], self._echoes.axes[members]
        ahead = self._viewers.ahead[receiver]
        is_behind = np.einsum("ei,ei->e", place_m - self._viewers.sensor_m[receiver], ahead) < 0
        if is_behind.any():
            axes = np.where(is_behind[:, None, None], mirrored(axes, ahead[:, None]), axes)
        position_m, covariance_m2 = place_m.copy(), np.empty((3, 3))
        is_alone = len(members) == 1
        self._locate(
            self._viewers.sensor_m[emitter],
            self._viewers.sensor_m[receiver],
            self._echoes.path_m[members, emitter],
            axes,
            deviation,
            _LEAST_INFORMATION_1_M2,
            NEAREST_M,
            math.inf if is_alone else _OUTLIER,
            1 if is_alone else _ROUNDS,
            position_m,
            covariance_m2,
        )
        return position_m, covariance_m2

    def reflectivity(self, sight: kernels.SeenPlaces, members: Numbers, emitter: Numbers) -> float:
        """Return the power at 1 m of a reflector that fits its echoes best, by least squares.

        Calls of emitters at about the same distance arrive together, with unknown phases.
        """
        apart_m = sight.apart_m[0]
        together = np.exp(-(((apart_m - apart_m[emitter][:, None]) / _RESOLUTION_M) ** 2))
        together[~np.isfinite(self._echoes.path_m[members])] = 0.0
        gain = np.sum(self._viewers.echo_powers(sight, self._echoes.receiver[members]) * together, axis=1)
        return float(self._echoes.power[members] @ gain / max(gain @ gain, _TINY**2))

    def refined(self, found: list[LocatedReflector]) -> list[LocatedReflector]:
        """Return reflectors located with the errors of echoes that overlap, without those that overlaps explain."""
        if not found:
            return found
        found = sorted(found, key=lambda each: -len(each.echo))
        echo = np.concatenate([each.echo for each in found])
        emitter = np.concatenate([each.emitter for each in found])
        number = np.repeat(np.arange(len(found)), [len(each.echo) for each in found])
        sight = self._viewers.sight(np.array([each.place_m for each in found]))
        overlap, beside_m = self.overlap(found, echo, number, emitter), sight.beside_m
        ends = np.cumsum([len(each.echo) for each in found])
        rows = [slice(end - len(each.echo), end) for end, each in zip(ends, found, strict=True)]
        is_kept = np.zeros(len(found), np.bool_)
        for place, row in enumerate(rows):
            is_kept[place] = median_of(overlap.only(row, is_kept).power) <= _DISTURBED
        summed_m2 = self._summed_m2(found, sight, number, echo, emitter)
        refined = []
        for place in np.flatnonzero(is_kept).tolist():
            each, disturbed, own_m2 = found[place], overlap.only(rows[place], is_kept), summed_m2[rows[place]]
            disturbed = disturbed._replace(path_m2=disturbed.path_m2 + own_m2)
            place_m, covariance_m2 = self.located(each.echo, each.emitter, each.place_m, disturbed, beside_m[place])
            path_m2 = self._echoes.deviation[each.echo, 0] ** 2 + disturbed.path_m2 + beside_m[place, each.emitter] ** 2
            shift_m = covariance_m2 @ (np.sqrt(own_m2) / path_m2 @ self._slopes(each, place_m))
            refined.append(each._replace(place_m=place_m, covariance_m2=covariance_m2 + np.outer(shift_m, shift_m)))
        return refined

    def _summed_m2(
        self,
        found: Sequence[LocatedReflector],
        sight: kernels.SeenPlaces,
        number: Numbers,
        echo: Numbers,
        emitter: Numbers,
    ) -> Floats:
        """Return the variances of paths by the calls that other emitters send over the same reflectors: (echo,).

        These shift the echoes at all receivers alike.
        """
        apart_m, receiver = sight.apart_m[number], self._echoes.receiver[echo]
        late_m = np.abs(apart_m - np.take_along_axis(apart_m, emitter[:, None], axis=1))
        power = sight.gain[number, receiver] * np.array([each.reflectivity for each in found])[number, None]
        power[~np.isfinite(self._echoes.path_m[echo])] = 0.0
        return summed_m2(late_m, power / self._echoes.power[echo, None], self._pulse_m[receiver, None])

    def _slopes(self, each: LocatedReflector, place_m: Floats) -> Floats:
        """Return the change of the paths of a reflector's echoes with its place: (echo, axis)."""
        toward = self._viewers.sight(place_m[None]).toward[0]
        return np.asarray(toward[each.emitter] + toward[self._echoes.receiver[each.echo]])

    def overlap(
        self,
        found: Sequence[LocatedReflector],
        echo: Numbers,
        number: Numbers | None = None,
        emitter: Numbers | None = None,
    ) -> Overlap:
        """Return how much the echoes of reflectors disturb some echoes, which may be those of reflectors themselves."""
        predicted = self.predicted(found)
        is_other = np.ones((len(echo), len(found), len(self._viewers.sensor_m)), np.bool_)
        if number is not None and emitter is not None:
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
