"""Reference beamformers and weightings in float64, as defined in docs/explanation/beamformers.md."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Processing

__all__ = ["combine"]

_MAX_ELEMENTS = 2**22  # Maximum number of elements of the covariance matrices in a block.

Delayed = NDArray[np.complex128]


def combine(y: Delayed, processing: Processing) -> NDArray[np.float64]:
    """Return the amplitude (range,) of a direction from delayed signals (mic, range) with weights, without gains."""
    amplitude, factor = _BEAMFORMERS[processing.beamformer](y, processing), _WEIGHTINGS[processing.weighting](y)
    found: NDArray[np.float64] = amplitude * factor
    return found


def _delay_and_sum(y: Delayed, _: Processing) -> NDArray[np.float64]:
    return np.asarray(np.abs(y.mean(axis=0)))


def _coherence_factor(y: Delayed) -> NDArray[np.float64]:
    coherent, total = np.abs(y.mean(axis=0)) ** 2, np.mean(np.abs(y) ** 2, axis=0)
    return np.asarray(np.divide(coherent, total, out=np.zeros_like(coherent), where=total > 0))


def _dmas(y: Delayed, processing: Processing) -> NDArray[np.float64]:
    """Return the elementary symmetric polynomial of the roots, accumulated microphone by microphone."""
    order, level = processing.dmas_order, np.abs(y)
    z = y * np.power(level, 1 / order - 1, out=np.zeros_like(level), where=level > 0)
    sums: Delayed = np.zeros((order + 1, y.shape[1]), dtype=np.complex128)
    sums[0] = 1.0
    for root in z:
        sums[1:] += root * sums[:-1]
    return np.asarray(np.abs(sums[order]) / math.comb(len(y), order))


def _capon(y: Delayed, processing: Processing) -> NDArray[np.float64]:
    """Return ``|wᴴ y|`` with the weights from the full covariance matrix, (mic, mic)."""
    n_mics, n_ranges = y.shape
    n_snapshots = min(processing.snapshots, n_ranges)
    first = np.clip(np.arange(n_ranges) - n_snapshots // 2, 0, n_ranges - n_snapshots)
    out = np.zeros(n_ranges)
    for some in np.array_split(np.arange(n_ranges), math.ceil(n_ranges * n_mics**2 / _MAX_ELEMENTS)):
        snapshots = y[:, first[some, None] + np.arange(n_snapshots)].transpose(1, 0, 2)  # (range, mic, snapshot)
        covariance = snapshots @ snapshots.conj().transpose(0, 2, 1) / n_snapshots
        power = np.trace(covariance, axis1=1, axis2=2).real / n_mics
        heard = power > 0
        loaded = covariance[heard] + (processing.diagonal_loading * power[heard])[:, None, None] * np.eye(n_mics)
        solved = np.linalg.solve(loaded, np.ones((len(loaded), n_mics, 1)))[:, :, 0]
        beams = np.sum(solved.conj() * y[:, some[heard]].T, axis=1)
        out[some[heard]] = np.abs(beams / solved.conj().sum(axis=1))
    return out


_BEAMFORMERS: dict[str, Callable[[Delayed, Processing], NDArray[np.float64]]] = {
    "delay_and_sum": _delay_and_sum,
    "dmas": _dmas,
    "capon": _capon,
}
_WEIGHTINGS: dict[str, Callable[[Delayed], NDArray[np.float64]]] = {
    "none": lambda y: np.ones(y.shape[1]),
    "coherence_factor": _coherence_factor,
}
