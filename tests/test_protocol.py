"""Blocks out of bytes: whatever happens to a line, no block is lost but its own victims, and none is made up."""

import itertools
import struct
import time
import zlib

import numpy as np
import pytest
from ertis_bench import wire_faults
from hypothesis import given, settings
from hypothesis import strategies as st

from ertis_numba.devices.commands import FOOTER, HEADER, encode_block
from ertis_numba.devices.faults import KINDS, Faults, Stall, Unplug
from ertis_numba.devices.protocol import BlockParser, Instant, Receiver
from ertis_numba.errors import ArgumentError

N_SAMPLES = 5
N_BYTES = 4 * N_SAMPLES + 12
WORD = struct.Struct("<I")
TRICKY = st.sampled_from([HEADER, FOOTER, 0, HEADER >> 8, HEADER << 8 & 0xFFFF_FFFF, HEADER >> 16])
WORDS = st.lists(TRICKY | st.integers(0, 2**32 - 1), min_size=N_SAMPLES, max_size=N_SAMPLES)
JUNK = st.lists(st.integers(0, 255) | st.sampled_from(list(WORD.pack(HEADER) + WORD.pack(FOOTER)))).map(bytes)


def at(time_s):
    return Instant(10**18 + round(time_s * 1e9), round(time_s * 1e9), 1000)


def block_of(counter, words=None, n_samples=N_SAMPLES):
    if words is None:
        words = np.random.default_rng(counter % 2**32).integers(0, 2**32, n_samples, dtype=np.uint32)
    return encode_block(counter % 2**32, np.asarray(words, dtype=np.uint32))


def told(blocks):
    return [encode_block(block.counter, block.words) for block in blocks]


def counters(blocks):
    return [block.counter for block in blocks]


def fed(data, cuts=()):
    """What a parser makes of a stream that is cut into pieces, each of which comes a second after the other."""
    parser = BlockParser(N_SAMPLES)
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    found = []
    for second, (begin, end) in enumerate(itertools.pairwise(edges)):
        found += parser.feed(data[begin:end], at(second))
    assert len(found) * N_BYTES + parser.rejected.total() + parser.pending == len(data)
    assert parser.missing == (N_BYTES - parser.pending if parser.pending else 0)
    return parser, found


@given(st.lists(WORDS.map(lambda words: block_of(3, words)) | JUNK, max_size=6).map(b"".join), st.lists(st.integers(0)))
def test_it_does_not_matter_how_a_stream_is_cut(data, cuts):
    whole, found = fed(data)
    pieces, found_again = fed(data, cuts)
    assert told(found_again) == told(found)
    for name in ("rejected", "rejected_blocks", "pending"):
        assert getattr(pieces, name) == getattr(whole, name)


@given(st.lists(WORDS, min_size=1, max_size=5), st.integers(0, 2**32 - 1))
def test_what_was_sent_without_faults_is_received(sent, first):
    """False headers and footers in the words cost nothing as long as each block directly follows another."""
    data = [block_of(first + 1000 * index, words) for index, words in enumerate(sent)]
    parser, found = fed(b"".join(data))
    assert told(found) == data
    assert not parser.rejected


@given(st.integers(0, N_BYTES - 1), st.integers(1, N_BYTES), st.binary(max_size=2 * N_BYTES), st.integers(0))
def test_no_damage_costs_a_block_but_its_own(place, n_lost, added, seed):
    """Bytes are lost, and others come in their place, at any alignment."""
    before, victim, after, last = (block_of(10 * seed + index) for index in range(4))
    damaged = victim[:place] + added + victim[place + n_lost :]
    _, found = fed(before + damaged + after + last)
    alone = told(found)
    assert alone[:1] == [before]
    assert alone[-2:] == [after, last]
    assert all(other in damaged for other in alone[1:-2])


@given(st.data())
def test_one_after_another_is_found_behind_any_junk(data):
    """Random bytes with whole headers among them: a header of junk costs no block either."""
    junk = data.draw(st.lists(JUNK | st.just(WORD.pack(HEADER)), max_size=4).map(b"".join))
    sent = [block_of(index) for index in range(3)]
    _, found = fed(junk + b"".join(sent))
    assert told(found)[-3:] == sent


def test_the_header_of_a_junk_block_within_words_costs_nothing():
    """Behind a damaged block, where nobody knows whether a header is one, words that hold headers are searched."""
    damaged = block_of(1)[:-1]
    sent = [block_of(index, [HEADER, 7, HEADER, FOOTER, HEADER]) for index in (2, 3)]
    parser, found = fed(damaged + b"".join(sent))
    assert told(found) == sent
    assert parser.rejected == {"footer": N_BYTES - 1}
    assert parser.rejected_blocks == {"footer": 1}


@pytest.mark.parametrize(("later_s", "taken"), [(0.05, [3]), (0.02, [1, 3])])
def test_two_damaged_blocks_that_have_the_right_length_together_are_none(later_s, taken):
    """The header of the second tells if it came later; else it might as well be one of the first one's words."""
    first, second, third = block_of(1), block_of(2), block_of(3)
    parser = BlockParser(N_SAMPLES, apart_s=0.03)
    assert parser.feed(first[:12], at(0)) == []
    found = parser.feed(second[:16] + second[28:] + third, at(later_s))
    assert counters(found) == taken
    assert parser.rejected_blocks == ({"cut short": 1, "footer": 1} if taken == [3] else {})


def test_rejected_bytes_have_reasons():
    parser, _ = fed(b"abc" + block_of(0)[:-1] + block_of(1) + b"de" + block_of(2)[:-2])
    assert parser.rejected == {"no header": 5, "footer": N_BYTES - 1}
    assert parser.missing == 2
    assert parser.expire() == []
    assert parser.rejected == {"no header": 5, "footer": N_BYTES - 1, "cut short": N_BYTES - 2}
    assert parser.rejected_blocks == {"cut short": 1, "footer": 1}
    assert parser.missing == 0


def test_after_a_deadline_the_rest_is_searched_for_the_block_that_has_begun_since():
    parser = BlockParser(N_SAMPLES)
    parser.feed(block_of(1)[:14] + block_of(2)[:10], at(0))
    parser.expire()
    assert parser.missing == N_BYTES - 10
    assert told(parser.feed(block_of(2)[10:], at(1))) == [block_of(2)]
    assert parser.rejected == {"cut short": 14}


def test_a_part_of_a_header_may_be_given_up():
    parser = BlockParser(N_SAMPLES)
    parser.feed(b"x" + WORD.pack(HEADER)[:3], at(0))
    assert parser.missing == N_BYTES - 3
    parser.expire()
    assert parser.missing == 0
    parser.expire()  # nothing has begun, nothing happens
    assert parser.rejected == {"no header": 4}
    assert not parser.rejected_blocks


def test_a_block_arrives_with_its_first_byte():
    parser = BlockParser(N_SAMPLES)
    stream = b"abc" + block_of(1) + block_of(2) + block_of(3)
    found = []
    for place in range(0, len(stream), 7):
        found += parser.feed(stream[place : place + 7], at(place))
    firsts = [3, 3 + N_BYTES, 3 + 2 * N_BYTES]
    assert [block.arrived for block in found] == [at(first - first % 7) for first in firsts]


def test_a_block_that_was_searched_for_arrives_with_its_first_byte_too():
    parser = BlockParser(N_SAMPLES)
    parser.feed(block_of(1)[:-5], at(1))
    parser.feed(block_of(2)[:20], at(2))
    [block] = parser.feed(block_of(2)[20:], at(3))
    assert block.arrived == at(2)


def test_words_have_memory_of_their_own():
    parser = BlockParser(N_SAMPLES)
    [block] = parser.feed(block_of(1), at(0))
    assert block.words.flags.owndata
    assert not block.words.flags.writeable
    assert block.words.dtype == np.uint32
    parser.feed(block_of(2), at(0))
    assert told([block]) == [block_of(1)]


@pytest.mark.alone
def test_a_block_takes_two_milliseconds_at_most():
    receiver = Receiver(163_840, expected=0, shortest_s=0.04)
    times_s = []
    for counter in range(20):
        data = block_of(counter, n_samples=163_840)
        pieces = [data[begin : begin + 4095] for begin in range(0, len(data), 4095)]
        began = time.perf_counter()
        found = [block for piece in pieces for block in receiver.feed(piece, at(0.05 * counter))]
        times_s.append(time.perf_counter() - began)
        assert counters(found) == [counter]
    assert np.median(times_s) < 2e-3


def test_the_time_for_a_stream_does_not_grow_with_its_pieces_squared():
    """A block of 8 MB in pieces of 512 bytes: copied at each, that would be 70 GB."""
    data = block_of(1, n_samples=2**21)
    parser = BlockParser(2**21)
    began = time.process_time()
    found = [b for place in range(0, len(data), 512) for b in parser.feed(data[place : place + 512], at(0))]
    assert counters(found) == [1]
    assert time.process_time() - began < 2


# The receiver

SHORTEST_S = 0.04
REGULAR = [0.05 * index for index in range(40)]
IRREGULAR = np.cumsum(0.041 + np.random.default_rng(5).exponential(0.1, 40)).tolist()
FIRST = 2**32 - 17  # the counter runs over its end
ANEW = 10**9


def heard(stream, **changes):
    """The numbers that a receiver takes of (time, bytes), what it takes when that has ended, and the receiver."""
    receiver = Receiver(N_SAMPLES, **{"expected": FIRST, "shortest_s": SHORTEST_S} | changes)
    found = [block for time_s, data in stream for block in receiver.feed(data, at(time_s))]
    n_bytes = sum(len(data) for _, data in stream)
    assert n_bytes == (len(found) + receiver.held) * N_BYTES + receiver.rejected.total() + receiver.pending
    found += receiver.finish()
    assert n_bytes == len(found) * N_BYTES + receiver.rejected.total()
    assert receiver.held == receiver.pending == receiver.missing == 0
    return [(block.counter - FIRST) % 2**32 for block in found], receiver


def stream_of(times_s):
    return [(time_s, block_of(FIRST + index)) for index, time_s in enumerate(times_s)]


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
def test_numbers_that_follow_are_taken_at_once(times_s):
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(times_s)):
        assert counters(receiver.feed(data, at(time_s))) == [(FIRST + index) % 2**32]
    assert receiver.lost == 0
    assert not receiver.rejected
    assert not receiver.rejected_blocks


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
@pytest.mark.parametrize("bit", range(32))
def test_a_counter_with_a_flipped_bit_is_not_taken(times_s, bit):
    stream = stream_of(times_s)
    damaged = bytearray(stream[20][1])
    damaged[4 + bit // 8] ^= 1 << bit % 8
    stream[20] = (stream[20][0], bytes(damaged))
    found, receiver = heard(stream)
    assert found == [index for index in range(40) if index != 20]
    assert receiver.rejected_blocks == {"counter": 1}
    assert receiver.lost == 1


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
@pytest.mark.parametrize("place", [0, 1, 2, 3, 28, 29, 30, 31])
def test_a_header_or_footer_with_a_flipped_byte_costs_its_block(times_s, place):
    stream = stream_of(times_s)
    damaged = bytearray(stream[20][1])
    damaged[place] ^= 0x5A
    stream[20] = (stream[20][0], bytes(damaged))
    found, receiver = heard(stream)
    assert found == [index for index in range(40) if index != 20]
    assert receiver.rejected == {"no header" if place < 4 else "footer": N_BYTES}
    assert receiver.lost == 1


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
@pytest.mark.parametrize("n_missing", [1, 2, 5])
@pytest.mark.parametrize("first", [0, 20])
def test_what_comes_after_blocks_that_never_came_is_taken(times_s, n_missing, first):
    if (first, n_missing) == (0, 5):
        n_missing = 3
    stream = stream_of(times_s)
    del stream[first : first + n_missing]
    found, receiver = heard(stream)
    assert found == [index for index in range(40) if not first <= index < first + n_missing]
    assert not receiver.rejected
    assert receiver.lost in ({n_missing} if first else {n_missing - 1, n_missing})


def test_regular_triggers_are_counted_by_the_clock():
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    stream = stream_of(REGULAR)
    for time_s, data in [*stream[:20], *stream[24:]]:
        assert len(receiver.feed(data, at(time_s))) == 1  # none is held
    assert receiver.lost == 4


def test_irregular_triggers_are_counted_by_what_came_of_them():
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(IRREGULAR)):
        found = receiver.feed(data[:9] if index in {20, 21} else data, at(time_s))
        assert counters(found) == ([] if index in {20, 21} else [(FIRST + index) % 2**32])
    assert receiver.lost == 2


def test_a_number_in_doubt_is_held_until_others_decide():
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    stream = stream_of(IRREGULAR)
    for time_s, data in stream[:20]:
        receiver.feed(data, at(time_s))
    assert receiver.feed(stream[21][1], at(stream[21][0])) == []
    assert receiver.held == 1
    found = receiver.feed(stream[22][1], at(stream[22][0]))
    assert counters(found) == [FIRST + 21 - 2**32, FIRST + 22 - 2**32]
    assert found[0].arrived == at(stream[21][0])


def test_a_sensor_that_begins_anew_is_followed():
    stream = stream_of(REGULAR)[:20] + [(time_s, block_of(ANEW + index)) for index, time_s in enumerate(REGULAR[20:])]
    found, receiver = heard(stream)
    assert found == [*range(20), *range(ANEW + 17, ANEW + 17 + 20)]
    assert receiver.lost == 0


def test_a_wrong_first_number_is_recovered_from():
    stream = stream_of(REGULAR)
    stream[0] = (0.0, block_of(FIRST + 2**20))
    found, _ = heard(stream, expected=None)
    assert found == [2**20, *range(1, 40)]


def with_strays(stream):
    """Stray bytes come between any two, so that neither clock nor bursts can tell how many triggers there were."""
    times_s = [time_s for time_s, _ in stream[1:]]
    return sorted(stream + [(time_s - early_s, b"stray") for time_s in times_s for early_s in (0.05, 0.1, 0.15)])


SPARSE = np.cumsum(0.2 + np.random.default_rng(6).exponential(0.2, 40)).tolist()


def test_blocks_between_which_there_are_strays_follow_all_the_same():
    found, receiver = heard(with_strays(stream_of(SPARSE)))
    assert found == list(range(40))
    assert receiver.lost == 0


def test_a_sensor_that_begins_anew_is_followed_between_strays():
    stream = stream_of(SPARSE)[:5] + [(time_s, block_of(ANEW + index)) for index, time_s in enumerate(SPARSE[5:])]
    found, receiver = heard(with_strays(stream))
    assert found == [*range(4), *range(ANEW + 17, ANEW + 17 + 35)]  # the last one before is in doubt and stays it
    assert receiver.lost == 0


def test_a_pulse_that_a_sensor_has_missed_is_no_gap():
    """The number that follows is taken at once although the clock says that it should be another."""
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    times_s = REGULAR[:20] + REGULAR[21:30] + REGULAR[33:]
    for time_s, data in stream_of(times_s):
        assert len(receiver.feed(data, at(time_s))) == 1
    assert receiver.lost == 0


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
def test_numbers_may_go_by_twos(times_s):
    """A sensor that counts pulses but serves every second one, from some moment on."""
    stream = stream_of(times_s)[:10]
    stream += [(time_s, block_of(FIRST + 10 + 2 * index)) for index, time_s in enumerate(times_s[10:])]
    found, receiver = heard(stream)
    assert found == [*range(10), *range(10, 70, 2)]
    assert receiver.lost == 29
    assert not receiver.rejected


def test_two_that_agree_over_a_damaged_one_are_taken_at_once():
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(IRREGULAR)[:24]):
        if index != 20:
            found = receiver.feed(data[:-9] if index == 22 else data, at(time_s))
    assert counters(found) == [FIRST + 21 - 2**32, FIRST + 23 - 2**32]


def test_a_true_number_outlives_many_wrong_ones():
    stream = stream_of(IRREGULAR)
    for index, wrong in ((22, 2**20), (23, 2**21), (24, 2**29)):
        stream[index] = (stream[index][0], block_of(FIRST + index + wrong))
    found, receiver = heard(stream[:20] + stream[21:])
    assert found == [index for index in range(40) if index not in {20, 22, 23, 24}]
    assert receiver.rejected_blocks == {"counter": 3}


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
def test_a_number_of_a_damaged_block_is_not_another_ones(times_s):
    """The counter of the block behind a damaged one is flipped to just that one's number."""
    stream = stream_of(times_s)
    stream[20] = (stream[20][0], stream[20][1][:-9])
    stream[21] = (stream[21][0], block_of(FIRST + 20, np.zeros(N_SAMPLES)))
    expected = [index for index in range(40) if index not in {20, 21}]
    assert heard(stream)[0] == expected
    assert heard(stream[:22] + stream[23:])[0] == [index for index in expected if index != 22]


def test_a_number_of_a_damaged_block_is_not_another_ones_in_the_end():
    stream = stream_of(REGULAR)
    stream[20] = (stream[20][0], stream[20][1][:-9])
    stream[21] = (stream[21][0], block_of(FIRST + 20))
    assert heard(stream[:22])[0] == list(range(20))


def test_bytes_that_come_late_are_no_trigger_of_their_own():
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    sent = [block_of(FIRST + index) for index in range(3)]
    assert receiver.feed(sent[0][:15], at(0.0)) == []
    assert len(receiver.feed(sent[0][15:], at(0.035))) == 1
    assert receiver.feed(sent[1][:15], at(0.1)) == []
    assert len(receiver.feed(sent[2], at(0.27))) == 1
    assert receiver.lost == 1


def test_what_comes_all_at_once_is_counted_by_its_bytes_in_the_end():
    """The program was stopped for a while: a dozen damaged blocks and a whole one wait for it."""
    waiting = b"".join(block_of(FIRST + index)[:-1] for index in range(1, 13))
    assert heard([(0, block_of(FIRST)), (0, waiting + block_of(FIRST + 13))])[0] == [0, 13]


def test_a_copy_is_not_taken():
    stream = stream_of(REGULAR)
    found, receiver = heard([(time_s, 2 * data) for time_s, data in stream])
    assert found == list(range(40))
    assert receiver.rejected_blocks == {"counter": 40}


def test_numbers_that_have_room_are_taken_in_the_end_and_others_are_not():
    stream = stream_of(IRREGULAR)
    assert heard([*stream[:20], stream[21]])[0] == [*range(20), 21]
    assert heard([*stream[:20], stream[30]])[0] == list(range(20))
    found, receiver = heard([*stream[:20], (stream[20][0], block_of(FIRST + 120))])
    assert found == list(range(20))
    assert receiver.rejected == {"counter": N_BYTES}


def test_the_next_number_is_taken_in_the_end_whatever_came_before():
    stream = stream_of(IRREGULAR)[:20]
    stray = [(stream[19][0] - 0.04, b"s"), (stream[19][0] - 0.005, b"s")]
    assert heard([*stream[:19], *stray, stream[19]])[0] == list(range(20))


@pytest.mark.parametrize(("first", "taken"), [(-1, False), (0, True), (1, True), (2, False), (2**31, False)])
def test_after_a_counter_was_set_its_number_or_the_next_comes(first, taken):
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    assert len(receiver.feed(block_of(FIRST + first), at(0))) == taken
    assert receiver.held == (not taken)
    assert receiver.lost == 0


def test_any_first_number_is_taken_where_none_is_expected():
    receiver = Receiver(N_SAMPLES, shortest_s=SHORTEST_S)
    assert counters(receiver.feed(block_of(123_456), at(0))) == [123_456]


def test_after_a_counter_was_set_strays_and_damaged_blocks_are_no_hindrance():
    strays = [(0.1 * index, b"stray") for index in range(5)]
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for time_s, data in strays:
        receiver.feed(data, at(time_s))
    assert len(receiver.feed(block_of(FIRST), at(0.5))) == 1
    receiver = Receiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index in range(5):
        receiver.feed(block_of(FIRST + index)[:-1], at(0.1 * index))
    assert len(receiver.feed(block_of(FIRST + 5), at(0.5))) == 1
    assert receiver.lost == 5


def test_what_is_expected_comes_next_and_what_was_before_does_not():
    receiver = Receiver(N_SAMPLES, expected=0, shortest_s=SHORTEST_S)
    receiver.feed(block_of(0) + block_of(77) + block_of(1)[:20] + b"\x12", at(0))
    assert (receiver.held, receiver.missing) == (1, N_BYTES - 21)
    receiver.expect(500)
    assert (receiver.held, receiver.missing) == (0, 0)
    assert receiver.rejected_blocks == {"counter": 1, "cut short": 1}
    assert receiver.rejected == {"counter": N_BYTES, "cut short": 21}
    assert counters(receiver.feed(b"late" + block_of(501), at(1))) == [501]


def test_a_late_deadline_and_a_later_number():
    """A measurement that was commanded comes to nothing, the next one is whole."""
    receiver = Receiver(N_SAMPLES, expected=5, shortest_s=SHORTEST_S)
    receiver.feed(block_of(5)[:-3], at(0))
    assert receiver.missing == 3
    assert receiver.expire() == []
    assert counters(receiver.feed(block_of(6), at(0.5))) == [6]
    assert receiver.rejected == {"cut short": N_BYTES - 3}


def test_where_nothing_has_begun_a_deadline_decides_what_is_held():
    receiver = Receiver(N_SAMPLES, expected=5, shortest_s=SHORTEST_S)
    assert receiver.feed(block_of(7), at(0)) == []
    assert counters(receiver.expire()) == [7]
    assert receiver.held == 0


def test_bits_have_the_last_word():
    def reason(words):
        return "too quiet" if not words.any() else None

    stream = stream_of(REGULAR)
    stream[20] = (stream[20][0], block_of(FIRST + 20, [0] * N_SAMPLES))
    found, receiver = heard(stream, bits=reason)
    assert found == [index for index in range(40) if index != 20]
    assert receiver.rejected == {"too quiet": N_BYTES}
    assert receiver.rejected_blocks == {"too quiet": 1}
    assert receiver.lost == 0  # its number came


# Faults


def spoilt_blocks(kinds, count=200, seed=3, size=500):
    faults = Faults(seed, kinds)
    return [(block, faults.spoil(block)) for block in (block_of(index, n_samples=size) for index in range(count))]


def test_faults_are_the_same_for_the_same_seed():
    kinds = dict.fromkeys(KINDS, 0.3) | {"short_reads": True}
    first, again, other = (spoilt_blocks(kinds, seed=seed) for seed in (3, 3, 4))
    assert first == again
    assert first != other


def test_without_faults_blocks_stay_as_they_are():
    for block, spoilt in spoilt_blocks({}):
        assert (spoilt.data, spoilt.note, spoilt.faults) == (block, "", ())
        assert len(spoilt.pieces) == 1  # shorter than a terminal's buffer
    for block, spoilt in spoilt_blocks({"short_reads": True}, size=5000, count=20):
        assert (spoilt.data, spoilt.note) == (block, "")
        assert all(1 <= len(piece) <= 4095 for piece in spoilt.pieces)
        assert len({len(piece) for piece in spoilt.pieces}) > 3


def _as_told(block, fault, spoilt):
    """What one fault makes of a block, by its note."""
    place, count = fault.place, fault.n_bytes
    again = int(fault.detail.removeprefix("at ")) if fault.kind == "swap" else place
    left = {"add": block, "duplicate": block, "stall": block, "cut": block[:place], "unplug": block[:place]}
    rest = left.get(fault.kind, block[:place] + block[place + count :])
    n_new = {"lose": 0, "stall": 0, "cut": 0, "drop": 0, "unplug": 0}.get(fault.kind, count)
    return rest[:again] + spoilt.data[again : again + n_new] + rest[again:]


@pytest.mark.parametrize("kind", KINDS)
def test_notes_tell_what_was_done(kind):
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


def test_half_of_all_flips_are_in_the_frame_and_half_of_all_losses_whole_words():
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


def test_stalls_have_a_length_and_a_limit():
    faults = Faults(1, {"stall": 1.0}, longest_stall_s=0.5)
    stalls = [piece.duration_s for _ in range(50) for piece in faults.spoil(block_of(1)).pieces if type(piece) is Stall]
    assert len(stalls) == 50
    assert 0.25 < max(stalls) <= 0.5


def test_even_a_block_of_nothing_may_be_spoilt():
    faults = Faults(1, dict.fromkeys(KINDS, 0.5))
    for _ in range(300):
        faults.spoil(encode_block(0, np.zeros(0, np.uint32)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kinds": {"loose": 0.1}}, r"kind of fault 'loose' is unknown \(did you mean 'lose'\?\)"),
        ({"kinds": {"lose": 1.1}}, "probability of lose is 1.1; give a number from 0 to 1"),
        ({"seed": -1}, "seed is -1; give a whole number of at least 0"),
        ({"longest_stall_s": -1}, "longest_stall_s is -1; give a number from 0 to 3600"),
    ],
)
def test_faults_that_there_are_not(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        Faults(**arguments)


# Both together


def lawful(report, n_samples=128):
    """Of what the frame can tell, everything is told right, and each byte is counted once."""
    taken = report.delivered + report.altered + report.mixed + report.wrong_counter + report.twice
    assert report.fed == taken * (4 * n_samples + 12) + report.rejected.total() + report.pending
    assert report.untouched_lost == report.mixed == report.wrong_counter == report.twice == 0


@pytest.mark.parametrize("triggers", ["regular", "irregular"])
@pytest.mark.parametrize("deadline_s", [None, 0.01])
def test_a_line_with_faults_on_half_of_all_blocks(triggers, deadline_s):
    report = wire_faults.send(3000, triggers=triggers, deadline_s=deadline_s)
    lawful(report)
    assert 0.4 < report.spoilt / report.sent < 0.6
    assert report.untouched < report.delivered < report.sent
    assert report.delivered + report.altered + report.lost > 0.95 * report.sent  # nearly all are accounted for
    assert set(report.rejected) == {"no header", "footer", "counter", "cut short"}


def test_what_is_altered_within_the_words_is_told_by_bits_only():
    """Here the bits tell everything, since they are compared with those of all blocks."""
    kinds = {"flip": 0.3, "swap": 0.3}
    report = wire_faults.send(1000, kinds=kinds)
    lawful(report)
    assert report.altered > 100
    random = np.random.default_rng(1)
    sent = {zlib.crc32(random.integers(0, 2**32, 128, dtype=np.uint32).tobytes()) for _ in range(1000)}
    checked = wire_faults.send(1000, kinds=kinds, bits=lambda words: None if zlib.crc32(words) in sent else "bits")
    lawful(checked)
    assert (checked.altered, checked.rejected_blocks["bits"]) == (0, report.altered)
    assert checked.delivered == report.delivered


def test_blocks_may_be_stretches_of_a_recording():
    words = np.arange(1000, dtype=np.uint32)
    seen = []
    report = wire_faults.send(50, words=words, kinds={}, n_samples=64, bits=seen.append)
    lawful(report, 64)
    assert report.delivered == report.sent == len(seen) == 50
    assert all(np.array_equal(np.diff(each.astype(int)), np.ones(63)) for each in seen)
    assert len({int(each[0]) for each in seen}) > 25


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.dictionaries(st.sampled_from(KINDS), st.floats(0, 0.4)), st.booleans())
def test_each_byte_is_counted_once_whatever_happens(seed, kinds, short_reads):
    report = wire_faults.send(60, seed=seed, kinds=kinds | {"short_reads": short_reads}, n_samples=16)
    taken = report.delivered + report.altered + report.mixed + report.wrong_counter + report.twice
    assert report.fed == taken * 76 + report.rejected.total() + report.pending
