"""Repeated blocks of words: buffers sent twice are reported, cycles of silent modulators are not."""

import numpy as np
import pytest

from ertis_numba.analysis.health.pcm_samples import swapped_bytes
from ertis_numba.analysis.health.repeats import duplicates, repeated_blocks

CHANNELS = tuple(range(32))


def noise():
    return np.random.default_rng(3).integers(0, 2**32, 40_000, dtype=np.uint32)


@pytest.mark.parametrize("period", [2, 3, 32, 128, 500])
def test_repeated_blocks_ignores_a_cycle_within_one_stretch(period):
    words = noise()
    words[20_000:37_000] = np.resize(words[:period], 17_000)
    assert repeated_blocks(words[:, None], CHANNELS) == []


def test_repeated_blocks_ignores_cycles_in_two_distant_stretches():
    words = noise()
    cycle = words[:150].copy()
    for first in (3_000, 30_000):
        words[first : first + 2_000] = np.resize(cycle, 2_000)
    assert repeated_blocks(words[:, None], CHANNELS) == []


@pytest.mark.parametrize("copies", [1, 5])
@pytest.mark.parametrize("length", [600, 1024, 4096])
def test_repeated_blocks_reports_a_buffer_sent_again(length, copies):
    words = noise()
    words[10_000 : 10_000 + length * (1 + copies)] = np.tile(words[10_000 : 10_000 + length], 1 + copies)
    [finding] = repeated_blocks(words[:, None], CHANNELS)
    assert finding.measured == length * copies
    assert f"again {length} samples later" in finding.detail


@pytest.mark.parametrize("is_pdm", [False, True])
def test_one_signal_in_all_channels_is_a_duplicate(is_pdm):
    words = noise() % 2 == 1 if is_pdm else noise()
    found = duplicates([(channel, words) for channel in CHANNELS], is_pdm=is_pdm)
    assert [finding.channels for finding in found] == [(channel,) for channel in CHANNELS]


def test_samples_of_eight_bits_are_not_swapped():
    numbers = np.round(3 * np.random.default_rng(1).standard_normal((4000, 4))).astype(np.int16)
    assert swapped_bytes(numbers * np.int16(256), (0, 1, 2, 3)) == []
    assert len(swapped_bytes(numbers.byteswap(), (0, 1, 2, 3))) == 1
