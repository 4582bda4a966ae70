"""JAX in single precision, compiled by XLA for all cores."""

from typing import Any

import numpy as np

from ertis_bench.peers.problem import Implementation, Problem
from ertis_numba.base.forks import usable_cores

__all__ = ["make"]


def make(problem: Problem) -> Implementation:
    """Return the implementation with JAX.

    The loop over microphones is unrolled, so that XLA sums them in one pass over the image. A map over directions takes
    about three times as long, and gathered indices eight times.
    """
    import jax  # noqa: PLC0415 - an optional dependency
    from jax import lax, numpy as jnp  # noqa: PLC0415 - the same

    n_mics, n_phases, n_outputs = problem.shape
    channels, taps = jnp.asarray(problem.channels.astype(np.uint32)[:, None]), jnp.asarray(problem.taps)
    response, starts, weights = map(jnp.asarray, (problem.response, problem.starts.T, problem.weights.T))

    def signals(words: Any) -> Any:
        bits = (words >> channels & 1).astype(jnp.float32)
        steps = bits.reshape(n_mics, -1, len(taps)) @ taps
        decimated = sum(steps[:, step : step + problem.n_signals, step] for step in range(steps.shape[2])) - 1
        spectra = jnp.fft.rfft(decimated, problem.n_fft)[:, problem.bins] * response
        padded = jnp.zeros((n_mics, n_phases * n_outputs), jnp.complex64).at[:, problem.bins].set(spectra)
        fine = jnp.fft.ifft(padded, norm="forward")
        return fine.reshape(n_mics, n_outputs, n_phases).swapaxes(1, 2).reshape(-1)

    def delay_and_sum(heard: Any) -> Any:
        part = jax.vmap(lambda start: lax.dynamic_slice(heard, (start,), (problem.n_ranges,)))
        return jnp.abs(sum(weights[mic][:, None] * part(starts[mic]) for mic in range(n_mics)))

    compress, beamform = jax.jit(signals), jax.jit(delay_and_sum)
    return Implementation.of(
        lambda words: compress(words[problem.words]).block_until_ready(),
        lambda heard: np.asarray(beamform(heard)),
        threads=usable_cores(),
    )
