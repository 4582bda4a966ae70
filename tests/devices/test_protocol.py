"""Parser of blocks in a byte stream: faults lose only the damaged blocks, and no false block is returned."""

import itertools
import struct
import time
import zlib

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ertis_numba.devices.block_receiver import BlockParser, BlockReceiver
from ertis_numba.devices.blocks import FOOTER, HEADER
from ertis_numba.devices.emulator.faults import KINDS
from tests.faults import wire_faults
from tests.wire import N_BYTES, N_SAMPLES, at, block_of, counters, reported

WORD = struct.Struct("<I")
TRICKY = st.sampled_from([HEADER, FOOTER, 0, HEADER >> 8, HEADER << 8 & 0xFFFF_FFFF, HEADER >> 16])
WORDS = st.lists(TRICKY | st.integers(0, 2**32 - 1), min_size=N_SAMPLES, max_size=N_SAMPLES)
JUNK = st.lists(st.integers(0, 255) | st.sampled_from(list(WORD.pack(HEADER) + WORD.pack(FOOTER)))).map(bytes)


def parse_in_pieces(data, cuts=()):
    """Feed a stream to a new parser in pieces one second apart; return the parser and its blocks."""
    parser = BlockParser(N_SAMPLES)
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    found = []
    for second, (begin, end) in enumerate(itertools.pairwise(edges)):
        found += parser.feed(data[begin:end], at(second))
    assert len(found) * N_BYTES + parser.rejected.total() + parser.pending == len(data)
    assert parser.missing == (N_BYTES - parser.pending if parser.pending else 0)
    return parser, found


@given(st.lists(WORDS.map(lambda words: block_of(3, words)) | JUNK, max_size=6).map(b"".join), st.lists(st.integers(0)))
def test_parser_is_independent_of_the_chunks_of_a_stream(data, cuts):
    whole, found = parse_in_pieces(data)
    pieces, found_again = parse_in_pieces(data, cuts)
    assert reported(found_again) == reported(found)
    for name in ("rejected", "rejected_blocks", "pending"):
        assert getattr(pieces, name) == getattr(whole, name)


@given(st.lists(WORDS, min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_faultless_stream_is_received_completely(sent, first):
    """Headers and footers among the samples lose no block while each block directly follows the previous one."""
    data = [block_of(first + 1000 * index, words) for index, words in enumerate(sent)]
    parser, found = parse_in_pieces(b"".join(data))
    assert reported(found) == data
    assert not parser.rejected


@given(st.integers(0, N_BYTES - 1), st.integers(1, N_BYTES), st.binary(max_size=2 * N_BYTES), st.integers(0))
def test_damage_loses_only_the_damaged_block(place, n_lost, added, seed):
    """Replace bytes of one block by other bytes, at any alignment."""
    before, victim, after, last = (block_of(10 * seed + index) for index in range(4))
    damaged = victim[:place] + added + victim[place + n_lost :]
    _, found = parse_in_pieces(before + damaged + after + last)
    alone = reported(found)
    assert alone[:1] == [before]
    assert alone[-2:] == [after, last]
    assert all(other in damaged for other in alone[1:-2])


@given(st.data())
def test_consecutive_blocks_are_found_after_any_junk(data):
    """The junk contains whole headers, and these lose no block either."""
    junk = data.draw(st.lists(JUNK | st.just(WORD.pack(HEADER)), max_size=4).map(b"".join))
    sent = [block_of(index) for index in range(3)]
    _, found = parse_in_pieces(junk + b"".join(sent))
    assert reported(found)[-3:] == sent


def test_false_header_within_samples_loses_no_block():
    """After a damaged block, the parser cannot distinguish headers from samples and searches both."""
    damaged = block_of(1)[:-1]
    sent = [block_of(index, [HEADER, 7, HEADER, FOOTER, HEADER]) for index in (2, 3)]
    parser, found = parse_in_pieces(damaged + b"".join(sent))
    assert reported(found) == sent
    assert parser.rejected == {"footer": N_BYTES - 1}
    assert parser.rejected_blocks == {"footer": 1}


@pytest.mark.parametrize(("later_s", "taken"), [(0.05, [3]), (0.02, [1, 3])])
def test_two_damaged_blocks_are_not_joined_to_one(later_s, taken):
    """A header that arrives after a pause starts a new block; without a pause it may be a sample of the first."""
    first, second, third = block_of(1), block_of(2), block_of(3)
    parser = BlockParser(N_SAMPLES, apart_s=0.03)
    assert parser.feed(first[:12], at(0)) == []
    found = parser.feed(second[:16] + second[28:] + third, at(later_s))
    assert counters(found) == taken
    assert parser.rejected_blocks == ({"cut short": 1, "footer": 1} if taken == [3] else {})


def test_parser_counts_rejected_bytes_by_reason():
    parser, _ = parse_in_pieces(b"abc" + block_of(0)[:-1] + block_of(1) + b"de" + block_of(2)[:-2])
    assert parser.rejected == {"no header": 5, "footer": N_BYTES - 1}
    assert parser.missing == 2
    parser.expire()
    assert parser.rejected == {"no header": 5, "footer": N_BYTES - 1, "cut short": N_BYTES - 2}
    assert parser.rejected_blocks == {"cut short": 1, "footer": 1}
    assert parser.missing == 0


def test_search_after_a_deadline_finds_the_next_block():
    parser = BlockParser(N_SAMPLES)
    parser.feed(block_of(1)[:14] + block_of(2)[:10], at(0))
    parser.expire()
    assert parser.missing == N_BYTES - 10
    assert reported(parser.feed(block_of(2)[10:], at(1))) == [block_of(2)]
    assert parser.rejected == {"cut short": 14}


def test_partial_header_may_be_discarded():
    parser = BlockParser(N_SAMPLES)
    parser.feed(b"x" + WORD.pack(HEADER)[:3], at(0))
    assert parser.missing == N_BYTES - 3
    parser.expire()
    assert parser.missing == 0
    parser.expire()  # No block has begun, so nothing expires.
    assert parser.rejected == {"no header": 4}
    assert not parser.rejected_blocks


def test_arrival_time_is_that_of_the_first_byte():
    parser = BlockParser(N_SAMPLES)
    stream = b"abc" + block_of(1) + block_of(2) + block_of(3)
    found = []
    for place in range(0, len(stream), 7):
        found += parser.feed(stream[place : place + 7], at(place))
    firsts = [3, 3 + N_BYTES, 3 + 2 * N_BYTES]
    assert [block.arrived for block in found] == [at(first - first % 7) for first in firsts]


def test_arrival_time_after_a_search_is_that_of_the_first_byte():
    parser = BlockParser(N_SAMPLES)
    parser.feed(block_of(1)[:-5], at(1))
    parser.feed(block_of(2)[:20], at(2))
    [block] = parser.feed(block_of(2)[20:], at(3))
    assert block.arrived == at(2)


def test_parsed_samples_own_their_memory():
    parser = BlockParser(N_SAMPLES)
    [block] = parser.feed(block_of(1), at(0))
    assert block.data.flags.owndata
    assert not block.data.flags.writeable
    assert block.data.dtype == np.uint32
    parser.feed(block_of(2), at(0))
    assert reported([block]) == [block_of(1)]


def test_parsing_a_block_takes_two_milliseconds_at_most():
    receiver = BlockReceiver(163_840, expected=0, shortest_s=0.04)
    times_s = []
    for counter in range(20):
        data = block_of(counter, n_samples=163_840)
        pieces = [data[begin : begin + 4095] for begin in range(0, len(data), 4095)]
        began = time.process_time()
        found = [block for piece in pieces for block in receiver.feed(piece, at(0.05 * counter))]
        times_s.append(time.process_time() - began)
        assert counters(found) == [counter]
    assert np.median(times_s) < 2e-3


def test_parsing_time_is_linear_in_the_number_of_chunks():
    """Copying an 8 MB block at each of its 512-byte pieces would move 70 GB."""
    data = block_of(1, n_samples=2**21)
    parser = BlockParser(2**21)
    began = time.process_time()
    found = [b for place in range(0, len(data), 512) for b in parser.feed(data[place : place + 512], at(0))]
    assert counters(found) == [1]
    assert time.process_time() - began < 2


def assert_consistent(report, n_samples=128):
    """Assert that the parser detects all faults visible in the frame, and counts each byte once."""
    taken = report.delivered + report.altered + report.mixed + report.wrong_counter + report.twice
    assert report.fed == taken * (4 * n_samples + 12) + report.rejected.total() + report.pending
    assert report.untouched_lost == report.mixed == report.wrong_counter == report.twice == 0


@pytest.mark.parametrize("triggers", ["regular", "irregular"])
@pytest.mark.parametrize("deadline_s", [None, 0.01])
def test_parser_survives_faults_in_half_of_all_blocks(triggers, deadline_s):
    report = wire_faults.send(3000, triggers=triggers, deadline_s=deadline_s)
    assert_consistent(report)
    assert 0.4 < report.spoilt / report.sent < 0.6
    assert report.untouched < report.delivered < report.sent
    assert report.delivered + report.altered + report.lost > 0.95 * report.sent  # Few stay uncounted.
    assert set(report.rejected) == {"no header", "footer", "counter", "cut short"}


def test_altered_samples_are_detected_by_the_bit_check_only():
    """The bit check of this test detects every change, because it compares samples with those of all blocks."""
    kinds = {"flip": 0.3, "swap": 0.3}
    report = wire_faults.send(1000, kinds=kinds)
    assert_consistent(report)
    assert report.altered > 100
    random = np.random.default_rng(1)
    sent = {zlib.crc32(random.integers(0, 2**32, 128, dtype=np.uint32).tobytes()) for _ in range(1000)}
    checked = wire_faults.send(1000, kinds=kinds, bits=lambda words: None if zlib.crc32(words) in sent else "bits")
    assert_consistent(checked)
    assert (checked.altered, checked.rejected_blocks["bits"]) == (0, report.altered)
    assert checked.delivered == report.delivered


def test_blocks_may_come_from_a_recording():
    words = np.arange(1000, dtype=np.uint32)
    seen = []
    report = wire_faults.send(50, words=words, kinds={}, n_samples=64, bits=seen.append)
    assert_consistent(report, 64)
    assert report.delivered == report.sent == len(seen) == 50
    assert all(np.array_equal(np.diff(each.astype(int)), np.ones(63)) for each in seen)
    assert len({int(each[0]) for each in seen}) > 25


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.dictionaries(st.sampled_from(KINDS), st.floats(0, 0.4)), st.booleans())
def test_each_byte_is_counted_once(seed, kinds, short_reads):
    report = wire_faults.send(60, seed=seed, kinds=kinds | {"short_reads": short_reads}, n_samples=16)
    taken = report.delivered + report.altered + report.mixed + report.wrong_counter + report.twice
    assert report.fed == taken * 76 + report.rejected.total() + report.pending
