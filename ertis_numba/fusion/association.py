"""Association of the echoes of all sensors with the reflectors that cause them."""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.confirmation import confirmation
from ertis_numba.fusion.echo_paths import EchoPaths
from ertis_numba.fusion.known_echoes import KnownEchoes
from ertis_numba.fusion.overlaps import Overlap, PredictedEchoes, overlap
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import Receiver
from ertis_numba.fusion.rig import Emitters, MountedSensor
from ertis_numba.fusion.sight import Viewers, mirrored

__all__ = ["LocatedReflector", "Reflectors", "SensorEchoes", "tangents"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_MIN_SHARE: Final = 0.5  # Share from which the attribution of the images supports an explanation.
_GATE: Final = 16.0  # Squared Mahalanobis distance; four standard deviations along one axis.
_MOUNTED_M: Final = 1.7e-3  # Standard deviations of paths and directions that errors of mountings and of the air add to
_MOUNTED_RAD: Final = math.radians(0.22)  # the search for echoes of the same reflector.
_SAME_M: Final = 0.015  # Distance within which a reflector explains a lone echo, in addition to uncertainties.
_REFINED_M: Final = 0.005  # Standard deviation that overlapping echoes add to paths, once a reflector is located.
_ALIKE: Final = 10.0  # Largest ratio of reflectivities between two echoes of a reflector.
_MIN_SCORE: Final = 0.75  # Sum of the fits of two echoes halfway to the limit of the gate, one of them attributed.
_N_CONFIRMING: Final = 3  # Echoes required for a reflector that the attribution of the images does not support.
_USUAL_DB: Final = 6.0  # Reflectivity relative to the usual one, above which a reflector is a surprise, …
_SURPRISE_DB: Final = 10.0  # … which counts as much as a missing echo for each so many decibels.
_DISTURBED: Final = 0.25  # Power of overlapping echoes relative to one that they explain.
_MANY_PAIRS: Final = 9  # If so many pairs should hear a reflector, more than those of two calls, one echo shows none.
_N_UNCLEAR: Final = 4  # Echoes of a reflector in space from which none needs to be clear (`SensorEchoes.is_clear`).
_EXCESS: Final = 4.0  # Reflectivity relative to the bound of a cell, above which missing echoes exclude a candidate.
_TINY: Final = 1e-30
_STRONG: Final = 10 ** (-10.0 / 10)  # Reflectivity relative to the median, from which echoes need their own call.
_ROUNDS: Final = 8
_RESOLUTION_M: Final = 0.014  # Difference of paths that separates two echoes.
_OUTLIER: Final = 2.0  # Residual with half weight, in standard deviations.
_NEAREST_M: Final = 0.05
_FEW: Final = 1024  # Fits that there is space for at first.
_VERTICAL: Final = 1e-6
# Between emitter and receiver, the path does not depend on the position, which may then be anywhere within 10 m.
_LEAST_INFORMATION_1_M2: Final = 1 / 10.0**2


class SensorEchoes(NamedTuple):
    """Echoes in the image of one sensor.

    Attributes
    ----------
    receiver : int
    emitters : (emitter,) int64
        Sensors whose calls may have caused the echoes.
    direction : (echo, axis) float64
        Unit vectors from the receiver, in the frame of the platform.
    path_m : (echo, emitter) float64
        Length of the path of the sound if the emitter's call caused the echo.
    path_sd_m, angle_sd_rad : (echo,) float64
        Standard deviations of path and direction.
    power : (echo,) float64
    share : (echo, emitter) float64
        Share of each emitter according to the attribution of the images.
    is_clear : (echo,) bool
        Echoes that noise hardly causes, even if its level changes within a record.
    is_faint : (echo,) bool
        Echoes that only confirm reflectors that others show.
    """

    receiver: int
    emitters: Numbers
    direction: Floats
    path_m: Floats
    path_sd_m: Floats
    angle_sd_rad: Floats
    power: Floats
    share: Floats
    is_clear: NDArray[np.bool_]
    is_faint: NDArray[np.bool_]

    def without(self, emitters: Collection[int]) -> "SensorEchoes":
        """Return the echoes as those of other emitters only."""
        if not emitters:
            return self
        kept = ~np.isin(self.emitters, [*emitters])
        return self._replace(emitters=self.emitters[kept], path_m=self.path_m[:, kept], share=self.share[:, kept])


class _Candidates(NamedTuple):
    """Possible reflectors, each derived from one echo and one emitter.

    Attributes
    ----------
    echo, emitter : (candidate,) int64
    place_m : (candidate, axis) float64
    across : (candidate, axis) float64
        Horizontal vector across the direction, as long as one standard deviation.
    reflectivity : (candidate,) float64
    is_ahead : (candidate,) bool
        True in front of the receiver.
    """

    echo: Numbers
    emitter: Numbers
    place_m: Floats
    across: Floats
    reflectivity: Floats
    is_ahead: NDArray[np.bool_]

    def only(self, number: int) -> "_Candidates":
        """Return one of the candidates."""
        return _Candidates._make(each[number : number + 1] for each in self)


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


class Reflectors:
    """Reflectors that explain echoes jointly, each at the position that fits all of its echoes best.

    The call of any sensor may have caused an echo, and a flat array does not distinguish front and back. Each possible
    emitter of an echo yields a candidate: the place of a reflector. It predicts the paths and directions of the echoes
    at all other pairs of emitter and receiver. The candidate that fits the most echoes is accepted first and explains
    them; the next one must fit the remaining echoes. This is a greedy solution of the set cover problem. An own echo
    without confirmation is a reflector if the attribution of the images agrees. A foreign echo without confirmation has
    several explanations, and is discarded.

    Parameters
    ----------
    echoes : sequence of SensorEchoes
        Echoes of each receiver.
    sensors : sequence of MountedSensor
    receivers : mapping of int to Receiver
    emitters : mapping of int to Emitters
        Model of the emitters in the air of each receiver.
    grid : PolarGrid
    bound : (cell,) float32
        Highest reflectivity of each cell of the grid that the images allow.

    Attributes
    ----------
    located : tuple of LocatedReflector
    position_m : (reflector, axis) float64
    covariance_m2 : (reflector, axis, axis) float64
    reflectivity : (reflector,) float64
        Power of its echo at 1 m.
    radiated : (reflector, emitter) float64
        Power of each call towards it, relative to ahead.
    confirmed : (reflector,) bool
        Reflectors that echoes at enough pairs confirm, as in `ertis_numba.fusion.confirmation`.
    is_unexplained : (echo,) bool
    n_unexplained : int
        Echoes that no reflector explains together with others.
    """

    def __init__(
        self,
        echoes: Sequence[SensorEchoes],
        sensors: Sequence[MountedSensor],
        receivers: Mapping[int, Receiver],
        emitters: Mapping[int, Emitters],
        grid: PolarGrid,
        bound: NDArray[np.float32],
    ) -> None:
        self._grid, self._bound = grid, bound
        self._kernels = kernels.load_fusion()
        flat = {number for number, receiver in receivers.items() if receiver.is_flat}
        self._viewers = Viewers(sensors, emitters, flat)
        self._sensor_m, self._ahead = self._viewers.sensor_m, self._viewers.ahead
        self._receiver = np.concatenate([np.full(len(each.power), each.receiver) for each in echoes])
        n_echoes, n_sensors = len(self._receiver), len(sensors)
        self._path_m, self._share = np.full((n_echoes, n_sensors), np.nan), np.zeros((n_echoes, n_sensors))
        begin = 0
        for each in echoes:
            rows = slice(begin, begin := begin + len(each.power))
            self._path_m[rows, each.emitters], self._share[rows, each.emitters] = each.path_m, each.share
        self._direction = np.concatenate([each.direction for each in echoes]).reshape(-1, 3)
        self._axes = np.stack([self._direction, *tangents(self._direction)], axis=1)
        path_sd_m = np.concatenate([each.path_sd_m for each in echoes])
        angle_sd_rad = np.concatenate([each.angle_sd_rad for each in echoes])
        self._deviation = np.stack([path_sd_m, angle_sd_rad], axis=1)
        self._gate_rad = np.hypot(angle_sd_rad, _MOUNTED_RAD)
        self._power = np.concatenate([each.power for each in echoes])
        gate_m2 = path_sd_m**2 + _MOUNTED_M**2
        self._heard = kernels.HeardEchoes(
            self._receiver, self._direction, self._path_m, self._gate_rad**2, gate_m2, self._power
        )
        self._rows = {number: np.flatnonzero(self._receiver == number) for number in receivers}
        self._is_free = ~np.concatenate([each.is_faint for each in echoes])
        self._is_clear = np.concatenate([each.is_clear for each in echoes])
        # Only foreign echoes show the calls of sensors without an image.
        self._has_image = np.isin(np.arange(n_sensors), [each.receiver for each in echoes])
        self._is_incomplete = bool(np.isfinite(self._path_m[:, ~self._has_image]).any())
        self._pulse_m, self._beam = np.ones((2, n_sensors))
        for number, receiver in receivers.items():
            self._pulse_m[number], self._beam[number] = receiver.pulse_m, receiver.width
        candidates = self._candidates()
        found = self._refined(self._confirmed(candidates))
        self._add_lone(candidates, found)
        with_image = {each.receiver: self._rows[each.receiver] for each in echoes}
        heard = EchoPaths(self._sensor_m, self._ahead, with_image, flat, self._direction, self._path_m, self._power)
        place_m = np.array([each.place_m for each in found]).reshape(-1, 3)
        sight = self._viewers.sight(place_m)
        reflectivity = np.array([each.reflectivity for each in found])
        sure = confirmation(heard, place_m, sight.gain, reflectivity, [each.echo for each in found])
        # A single echo of a reflector that many pairs should hear comes from elsewhere, unless it is that of a wall.
        n_echoes_of = np.array([len(each.echo) for each in found], np.int64)
        kept = (n_echoes_of > 1) | sure.is_wall | (sure.n_pairs < _MANY_PAIRS)
        is_clear = np.array([self._is_clear[each.echo].any() for each in found], np.bool_)
        kept &= is_clear | (n_echoes_of >= _N_UNCLEAR) | grid.is_planar
        self.located = tuple(found[number] for number in np.flatnonzero(kept))
        self.position_m, self.radiated, self.confirmed = place_m[kept], sight.radiated[kept], sure.is_confirmed[kept]
        self.covariance_m2 = np.array([each.covariance_m2 for each in self.located]).reshape(-1, 3, 3)
        self.reflectivity = np.array([each.reflectivity for each in self.located])
        self.is_unexplained, self.n_unexplained = self._is_free, int(self._is_free.sum())

    def _candidates(self) -> _Candidates:
        """Return the candidates of all echoes, where their emitter is audible."""
        echo, emitter = np.nonzero(np.isfinite(self._path_m) & self._is_free[:, None])
        direction = self._direction[echo]
        if self._is_incomplete:
            twice = np.flatnonzero(self._viewers.is_flat[self._receiver[echo]])
            behind = mirrored(direction[twice], self._ahead[self._receiver[echo[twice]]])
            echo, emitter = np.append(echo, echo[twice]), np.append(emitter, emitter[twice])
            direction = np.concatenate([direction, behind])
        receiver, path_m = self._receiver[echo], self._path_m[echo, emitter]
        offset_m = self._sensor_m[emitter] - self._sensor_m[receiver]
        beyond = path_m**2 - np.einsum("ci,ci->c", offset_m, offset_m)
        to_m = beyond / np.maximum(2 * (path_m - np.einsum("ci,ci->c", direction, offset_m)), 1e-6)
        place_m = self._sensor_m[receiver] + to_m[:, None] * direction
        gain = self._viewers.sight(place_m).gain[np.arange(len(place_m)), receiver, emitter]
        reflectivity = np.divide(self._power[echo], gain, out=np.full(len(gain), np.inf), where=gain > 0)
        is_possible = (gain > 0) & (reflectivity <= self._limit(place_m))
        kept = np.flatnonzero((beyond > 0) & (to_m > _NEAREST_M) & is_possible)
        sideways = np.stack([-direction[kept, 1], direction[kept, 0], np.zeros(len(kept))], axis=1)
        across = sideways * (to_m[kept] * self._gate_rad[echo[kept]])[:, None]
        is_ahead = np.einsum("ci,ci->c", direction[kept], self._ahead[receiver[kept]]) >= 0
        return _Candidates(echo[kept], emitter[kept], place_m[kept], across, reflectivity[kept], is_ahead)

    def _limit(self, place_m: Floats) -> Floats:
        """Return the highest reflectivity that the images allow at places, 0 outside the grid."""
        cell = self._grid.cell_of(place_m)
        return np.where(cell >= 0, _EXCESS * self._bound[cell.clip(0)].astype(np.float64), 0.0)

    def _fits(
        self, candidates: _Candidates, sight: kernels.SeenPlaces, extra_m: float
    ) -> tuple[Numbers, Numbers, Numbers, Floats]:
        """Return the free echoes that candidates predict: candidate, echo, emitter and squared distance."""
        across = candidates.across
        # Echoes of a reflector show about the same reflectivity; those from behind may be weaker.
        places = kernels.PredictedPlaces(
            sight.apart_m,
            sight.seen,
            sight.depth,
            np.einsum("psi,pi->ps", sight.toward, across),
            np.einsum("pi,pi->p", across, across),
            candidates.reflectivity[:, None, None] * sight.gain,
            sight.beside_m**2 + extra_m**2,
            self._viewers.is_flat,
        )
        chosen = np.flatnonzero(self._is_free)
        count = _FEW
        while True:
            found, distance = np.empty((3, count), np.int64), np.empty(count)
            n_found = self._kernels.match_echoes(places, self._heard, chosen, _GATE, _ALIKE, found, distance)
            if n_found <= count:
                which, echo, emitter = found[:, :n_found]
                return which, echo, emitter, distance[:n_found]
            count = n_found

    def _confirmed(self, candidates: _Candidates) -> list[LocatedReflector]:
        """Return the reflectors that several echoes confirm, and mark these echoes as explained."""
        sight = self._viewers.sight(candidates.place_m)
        which, echo, emitter, distance = self._fits(candidates, sight, 0.0)
        n_candidates, n_echoes = len(candidates.echo), len(self._receiver)
        # An echo confirms a candidate once, by the emitter that fits best.
        fit = (1 - distance / _GATE) * (1 + self._share[echo, emitter]) / 2
        order = np.lexsort((-fit, echo, which))
        key = which[order] * n_echoes + echo[order]
        order = order[np.diff(key, prepend=-1) > 0]
        score = np.bincount(which[order], fit[order], minlength=n_candidates) - self._surprise(candidates)
        self._n_fitting = np.bincount(which[order], minlength=n_candidates)
        by_echo = order[np.argsort(echo[order], kind="stable")]
        bounds = np.searchsorted(echo[by_echo], np.arange(n_echoes + 1))
        found = []
        while n_candidates:
            best = int(np.argmax(score))
            if score[best] <= _MIN_SCORE:
                break
            taken = np.empty(0, np.int64)
            if self._is_free[candidates.echo[best]]:
                reflector, taken = self._accepted(candidates.only(best), sight.only(best))
                if reflector is not None:
                    found.append(reflector)
            score[best] = -1.0
            for each in taken[self._is_free[taken]]:
                self._is_free[each] = False
                entries = by_echo[bounds[each] : bounds[each + 1]]
                np.subtract.at(score, which[entries], fit[entries])
        return found

    def _surprise(self, candidates: _Candidates) -> Floats:
        """Return how much stronger candidates reflect than usual: (candidate,) float64.

        Where an image is missing, the echoes of its sensor's call fit the calls of its neighbours as well. But these
        would reach the place beside their beams, so that its reflector must be stronger.
        """
        if not self._is_incomplete or not len(candidates.echo):
            return np.zeros(len(candidates.echo))
        least = np.full(len(self._receiver), np.inf)
        np.minimum.at(least, candidates.echo, candidates.reflectivity)
        usual = float(np.median(least[np.isfinite(least)]))
        excess_db = 10 * np.log10(np.maximum(candidates.reflectivity / max(usual, _TINY), 1.0))
        return np.asarray(np.maximum(0.0, excess_db - _USUAL_DB) / _SURPRISE_DB)

    def _accepted(self, here: _Candidates, sight: kernels.SeenPlaces) -> tuple[LocatedReflector | None, Numbers]:
        """Return the reflector at a candidate if enough echoes confirm it, and all echoes that it explains."""
        extra_m, covariance_m2, echo = 0.0, np.empty((3, 3)), np.empty(0, np.int64)
        for _ in range(2):
            _, echo, emitters, distance = self._fits(here, sight, extra_m)
            members, emitter = self._members(echo, emitters, distance)
            is_own = self._receiver[members] == emitter
            is_likely = np.any(is_own & (self._share[members, emitter] > _MIN_SHARE))
            if len(members) < (2 if is_likely else _N_CONFIRMING):
                return None, np.empty(0, np.int64)
            place_m, covariance_m2 = self._located(members, emitter, here.place_m[0])
            sight = self._viewers.sight(place_m[None])
            gain = sight.gain[0, self._receiver[members], emitter]
            reflectivity = _median(self._power[members] / np.maximum(gain, _TINY))
            here = here._replace(place_m=place_m[None], across=np.zeros((1, 3)), reflectivity=np.array([reflectivity]))
            extra_m = _REFINED_M
        reflectivity = self._reflectivity(sight, members, emitter)
        return LocatedReflector(place_m, covariance_m2, reflectivity, members, emitter), np.unique(echo)

    def _reflectivity(self, sight: kernels.SeenPlaces, members: Numbers, emitter: Numbers) -> float:
        """Return the power at 1 m of a reflector that fits its echoes best, by least squares.

        Calls of emitters at about the same distance arrive together, with unknown phases.
        """
        apart_m = sight.apart_m[0]
        together = np.exp(-(((apart_m - apart_m[emitter][:, None]) / _RESOLUTION_M) ** 2))
        together[~np.isfinite(self._path_m[members])] = 0.0
        gain = np.sum(self._viewers.echo_powers(sight, self._receiver[members]) * together, axis=1)
        return float(self._power[members] @ gain / max(gain @ gain, _TINY**2))

    def _members(self, echo: Numbers, emitter: Numbers, distance: Floats) -> tuple[Numbers, Numbers]:
        """Return the best echo of each pair, and its emitter; each echo at most once."""
        taken: set[int | tuple[int, int]] = set()
        found = []
        for entry in np.argsort(distance, kind="stable").tolist():
            one = int(echo[entry])
            pair = int(emitter[entry]), int(self._receiver[one])
            if one not in taken and pair not in taken:
                taken |= {one, pair}
                found.append(entry)
        return echo[found], emitter[found]

    def _refined(self, found: list[LocatedReflector]) -> list[LocatedReflector]:
        """Return reflectors located with the errors of echoes that overlap, without those that overlaps explain."""
        if not found:
            return found
        found = sorted(found, key=lambda each: -len(each.echo))
        echo = np.concatenate([each.echo for each in found])
        emitter = np.concatenate([each.emitter for each in found])
        number = np.repeat(np.arange(len(found)), [len(each.echo) for each in found])
        sight = self._viewers.sight(np.array([each.place_m for each in found]))
        overlap, beside_m = self._overlap(found, echo, number, emitter), sight.beside_m
        ends = np.cumsum([len(each.echo) for each in found])
        rows = [slice(end - len(each.echo), end) for end, each in zip(ends, found, strict=True)]
        is_kept = np.zeros(len(found), np.bool_)
        for place, row in enumerate(rows):
            is_kept[place] = _median(overlap.only(row, is_kept).power) <= _DISTURBED
        refined = []
        for place in np.flatnonzero(is_kept).tolist():
            each, disturbed = found[place], overlap.only(rows[place], is_kept)
            place_m, covariance_m2 = self._located(each.echo, each.emitter, each.place_m, disturbed, beside_m[place])
            refined.append(each._replace(place_m=place_m, covariance_m2=covariance_m2))
        return refined

    def _overlap(
        self,
        found: Sequence[LocatedReflector],
        echo: Numbers,
        number: Numbers | None = None,
        emitter: Numbers | None = None,
    ) -> Overlap:
        """Return how much the echoes of reflectors disturb some echoes, which may be those of reflectors themselves."""
        predicted = self._predicted(found)
        is_other = np.ones((len(echo), len(found), len(self._sensor_m)), np.bool_)
        if number is not None and emitter is not None:
            is_other[np.arange(len(echo)), number, emitter] = False
        return overlap(
            predicted,
            self._receiver[echo],
            self._path_m[echo],
            self._direction[echo],
            self._power[echo],
            is_other,
            ahead=self._ahead,
            pulse_m=self._pulse_m,
            beam=self._beam,
        )

    def needs(self, number: int, silent: "Reflectors") -> bool:
        """Return True if an emitter is needed to explain strong echoes of its own sensor.

        Echoes of sound that walls reflect several times are missed and unexplained in any case, so that their number
        does not show that an emitter is silent. The image of its sensor then holds only echoes of other calls, which
        others explain, or which are weak for an own call.

        Parameters
        ----------
        number : int
            Index of the emitter and of its sensor.
        silent : Reflectors
            Explanation of the same echoes without this emitter.
        """
        least = _STRONG * _median(self.reflectivity) if len(self.reflectivity) else 0.0
        own = [
            each.echo[(each.emitter == number) & (self._receiver[each.echo] == number)]
            for each in self.located
            if each.reflectivity > least
        ]
        return any(bool(silent.is_unexplained[echo].any()) for echo in own)

    def own_emitters(self) -> frozenset[int]:
        """Return the emitters to whose calls the echoes of their own sensors are attributed."""
        own = [each.emitter[each.emitter == self._receiver[each.echo]].tolist() for each in self.located]
        return frozenset(number for each in own for number in each)

    def predicted(self) -> PredictedEchoes:
        """Return the echoes that the reflectors should cause if all sensors emit."""
        return self._predicted(self.located)

    @property
    def is_sure(self) -> NDArray[np.bool_]:
        """True for confirmed reflectors, and for those that several echoes locate: (reflector,) bool."""
        several = [len(each.echo) >= _N_CONFIRMING for each in self.located]
        return np.asarray(self.confirmed | np.array(several, np.bool_))

    def known_echoes(self, receiver: int) -> KnownEchoes:
        """Return the echoes of the reflectors in the image of a receiver: those that locate them, and predicted ones.

        Parameters
        ----------
        receiver : int
        """
        sight = self._viewers.sight(self.position_m)
        is_heard = np.isfinite(self._path_m[self._rows[receiver]]).any(axis=0)
        power = sight.gain[:, receiver] * self.reflectivity[:, None] * is_heard
        path_m = sight.apart_m[:, receiver, None] + sight.apart_m
        direction = np.repeat(sight.seen[:, receiver, None], power.shape[1], axis=1)
        for number, each in enumerate(self.located):
            here = self._receiver[each.echo] == receiver
            echo, emitter = each.echo[here], each.emitter[here]
            path_m[number, emitter], direction[number, emitter] = self._path_m[echo, emitter], self._direction[echo]
            power[number, emitter] = self._power[echo]
        reflector, emitter = np.nonzero(power > 0)
        return KnownEchoes(
            reflector,
            emitter,
            path_m[reflector, emitter],
            direction[reflector, emitter],
            power[reflector, emitter],
            sight.depth[reflector, receiver] > 0,
        )

    def _predicted(self, found: Sequence[LocatedReflector]) -> PredictedEchoes:
        """Return the echoes that reflectors cause."""
        sight = self._viewers.sight(np.array([each.place_m for each in found]).reshape(-1, 3))
        return PredictedEchoes(
            sight.apart_m[:, :, None] + sight.apart_m[:, None],
            sight.gain * np.array([each.reflectivity for each in found])[:, None, None],
            sight.seen,
        )

    def _add_lone(self, candidates: _Candidates, found: list[LocatedReflector]) -> None:
        """Add reflectors that a single own echo shows, unless the attribution explains it otherwise."""
        own = self._share[np.arange(len(self._receiver)), self._receiver]
        kept = self._is_free & (self._share.sum(axis=1) > _MIN_SHARE) & (own >= self._share.max(axis=1)) & (own > 0)
        kept &= self._is_clear & ~self._is_ambiguous(candidates)
        if found:
            kept[kept] = self._overlap(found, np.flatnonzero(kept)).power.sum(axis=1) < _DISTURBED
        for echo in np.flatnonzero(kept)[np.argsort(-self._power[kept], kind="stable")]:
            sensor = self._receiver[echo : echo + 1]
            place_m = self._sensor_m[sensor[0]] + self._path_m[echo, sensor[0]] / 2 * self._direction[echo]
            sensor_echo = np.array([echo])
            _, covariance_m2 = self._located(sensor_echo, sensor, place_m)
            if _is_apart(place_m, covariance_m2, found):
                reflectivity = self._reflectivity(self._viewers.sight(place_m[None]), sensor_echo, sensor)
                found.append(LocatedReflector(place_m, covariance_m2, reflectivity, sensor_echo, sensor))

    def _is_ambiguous(self, candidates: _Candidates) -> NDArray[np.bool_]:
        """Return True for echoes that another call explains as well, if an image is missing: (echo,) bool.

        Several sensors that could contradict the call of one without an image may fail to. Other calls must explain a
        second echo.
        """
        found = np.zeros(len(self._receiver), np.bool_)
        if self._is_incomplete:
            is_own = (candidates.emitter == self._receiver[candidates.echo]) & candidates.is_ahead
            own = np.zeros(len(found))
            own[candidates.echo[is_own]] = candidates.reflectivity[is_own]
            is_other = ~is_own & (candidates.reflectivity < _ALIKE * own[candidates.echo])
            is_alone = np.count_nonzero(self._has_image) == 1
            is_other &= (self._n_fitting > 1) | ~(is_alone | self._has_image[candidates.emitter])
            found[candidates.echo[is_other]] = True
        return found

    def _located(
        self,
        members: Numbers,
        emitter: Numbers,
        place_m: Floats,
        disturbed: Overlap | None = None,
        beside_m: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """Return the position of a reflector and its covariance: (axis,) and (axis, axis) float64."""
        deviation = self._deviation[members]
        if disturbed is not None and beside_m is not None:
            added = np.stack([disturbed.path_m2 + beside_m[emitter] ** 2, disturbed.angle_rad2], axis=1)
            deviation = np.sqrt(deviation**2 + added)
        receiver, axes = self._receiver[members], self._axes[members]
        ahead = self._ahead[receiver]
        is_behind = np.einsum("ei,ei->e", place_m - self._sensor_m[receiver], ahead) < 0
        if is_behind.any():
            axes = np.where(is_behind[:, None, None], mirrored(axes, ahead[:, None]), axes)
        position_m, covariance_m2 = place_m.copy(), np.empty((3, 3))
        is_alone = len(members) == 1
        self._kernels.locate_reflector(
            self._sensor_m[emitter],
            self._sensor_m[receiver],
            self._path_m[members, emitter],
            axes,
            deviation,
            _LEAST_INFORMATION_1_M2,
            _NEAREST_M,
            math.inf if is_alone else _OUTLIER,
            1 if is_alone else _ROUNDS,
            position_m,
            covariance_m2,
        )
        return position_m, covariance_m2


def _is_apart(place_m: Floats, covariance_m2: Floats, found: list[LocatedReflector]) -> bool:
    """Return True if no reflector is at a place.

    Another echo at a reflector is a shoulder of its main lobe, or overlaps with other echoes.
    """
    if not found:
        return True
    offset_m = place_m - np.array([each.place_m for each in found])
    spread_m2 = np.array([each.covariance_m2 for each in found]) + covariance_m2 + _SAME_M**2 * np.eye(3)
    distance = np.einsum("ri,ri->r", offset_m, np.linalg.solve(spread_m2, offset_m[..., None])[..., 0])
    return bool(distance.min() >= _GATE)


def _median(values: Floats) -> float:
    """Return the median of some numbers; `numpy.median` takes ten times as long."""
    ordered = np.sort(values)
    return float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)


def tangents(direction: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors to the left and upwards, across directions: two of (..., axis) float64."""
    x, y, z = np.moveaxis(direction, -1, 0)
    level = np.hypot(x, y)
    # Straight up, any horizontal direction will do.
    is_level = level > _VERTICAL
    safe = np.where(is_level, level, 1.0)
    left_x, left_y = np.where(is_level, -y / safe, 0.0), np.where(is_level, x / safe, 1.0)
    left = np.stack([left_x, left_y, np.zeros_like(x)], axis=-1)
    return left, np.stack([-z * left_y, z * left_x, x * left_y - y * left_x], axis=-1)
