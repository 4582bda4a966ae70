# mypy: ignore-errors
"""Fusion of images: reflectivities of cells from powers of pixels, and back.

Much of the time is memory traffic, so each kernel reads its tables once, and temporary arrays hold one image at most.
One thread suffices, because a central node and its sensors use the other cores. Indices are unsigned: Numba then needs
no code for negative ones.
"""

import numpy as np
from numba import njit

from ertis_numba.kernels._contract.fusion import NEGLIGIBLE, FusionKernels
from ertis_numba.kernels._cpu.reflectors import (
    find_arrivals,
    find_maxima,
    locate_reflector,
    match_echoes,
    overlap_echoes,
    see_places,
)

__all__ = ["KERNELS"]

_ZERO, _ONE, _TINY = np.float32(0), np.float32(1), np.float32(1e-30)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def coarsen_image(amplitude, first, is_deaf, close, side_lobes, least, floor, highest, out):
    """Reduce an image to the highest power of each coarse step, and separate noise and side lobes."""
    n_directions, n_steps = out.shape
    power = np.zeros((n_directions, n_steps), np.float32)
    for s in range(n_steps):
        floor[s] = _ZERO
    for d in range(n_directions):
        for s in range(n_steps):
            if not is_deaf[s]:
                top = _ZERO
                for r in range(first[s], first[s + 1]):
                    top = max(top, amplitude[d, r])
                power[d, s] = top * top
                floor[s] = max(floor[s], power[d, s])
    before = _ZERO
    for s in range(n_steps):
        here = floor[s]
        around = max(before, here, floor[min(s + 1, n_steps - 1)])
        floor[s] = max(side_lobes * around, least)
        before = here
    wide = np.empty((n_directions, n_steps), np.float32)
    for d in range(n_directions):
        for s in range(n_steps):
            out[d, s] = max(power[d, s] - floor[s], _ZERO)
            wide[d, s] = max(power[d, s], power[d, max(s - 1, 0)], power[d, min(s + 1, n_steps - 1)])
    _highest(wide, close, highest)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def _highest(values, near, out):
    for d in range(out.shape[0]):
        first = near[d, 0]
        for s in range(out.shape[1]):
            out[d, s] = values[first, s]
        for place in range(1, near.shape[1]):
            other = near[d, place]
            for s in range(out.shape[1]):
                out[d, s] = max(out[d, s], values[other, s])


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def spread_cells(values, reach, out):
    """Return the highest value of each cell and its neighbours."""
    n_rows, n_azimuths, n_ranges = values.shape
    wide = np.empty(n_ranges, np.float32)
    for row in range(n_rows):
        for azimuth in range(n_azimuths):
            for r in range(n_ranges):
                wide[r] = values[row, azimuth, r]
            for shift in range(-reach, reach + 1):
                other = (azimuth + shift) % n_azimuths
                for r in range(n_ranges):
                    wide[r] = max(wide[r], values[row, other, r])
            for r in range(n_ranges):
                out[row, azimuth, r] = max(wide[r], wide[max(r - 1, 0)], wide[min(r + 1, n_ranges - 1)])


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def predict_echoes(begin, bounds, cell, gain, reflectivity, lobe, out):
    """Predict the power of the echoes of reflectors, within a main lobe around each direction."""
    n_directions, n_steps = out.shape
    raw = np.empty((n_directions, n_steps), np.float32)
    half = np.empty(2 * n_steps + 1, np.float32)
    for d in range(n_directions):
        for h in range(2 * n_steps + 1):
            half[h] = _ZERO
        first, last = bounds[d], bounds[d + 1]
        # LLVM vectorises loops over views, but not over sums of indices.
        run, run_cell, run_gain = half[begin[d] :], cell[first:last], gain[first:last]
        for entry in range(len(run_cell)):
            run[entry] = run_gain[entry] * reflectivity[run_cell[entry]]
        for s in range(n_steps):
            raw[d, s] = max(half[2 * s], half[2 * s + 1], half[2 * s + 2])
    _highest(raw, lobe, out)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def share_echoes(
    predicted,
    wanted,
    bounds,
    same_pixel,
    same_hypothesis,
    power,
    part,
    confirmed,
    own,
    suppression,
    least_confirmed,
    out,
):
    """Compute the shares of each pixel's power that belong to hypotheses."""
    total = predicted[0].copy()
    for number in range(1, len(predicted)):
        alone = predicted[number]
        for p in range(len(total)):
            total[p] += alone[p]
    for number in range(len(wanted)):
        alone, share = predicted[wanted[number]], out[number]
        for p in range(len(total)):
            share[p] = total[p] - alone[p]
        for entry in range(bounds[number], bounds[number + 1]):
            share[same_pixel[entry]] -= predicted[same_hypothesis[entry], same_pixel[entry]]
        here = confirmed if number == own else confirmed[:0]
        _limit_shares(alone, power, here, suppression, least_confirmed, part[number], share)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def _limit_shares(alone, power, confirmed, suppression, least_confirmed, part, out):
    """Turn the power of rivals into shares."""
    for p in range(len(out)):
        rivals = max(out[p], _ZERO)  # Differences of rounding may be negative.
        out[p] = min(max(_ONE - suppression * rivals / (power[p] + _TINY), _ZERO), _ONE)
        if len(confirmed) and confirmed[p] > least_confirmed * (power[p] + _TINY):
            ratio = alone[p] / (alone[p] + rivals + _TINY)
            out[p] = max(out[p], ratio * ratio * ratio)
        out[p] *= part[p]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def gather_evidence(first, second, between, step, gain, weight, highest, floor, out):
    """Gather the floor, the highest power and the weight of the echoes of a pair."""
    for entry in range(len(first)):
        low = highest[first[entry]]
        here = floor[step[entry]]
        ratio = gain[entry] / here
        out[0, entry] = here
        out[1, entry] = low + between[entry] * (highest[second[entry]] - low)
        out[2, entry] = weight[entry] * (ratio * ratio)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def add_echoes(cell, first, second, between, weight, lifted, power, share, is_foreign, out):
    """Add the weighted reflectivities that a pair shows, and the weights."""
    for entry in range(len(cell)):
        one, other, here = first[entry], second[entry], cell[entry]
        low, high, factor = power[one], power[other], weight[entry]
        if len(share):
            low *= share[one]
            high *= share[other]
            if is_foreign:
                factor *= share[one] + between[entry] * (share[other] - share[one])
        out[0, here] += factor * (low + between[entry] * (high - low)) / lifted[entry]
        out[1, here] += factor


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def add_lobes(lobe, pulse, out):
    """Add the products of the lobes and the pulses of echoes."""
    for echo in range(len(lobe)):
        there = pulse[echo]
        for d in range(out.shape[0]):
            here, row = lobe[echo, d], out[d]
            if here > NEGLIGIBLE:
                for s in range(out.shape[1]):
                    row[s] += here * there[s]


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def limit_cells(cell, is_used, gain, evidence, margin, out):
    """Limit cells to the reflectivity that a pair shows."""
    for entry in range(len(cell)):
        if is_used[entry]:
            shown = margin * (evidence[1, entry] + evidence[0, entry]) / gain[entry]
            out[cell[entry]] = min(out[cell[entry]], shown)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def confirm_cells(cell, is_used, gain, evidence, reflectivity, visible, skipped, out):
    """Limit cells to the reflectivity that a pair confirms, where its echo must be visible."""
    for entry in range(len(cell)):
        here = cell[entry]
        if is_used[entry] and gain[entry] * reflectivity[here] > visible * evidence[0, entry]:
            shown = evidence[1, entry] / gain[entry]
            for row in range(out.shape[0]):
                if row != skipped:
                    out[row, here] = min(out[row, here], shown)


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"nnan"})
def compare_echoes(cell, is_used, gain, evidence, reflectivity, visible, strong, out):
    """Add the reflectivity that a pair shows, and the expected one, over the cells with visible echoes."""
    for entry in range(len(cell)):
        expected = reflectivity[cell[entry]]
        if is_used[entry] and expected > strong and gain[entry] * expected > visible * evidence[0, entry]:
            out[0] += min(evidence[1, entry] / gain[entry], expected)
            out[1] += expected


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
