"""Checks of compiled kernels, tested with deliberately faulty kernels."""

import dataclasses
import types

import numpy as np
import pytest
from cuda import pathfinder
from numba import cuda

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._cuda.lane import launch
from tests.ptx import offline_compilation
from tests.ptx.faults import contracts, faults

CC = (9, 0)
SUMS = 64


@cuda.jit
def good(x, out):
    out[cuda.threadIdx.x] = x[cuda.threadIdx.x]


@cuda.jit
def double(x, out):
    out[0] = x[0] * 1.1


@cuda.jit
def stacked(x, out):
    local = cuda.local.array(1000, np.float32)
    for k in range(x.size):
        local[k] = x[k]
    out[0] = local[int(x[0])]


@cuda.jit
def calling(x, out):
    print(x[0], out[0])  # noqa: T201 - GPUs print by calling a function


def spilling():
    """A kernel with more sums than registers."""
    lines = ["def spilling(x, out):", "    t = cuda.threadIdx.x", *(f"    a{k} = x[t + {k}]" for k in range(SUMS))]
    lines += ["    for i in range(x.size):"]
    lines += [f"        a{k} = a{k} * x[i] + a{(k + 1) % SUMS}" for k in range(SUMS)]
    lines += [f"    out[t + {k}] = a{k}" for k in range(SUMS)]
    names = {"cuda": cuda}
    exec("\n".join(lines), names)
    return cuda.jit(launch_bounds=(1024, 2))(names["spilling"])


@cuda.jit
def contracted(x, out):
    out[0] = x[0] * x[1] + x[2]


def recorded(kernel, *, grid=(1,), block=(32,), dtype=np.float32):
    (one,) = offline_compilation.recorded(
        lambda _: launch(kernel, grid, block, np.zeros(100, dtype), np.zeros(100, dtype))
    )
    return one


def found(kernel, **given):
    one = recorded(kernel, **given)
    return faults(one, offline_compilation.code_of(one, CC))


def test_correct_kernel_has_no_faults():
    assert found(good) == []
    assert found(good, grid=(2**31 - 1, 65_535, 65_535), block=(32, 32)) == []


def test_double_precision_is_detected():
    assert found(double) == ["computes in double precision"]


def test_stack_use_is_detected():
    assert found(stacked) == ["has 4000 bytes on the stack"]


def test_function_calls_are_detected():
    assert "calls a function" in found(calling)


def test_register_spills_are_detected():
    assert any(fault.startswith("spills ") for fault in found(spilling()))


@pytest.mark.parametrize(
    ("grid", "block", "fault"),
    [
        ((1, 65_536), (32,), "has a grid of (1, 65536)"),
        ((1, 1, 70_000), (32,), "has a grid of (1, 1, 70000)"),
        ((2**31,), (32,), "has a grid of (2147483648,)"),
        ((1,), (32, 64), "has 2048 threads in a block"),
    ],
)
def test_launches_beyond_bounds_are_detected(grid, block, fault):
    one = dataclasses.replace(recorded(good), grid=grid, block=block)  # `launch` itself refuses some of these
    assert faults(one, offline_compilation.code_of(one, CC)) == [fault]


def test_excess_registers_and_shared_memory_are_detected():
    one = recorded(good, block=(1024,))
    code = offline_compilation.code_of(one, CC)
    assert faults(one, dataclasses.replace(code, registers=64)) == []
    assert faults(one, dataclasses.replace(code, registers=65)) == ["has 72 registers in 1024 threads"]
    assert faults(one, dataclasses.replace(code, shared_bytes=49_153)) == ["shares 49153 bytes"]


def test_fused_multiply_add_in_double_precision_is_detected():
    code = offline_compilation.code_of(recorded(contracted, dtype=np.float64), CC)
    assert contracts(code.ptx)
    assert contracts(offline_compilation.disassembled(code))
    single = offline_compilation.code_of(recorded(contracted), CC)
    assert not contracts(single.ptx)
    assert not contracts(offline_compilation.disassembled(single))


def test_shared_memory_is_reported():
    @cuda.jit
    def sharing(x, out):
        shared = cuda.shared.array(256, np.float32)
        shared[cuda.threadIdx.x] = x[cuda.threadIdx.x]
        cuda.syncthreads()
        out[cuda.threadIdx.x] = shared[255 - cuda.threadIdx.x]

    assert offline_compilation.code_of(recorded(sharing), CC).shared_bytes == 1024


def test_recorded_launch_has_types_of_gpu_arrays():
    x = np.zeros(100, np.float32)
    x.flags.writeable = False
    (one,) = offline_compilation.recorded(lambda _: launch(good, (1,), (32,), x, x))
    assert [str(kind) for kind in one.types] == ["array(float32, 1d, C)"] * 2
    assert one.arguments["x"] is x


def test_kernel_is_compiled_once(monkeypatch):
    one, other = recorded(good), recorded(good, grid=(7,))
    code = offline_compilation.code_of(one, CC)
    monkeypatch.setattr(offline_compilation.cuda, "compile_ptx", None)
    assert offline_compilation.code_of(other, CC) is code


def test_ptx_checks_refuse_the_simulator(monkeypatch):
    monkeypatch.setattr(offline_compilation, "SIMULATED", True)
    with pytest.raises(DeviceError, match=r"^kernels are not compiled if the GPU is simulated; unset NUMBA_ENABLE_"):
        offline_compilation.recorded(print)


def test_missing_compiler_is_named(monkeypatch):
    monkeypatch.setattr(pathfinder, "find_nvidia_binary_utility", lambda _: None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(DeviceError, match=r"needs numba-cuda, ptxas and nvdisasm, but ptxas is missing; install them"):
        offline_compilation.require_compilers()
    monkeypatch.setattr(offline_compilation, "cuda", types.SimpleNamespace(__file__="numba/cuda/__init__.py"))
    with pytest.raises(DeviceError, match=r"but numba-cuda is missing; install them with pip install 'ertis-numba\["):
        offline_compilation.require_compilers()


def test_compiler_error_is_reported():
    code = offline_compilation.code_of(recorded(good), (6, 0))
    with pytest.raises(DeviceError, match=r'^nvdisasm fails \(.*"SM60" is deprecated.*\); install'):
        offline_compilation.disassembled(code)
