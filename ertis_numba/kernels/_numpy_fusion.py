"""Kernels of fusion in plain NumPy, as a reference for the compiled ones, and where none can be compiled.

They compute in the type of ``out``, so that float64 arrays give an exact reference.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._contract.arrays import Real, Turns
from ertis_numba.kernels._contract.fusion import NEGLIGIBLE, FusionKernels
from ertis_numba.kernels._contract.reflectors import Doubles, Truths
from ertis_numba.kernels._numpy_reflectors import (
    find_arrivals,
    find_maxima,
    locate_reflector,
    match_echoes,
    overlap_echoes,
    see_places,
)

__all__ = ["KERNELS"]

_TINY = np.float32(1e-30)


def coarsen_image(
    amplitude: Real,
    first: Turns,
    is_deaf: Truths,
    close: Turns,
    side_lobes: np.float32,
    least: np.float32,
    floor: Real,
    highest: Real,
    out: Real,
) -> None:
    """Reduce an image to the highest power of each coarse step, and separate noise and side lobes."""
    power = np.zeros_like(out)
    filled = np.flatnonzero(np.diff(first.astype(np.int64)) > 0)
    power[:, filled] = np.maximum.reduceat(amplitude, first[filled].astype(np.int64), axis=1).astype(out.dtype) ** 2
    power[:, is_deaf] = 0
    top = power.max(axis=0)
    around = np.maximum(top, np.maximum(np.append(0, top[:-1]), np.append(top[1:], 0)))
    floor[:] = np.maximum(side_lobes * around, least)
    np.maximum(power - floor, 0, out=out)
    wide = power.copy()
    np.maximum(wide[:, 1:], power[:, :-1], out=wide[:, 1:])
    np.maximum(wide[:, :-1], power[:, 1:], out=wide[:, :-1])
    _highest(wide, close, highest)


def spread_cells(values: Real, reach: int, out: Real) -> None:
    """Return the highest value of each cell and its neighbours."""
    found = np.max([np.roll(values, shift, axis=1) for shift in range(-reach, reach + 1)], axis=0)
    out[:] = found
    np.maximum(out[..., 1:], found[..., :-1], out=out[..., 1:])
    np.maximum(out[..., :-1], found[..., 1:], out=out[..., :-1])


def predict_echoes(
    begin: Turns, bounds: Turns, cell: Turns, gain: Real, reflectivity: Real, lobe: Turns, out: Real
) -> None:
    """Predict the power of the echoes of reflectors, within a main lobe around each direction."""
    halves = np.zeros((len(out), 2 * out.shape[1] + 1), out.dtype)
    direction = np.repeat(np.arange(len(out)), np.diff(bounds))
    halves[direction, begin[direction] + np.arange(len(cell)) - bounds[direction]] = gain * reflectivity[cell]
    _highest(np.max([halves[:, :-1:2], halves[:, 1::2], halves[:, 2::2]], axis=0), lobe, out)


def share_echoes(
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
) -> None:
    """Compute the shares of each pixel's power that belong to hypotheses."""
    total = predicted.sum(axis=0)
    for number, (alone, share) in enumerate(zip(predicted[wanted], out, strict=True)):
        entries, rivals = slice(bounds[number], bounds[number + 1]), total - alone
        pixel = same_pixel[entries]
        np.subtract.at(rivals, pixel, predicted[same_hypothesis[entries], pixel])
        np.maximum(rivals, 0, out=rivals)  # Differences of rounding may be negative.
        share[:] = (1 - suppression * rivals / (power + _TINY)).clip(0, 1)
        if number == own and len(confirmed):
            is_confirmed = confirmed > least_confirmed * (power + _TINY)
            np.maximum(share, is_confirmed * (alone / (alone + rivals + _TINY)) ** 3, out=share)
        np.multiply(share, part[number], out=share)


def gather_evidence(
    first: Turns,
    second: Turns,
    between: Real,
    step: Turns,
    gain: Real,
    weight: Real,
    highest: Real,
    floor: Real,
    out: Real,
) -> None:
    """Gather the floor, the highest power and the weight of the echoes of a pair."""
    out[0] = floor[step]
    out[1] = _between(highest, first, second, between)
    out[2] = weight * (gain / out[0]) ** 2


def add_echoes(
    cell: Turns,
    first: Turns,
    second: Turns,
    between: Real,
    weight: Real,
    lifted: Real,
    power: Real,
    share: Real,
    is_foreign: bool,  # noqa: FBT001  as in the contract
    out: Real,
) -> None:
    """Add the weighted reflectivities that a pair shows, and the weights."""
    if len(share):
        power = power * share
        if is_foreign:
            weight = weight * _between(share, first, second, between)
    out[0, cell] += weight * _between(power, first, second, between) / lifted
    out[1, cell] += weight


def add_lobes(lobe: Real, pulse: Real, out: Real) -> None:
    """Add the products of the lobes and the pulses of echoes."""
    out += np.einsum("ed,es->ds", np.where(lobe > NEGLIGIBLE, lobe, 0).astype(out.dtype), pulse.astype(out.dtype))


def limit_cells(cell: Turns, is_used: Truths, gain: Real, evidence: Real, margin: np.float32, out: Real) -> None:
    """Limit cells to the reflectivity that a pair shows."""
    shown = (margin * (evidence[1] + evidence[0]) / gain)[is_used]
    out[cell[is_used]] = np.minimum(out[cell[is_used]], shown)


def confirm_cells(
    cell: Turns,
    is_used: Truths,
    gain: Real,
    evidence: Real,
    reflectivity: Real,
    visible: np.float32,
    skipped: int,
    out: Real,
) -> None:
    """Limit cells to the reflectivity that a pair confirms, where its echo must be visible."""
    sees = is_used & (gain * reflectivity[cell] > visible * evidence[0])
    for row in range(len(out)):
        if row != skipped:
            out[row, cell[sees]] = np.minimum(out[row, cell[sees]], evidence[1, sees] / gain[sees])


def compare_echoes(
    cell: Turns,
    is_used: Truths,
    gain: Real,
    evidence: Real,
    reflectivity: Real,
    visible: np.float32,
    strong: np.float32,
    out: Doubles,
) -> None:
    """Add the reflectivity that a pair shows, and the expected one, over the cells with visible echoes."""
    expected = reflectivity[cell]
    sees = is_used & (expected > strong) & (gain * expected > visible * evidence[0])
    out[0] += np.minimum(evidence[1, sees] / gain[sees], expected[sees]).sum(dtype=np.float64)
    out[1] += expected[sees].sum(dtype=np.float64)


def _highest(values: NDArray[Any], near: Turns, out: NDArray[Any]) -> None:
    out[:] = values[near[:, 0]]
    for column in near.T[1:]:
        np.maximum(out, values[column], out=out)


def _between(values: NDArray[Any], first: Turns, second: Turns, between: Real) -> NDArray[Any]:
    """Return values between two pixels: (entry,)."""
    low = values[first]
    return np.asarray(low + between * (values[second] - low))


KERNELS = FusionKernels(
    coarsen_image=coarsen_image,
    spread_cells=spread_cells,
    predict_echoes=predict_echoes,
    share_echoes=share_echoes,
    gather_evidence=gather_evidence,
    add_echoes=add_echoes,
    add_lobes=add_lobes,
    limit_cells=limit_cells,
    confirm_cells=confirm_cells,
    compare_echoes=compare_echoes,
    locate_reflector=locate_reflector,
    match_echoes=match_echoes,
    find_maxima=find_maxima,
    find_arrivals=find_arrivals,
    see_places=see_places,
    overlap_echoes=overlap_echoes,
)
