"""Gaps, and their reasons in captures that SYNC pulses trigger."""

import numpy as np
import pytest

from ertis_numba.devices.blocks import Block, Instant
from ertis_numba.devices.capture.gap_reasons import DAMAGED, DISK_BUSY, DROPPED, NOT_TRIGGERED, gap_reason
from ertis_numba.devices.capture.readers import BlockArrived
from ertis_numba.frames import SequenceGap


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ({}, NOT_TRIGGERED),
        ({"skipped": 2}, DROPPED),
        ({"skipped": 2, "waited_s": 1.0}, DISK_BUSY),
        ({"waited_s": 1.0}, NOT_TRIGGERED),
        ({"skipped": 2, "damaged": True}, DAMAGED),
    ],
)
def test_gap_reason_names_the_place_of_the_loss(what, reason):
    block = Block(5, np.zeros(8, np.uint32), Instant(0, 0, 0))
    assert gap_reason(BlockArrived("one", block, 5, None, **what)) == reason


def test_sequence_gap_holds_plain_integers():
    gap = SequenceGap("left", np.int64(3), np.uint8(9), "footer", np.int64(5))
    assert gap == SequenceGap("left", 3, 9, "footer", 5)
    assert {type(value) for value in (gap.first, gap.last, gap.session_id)} == {int}
    assert gap.n_missing == 7
