"""NumPy and SciPy on one thread."""

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_bench.peers.problem import Implementation, Problem

__all__ = ["analytic", "make"]


def make(problem: Problem) -> Implementation:
    """Return the implementation with NumPy, which sums one direction at a time."""
    image = np.empty((len(problem.starts), problem.n_ranges), np.float32)

    def signals(words: NDArray[Any]) -> NDArray[np.complex64]:
        phases = analytic(problem, words).reshape(problem.shape[0], -1, problem.shape[1])
        return np.ascontiguousarray(phases.swapaxes(1, 2)).reshape(-1)

    def delay_and_sum(heard: NDArray[np.complex64]) -> NDArray[np.float32]:
        parts = np.lib.stride_tricks.sliding_window_view(heard, problem.n_ranges)
        for out, starts, weights in zip(image, problem.starts, problem.weights, strict=True):
            np.abs(weights @ parts[starts], out=out)
        return image

    return Implementation.of(signals, delay_and_sum, threads=1)


def analytic(problem: Problem, words: NDArray[Any]) -> NDArray[np.complex64]:
    """Return the analytic signals: (mic, sample) complex64."""
    octets = np.ascontiguousarray(words[problem.words].view(np.uint8).reshape(-1, words.itemsize).T)
    bits = octets[problem.channels // 8] >> (problem.channels % 8)[:, None].astype(np.uint8) & np.uint8(1)
    steps = bits.astype(np.float32).reshape(len(bits), -1, len(problem.taps)) @ problem.taps
    signals = sum(steps[:, step : step + problem.n_signals, step] for step in range(steps.shape[2])) - np.float32(1)
    n_mics, n_phases, n_outputs = problem.shape
    spectra = np.zeros((n_mics, n_phases * n_outputs), np.complex64)
    np.multiply(scipy.fft.rfft(signals, problem.n_fft)[:, problem.bins], problem.response, out=spectra[:, problem.bins])
    return np.asarray(scipy.fft.ifft(spectra, norm="forward", overwrite_x=True))
