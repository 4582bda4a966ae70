"""Kernels compiled by Numba for all cores of the CPU."""

import contextlib
import os
import threading
from collections.abc import Iterator

# By default, libgomp's idle threads spin and take the cores from SciPy's transforms between two kernels. This is 1.4
# times slower on two cores. Sleeping immediately costs a wake-up per kernel, and is 1.06 times slower than spinning for
# some microseconds. libgomp reads these variables once, when Numba first loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import numba
from numba.core import event

from ertis_numba.base import checks
from ertis_numba.base.errors import DeviceError
from ertis_numba.base.forks import ForkSafeLock
from ertis_numba.kernels import _compile_notice
from ertis_numba.kernels._cpu.after_fork import run_kernels_after_forks
from ertis_numba.kernels._cpu.dot16 import RANGES
from ertis_numba.kernels._cpu.features import INSTRUCTION_SET
from ertis_numba.kernels._cpu.loading import load_without_compiler
from ertis_numba.kernels._host import HostMemory
from ertis_numba.kernels._kernel_set import KernelSet, twins_in

__all__ = ["KERNELS", "cache_folder", "threading_layer"]

if numba.config.DISABLE_JIT:
    raise DeviceError(
        "NUMBA_DISABLE_JIT is set, but device 'cpu' needs Numba's compiler; unset it or use device 'numpy'"
    )


class _CompilationListener(event.Listener):  # type: ignore[misc]  # Numba has no type hints
    """Listener to Numba's compilations; loading a kernel from the cache is no such event."""

    def on_start(self, event: object) -> None:  # noqa: ARG002  Numba passes it by name
        """Report that a compilation has begun."""
        _compile_notice.begun()

    def on_end(self, event: object) -> None:
        """Ignore the end of a compilation."""


event.register("numba:compile", _CompilationListener())

run_kernels_after_forks()

_MAX_THREADS: int = numba.config.NUMBA_NUM_THREADS
_ONE_AT_A_TIME = ForkSafeLock(threading.RLock)


def threading_layer() -> str:
    """Return Numba's threading layer: "omp", "tbb" or "workqueue"; empty until a parallel kernel has run."""
    try:
        return str(numba.threading_layer())
    except ValueError:  # no parallel kernel has run yet, so no layer is chosen
        return ""


def cache_folder() -> str:
    """Return the folder of the compiled kernels."""
    return str(next(iter(_TWINS.values())).stats.cache_path)


def _layer_is_reentrant() -> bool:
    """Return True if two Python threads can run parallel kernels concurrently; False if unknown."""
    return threading_layer() not in {"", "workqueue"}


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Run the enclosed kernels of this Python thread on ``count`` threads."""
    # Numba's workqueue layer aborts the process if two threads use it, so that one runs at a time with it.
    checks.integer("threads", count, 1, _MAX_THREADS)
    before = numba.get_num_threads()
    with contextlib.nullcontext() if _layer_is_reentrant() else _ONE_AT_A_TIME:
        numba.set_num_threads(count)
        try:
            yield
        finally:
            numba.set_num_threads(before)


_TWINS = twins_in(__name__)
load_without_compiler(_TWINS.values())

KERNELS = KernelSet.of(
    _TWINS,
    device="cpu",
    hardware="",
    transforms="scipy",
    simulated=False,
    memory=HostMemory,
    max_threads=_MAX_THREADS,
    tile_ranges=RANGES,
    instruction_set=INSTRUCTION_SET.name,
    threads=threads,
)
