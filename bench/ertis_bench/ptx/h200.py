"""Estimated time of a kernel on an NVIDIA H200 SXM.

The estimates are arithmetic with published figures, and remain to be confirmed on a GPU.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_bench.ptx.instructions import Instruction, kinds, loops, way
from ertis_numba.kernels._cuda.beam_sums import DIRECTIONS, TILE

__all__ = ["ASSUMED", "CC", "GPU", "LOOPS", "Loop", "main_loop", "predicted_us", "resident_warps"]

CC: Final = (9, 0)
GPU: Final[dict[str, float]] = {
    # NVIDIA, "H200 Tensor Core GPU", data sheet, and "H100 Tensor Core GPU Architecture", white paper. Both GPUs
    # have the same chip.
    "multiprocessors": 132,
    "clock_hz": 1.98e9,  # highest clock; lower under load
    "memory_bytes_s": 4.8e12,
    "schedulers": 4,  # per multiprocessor; each issues one instruction of a warp per clock, for 32 lanes
    "cache_line_bytes": 128,  # per clock from the first-level cache
    # NVIDIA, "CUDA C++ Programming Guide", technical specifications for compute capability 9.0
    "warps": 64,
    "blocks": 32,
    "registers": 65_536,
    "registers_at_a_time": 256,  # granularity of the registers of a warp
    # Luo et al., "Benchmarking and dissecting the NVIDIA Hopper GPU architecture" (2024), measured on an H100
    "cache_latency_clocks": 41,
}
ASSUMED: Final[dict[str, float]] = {
    "second_cache_bytes_s": 5.5e12,  # to all multiprocessors together
    "pcie_bytes_s": 55e9,  # from pinned memory; PCIe 5 x16 has 63 GB/s including its protocol
    "copy_bytes_s": 10e9,  # one core that copies words to pinned memory
    "between_kernels_us": 2.0,  # between dependent kernels of a graph
    "transform_kernels": 2,  # kernels of cuFFT per transform; each reads and writes its arrays once
    "transform_kernel_us": 3.0,  # lower limit per kernel
    "graph_us": 10.0,  # processor time to start a graph
    "host_us": 30.0,  # processor time for all other work of a measurement, in Python
    # numba-cuda, pull request 288: time of a launch, and of each of its arrays
    "launch_us": 6.6,
    "launch_array_us": 4.0,
    "transform_launch_us": 10.0,
}

Arguments = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Loop:
    """Work of one pass through the main loop of a kernel.

    Attributes
    ----------
    of : str
        Unit that a pass processes.
    passes : callable
        Returns the number of passes of a thread, from the launch's arguments.
    loads : int
        Load instructions of a pass. Their number in machine code shows how many passes the compiler has merged.
    lines : int
        Lines of the first-level cache that the loads of a warp read. A warp that loads 256 bytes reads two lines, or
        three if the bytes do not start at a line. A warp that loads the same number 32 times reads one line.
    chain : int
        Loads that depend on each other.
    points : int
        Results per thread.
    fetched : callable
        Returns the bytes that blocks fetch from the second-level to the first-level cache, with each line once per
        block.
    """

    of: str
    passes: Callable[[Arguments], int]
    loads: int
    lines: int
    chain: int
    points: int
    fetched: Callable[[Arguments, tuple[int, ...]], float]


def _bytes_of_terms(given: Arguments, grid: tuple[int, ...]) -> float:
    """Return the bytes that blocks fetch for a loop over terms.

    A block computes a group of directions and a tile of ranges. Terms of a group may share cache lines.
    """
    offsets = given["offsets"].reshape(-1, int(given["n_terms"])).astype(np.int64)
    return grid[1] * sum(
        _bytes_of_lines(8 * offsets[first : first + DIRECTIONS], 8 * TILE)
        for first in range(0, len(offsets), DIRECTIONS)
    )


def _bytes_of_grid_points(given: Arguments, grid: tuple[int, ...]) -> float:
    places = given["places"].reshape(-1, int(given["n_pairs"])).astype(np.int64)
    row_bytes = 8 * int(given["width"])
    return grid[1] * sum(
        _bytes_of_lines(row_bytes * (places[first : first + DIRECTIONS, :, None] + np.arange(2)), 8 * TILE)
        for first in range(0, len(places), DIRECTIONS)
    )


def _bytes_of_words(given: Arguments, grid: tuple[int, ...]) -> float:
    n_taps, outputs = given["taps"].size, -(-given["out"].shape[1] // grid[0])
    words = n_taps + (outputs - 1) * int(given["factor"])
    return float(math.prod(grid) * (words * int(given["n_octets"]) + given["taps"].nbytes))


def _bytes_of_lines(starts_bytes: NDArray[np.int64], n_bytes: int) -> float:
    """Return the size of all cache lines that runs of ``n_bytes`` touch, in bytes."""
    line = int(GPU["cache_line_bytes"])
    first, last = starts_bytes.ravel() // line, (starts_bytes.ravel() + n_bytes - 1) // line
    return float(line * len(np.unique(np.concatenate([first + k for k in range(int((last - first).max()) + 1)]))))


_TERMS: Final = Loop(
    of="term",
    passes=lambda given: int(given["n_terms"]),
    loads=6,
    lines=2 + 4 * 3,
    chain=2,
    points=4,
    fetched=_bytes_of_terms,
)
LOOPS: Final = {
    "delay_and_sum_envelope.fill": _TERMS,
    "delay_and_sum.fill": _TERMS,
    "interpolated_beams_envelope.interpolate": Loop(
        of="pair of grid points",
        passes=lambda given: int(given["n_pairs"]),
        loads=10,
        lines=2 + 8 * 2,
        chain=2,
        points=4,
        fetched=_bytes_of_grid_points,
    ),
    "demodulate_words.sum_taps": Loop(
        of="tap",
        passes=lambda given: int(given["taps"].size),
        loads=2,
        lines=2,
        chain=1,
        points=1,
        fetched=_bytes_of_words,
    ),
}
"""Kernels that spend their time in a loop, by name."""


def main_loop(code: list[Instruction]) -> list[Instruction]:
    """Return the loop with the most loads."""
    parts = [[code[at] for at in loop] for loop in loops(code)]
    return max(parts, key=lambda part: kinds(part)["loads"])


def resident_warps(registers: int, warps_per_block: int) -> int:
    """Return the number of warps of a kernel that a multiprocessor holds at a time.

    Shared memory is no limit, because no kernel here uses it.
    """
    at_a_time = GPU["registers_at_a_time"]
    of_warp = math.ceil(32 * registers / at_a_time) * at_a_time
    by_registers = GPU["registers"] // (of_warp * warps_per_block)
    return int(min(by_registers, GPU["blocks"], GPU["warps"] // warps_per_block)) * warps_per_block


def predicted_us(
    name: str,
    code: list[Instruction],
    *,
    registers: int,
    grid: tuple[int, ...],
    block: tuple[int, ...],
    arguments: Arguments,
) -> dict[str, float]:
    """Return the busy time of each part of the GPU during a launch, in microseconds. The longest is the prediction.

    Parameters
    ----------
    name : str
        Kernel. Loops count only for kernels in `LOOPS`.
    code : list of Instruction
    registers : int
    grid, block : tuple of int
    arguments : dict
        Arguments as in `Launch`. Each array is read or written once.
    """
    warps_per_block = -(-math.prod(block) // 32)
    blocks = -(-math.prod(grid) // GPU["multiprocessors"])  # on the multiprocessor with the most blocks
    resident = resident_warps(registers, warps_per_block)
    instructions, lines, waits, fetched = float(len(way(code))), 0.0, 0.0, 0.0
    if name in LOOPS:
        loop, part = LOOPS[name], main_loop(code)
        passes = loop.passes(arguments)
        rounds = passes * loop.loads / kinds(part)["loads"]
        instructions += (rounds - 1) * len(part)
        lines, waits, fetched = passes * loop.lines, rounds * loop.chain, loop.fetched(arguments, grid)
    warps = blocks * warps_per_block
    clocks = {
        "instructions": warps * instructions / GPU["schedulers"],
        "first cache": warps * lines,
        "waiting": math.ceil(warps / resident) * waits * GPU["cache_latency_clocks"],
    }
    times_us = {each: 1e6 * count / GPU["clock_hz"] for each, count in clocks.items()}
    n_bytes = sum(each.nbytes for each in arguments.values() if isinstance(each, np.ndarray))
    times_us["second cache"] = 1e6 * fetched / ASSUMED["second_cache_bytes_s"]
    return {**times_us, "memory": 1e6 * n_bytes / GPU["memory_bytes_s"]}
