"""Instruction set for which Numba compiles, and the numbers by which vector code adapts to it."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from llvmlite import binding, ir
from numba.core import cgutils, config

__all__ = ["INSTRUCTION_SET", "InstructionSet", "host", "passes", "target_features", "vectors_per_pass"]


def target_features() -> frozenset[str]:
    """Return the names of the target's features, as spelled by LLVM.

    NUMBA_CPU_FEATURES and NUMBA_CPU_NAME select another target than this processor, for example the oldest of several
    machines that share a cache. An instruction that the target lacks would abort the compiler.
    """
    if config.CPU_FEATURES is not None:
        flags = str(config.CPU_FEATURES).split(",")
        return frozenset(flag[1:] for flag in flags if flag.startswith("+"))
    if config.CPU_NAME == "generic":
        return frozenset()
    try:
        return frozenset(name for name, present in binding.get_host_cpu_features().items() if present)
    except RuntimeError:  # LLVM does not support this system
        return frozenset()


def host() -> tuple[str, dict[str, bool]]:
    """Return LLVM's name of this processor, and its features; False for those that it lacks."""
    return binding.get_host_cpu_name(), dict(binding.get_host_cpu_features())


@dataclass(frozen=True, slots=True)
class InstructionSet:
    """Vector instructions of a processor, with 32-bit lanes; ``sums`` vectors stay in registers.

    ``multiply_pairs`` is LLVM's name of the instruction that multiplies 16-bit numbers and adds the products of each
    pair. If it is empty, each product has a sum of its own, and LLVM emits ``smlal`` for NEON. ``has_masks``: registers
    of one bit per lane select lanes. ``symbol_bits``: one instruction looks up numbers of 16 or 32 bits in tables of
    ``2 ** symbol_bits``; 0 if none does.
    """

    name: str
    lanes: int
    sums: int
    multiply_pairs: str
    has_masks: bool = False
    symbol_bits: int = 0


_X86: Final[tuple[tuple[set[str], InstructionSet], ...]] = (
    (
        {"avx512bw", "avx512vnni"},
        InstructionSet("AVX-512 VNNI", 16, 24, "llvm.x86.avx512.pmaddw.d.512", has_masks=True, symbol_bits=5),
    ),
    ({"avx512bw"}, InstructionSet("AVX-512", 16, 24, "llvm.x86.avx512.pmaddw.d.512", has_masks=True, symbol_bits=5)),
    ({"avx2"}, InstructionSet("AVX2", 8, 12, "llvm.x86.avx2.pmadd.wd", symbol_bits=3)),
    (set(), InstructionSet("SSE2", 4, 12, "llvm.x86.sse2.pmadd.wd")),
)
"""Instruction sets of x86-64 with the features that they need, best first; every x86-64 has SSE2.

LLVM merges the multiplication of pairs with the following addition to ``vpdpwssd`` if the target has AVX-512 VNNI or
AVX-VNNI.
"""


def _chosen() -> InstructionSet:
    machine = binding.get_process_triple().partition("-")[0]
    if machine == "x86_64":
        return next(each for needed, each in _X86 if needed <= target_features())
    return InstructionSet("NEON" if machine in {"aarch64", "arm64"} else "generic", 4, 24, "")


INSTRUCTION_SET: Final = _chosen()


def vectors_per_pass(n_vectors: int, sums_each: int) -> int:
    """Return the number of vectors of a tile, a divisor of ``n_vectors``, whose sums fit in registers."""
    most = INSTRUCTION_SET.sums // sums_each
    return next(count for count in range(most, 0, -1) if n_vectors % count == 0)


@contextlib.contextmanager
def passes(builder: Any, n_used: Any, n_ranges: int, at_a_time: int) -> Iterator[Any]:
    """Emit a loop over the first ``n_used`` of the ``n_ranges`` of a tile; yield the first range of a pass."""
    step = ir.Constant(n_used.type, at_a_time)
    if at_a_time == n_ranges:
        yield ir.Constant(n_used.type, 0)
        return
    count = builder.sdiv(builder.add(n_used, ir.Constant(n_used.type, at_a_time - 1)), step)
    with cgutils.for_range(builder, count) as loop:
        yield builder.mul(loop.index, step)
