"""The kernels compiled by Numba for all cores of the processor."""

import contextlib
import os
import threading
from collections.abc import Iterator

# libgomp's idle threads spin by default and take the cores from SciPy's transforms between two
# kernels: 1.4 times slower on two cores. Sleeping at once costs a wake-up per kernel: 1.06 times slower than
# spinning for some microseconds. It reads these once, when Numba first loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import numba
from numba.core import event

from ertis_numba import checks
from ertis_numba.errors import DeviceError
from ertis_numba.kernels import _compiling
from ertis_numba.kernels._cpu.dot16 import HAS_INT16_DOT, RANGES
from ertis_numba.kernels._host import HostMemory
from ertis_numba.kernels._kernel_set import KernelSet, twins_in

__all__ = ["KERNELS", "threading_layer"]

if numba.config.DISABLE_JIT:
    raise DeviceError(
        "NUMBA_DISABLE_JIT is set, and device 'cpu' is what Numba compiles; unset it or use device 'numpy'"
    )


class _CompilationListener(event.Listener):  # type: ignore[misc]  # Numba is not looked into
    """Listener to what Numba compiles; what it loads from its cache is no such event."""

    def on_start(self, event: object) -> None:  # noqa: ARG002  as Numba calls it
        """Report that a compilation has begun."""
        _compiling.begun()

    def on_end(self, event: object) -> None:
        """Do nothing."""


event.register("numba:compile", _CompilationListener())

_MAX_THREADS: int = numba.config.NUMBA_NUM_THREADS
_ONE_AT_A_TIME = threading.RLock()


def threading_layer() -> str:
    """Return what Numba shares work among threads with: "omp", "tbb" or "workqueue"; empty until a kernel has run."""
    try:
        return str(numba.threading_layer())
    except ValueError:  # no parallel kernel has run yet, so no layer is chosen
        return ""


def _layer_is_reentrant() -> bool:
    """Whether two Python threads may run parallel kernels at a time; unknown counts as no."""
    return threading_layer() not in {"", "workqueue"}


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """See `Threads`.

    Numba's workqueue layer, which it falls back to without OpenMP and TBB, aborts the process when two
    threads meet in it. There, and until the layer is known, one thread runs at a time.
    """
    checks.integer("threads", count, 1, _MAX_THREADS)
    before = numba.get_num_threads()
    with contextlib.nullcontext() if _layer_is_reentrant() else _ONE_AT_A_TIME:
        numba.set_num_threads(count)
        try:
            yield
        finally:
            numba.set_num_threads(before)


KERNELS = KernelSet.of(
    twins_in(__name__),
    device="cpu",
    hardware="",
    transforms="scipy",
    simulated=False,
    memory=HostMemory,
    max_threads=_MAX_THREADS,
    tile_ranges=RANGES if HAS_INT16_DOT else 0,
    fastest_precision="int16" if HAS_INT16_DOT else "float32",
    threads=threads,
)
