"""Contracts of the kernels of fusion: powers of images to reflectivities of cells, for one thread.

Pixels are (direction, step) of one receiver, flattened; cells are those of the fused image. Entries are the cells or
pixels of one pair of emitter and receiver. ``cell`` of `AddEchoes`, `LimitCells` and `ConfirmCells` holds no cell
twice. Other indices may repeat.
"""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from ertis_numba.kernels._contract.arrays import Real, Turns
from ertis_numba.kernels._contract.reflectors import (
    Doubles,
    FindArrivals,
    FindMaxima,
    LocateReflector,
    MatchEchoes,
    OverlapEchoes,
    SeePlaces,
    Truths,
)

__all__ = ["NEGLIGIBLE", "FusionKernels"]

NEGLIGIBLE: Final = 1e-20
"""Values of lobes that are left out. Products with them may be denormal, which takes a hundred times as long."""


class CoarsenImage(Protocol):
    """Reduce an image to the highest power of each coarse step, and separate noise and side lobes.

    ``first`` (step + 1,) are the first ranges, equal for a step without ranges; ``is_deaf`` (step,) steps have the
    power 0. ``close`` (direction, neighbour) lie within the error of a direction. ``side_lobes`` are relative to the
    strongest direction of a step and of both adjacent steps, because a pulse covers several steps. Outputs: ``floor``
    (step,), the power that noise and side lobes may reach, at least ``least``; ``highest`` (direction, step), the power
    of close directions at a step and beside it; ``out`` (direction, step), the power above the floor, 0 below it.
    """

    def __call__(
        self,
        amplitude: Real,
        first: Turns,
        is_deaf: Truths,
        close: Turns,
        side_lobes: np.float32,
        least: np.float32,
        floor: Real,
        highest: Real,
        out: Real,
    ) -> None: ...


class SpreadCells(Protocol):
    """Compute the highest value of each cell and its neighbours: one range and ``reach`` cyclic azimuths each side."""

    def __call__(self, values: Real, reach: int, out: Real) -> None: ...


class PredictEchoes(Protocol):
    """Predict the power of the echoes of reflectors, within a main lobe around each direction: (direction, step).

    Entries from ``bounds[direction]`` on, for half-steps from ``begin[direction]`` on, state the ``cell`` that causes
    an echo and its ``gain``. A step has three: its start, its middle and its end, the start of the next one. The
    highest counts. ``lobe`` (direction, neighbour) are the directions in the main lobe.
    """

    def __call__(
        self, begin: Turns, bounds: Turns, cell: Turns, gain: Real, reflectivity: Real, lobe: Turns, out: Real
    ) -> None: ...


class ShareEchoes(Protocol):
    """Compute the shares (share, pixel) of each pixel's power that belong to the hypotheses ``wanted`` (share,).

    ``predicted`` (hypothesis, pixel) are the powers that all hypotheses predict. With the rivals' predicted power R,
    the share is ``1 − suppression · R / power``, limited to 0 to 1. With the predicted own power P, a pixel whose
    reflector other pairs confirm has a share ``own`` of at least ``(P / (P + R))³``. Shares are multiplied by ``part``
    (share, pixel). ``same_pixel`` and ``same_hypothesis`` (entry,), from ``bounds[share]`` on, lead to one place and
    are no rivals. ``confirmed`` is empty if unknown; ``least_confirmed`` is relative to a pixel.
    """

    def __call__(
        self,
        predicted: Real,
        wanted: Turns,
        bounds: Turns,
        same_pixel: Turns,
        same_hypothesis: Turns,
        power: Real,
        part: Real,
        confirmed: Real,
        own: int,
        suppression: np.float32,
        least_confirmed: np.float32,
        out: Real,
    ) -> None: ...


class GatherEvidence(Protocol):
    """Gather the floor, the highest power and the weight of the echoes of a pair: (3, entry).

    ``first`` and ``second`` are pixels of two neighbouring directions, ``between`` the weight of the second one. The
    weight of an echo is ``weight · (gain / floor)²``.
    """

    def __call__(
        self,
        first: Turns,
        second: Turns,
        between: Real,
        step: Turns,
        gain: Real,
        weight: Real,
        highest: Real,
        floor: Real,
        out: Real,
    ) -> None: ...


class AddEchoes(Protocol):
    """Add the weighted reflectivities that a pair shows, and the weights, to ``out`` (2, cell).

    Pixels are those of `GatherEvidence`; ``lifted`` (entry,) is the gain of an echo. ``share`` (pixel,) of the power
    belongs to the pair, all if it is empty; with ``is_foreign``, shares are also factors of the weights.
    """

    def __call__(
        self,
        cell: Turns,
        first: Turns,
        second: Turns,
        between: Real,
        weight: Real,
        lifted: Real,
        power: Real,
        share: Real,
        is_foreign: bool,  # noqa: FBT001  kernels take no keywords
        out: Real,
    ) -> None: ...


class AddLobes(Protocol):
    """Add the products of lobes (echo, direction), 0 up to `NEGLIGIBLE`, and pulses (echo, step) to (direction, step).

    Matrix products of BLAS take several times as long, because lobes are narrow, and some use all cores.
    """

    def __call__(self, lobe: Real, pulse: Real, out: Real) -> None: ...


class LimitCells(Protocol):
    """Limit cells to the reflectivity that a pair shows in the result of `GatherEvidence`, times ``margin``."""

    def __call__(
        self, cell: Turns, is_used: Truths, gain: Real, evidence: Real, margin: np.float32, out: Real
    ) -> None: ...


class ConfirmCells(Protocol):
    """Limit cells (row, cell) to the reflectivity that a pair confirms, where its echo must be visible.

    ``reflectivity`` is the expected one, ``visible`` the power of a visible echo relative to the floor, and ``skipped``
    the row that the pair does not limit, −1 for none.
    """

    def __call__(
        self,
        cell: Turns,
        is_used: Truths,
        gain: Real,
        evidence: Real,
        reflectivity: Real,
        visible: np.float32,
        skipped: int,
        out: Real,
    ) -> None: ...


class CompareEchoes(Protocol):
    """Add the shown and the expected reflectivity (2,) of cells above ``strong`` with echoes as in `ConfirmCells`."""

    def __call__(
        self,
        cell: Turns,
        is_used: Truths,
        gain: Real,
        evidence: Real,
        reflectivity: Real,
        visible: np.float32,
        strong: np.float32,
        out: Doubles,
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionKernels:
    """Kernels of fusion of one device, all for one thread."""

    coarsen_image: CoarsenImage
    spread_cells: SpreadCells
    predict_echoes: PredictEchoes
    share_echoes: ShareEchoes
    gather_evidence: GatherEvidence
    add_echoes: AddEchoes
    add_lobes: AddLobes
    limit_cells: LimitCells
    confirm_cells: ConfirmCells
    compare_echoes: CompareEchoes
    locate_reflector: LocateReflector
    match_echoes: MatchEchoes
    find_maxima: FindMaxima
    find_arrivals: FindArrivals
    see_places: SeePlaces
    overlap_echoes: OverlapEchoes
