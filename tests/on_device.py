"""Kernels of any device, called with NumPy arrays, to share one table of test cases."""

import functools

import numpy as np

from ertis_numba import kernels

__all__ = ["KERNELS", "SIMULATED", "on_device", "sized"]


class _OnDevice:
    """A kernel set whose kernels accept host arrays; other attributes are passed through."""

    def __init__(self, kernel_set):
        self._kernel_set = kernel_set
        self._memory = kernel_set.memory()

    def __getattr__(self, name):
        found = getattr(self._kernel_set, name)
        is_kernel = callable(found) and name not in ("memory", "threads")
        return functools.partial(self._run, found) if is_kernel else found

    def _run(self, kernel, *arguments):
        """Copy arrays to the device, run the kernel, and copy writable arrays back."""
        lane = self._memory.lane()
        here = [self._memory.table(each) if isinstance(each, np.ndarray) else each for each in arguments]
        with lane.entered():
            kernel(*here)
            for there, array in zip(here, arguments, strict=True):
                if isinstance(array, np.ndarray) and array.flags.writeable:
                    lane.fetch(there, array)
        lane.wait()


def on_device(kernel_set):
    """Return a kernel set whose kernels accept NumPy arrays."""
    return _OnDevice(kernel_set) if kernel_set.device == "cuda" else kernel_set


KERNELS = {name: on_device(kernels.load(name)) for name in kernels.usable()}
SIMULATED = any(kernel_set.simulated for kernel_set in KERNELS.values())


def sized(small, large):
    """Return small and large cases, or only small ones in the simulator, whose GPU threads are calls of Python."""
    return list(small) if SIMULATED else [*small, *large]
