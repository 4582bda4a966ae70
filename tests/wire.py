"""Blocks as sent on the serial line, short and with distinct words."""

import numpy as np

from ertis_numba.devices.block_receiver import Instant
from ertis_numba.devices.blocks import FRAME_BYTES, encode_block

N_SAMPLES = 5
N_BYTES = 4 * N_SAMPLES + FRAME_BYTES


def at(time_s):
    return Instant(10**18 + round(time_s * 1e9), round(time_s * 1e9), 1000)


def block_of(counter, words=None, n_samples=N_SAMPLES):
    if words is None:
        words = np.random.default_rng(counter % 2**32).integers(0, 2**32, n_samples, dtype=np.uint32)
    return encode_block(counter % 2**32, np.asarray(words, dtype=np.uint32))


def reported(blocks):
    return [encode_block(block.counter, block.data) for block in blocks]


def counters(blocks):
    return [block.counter for block in blocks]
