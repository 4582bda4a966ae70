"""Print the numbers of ``smlal`` and of other vector multiplications in a 16-bit kernel for this processor."""

import re

import click
from numba import njit, types

from ertis_numba.kernels._cpu import delay_and_sum_envelope_int16 as module

_KERNEL = vars(module)["_beam_tile"]


@njit
def _tile(tiles, offsets, weights, out):
    _KERNEL(tiles, 0, offsets, weights, 0, 1.0, out, 0, 96)


if __name__ == "__main__":
    _tile.compile((types.int16[:, :, :, :, ::1], types.int32[:, ::1], types.int16[:, :, :, ::1], types.float32[:, ::1]))
    (text,) = _tile.inspect_asm().values()
    long = re.findall(r"\tsmlal2?\t", text)
    other = re.findall(r"\tml[as]\tv\d+\.4s", text)
    click.echo(f"{len(long)} {len(other)}")
