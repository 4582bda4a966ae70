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
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target
from numba.np.ufunc import parallel

__all__ = ["run_kernels_after_forks"]

_SYMBOL: Final = "numba_parallel_for"  # Numba links compiled code to it.
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


@global_compiler_lock  # type: ignore[untyped-decorator]  # Numba has no type hints
def _compiled(parallel_for: int) -> int:
    """Return the address of a function that calls kernels directly in a forked process, otherwise with OpenMP."""
    flag, word, address = ir.IntType(32), ir.IntType(64), ir.IntType(8).as_pointer()
    kernel_type = ir.FunctionType(ir.VoidType(), [address] * 4)  # arguments, dimensions, steps, data
    layer_type = ir.FunctionType(ir.VoidType(), [address] * 5 + [word] * 2 + [flag])
    library: Any = cpu_target.target_context.codegen().create_library(__name__)
    module = library.create_ir_module(__name__)
    function = ir.Function(module, layer_type, f"{__name__}.{_SYMBOL}")
    build = ir.IRBuilder(function.append_basic_block())
    is_forked = build.load(build.inttoptr(word(ctypes.addressof(_is_forked)), flag.as_pointer()))
    with build.if_then(build.icmp_signed("!=", is_forked, flag(0))):
        build.call(build.bitcast(function.args[0], kernel_type.as_pointer()), function.args[1:5])
        build.ret_void()
    build.call(build.inttoptr(word(parallel_for), layer_type.as_pointer()), function.args)
    build.ret_void()
    library.add_ir_module(module)
    library.finalize()
    return int(library.get_pointer_to_function(function.name))
