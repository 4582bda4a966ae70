"""Parallel kernels in forked processes.

GNU OpenMP runs Numba's parallel kernels on Linux, and loses its threads in a fork. Numba ends a forked process at its
first parallel kernel, so a pool of such workers never returns. Compiled code therefore calls OpenMP through a function
that a fork changes: kernels of a forked process run on the calling thread, and return the same results.
"""

import ctypes
import importlib
import os
from typing import Any, Final

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core.ccallback import CFunc
from numba.core.compiler_lock import global_compiler_lock
from numba.extending import intrinsic
from numba.np.ufunc import parallel

from ertis_numba.kernels._cpu.loading import load_without_compiler

__all__ = ["run_kernels_after_forks"]

_SYMBOL: Final = "numba_parallel_for"  # Numba links compiled code to it.
_FLAG, _LAYER = "ertis_is_forked", "ertis_parallel_for"
_is_forked = ctypes.c_int32(0)  # 1 in a process that inherited threads which do not exist in it.


def run_kernels_after_forks() -> None:
    """Let kernels run in processes that are forked after Numba's threads have started; call before the first one."""
    if not hasattr(os, "register_at_fork"):
        return
    try:
        omppool = importlib.import_module("numba.np.ufunc.omppool")
    except ImportError:  # Numba is built without OpenMP, or its library is missing.
        return
    if omppool.openmp_vendor != "GNU":
        return
    omppool.parallel_for = _compiled(omppool.parallel_for)  # type: ignore[attr-defined]
    if _has_threads() and parallel.threading_layer() == "omp":  # the program has run parallel functions of its own
        llvmlite.binding.add_symbol(_SYMBOL, omppool.parallel_for)
    os.register_at_fork(after_in_child=_after_fork)
    # A fork waits for compilations in other threads, whose locks would stay locked in it.
    lock = global_compiler_lock
    os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)


def _after_fork() -> None:
    """Stop the use of OpenMP, unless this process can start threads of its own."""
    if _has_threads():
        _is_forked.value = 1


def _has_threads() -> bool:
    return bool(parallel._is_initialized)  # noqa: SLF001  Numba has no public function that starts no threads


def _compiled(parallel_for: int) -> int:
    """Return the address of a function that calls kernels directly in a forked process, otherwise with OpenMP."""
    # It comes from Numba's cache, because a compilation takes 15 ms and 30 MB. Its addresses are symbols, therefore.
    llvmlite.binding.add_symbol(_FLAG, ctypes.addressof(_is_forked))
    llvmlite.binding.add_symbol(_LAYER, parallel_for)
    signature = types.void(*[types.voidptr] * 5, types.intp, types.intp, types.int32)
    function = CFunc(_parallel_for, (signature.args, signature.return_type), {}, {})
    function.enable_caching()
    load_without_compiler([function])
    function.compile()
    address: Any = function.address
    return int(address)


@intrinsic  # type: ignore[untyped-decorator]
def _call(
    _typing: Any, kernel: Any, parts: Any, sizes: Any, steps: Any, data: Any, n: Any, m: Any, threads: Any
) -> Any:
    def build(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        flag, address = ir.IntType(32), values[0].type
        kernel_type = ir.FunctionType(ir.VoidType(), [address] * 4)  # arguments, dimensions, steps, data
        layer_type = ir.FunctionType(ir.VoidType(), [each.type for each in values])
        is_forked = builder.load(ir.GlobalVariable(builder.module, flag, _FLAG))
        with builder.if_else(builder.icmp_signed("!=", is_forked, flag(0))) as (forked, usual):
            with forked:
                builder.call(builder.bitcast(values[0], kernel_type.as_pointer()), values[1:5])
            with usual:
                builder.call(ir.Function(builder.module, layer_type, _LAYER), values)
        return context.get_dummy_value()

    return types.void(kernel, parts, sizes, steps, data, n, m, threads), build


def _parallel_for(kernel: Any, parts: Any, sizes: Any, steps: Any, data: Any, n: Any, m: Any, threads: Any) -> None:
    _call(kernel, parts, sizes, steps, data, n, m, threads)
