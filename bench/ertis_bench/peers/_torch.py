"""PyTorch in single precision on all cores, without ``torch.compile``, which needs a C++ compiler."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.peers.problem import Implementation, Problem

__all__ = ["make"]

_DIRECTIONS: Final = 16
"""Directions at a time: their samples stay in the caches. Fewer and more are slower."""


def make(problem: Problem) -> Implementation:
    """Return the implementation with PyTorch.

    Samples are read in whole rows, because single indices take twice as long.
    """
    import torch  # noqa: PLC0415 - an optional dependency

    n_mics, n_phases, n_outputs = problem.shape
    places = torch.from_numpy(problem.channels // 8)
    shifts, taps = torch.from_numpy((problem.channels % 8).astype(np.uint8)[:, None]), torch.from_numpy(problem.taps)
    response, weights = torch.from_numpy(problem.response), torch.from_numpy(problem.weights)
    starts = torch.from_numpy(problem.starts)
    image = torch.empty((len(starts), problem.n_ranges))

    def signals(words: NDArray[Any]) -> Any:
        octets = torch.from_numpy(words[problem.words].view(np.uint8).reshape(-1, words.itemsize)).T.contiguous()
        bits = (octets[places] >> shifts & 1).float()
        steps = bits.reshape(n_mics, -1, len(taps)) @ taps
        decimated = sum(steps[:, step : step + problem.n_signals, step] for step in range(steps.shape[2])) - 1
        spectra = torch.zeros((n_mics, n_phases * n_outputs), dtype=torch.complex64)
        spectra[:, problem.bins] = torch.fft.rfft(decimated, problem.n_fft)[:, problem.bins] * response
        fine = torch.fft.ifft(spectra, norm="forward")
        return fine.reshape(n_mics, n_outputs, n_phases).transpose(1, 2).reshape(-1)

    def delay_and_sum(heard: Any) -> NDArray[np.float32]:
        parts = heard.unfold(0, problem.n_ranges, 1)
        for first in range(0, len(starts), _DIRECTIONS):
            some = slice(first, first + _DIRECTIONS)
            rows = parts.index_select(0, starts[some].reshape(-1)).view(-1, n_mics, problem.n_ranges)
            image[some] = torch.bmm(weights[some, None], rows)[:, 0].abs()
        return np.asarray(image.numpy())

    return Implementation.of(signals, delay_and_sum, threads=torch.get_num_threads())
