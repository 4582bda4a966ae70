"""The kernels of the signal chain, and the only door to Numba.

`load` returns the kernels of one device as a `KernelSet`. What each kernel does is written once, in
``_contract``; ``_cpu``, ``_cuda`` and ``_numpy`` hold the twins under the same names.
"""

from ertis_numba.kernels._compiling import on_compiling
from ertis_numba.kernels._dispatch import DEVICES, load, usable
from ertis_numba.kernels._kernel_set import KernelSet
from ertis_numba.kernels._memory import Lane, Memory

__all__ = ["DEVICES", "KernelSet", "Lane", "Memory", "load", "on_compiling", "usable"]
