"""Processes whose kernels are compiled for an older processor than this one."""

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Final

from ertis_numba import kernels
from ertis_numba.kernels._cpu.features import host

__all__ = ["environment", "here", "lesser", "start"]

_X86_64: Final = frozenset(["64bit", "cmov", "cx8", "fxsr", "mmx", "sse", "sse2"])
_V3: Final = "cx16 sahf sse3 ssse3 sse4.1 sse4.2 avx avx2 bmi bmi2 f16c fma lzcnt movbe popcnt"
_KEPT: Final = {"AVX-512": None, "AVX2": _X86_64.union(_V3.split()), "SSE2": _X86_64}
"""Features of the instruction sets of older x86-64 processors, newest first; None for all but VNNI."""


def here() -> str:
    """Return the instruction set of the kernels in this process."""
    return kernels.load("cpu").instruction_set


def lesser() -> list[str]:
    """Return the instruction sets, other than its own, that this machine has as well."""
    names = list(_KEPT)
    if here() == "AVX-512 VNNI":
        return names
    return names[names.index(here()) + 1 :] if here() in names else []


def environment(name: str) -> dict[str, str]:
    """Return the environment variables with which Numba compiles for one of `lesser`."""
    (own_name, own_features), kept = host(), _KEPT[name]
    features = {
        feature: present and ("vnni" not in feature if kept is None else feature in kept)
        for feature, present in own_features.items()
    }
    return {
        "NUMBA_CPU_NAME": {"AVX2": "haswell", "SSE2": "x86-64"}.get(name, own_name),
        "NUMBA_CPU_FEATURES": ",".join(f"{'+' if keep else '-'}{feature}" for feature, keep in features.items()),
    }


def start(name: str, arguments: Sequence[str]) -> subprocess.Popen[str]:
    """Start Python with ``arguments`` on the kernels of an instruction set, with pipes to its input and output."""
    return subprocess.Popen(  # noqa: S603 - this package's own modules
        [sys.executable, *arguments],
        env=os.environ | environment(name),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
