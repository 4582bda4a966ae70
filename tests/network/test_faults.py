"""Injected faults equal their descriptions, and are the same for the same seed."""

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.blocks import encode_block
from ertis_numba.devices.emulator.faults import KINDS, Faults, Stall, Unplug
from tests.wire import block_of


def spoilt_blocks(kinds, count=200, seed=3, size=500):
    faults = Faults(seed, kinds)
    return [(block, faults.spoil(block)) for block in (block_of(index, n_samples=size) for index in range(count))]


def test_equal_seeds_give_equal_faults():
    kinds = dict.fromkeys(KINDS, 0.3) | {"short_reads": True}
    first, again, other = (spoilt_blocks(kinds, seed=seed) for seed in (3, 3, 4))
    assert first == again
    assert first != other


def test_blocks_without_faults_are_unchanged():
    for block, spoilt in spoilt_blocks({}):
        assert (spoilt.data, spoilt.note, spoilt.faults) == (block, "", ())
        assert len(spoilt.pieces) == 1  # shorter than a terminal's buffer
    for block, spoilt in spoilt_blocks({"short_reads": True}, size=5000, count=20):
        assert (spoilt.data, spoilt.note) == (block, "")
        assert all(1 <= len(piece) <= 4095 for piece in spoilt.pieces)
        assert len({len(piece) for piece in spoilt.pieces}) > 3


def _as_told(block, fault, spoilt):
    """Apply one fault to a block, as its description says."""
    place, count = fault.place, fault.n_bytes
    again = int(fault.detail.removeprefix("at ")) if fault.kind == "swap" else place
    left = {"add": block, "duplicate": block, "stall": block, "cut": block[:place], "unplug": block[:place]}
    rest = left.get(fault.kind, block[:place] + block[place + count :])
    n_new = {"lose": 0, "stall": 0, "cut": 0, "drop": 0, "unplug": 0}.get(fault.kind, count)
    return rest[:again] + spoilt.data[again : again + n_new] + rest[again:]


@pytest.mark.parametrize("kind", KINDS)
def test_notes_describe_the_injected_faults(kind):
    for block, spoilt in spoilt_blocks({kind: 1.0}):
        [fault] = spoilt.faults
        assert fault.kind == kind
        assert spoilt.note.startswith(f"{kind} {fault.n_bytes} at {fault.place}")
        assert spoilt.data == _as_told(block, fault, spoilt)
        assert kind != "duplicate" or spoilt.data == 2 * block
        assert kind != "swap" or len(spoilt.data) == len(block)
        assert kind in {"duplicate", "add"} or fault.place + fault.n_bytes <= len(block)
        if kind not in {"stall", "unplug", "swap", "cut"}:
            assert spoilt.data != block
        assert any(isinstance(piece, Stall) for piece in spoilt.pieces) == (kind == "stall")
        assert isinstance(spoilt.pieces[-1:] and spoilt.pieces[-1], Unplug) == (kind == "unplug")


def test_flips_and_losses_have_their_documented_distribution():
    parts = [spoilt.faults[0].detail for _, spoilt in spoilt_blocks({"flip": 1.0}, count=1000)]
    assert {part: round(parts.count(part) / 1000, 1) for part in parts} == {
        "words": 0.5,
        "header": 0.2,
        "counter": 0.2,
        "footer": 0.2,
    }
    losses = [spoilt.faults[0] for _, spoilt in spoilt_blocks({"lose": 1.0}, count=1000)]
    assert 0.5 < np.mean([loss.place % 4 == loss.n_bytes % 4 == 0 for loss in losses]) < 0.6
    assert min(loss.n_bytes for loss in losses) == 1
    assert max(loss.n_bytes for loss in losses) > 1000


def test_stalls_have_a_duration_and_a_limit():
    faults = Faults(1, {"stall": 1.0}, longest_stall_s=0.5)
    stalls = [piece.duration_s for _ in range(50) for piece in faults.spoil(block_of(1)).pieces if type(piece) is Stall]
    assert len(stalls) == 50
    assert 0.25 < max(stalls) <= 0.5


def test_empty_block_may_be_damaged():
    faults = Faults(1, dict.fromkeys(KINDS, 0.5))
    for _ in range(300):
        faults.spoil(encode_block(0, np.zeros(0, np.uint32)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kinds": {"loose": 0.1}}, r"kind of fault 'loose' is unknown \(did you mean 'lose'\?\)"),
        ({"kinds": {"lose": 1.1}}, "probability of lose is 1.1; use a number from 0 to 1"),
        ({"seed": -1}, "seed is -1; use a whole number of at least 0"),
        ({"longest_stall_s": -1}, "longest_stall_s is -1; use a number from 0 to 3600"),
    ],
)
def test_unknown_faults_are_refused(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        Faults(**arguments)
