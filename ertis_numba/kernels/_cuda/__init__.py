"""Kernels compiled by Numba for NVIDIA GPUs, or run by its simulator if ``NUMBA_ENABLE_CUDASIM=1``."""

import contextlib
from collections.abc import Iterator

from ertis_numba.base import checks
from ertis_numba.kernels._cuda.delay_and_sum_envelope_int16 import TILE_RANGES
from ertis_numba.kernels._cuda.lane import SIMULATED, require_own_process
from ertis_numba.kernels._device_protocols import NewMemory
from ertis_numba.kernels._kernel_set import KernelSet, twins_in

__all__ = ["kernel_set"]


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """See `Threads`; one Python thread launches kernels, and the GPU has its own threads."""
    require_own_process()
    checks.integer("threads", count, 1, 1)
    yield


def kernel_set(*, hardware: str, transforms: str, memory: NewMemory) -> KernelSet:
    """Return the kernels of the GPU named ``hardware``; the other arguments are attributes of `KernelSet`."""
    return KernelSet.of(
        twins_in(__name__),
        device="cuda",
        hardware=hardware,
        transforms=transforms,
        simulated=SIMULATED,
        memory=memory,
        max_threads=1,
        tile_ranges=TILE_RANGES,
        instruction_set="",
        threads=threads,
    )
