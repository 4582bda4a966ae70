"""Search for the reflectors that explain the echoes of all sensors."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.locating import NEAREST_M, LocatedReflector, Locator, median_of
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.sensor_echoes import PulseEchoes
from ertis_numba.fusion.sight import Viewers, mirrored

__all__ = ["Search"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_MIN_SHARE: Final = 0.5  # Share from which the attribution of the images supports an explanation.
_TOGETHER_M: Final = 0.025  # Difference of paths below which calls arrive together: two widths of the usual pulse.
_GATE: Final = 16.0  # Squared Mahalanobis distance; four standard deviations along one axis.
_SAME_M: Final = 0.015  # Distance within which a reflector explains a lone echo, in addition to uncertainties.
_REFINED_M: Final = 0.005  # Standard deviation that overlapping echoes add to paths, once a reflector is located.
_ALIKE: Final = 10.0  # Largest ratio of reflectivities between two echoes of a reflector.
_MIN_SCORE: Final = 0.75  # Sum of the fits of two echoes halfway to the limit of the gate, one of them attributed.
_N_CONFIRMING: Final = 3  # Echoes required for a reflector that the attribution of the images does not support.
_N_LIKELY: Final = 2  # The same for one that it supports.
_USUAL_DB: Final = 6.0  # Reflectivity relative to the usual one, above which a reflector is a surprise, …
_SURPRISE_DB: Final = 10.0  # … which counts as much as a missing echo for each so many decibels.
_DISTURBED: Final = 0.25  # Power of overlapping echoes relative to one that they explain.
_EXCESS: Final = 4.0  # Reflectivity relative to the bound of a cell, above which missing echoes exclude a candidate.
_TINY: Final = 1e-30
_FEW: Final = 1024  # Fits that there is space for at first.


class _Candidates(NamedTuple):
    """Possible reflectors (candidate,), each derived from one echo and one emitter.

    ``across`` is a horizontal vector across the direction, as long as one standard deviation; ``is_ahead`` of the
    receiver.
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


class Search:
    """Greedy search for reflectors: the candidate that fits the most echoes explains them, the next one the others.

    ``bound`` (cell,) is the highest reflectivity that the images allow. ``is_free`` (echo,) are those that no reflector
    explains together with others, except faint ones.
    """

    def __init__(
        self, echoes: PulseEchoes, viewers: Viewers, locator: Locator, grid: PolarGrid, bound: NDArray[np.float32]
    ) -> None:
        self._echoes, self._viewers, self._locator = echoes, viewers, locator
        self._grid, self._bound = grid, bound
        self._is_incomplete, self._match = echoes.is_incomplete, kernels.load_fusion().match_echoes
        self.is_free = ~echoes.is_faint
        candidates = self._candidates()
        self.found = locator.refined(locator.measured(self._confirmed(candidates)))
        self._add_lone(candidates)

    def _candidates(self) -> _Candidates:
        """Return the candidates of all echoes, where their emitter is audible."""
        echo, emitter = np.nonzero(np.isfinite(self._echoes.path_m) & self.is_free[:, None])
        direction = self._echoes.direction[echo]
        if self._is_incomplete:
            twice = np.flatnonzero(self._viewers.is_flat[self._echoes.receiver[echo]])
            behind = mirrored(direction[twice], self._viewers.ahead[self._echoes.receiver[echo[twice]]])
            echo, emitter = np.append(echo, echo[twice]), np.append(emitter, emitter[twice])
            direction = np.concatenate([direction, behind])
        receiver, path_m = self._echoes.receiver[echo], self._echoes.path_m[echo, emitter]
        offset_m = self._viewers.sensor_m[emitter] - self._viewers.sensor_m[receiver]
        beyond = path_m**2 - np.einsum("ci,ci->c", offset_m, offset_m)
        to_m = beyond / np.maximum(2 * (path_m - np.einsum("ci,ci->c", direction, offset_m)), 1e-6)
        place_m = self._viewers.sensor_m[receiver] + to_m[:, None] * direction
        gain = self._viewers.sight(place_m).gain[np.arange(len(place_m)), receiver, emitter]
        reflectivity = np.divide(self._echoes.power[echo], gain, out=np.full(len(gain), np.inf), where=gain > 0)
        is_possible = (gain > 0) & (reflectivity <= self._limit(place_m))
        kept = np.flatnonzero((beyond > 0) & (to_m > NEAREST_M) & is_possible)
        sideways = np.stack([-direction[kept, 1], direction[kept, 0], np.zeros(len(kept))], axis=1)
        across = sideways * (to_m[kept] * self._echoes.gate_rad[echo[kept]])[:, None]
        is_ahead = np.einsum("ci,ci->c", direction[kept], self._viewers.ahead[receiver[kept]]) >= 0
        return _Candidates(echo[kept], emitter[kept], place_m[kept], across, reflectivity[kept], is_ahead)

    def _limit(self, place_m: Floats) -> Floats:
        """Return the highest reflectivity that the images allow at places, 0 outside the grid."""
        cell = self._grid.cell_of(place_m)
        return np.where(cell >= 0, _EXCESS * self._bound[cell.clip(0)].astype(np.float64), 0.0)

    def _fits(
        self, candidates: _Candidates, sight: kernels.SeenPlaces, extra_m: float
    ) -> tuple[Numbers, Numbers, Numbers, Floats]:
        """Return the free echoes that candidates predict: candidate, echo, emitter and squared distance."""
        # Echoes of a reflector show about the same reflectivity; those from behind may be weaker.
        places = sight, candidates.across, candidates.reflectivity, extra_m, self._viewers.is_flat
        chosen, count = np.flatnonzero(self.is_free), _FEW
        while True:
            found, distance = np.empty((3, count), np.int64), np.empty(count)
            n_found = self._match(*places, self._locator.heard, chosen, _GATE, _ALIKE, found, distance)
            if n_found <= count:
                which, echo, emitter = found[:, :n_found]
                return which, echo, emitter, distance[:n_found]
            count = n_found

    def _confirmed(self, candidates: _Candidates) -> list[LocatedReflector]:
        """Return the reflectors that several echoes confirm, and mark these echoes as explained."""
        sight = self._viewers.sight(candidates.place_m)
        which, echo, emitter, distance = self._fits(candidates, sight, 0.0)
        n_candidates, n_echoes = len(candidates.echo), len(self._echoes.receiver)
        # An echo confirms a candidate once, by the emitter that fits best.
        fit = (1 - distance / _GATE) * (1 + self._support((candidates, sight), which, echo, emitter)) / 2
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
            if self.is_free[candidates.echo[best]]:
                reflector, taken = self._accepted(candidates.only(best), sight.only(best))
                if reflector is not None:
                    found.append(reflector)
            score[best] = -1.0
            for each in taken[self.is_free[taken]]:
                self.is_free[each] = False
                entries = by_echo[bounds[each] : bounds[each + 1]]
                np.subtract.at(score, which[entries], fit[entries])
        return found

    def _support(
        self, places: tuple[_Candidates, kernels.SeenPlaces], which: Numbers, echo: Numbers, emitter: Numbers
    ) -> Floats:
        """Return the share (fit,) of an echo that emitters have whose calls arrive together over a candidate.

        Calls whose difference is unknown, because the place is, do not count as arriving together.
        """
        candidates, sight = places
        n_echoes = len(self._echoes.receiver)
        _, group = np.unique(which * n_echoes + echo, return_inverse=True)
        shares = np.zeros((int(group.max(initial=-1)) + 1, len(self._viewers.sensor_m)))
        shares[group, emitter] = self._echoes.share[echo, emitter]
        slope_m = np.einsum("psi,pi->ps", sight.toward, candidates.across)
        late_m = sum(
            np.abs(each[which] - np.take_along_axis(each[which], emitter[:, None], axis=1))
            for each in (sight.apart_m, slope_m)
        )
        return np.asarray(np.minimum(np.sum(shares[group] * (late_m < _TOGETHER_M), axis=1), 1.0))

    def _surprise(self, candidates: _Candidates) -> Floats:
        """Return how much stronger candidates reflect than usual: (candidate,).

        Where an image is missing, the echoes of its sensor's call fit the calls of its neighbours as well. But these
        would reach the place beside their beams, so that its reflector must be stronger.
        """
        if not self._is_incomplete or not len(candidates.echo):
            return np.zeros(len(candidates.echo))
        least = np.full(len(self._echoes.receiver), np.inf)
        np.minimum.at(least, candidates.echo, candidates.reflectivity)
        usual = float(np.median(least[np.isfinite(least)]))
        excess_db = 10 * np.log10(np.maximum(candidates.reflectivity / max(usual, _TINY), 1.0))
        return np.asarray(np.maximum(0.0, excess_db - _USUAL_DB) / _SURPRISE_DB)

    def _accepted(self, here: _Candidates, sight: kernels.SeenPlaces) -> tuple[LocatedReflector | None, Numbers]:
        """Return the reflector at a candidate if enough echoes confirm it, and all echoes that it explains."""
        extra_m, covariance_m2, echo, reflectivity = 0.0, np.empty((3, 3)), np.empty(0, np.int64), 0.0
        for _ in range(2):
            fits = _, echo, emitters, distance = self._fits(here, sight, extra_m)
            members, emitter = self._members(echo, emitters, distance)
            if len(members) < _N_CONFIRMING and not (len(members) == _N_LIKELY and self._is_likely(here, sight, fits)):
                return None, np.empty(0, np.int64)
            place_m, covariance_m2 = self._locator.located(members, emitter, here.place_m[0])
            sight = self._viewers.sight(place_m[None])
            gain = sight.gain[0, self._echoes.receiver[members], emitter]
            reflectivity = median_of(self._echoes.power[members] / np.maximum(gain, _TINY))
            here = here._replace(place_m=place_m[None], across=np.zeros((1, 3)), reflectivity=np.array([reflectivity]))
            extra_m = _REFINED_M
        deviation = self._echoes.deviation[members]
        located = LocatedReflector(place_m, covariance_m2, reflectivity, members, emitter, deviation)
        return located, np.unique(echo)

    def _is_likely(
        self, here: _Candidates, sight: kernels.SeenPlaces, fits: tuple[Numbers, Numbers, Numbers, Floats]
    ) -> bool:
        """Return True if the attribution of the images supports an own echo of a candidate."""
        which, echo, emitter, _ = fits
        is_own = self._echoes.receiver[echo] == emitter
        return bool(np.any(is_own & (self._support((here, sight), which, echo, emitter) > _MIN_SHARE)))

    def _members(self, echo: Numbers, emitter: Numbers, distance: Floats) -> tuple[Numbers, Numbers]:
        """Return the best echo of each pair, and its emitter; each echo at most once."""
        taken: set[int | tuple[int, int]] = set()
        found = []
        for entry in np.argsort(distance, kind="stable").tolist():
            one = int(echo[entry])
            pair = int(emitter[entry]), int(self._echoes.receiver[one])
            if one not in taken and pair not in taken:
                taken |= {one, pair}
                found.append(entry)
        return echo[found], emitter[found]

    def _add_lone(self, candidates: _Candidates) -> None:
        """Add reflectors that a single own echo shows, unless the attribution explains it otherwise."""
        receiver, path_m, share = self._echoes.receiver, self._echoes.path_m, self._echoes.share
        own = share[np.arange(len(receiver)), receiver]
        kept = self.is_free & (share.sum(axis=1) > _MIN_SHARE) & (own >= share.max(axis=1)) & (own > 0)
        kept &= self._echoes.is_clear & ~self._is_ambiguous(candidates)
        if self.found:
            kept[kept] = self._locator.overlap(self.found, np.flatnonzero(kept)).power.sum(axis=1) < _DISTURBED
        n_found = len(self.found)
        for echo in np.flatnonzero(kept)[np.argsort(-self._echoes.power[kept], kind="stable")]:
            sensor, member = receiver[echo : echo + 1], np.array([echo])
            to_m = path_m[echo, sensor[0]] / 2
            place_m = self._viewers.sensor_m[sensor[0]] + to_m * self._echoes.direction[echo]
            _, covariance_m2 = self._locator.located(member, sensor, place_m)
            if _is_apart(place_m, covariance_m2, self.found):
                deviation = self._echoes.deviation[member]
                lone = LocatedReflector(place_m, covariance_m2, 0.0, member, sensor, deviation)
                self.found += self._locator.measured([lone])
        if len(self.found) > n_found:
            self.found = self._locator.refined(self.found)

    def _is_ambiguous(self, candidates: _Candidates) -> NDArray[np.bool_]:
        """Return True for echoes (echo,) that another call explains as well, if an image is missing.

        Several sensors that could contradict the call of one without an image may fail to. Other calls must explain a
        second echo.
        """
        found = np.zeros(len(self._echoes.receiver), np.bool_)
        if self._is_incomplete:
            is_own = (candidates.emitter == self._echoes.receiver[candidates.echo]) & candidates.is_ahead
            own = np.zeros(len(found))
            own[candidates.echo[is_own]] = candidates.reflectivity[is_own]
            is_other = ~is_own & (candidates.reflectivity < _ALIKE * own[candidates.echo])
            is_alone = np.count_nonzero(self._echoes.has_image) == 1
            is_other &= (self._n_fitting > 1) | ~(is_alone | self._echoes.has_image[candidates.emitter])
            found[candidates.echo[is_other]] = True
        return found


def _is_apart(place_m: Floats, covariance_m2: Floats, found: list[LocatedReflector]) -> bool:
    """Return True if no reflector is near a place; an echo there would be a shoulder of a main lobe, or an overlap."""
    if not found:
        return True
    offset_m = place_m - np.array([each.place_m for each in found])
    spread_m2 = np.array([each.covariance_m2 for each in found]) + covariance_m2 + _SAME_M**2 * np.eye(3)
    distance = np.einsum("ri,ri->r", offset_m, np.linalg.solve(spread_m2, offset_m[..., None])[..., 0])
    return bool(distance.min() >= _GATE)
