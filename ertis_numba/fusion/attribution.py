"""Attribution of echoes to the emitters whose calls they are."""

from collections.abc import Mapping, Sequence
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.pairs import Hypothesis, Pair, floor_at
from ertis_numba.fusion.polar_grid import Places, PolarGrid
from ertis_numba.fusion.receivers import CoarseImage, Receiver

__all__ = ["Attribution", "Shares", "mean_reflectivity"]

Singles = NDArray[np.float32]
Shares: TypeAlias = Mapping[tuple[int, int], Singles]
"""Share of each pixel that belongs to a pair of emitter and receiver: (pixel,) float32, 0 to 1."""

# Power of other explanations relative to a pixel, at which the pixel is attributed to them. It begins with certain
# ones, because reflectors of wrong attribution predict echoes as well.
_SUPPRESSION: Final = (1.0, 2.0, 4.0)
_CONFIRMED: Final = 0.25  # Reflectivity in the images of other pairs, relative to that of the pixel.
_VISIBLE: Final = 2.0  # Power of an expected echo relative to noise and side lobes.
_BOUND: Final = 2.0  # Reflectivity relative to the least that any pair shows.
_REACH: Final = 2  # Neighbouring azimuths whose reflectors cause echoes in the same pixel.
_TINY: Final = np.float32(1e-30)


class Attribution:
    """Separator of own and foreign echoes by consistency over all pairs.

    A reflector causes an echo in each pair of emitter and receiver that can see it. A pixel whose power is predicted by
    reflectors that other pixels show is attributed to them, unless an own reflector is confirmed by another pair. This
    is a successive interference cancellation on power images, because phases of far apart sensors are not known.

    Parameters
    ----------
    grid : PolarGrid
    pairs : sequence of Pair
    hypotheses : mapping of int to sequence of Hypothesis
        Hypotheses of each receiver.
    receivers : mapping of int to Receiver
    """

    def __init__(
        self,
        grid: PolarGrid,
        pairs: Sequence[Pair],
        hypotheses: Mapping[int, Sequence[Hypothesis]],
        receivers: Mapping[int, Receiver],
    ) -> None:
        self._grid, self._pairs, self._hypotheses, self._receivers = grid, pairs, hypotheses, receivers
        self._own = [pair for pair in pairs if pair.emitter == pair.receiver]

    def __call__(self, images: Mapping[int, CoarseImage]) -> tuple[Shares, Singles]:
        """Return the share of each pair in the pixels, and an upper bound of the reflectivity of each cell.

        Parameters
        ----------
        images : mapping of int to CoarseImage
            Image of each receiver.
        """
        bound = self._bound(images)
        alone = mean_reflectivity(self._own, images, None, self._grid.n_cells)
        confirmed = {number: self._confirmed(images, alone, number) for number in images}
        reflectivity = np.minimum(alone, bound)
        shares: dict[tuple[int, int], Singles] = {}
        for suppression in _SUPPRESSION:
            around = self._around(reflectivity)
            for number, image in images.items():
                shares |= self._shares(number, image, around, confirmed[number], suppression)
            reflectivity = np.minimum(mean_reflectivity(self._own, images, shares, self._grid.n_cells), bound)
        return shares, bound

    def _bound(self, images: Mapping[int, CoarseImage]) -> Singles:
        """Return the least reflectivity that any pair shows, with a margin: (cell,) float32."""
        bound = np.full(self._grid.n_cells, np.inf, dtype=np.float32)
        for pair in self._pairs:
            if pair.receiver not in images:
                continue
            image = images[pair.receiver]
            shown = _BOUND * (pair.values(image.highest) + floor_at(pair, image)) / pair.gain
            cell = pair.cell[pair.bounds]
            bound[cell] = np.minimum(bound[cell], shown[pair.bounds])
        return bound

    def _confirmed(self, images: Mapping[int, CoarseImage], alone: Singles, number: int) -> Singles:
        """Return the reflectivity that all other pairs confirm: (cell,) float32, 0 where none can see the cell."""
        least = np.full(self._grid.n_cells, np.inf, dtype=np.float32)
        for pair in self._pairs:
            if pair.receiver not in images or pair.emitter == pair.receiver == number:
                continue
            image = images[pair.receiver]
            expected = pair.gain * alone.take(pair.cell)
            sees = pair.confirms & (expected > _VISIBLE * floor_at(pair, image))
            cell = pair.cell[sees]
            least[cell] = np.minimum(least[cell], (pair.values(image.highest) / pair.gain)[sees])
        return np.where(np.isfinite(least), least, np.float32(0))

    def _around(self, reflectivity: Singles) -> Singles:
        """Return the highest reflectivity of each cell and its neighbours: (cell,) float32."""
        cells = reflectivity.reshape(-1, self._grid.n_azimuths, self._grid.n_ranges)
        found = cells.copy()
        for shift in range(1, (_REACH if self._grid.is_planar else 1) + 1):
            np.maximum(found, np.roll(cells, shift, axis=1), out=found)
            np.maximum(found, np.roll(cells, -shift, axis=1), out=found)
        wide = found.copy()
        np.maximum(wide[..., 1:], found[..., :-1], out=wide[..., 1:])
        np.maximum(wide[..., :-1], found[..., 1:], out=wide[..., :-1])
        return wide.reshape(-1)

    def _shares(
        self, number: int, image: CoarseImage, around: Singles, confirmed: Singles, suppression: float
    ) -> dict[tuple[int, int], Singles]:
        receiver, shape = self._receivers[number], image.power.shape
        predicted = [
            receiver.over_lobe(each.predicted(around).reshape(shape)).reshape(-1) for each in self._hypotheses[number]
        ]
        total = np.sum(predicted, axis=0, dtype=np.float32) + _TINY
        power = image.power.reshape(-1) + _TINY
        found = {}
        for each, alone in zip(self._hypotheses[number], predicted, strict=True):
            if each.is_mirrored:
                continue
            share = (1 - np.float32(suppression) * (total - alone) / power).clip(0, 1)
            if each.emitter == number:
                own = self._own_gain(number, each.cell)
                is_confirmed = _at(confirmed, each.cell) * own > _CONFIRMED * power
                share = np.maximum(share, is_confirmed * (alone / total) ** 3)
            found[each.emitter, number] = share
        return found

    def _own_gain(self, number: int, cell: Places) -> Singles:
        """Return the gain of the receiver's own call for a reflector in each pixel: (pixel,) float32."""
        pair = next(each for each in self._own if each.receiver == number)
        gain = np.zeros(self._grid.n_cells, dtype=np.float32)
        gain[pair.cell] = pair.gain
        return _at(gain, cell)


def mean_reflectivity(
    pairs: Sequence[Pair], images: Mapping[int, CoarseImage], shares: Shares | None, n_cells: int
) -> Singles:
    """Return the mean over pairs of the reflectivity of each cell, as power at 1 m: (cell,) float32.

    Weights are the squares of gain relative to noise and side lobes, which is the least variance. They fade towards
    the limits of what a pair can see, so that images have no seams.

    Parameters
    ----------
    pairs : sequence of Pair
    images : mapping of int to CoarseImage
        Image of each receiver.
    shares : Shares or None
        Shares of the pixels, for pairs of different sensors also as weights; all if None.
    n_cells : int
    """
    total = np.zeros(n_cells, dtype=np.float64)
    weights = np.zeros(n_cells, dtype=np.float64)
    for pair in pairs:
        if pair.receiver not in images:
            continue
        image = images[pair.receiver]
        power = image.power.reshape(-1)
        weight = pair.weight * (pair.lifted.astype(np.float64) / floor_at(pair, image)) ** 2
        if shares is not None:
            share = shares[pair.emitter, pair.receiver]
            power = power * share
            if pair.emitter != pair.receiver:
                weight = weight * pair.values(share)
        total[pair.cell] += weight * pair.values(power) / pair.lifted
        weights[pair.cell] += weight
    return np.divide(total, weights, out=np.zeros_like(total), where=weights > 0).astype(np.float32)


def _at(values: Singles, cell: Places) -> Singles:
    """Return the values of cells: (pixel,) float32, 0 outside of the grid."""
    return np.where(cell >= 0, values.take(cell.clip(0)), np.float32(0))
