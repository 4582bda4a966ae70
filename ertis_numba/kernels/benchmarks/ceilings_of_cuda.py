"""Performance ceilings of this GPU: kernels that measure only device memory, arithmetic or the L1 cache."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from ertis_numba.kernels._cuda.lane import SIMULATED, launch
from ertis_numba.kernels.benchmarks.stopwatch import Stopwatch

__all__ = ["TURN_LOADS", "TURN_MULTIPLY_ADDS", "ceilings", "load", "multiply_add", "occupy", "properties"]

_BLOCK = 256
_WARP = np.uint32(32)
_BLOCKS_PER_MULTIPROCESSOR = 16  # twice as many as reside at the same time
_SUMS, _ROUNDS, _LOADS = 8, 16, 8
TURN_MULTIPLY_ADDS = _SUMS * _ROUNDS
TURN_LOADS = _LOADS
"""Loads per thread and turn."""
_SAMPLES = 2048  # of 8 bytes: they stay in the L1 cache of any GPU
_MASK = np.uint32(_SAMPLES - 1)
_OCCUPY_TURNS = 80_000  # About five milliseconds: a turn is 128 instructions per warp.
_TURNS = 2_000
_COPY_BYTES = 2**28


@cuda.jit(cache=True)
def _multiply_add(turns, factor, addend, out):
    """Compute eight independent sums: a multiply-add takes four clocks, and four warps take turns."""
    a = np.float32(cuda.threadIdx.x)
    b, c, d = a + addend, a - addend, a * factor
    e, f, g, h = b + addend, c - addend, b * factor, c * factor
    for _ in range(turns):
        for _ in range(_ROUNDS):
            a, b = a * factor + addend, b * factor + addend
            c, d = c * factor + addend, d * factor + addend
            e, f = e * factor + addend, f * factor + addend
            g, h = g * factor + addend, h * factor + addend
    out[cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x] = ((a + b) + (c + d)) + ((e + f) + (g + h))


@cuda.jit(cache=True)
def _load(samples, turns, first, out):
    """Load 32 adjacent samples per warp, as delay-and-sum does, ``first`` samples after the begin of a cache line."""
    at = np.uint32(np.uint32(cuda.threadIdx.x) % _WARP + np.uint32(first))
    total = np.uint64(0)
    for _ in range(turns):
        for k in range(_LOADS):
            total ^= samples[np.uint64(at) + np.uint64(32 * k)]
        at = np.uint32(np.uint32(at + _WARP) & _MASK)
    out[cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x] = total


def multiply_add(turns: int, out: NDArray[np.float32]) -> None:
    """Run float32 multiply-adds in registers, a thread per element of ``out``: at most 256, or a multiple of it."""
    launch(_multiply_add, *_shape(len(out)), turns, np.float32(0.5), np.float32(1), out)


def load(samples: NDArray[np.uint64], turns: int, first: int, out: NDArray[np.uint64]) -> None:
    """Load ``samples`` (2304,) from the L1 cache, a thread per element of ``out``, ``first`` < 16 off a cache line."""
    launch(_load, *_shape(len(out)), samples, turns, first, out)


def occupy(out: NDArray[np.float32]) -> None:
    """Keep a lane busy for milliseconds, so that kernels launched meanwhile run without gaps; ``out`` as above."""
    multiply_add(1 if SIMULATED else _OCCUPY_TURNS, out)


def properties() -> dict[str, Any]:
    """Return the number of multiprocessors, the compute capability and the UUID of the GPU as used by nvidia-smi."""
    device = cuda.get_current_device()
    return {
        "multiprocessors": 1 if SIMULATED else int(device.MULTIPROCESSOR_COUNT),
        "compute_capability": ".".join(map(str, device.compute_capability)),
        "uuid": "" if SIMULATED else str(device.uuid),
    }


def ceilings(
    runs: int, *, turns: int = _TURNS, copy_bytes: int = _COPY_BYTES, threads: int | None = None
) -> dict[str, float]:
    """Return the best result of several runs, because a ceiling is not an average."""
    # `copy_gb_s` counts bytes read and written, `float32_gop_s` a multiply-add as two operations.
    threads = threads or _BLOCK * _BLOCKS_PER_MULTIPROCESSOR * properties()["multiprocessors"]
    source, target = (cuda.to_device(np.ones(copy_bytes // 4, np.float32)) for _ in range(2))
    sums = cuda.device_array(threads, np.float32)
    words, samples = cuda.device_array(threads, np.uint64), cuda.to_device(np.arange(_SAMPLES + 256, dtype=np.uint64))
    operations, loaded = 2 * TURN_MULTIPLY_ADDS * turns * threads, 8 * TURN_LOADS * turns * threads
    return {
        "copy_gb_s": 2 * source.nbytes / _best_s(runs, lambda: target.copy_to_device(source)) / 1e9,
        "float32_gop_s": operations / _best_s(runs, lambda: multiply_add(turns, sums)) / 1e9,
        "load_gb_s": loaded / _best_s(runs, lambda: load(samples, turns, 0, words)) / 1e9,
        "load_unaligned_gb_s": loaded / _best_s(runs, lambda: load(samples, turns, 1, words)) / 1e9,
    }


def _shape(threads: int) -> tuple[tuple[int], tuple[int]]:
    """Return the number of blocks, and the number of threads per block."""
    block = min(_BLOCK, threads)
    return (threads // block,), (block,)


def _best_s(runs: int, run: Callable[[], object]) -> float:
    watch, times_ms, sums = Stopwatch(), [], cuda.to_device(np.zeros(32, np.float32))
    run()
    for _ in range(runs):
        watch.start()
        occupy(sums)  # The time then excludes the launch.
        watch.mark("busy")
        run()
        watch.mark("run")
        times_ms.append(watch.read_ms()["run"])
    return min(times_ms) / 1e3
