"""Compilation of kernels to machine code, for a GPU that need not be present.

The launches of a chain are recorded instead of run. Kernels are therefore compiled with the types of real launches, and
grids and blocks are those of real work.
"""

import contextlib
import dataclasses
import functools
import inspect
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest import mock

import numba
import numpy as np
from numba import cuda
from numpy.typing import NDArray

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._cuda import kernel_set
from ertis_numba.kernels._cuda.lane import SIMULATED, Lane
from ertis_numba.kernels._device_protocols import Array
from ertis_numba.kernels._host import HostMemory
from ertis_numba.kernels._kernel_set import KernelSet

__all__ = ["Code", "Launch", "code_of", "disassembled", "recorded", "require_compilers"]

_NEEDED = "compiling for GPUs needs numba-cuda, ptxas and nvdisasm"
_REMEDY = "install them with pip install 'ertis-numba[check]'"
_LOCK = threading.Lock()  # held while Numba is patched


@dataclass(frozen=True, slots=True)
class Launch:
    """Recorded launch of a kernel.

    Attributes
    ----------
    kernel : numba.cuda.dispatcher.CUDADispatcher
    grid, block : tuple of int
        Number of blocks, and threads per block, along each axis.
    types : tuple of numba.types.Type
        Types of the arguments.
    arguments : dict
        Arguments by name. The contents of arrays may have changed since the launch.
    """

    kernel: Any
    grid: tuple[int, ...]
    block: tuple[int, ...]
    types: tuple[Any, ...]
    arguments: dict[str, Any]

    @property
    def file(self) -> str:
        """Name of the kernel's module, which is also the name in its contract."""
        return str(self.kernel.py_func.__module__).rpartition(".")[2]

    @property
    def name(self) -> str:
        """Name of the module and of the kernel, joined by a dot."""
        return f"{self.file}.{self.kernel.py_func.__name__.lstrip('_')}"


@dataclass(frozen=True, slots=True)
class Code:
    """Kernel compiled for one compute capability.

    Attributes
    ----------
    ptx : str
        Intermediate code.
    cubin : bytes
        Machine code.
    registers : int
        Registers per thread.
    shared_bytes : int
        Shared memory per block.
    stack_bytes, spill_bytes : int
        Per thread: memory for local arrays, and bytes moved between registers and memory due to a lack of registers.
    """

    ptx: str
    cubin: bytes
    registers: int
    shared_bytes: int
    stack_bytes: int
    spill_bytes: int


def recorded(steps: Callable[[KernelSet], object]) -> list[Launch]:
    """Record the kernel launches of ``steps`` in order, without running them.

    Parameters
    ----------
    steps : callable
        Receives the kernels as a `KernelSet`.

    Returns
    -------
    list of Launch

    Raises
    ------
    DeviceError
        The process was started with NUMBA_ENABLE_CUDASIM=1.
    """
    if SIMULATED:
        raise DeviceError("kernels are not compiled if the GPU is simulated; unset NUMBA_ENABLE_CUDASIM")
    launches: list[Launch] = []
    kernels = kernel_set(hardware="", transforms="scipy", memory=functools.partial(_Memory, launches))
    with _Lane(launches).entered():
        steps(dataclasses.replace(kernels, simulated=True))  # so that no caller measures them
    return launches


def code_of(launch: Launch, cc: tuple[int, int]) -> Code:
    """Return the machine code of a kernel for compute capability ``cc``; results are cached by kernel and types.

    Raises
    ------
    DeviceError
        A compiler is missing or fails.
    """
    require_compilers()
    return _code(launch.kernel, launch.types, cc)


@functools.cache
def disassembled(code: Code) -> str:
    """Return machine code as text with labels and one instruction per line.

    Raises
    ------
    DeviceError
        nvdisasm is missing or fails. Version 13 does not support GPUs before compute capability 7.5.
    """
    with tempfile.TemporaryDirectory() as folder:
        cubin = Path(folder) / "kernel.cubin"
        cubin.write_bytes(code.cubin)
        return _run("nvdisasm", "-c", str(cubin)).stdout


def require_compilers() -> None:
    """Raise an error if kernels cannot be compiled.

    Raises
    ------
    DeviceError
        A compiler is missing.
    """
    if not hasattr(cuda, "compile_ptx") or "numba_cuda" not in str(cuda.__file__):
        raise DeviceError(
            f"compiling for GPUs needs numba-cuda, ptxas and nvdisasm, but numba-cuda is missing; {_REMEDY}"
        )
    for name in ("ptxas", "nvdisasm"):
        _tool(name)


class _Lane(Lane):
    """Lane of the host that records its launches."""

    def __init__(self, launches: list[Launch]) -> None:
        super().__init__(None, np.zeros)
        self._launches = launches

    def send(self, array: NDArray[Any]) -> Any:
        return array

    def target(self, out: NDArray[np.float32]) -> Any:
        return out

    def run(self, steps: Callable[[], None]) -> None:
        steps()

    def fetch(self, array: Any, out: NDArray[Any]) -> None:
        """Copy nothing, because no image was computed."""

    def wait(self) -> None:
        """Return immediately, because no kernel runs."""

    def launch(self, kernel: Any, grid: tuple[int, ...], block: tuple[int, ...], *arguments: Any) -> None:
        types = tuple(_type_of(argument) for argument in arguments)
        names = inspect.signature(kernel.py_func).parameters
        self._launches.append(Launch(kernel, grid, block, types, dict(zip(names, arguments, strict=True))))


class _Memory(HostMemory):
    def __init__(self, launches: list[Launch], *, graphs: bool | None = None) -> None:
        super().__init__(graphs=graphs)
        self._launches = launches

    def table(self, array: Array) -> Array:
        return cast("Array", np.ascontiguousarray(array))  # like arrays of a GPU

    def lane(self) -> Any:
        return _Lane(self._launches)


def _type_of(argument: Any) -> Any:
    """Return the type of an argument at a launch; arrays of a GPU are always writable."""
    found = numba.typeof(argument)
    return found.copy(readonly=False) if isinstance(argument, np.ndarray) else found


@functools.cache
def _code(kernel: Any, types: tuple[Any, ...], cc: tuple[int, int]) -> Code:
    options = {name: kernel.targetoptions[name] for name in ("fastmath", "launch_bounds")}
    with _device(cc):
        ptx, _ = cuda.compile_ptx(kernel.py_func, types, cc=cc, **options)
    with tempfile.TemporaryDirectory() as folder:
        source, cubin = Path(folder) / "kernel.ptx", Path(folder) / "kernel.cubin"
        source.write_text(ptx, "utf-8")
        done = _run("ptxas", "-v", f"-arch=sm_{cc[0]}{cc[1]}", str(source), "-o", str(cubin))
        code = cubin.read_bytes()
    reported = done.stdout + done.stderr
    return Code(
        ptx=ptx,
        cubin=code,
        registers=_sum(r"Used (\d+) registers", reported),
        shared_bytes=_sum(r"(\d+) bytes smem", reported),
        stack_bytes=_sum(r"(\d+) bytes stack frame", reported),
        spill_bytes=_sum(r"(\d+) bytes spill (?:stores|loads)", reported),
    )


@contextlib.contextmanager
def _device(cc: tuple[int, int]) -> Iterator[None]:
    """Patch Numba with a fake GPU, whose compute capability it queries if a kernel calls functions."""
    device = SimpleNamespace(compute_capability=cc)
    with _LOCK, mock.patch("numba.cuda.dispatcher.get_current_device", return_value=device):
        yield


def _sum(pattern: str, text: str) -> int:
    return sum(int(number) for number in re.findall(pattern, text))


def _tool(name: str) -> str:
    """Return the path of a program from NVIDIA's wheels, from CUDA_HOME or from PATH."""
    from cuda import pathfinder  # noqa: PLC0415 - comes with numba-cuda

    found = pathfinder.find_nvidia_binary_utility(name) or shutil.which(name)
    if found is None:
        raise DeviceError(f"{_NEEDED}, but {name} is missing; {_REMEDY}")
    return str(found)


def _run(name: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    done = subprocess.run([_tool(name), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise DeviceError(f"{name} fails ({done.stderr.strip().splitlines()[-1]}); {_REMEDY}")
    return done
