"""Attribution of echoes to the emitters whose calls they are."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.pairs import Hypothesis, Pair
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import CoarseImage, Receiver

__all__ = ["Attributed", "Attribution", "Rivalries", "Shares"]

Singles = NDArray[np.float32]
Places = NDArray[np.uint32]
Shares: TypeAlias = Mapping[tuple[int, int], Singles]
"""Share of each pixel that belongs to a pair of emitter and receiver: (pixel,) float32, 0 to 1.

It counts reflectors in front of the receiver, and is 0 for an emitter whose echoes come only from behind.
"""

# Power of other explanations relative to a pixel, at which the pixel is attributed to them. It begins with certain
# ones, because reflectors of wrong attribution predict echoes as well.
_SUPPRESSION: Final = (1.0, 2.0, 4.0)
_CONFIRMED: Final = 0.25  # Reflectivity in the images of other pairs, relative to that of the pixel.
_VISIBLE: Final = 2.0  # Power of an expected echo relative to noise and side lobes.
_BOUND: Final = 2.0  # Reflectivity relative to the least that any pair shows.
# Power of foreign echoes relative to the expected one, below which no foreign call is heard. The first number applies
# if a single sensor expects echoes, which may be those of a ghost; the second, if several do.
_HEARD: Final = 0.1, 0.2
_STRONG: Final = 0.1  # Reflectivity relative to the highest, from which missing echoes matter.
_REACH: Final = 2  # Neighbouring azimuths whose reflectors cause echoes in the same pixel.
_SAME_STEPS: Final = 2.0  # Distance, in steps, within which the reflectors of two hypotheses are one.
_TINY: Final = np.float32(1e-30)
_NONE: Final = np.empty(0, dtype=np.float32)


class Attributed(NamedTuple):
    """Result of an attribution: ``reflectivity`` (cell,) as power at 1 m, and its ``bound``, infinite if unseen.

    ``suspects`` are emitters whose calls no other sensor seems to hear, although it should; ghosts may pretend this.
    ``unheard`` are those of which no echoes were expected at other sensors.
    """

    reflectivity: Singles
    shares: Shares
    suspects: frozenset[int]
    bound: Singles
    unheard: frozenset[int]
    evidence: "Sequence[_Evidence]"


class _Evidence(NamedTuple):
    """Echoes of a pair: power that noise and side lobes may reach, highest power near a cell, weight: (3, entry)."""

    pair: Pair
    values: Singles


class _Rivalry(NamedTuple):
    """Rivals of those hypotheses of a receiver, ``wanted``, that are not mirrored, as in `kernels.ShareEchoes`.

    Where several of them lead to the same place, they are no rivals: its reflector causes all of their echoes. ``part``
    is the power of the echo relative to that of all of these.
    """

    wanted: Places
    bounds: Places
    same_pixel: Places
    same_hypothesis: Places
    part: Singles


Rivalries: TypeAlias = dict[tuple[int, tuple[tuple[int, bool], ...]], _Rivalry]
"""Rivalries by receiver, and by emitter and side of each hypothesis."""


class Attribution:
    """Separator of own and foreign echoes by consistency over all pairs.

    A reflector causes an echo in each pair of emitter and receiver that can see it. A pixel whose power is predicted by
    reflectors that other pixels show is attributed to them, unless an own reflector is confirmed by another pair. This
    is a successive interference cancellation on power images, because phases of far apart sensors are not known.
    Only ``unheard`` emitters themselves receive their calls, so that missing echoes show nothing. ``rivalries``
    of attributions with the same receivers are shared.
    """

    def __init__(
        self,
        grid: PolarGrid,
        pairs: Sequence[Pair],
        hypotheses: Mapping[int, Sequence[Hypothesis]],
        receivers: Mapping[int, Receiver],
        unheard: frozenset[int] = frozenset(),
        rivalries: Rivalries | None = None,
    ) -> None:
        self._grid, self._receivers, self._unheard = grid, receivers, unheard
        self._kernels = kernels.load_fusion()
        self._pairs = [pair for pair in pairs if pair.emitter == pair.receiver or pair.emitter not in unheard]
        self._hypotheses = {
            number: [each for each in several if each.emitter == number or each.emitter not in unheard]
            for number, several in hypotheses.items()
        }
        self._reduced: dict[frozenset[int], Attribution] = {}
        self._known = {} if rivalries is None else rivalries
        self._rivalries = {number: self._rivalry_of(number, each) for number, each in self._hypotheses.items()}
        self._own = {pair.receiver: self._own_of(pair) for pair in self._pairs if pair.emitter == pair.receiver}

    def __call__(self, images: Mapping[int, CoarseImage]) -> Attributed:
        """Return the reflectivity of each cell, and the share of each pair in the pixels."""
        evidence = [self._evidence(pair, images[pair.receiver]) for pair in self._pairs]
        own = [each for each in evidence if each.pair.emitter == each.pair.receiver]
        alone = self._mean(own, images, None)
        bound = self._bound(evidence)
        confirmed = self._confirmed(evidence, alone)
        reflectivity, suspects = alone, frozenset[int]()
        shares: Shares = {}
        for suppression in _SUPPRESSION:
            if suppression == _SUPPRESSION[-1]:
                unheard = self._not_heard(evidence, reflectivity)
                if unheard:
                    # Remaining ghosts cause no foreign echoes either, so they must not decide alone.
                    shares = self._all_shares(images, reflectivity, confirmed, suppression)
                    unheard &= self._not_heard(evidence, self._mean(own, images, shares))
                suspects = unheard
                reflectivity = np.minimum(reflectivity, bound)
            shares = self._all_shares(images, reflectivity, confirmed, suppression)
            if suppression < _SUPPRESSION[-1]:
                reflectivity = self._mean(own, images, shares)
        _limit_sums(shares)
        reflectivity = np.minimum(self._mean(evidence, images, shares), bound)
        return Attributed(reflectivity, shares, suspects, bound, self._unheard, evidence)

    def informed(self, images: Mapping[int, CoarseImage], found: Attributed, shares: Shares) -> Singles:
        """Return the reflectivity (cell,) by other shares of the pixels than those found."""
        return np.asarray(np.minimum(self._mean(found.evidence, images, shares), found.bound))

    def without(self, unheard: frozenset[int]) -> "Attribution":
        """Return an attribution that expects no echoes of some emitters at other sensors."""
        if unheard == self._unheard:
            return self
        if unheard not in self._reduced:
            self._reduced[unheard] = Attribution(
                self._grid, self._pairs, self._hypotheses, self._receivers, unheard, self._known
            )
        return self._reduced[unheard]

    def _rivalry_of(self, number: int, hypotheses: Sequence[Hypothesis]) -> _Rivalry:
        """Return the rivalry of a receiver's hypotheses, which takes long to compute."""
        key = number, tuple((each.emitter, each.is_mirrored) for each in hypotheses)
        if key not in self._known:
            self._known[key] = _rivalry(hypotheses, _SAME_STEPS * self._grid.step_m)
        return self._known[key]

    def _not_heard(self, evidence: Sequence[_Evidence], reflectivity: Singles) -> frozenset[int]:
        """Return emitters whose calls other sensors do not hear, where the reflectors of all images lead to expect it.

        An emitter may be broken, covered, or not on the same SYNC chain. If the image of an emitter's own sensor
        is missing, other sensors may take the echoes of its calls for those of their own. No emitter is then named.
        """
        own = {each.pair.emitter for each in evidence if each.pair.emitter == each.pair.receiver}
        if any(each.pair.emitter not in own for each in evidence):
            return frozenset()
        shown: dict[int, list[NDArray[np.float64]]] = {}
        strong = np.float32(_STRONG) * reflectivity.max()
        for each in evidence:
            pair = each.pair
            if pair.emitter == pair.receiver:
                continue
            sums = np.zeros(2)
            self._kernels.compare_echoes(
                pair.cell, pair.confirms, pair.gain, each.values, reflectivity, np.float32(2 * _VISIBLE), strong, sums
            )
            if sums[1]:
                shown.setdefault(pair.emitter, []).append(sums)
        return frozenset(
            emitter
            for emitter, several in shown.items()
            if np.divide(*np.sum(several, axis=0)) < _HEARD[len(several) > 1]
        )

    def _bound(self, evidence: Sequence[_Evidence]) -> Singles:
        """Return the least reflectivity that any pair shows, with a margin: (cell,) float32."""
        bound = np.full(self._grid.n_cells, np.inf, dtype=np.float32)
        for each in evidence:
            pair = each.pair
            if pair.emitter in self._unheard:
                continue
            self._kernels.limit_cells(pair.cell, pair.bounds, pair.gain, each.values, np.float32(_BOUND), bound)
        return bound

    def _confirmed(self, evidence: Sequence[_Evidence], alone: Singles) -> dict[int, Singles]:
        """Return the power (pixel,) of own echoes, by sensor, that all other pairs confirm; 0 if none sees the cell."""
        numbers = [*self._own]
        least = np.full((len(numbers), self._grid.n_cells), np.inf, dtype=np.float32)
        for each in evidence:
            pair = each.pair
            if pair.emitter in self._unheard:
                continue
            own = numbers.index(pair.receiver) if pair.emitter == pair.receiver else -1
            self._kernels.confirm_cells(
                pair.cell, pair.confirms, pair.gain, each.values, alone, np.float32(_VISIBLE), own, least
            )
        least[~np.isfinite(least)] = 0
        return {number: row[cell] * gain for row, (number, (cell, gain)) in zip(least, self._own.items(), strict=True)}

    def _around(self, reflectivity: Singles) -> Singles:
        """Return the highest reflectivity of each cell and its neighbours: (cell,) float32."""
        cells = reflectivity.reshape(-1, self._grid.n_azimuths, self._grid.n_ranges)
        found = np.empty_like(cells)
        self._kernels.spread_cells(cells, _REACH if self._grid.is_planar else 1, found)
        return found.reshape(-1)

    def _all_shares(
        self,
        images: Mapping[int, CoarseImage],
        reflectivity: Singles,
        confirmed: Mapping[int, Singles],
        suppression: float,
    ) -> Shares:
        around = self._around(reflectivity)
        found: dict[tuple[int, int], Singles] = {}
        for number, image in images.items():
            found |= self._shares(number, image, around, confirmed.get(number), suppression)
        return found

    def _shares(
        self, number: int, image: CoarseImage, around: Singles, confirmed: Singles | None, suppression: float
    ) -> dict[tuple[int, int], Singles]:
        lobe, hypotheses = self._receivers[number].lobe, self._hypotheses[number]
        power, rivalry = image.power.reshape(-1), self._rivalries[number]
        emitters = [hypotheses[each].emitter for each in rivalry.wanted.tolist()]
        # Sound of an opposite emitter comes only from behind. Its echoes still confirm reflectors.
        behind = {each.emitter for each in hypotheses}.difference(emitters)
        found = {(emitter, number): np.zeros_like(power) for emitter in behind}
        if not emitters:
            return found
        predicted = np.empty((len(hypotheses), *image.power.shape), dtype=np.float32)
        for each, out in zip(hypotheses, predicted, strict=True):
            self._kernels.predict_echoes(each.begin, each.bounds, each.half_cell, each.half_gain, around, lobe, out)
        shares = np.empty((len(emitters), len(power)), dtype=np.float32)
        self._kernels.share_echoes(
            predicted.reshape(len(hypotheses), len(power)),
            *rivalry[:4],
            power,
            rivalry.part,
            _NONE if confirmed is None else confirmed,
            emitters.index(number) if number in emitters else -1,
            np.float32(suppression),
            np.float32(_CONFIRMED),
            shares,
        )
        return found | {(emitter, number): share for emitter, share in zip(emitters, shares, strict=True)}

    def _own_of(self, pair: Pair) -> tuple[Places, Singles]:
        """Return the cell of each pixel, and the gain of the receiver's own call there, 0 outside of the grid."""
        gain = np.zeros(self._grid.n_cells, dtype=np.float32)
        gain[pair.cell] = pair.gain
        own = next(
            each for each in self._hypotheses[pair.receiver] if each.emitter == pair.receiver and not each.is_mirrored
        )
        inside = own.cell.clip(0)
        return inside.astype(np.uint32), np.where(own.cell >= 0, gain.take(inside), np.float32(0))

    def _mean(self, evidence: Sequence[_Evidence], images: Mapping[int, CoarseImage], shares: Shares | None) -> Singles:
        """Return the mean reflectivity (cell,) over pairs; shares are also weights, as others' power shows nothing."""
        sums = np.zeros((2, self._grid.n_cells), dtype=np.float32)
        sums[1] = _TINY
        for each in evidence:
            pair = each.pair
            self._kernels.add_echoes(
                pair.cell,
                pair.first,
                pair.second,
                pair.share,
                each.values[2],
                pair.lifted,
                images[pair.receiver].power.reshape(-1),
                _NONE if shares is None else shares[pair.emitter, pair.receiver],
                pair.emitter != pair.receiver,
                sums,
            )
        return np.asarray(sums[0] / sums[1])

    def _evidence(self, pair: Pair, image: CoarseImage) -> _Evidence:
        """Return the evidence of a pair.

        Weights are the squares of gain relative to noise and side lobes, which is the least variance. They fade towards
        the limits of what a pair can see, so that images have no seams.
        """
        values = np.empty((3, len(pair.cell)), dtype=np.float32)
        self._kernels.gather_evidence(
            pair.first,
            pair.second,
            pair.share,
            pair.step,
            pair.gain,
            pair.weight,
            image.highest.reshape(-1),
            image.floor,
            values,
        )
        return _Evidence(pair, values)


def _limit_sums(shares: Shares) -> None:
    """Scale the shares of pixels whose power would count more than once.

    A share is what rivals leave of a pixel, so each emitter has a share of power that no reflector explains.
    """
    for number in {number for _, number in shares}:
        several = [share for (_, receiver), share in shares.items() if receiver == number]
        factor = several[0].copy()
        for share in several[1:]:
            factor += share
        np.maximum(factor, 1, out=factor)
        np.reciprocal(factor, out=factor)
        for share in several:
            np.multiply(share, factor, out=share)


def _rivalry(hypotheses: Sequence[Hypothesis], same_m: float) -> _Rivalry:
    wanted = np.flatnonzero([not each.is_mirrored for each in hypotheses])
    parts, bounds, pixels, others = [], [0], [wanted[:0]], [wanted[:0]]
    for each in (hypotheses[number] for number in wanted.tolist()):
        gain = each.gain.copy()
        for number, other in enumerate(hypotheses):
            offset_m = other.place_m - each.place_m
            pixel = np.flatnonzero(np.einsum("px,px->p", offset_m, offset_m) < same_m**2)
            if other is not each:
                gain[pixel] += other.gain[pixel]
                pixels.append(pixel)
                others.append(np.full(len(pixel), number))
        parts.append(np.divide(each.gain, gain, out=np.ones_like(gain), where=gain > 0))
        bounds.append(sum(map(len, pixels)))
    same = [np.concatenate(each).astype(np.uint32) for each in (pixels, others)]
    return _Rivalry(
        wanted.astype(np.uint32), np.array(bounds, np.uint32), same[0], same[1], np.array(parts, np.float32)
    )
