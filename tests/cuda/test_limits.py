"""Limits of a GPU, each reported in one line before the driver fails with an error of its own."""

import types

import numpy as np
import pytest
from numba import cuda

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._cuda import beam_sums, lane


@cuda.jit
def _nothing(out):
    out[0] = np.float32(1)


@pytest.mark.parametrize("grid", [(1, 65_536), (1, 1, 70_000)])
def test_launch_of_too_many_blocks_is_refused(grid):
    with pytest.raises(DeviceError, match=r"a grid of \d+,\d+ blocks; the limit is 65,535\. Use a shorter"):
        lane.launch(_nothing, grid, (1,), np.zeros(1, np.float32))


def test_arrays_beyond_32_bit_indices_are_refused():
    too_many = types.SimpleNamespace(size=2**32)
    with pytest.raises(DeviceError, match=r"would have to index 4,294,967,296 numbers; the limit is 4,294,967,295\."):
        beam_sums.indexed(too_many)
    enough = types.SimpleNamespace(size=2**32 - 1)
    assert beam_sums.indexed(enough) is enough
