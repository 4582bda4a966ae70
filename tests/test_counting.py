"""Which numbers a receiver takes: all that were sent, and none that was not."""

import numpy as np
import pytest

from ertis_numba.devices.protocol import BlockReceiver
from tests.wire import N_BYTES, N_SAMPLES, at, block_of, counters

SHORTEST_S = 0.04
REGULAR = [0.05 * index for index in range(40)]
IRREGULAR = np.cumsum(0.041 + np.random.default_rng(5).exponential(0.1, 40)).tolist()
FIRST = 2**32 - 17  # the counter runs over its end
ANEW = 10**9


def heard(stream, **changes):
    """The numbers that a receiver takes of (time, bytes), what it takes when that has ended, and the receiver."""
    receiver = BlockReceiver(N_SAMPLES, **{"expected": FIRST, "shortest_s": SHORTEST_S} | changes)
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
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
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
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    stream = stream_of(REGULAR)
    for time_s, data in [*stream[:20], *stream[24:]]:
        assert len(receiver.feed(data, at(time_s))) == 1  # none is held
    assert receiver.lost == 4


def test_irregular_triggers_are_counted_by_what_came_of_them():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(IRREGULAR)):
        found = receiver.feed(data[:9] if index in {20, 21} else data, at(time_s))
        assert counters(found) == ([] if index in {20, 21} else [(FIRST + index) % 2**32])
    assert receiver.lost == 2


def test_a_number_in_doubt_is_held_until_others_decide():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
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
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
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
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
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
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
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
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    assert len(receiver.feed(block_of(FIRST + first), at(0))) == taken
    assert receiver.held == (not taken)
    assert receiver.lost == 0


def test_any_first_number_is_taken_where_none_is_expected():
    receiver = BlockReceiver(N_SAMPLES, shortest_s=SHORTEST_S)
    assert counters(receiver.feed(block_of(123_456), at(0))) == [123_456]


def test_after_a_counter_was_set_strays_and_damaged_blocks_are_no_hindrance():
    strays = [(0.1 * index, b"stray") for index in range(5)]
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for time_s, data in strays:
        receiver.feed(data, at(time_s))
    assert len(receiver.feed(block_of(FIRST), at(0.5))) == 1
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index in range(5):
        receiver.feed(block_of(FIRST + index)[:-1], at(0.1 * index))
    assert len(receiver.feed(block_of(FIRST + 5), at(0.5))) == 1
    assert receiver.lost == 5


def test_what_is_expected_comes_next_and_what_was_before_does_not():
    receiver = BlockReceiver(N_SAMPLES, expected=0, shortest_s=SHORTEST_S)
    receiver.feed(block_of(0) + block_of(77) + block_of(1)[:20] + b"\x12", at(0))
    assert (receiver.held, receiver.missing) == (1, N_BYTES - 21)
    receiver.expect(500)
    assert (receiver.held, receiver.missing) == (0, 0)
    assert receiver.rejected_blocks == {"counter": 1, "cut short": 1}
    assert receiver.rejected == {"counter": N_BYTES, "cut short": 21}
    assert counters(receiver.feed(b"late" + block_of(501), at(1))) == [501]


def test_a_late_deadline_and_a_later_number():
    """A measurement that was commanded comes to nothing, the next one is whole."""
    receiver = BlockReceiver(N_SAMPLES, expected=5, shortest_s=SHORTEST_S)
    receiver.feed(block_of(5)[:-3], at(0))
    assert receiver.missing == 3
    assert receiver.expire() == []
    assert counters(receiver.feed(block_of(6), at(0.5))) == [6]
    assert receiver.rejected == {"cut short": N_BYTES - 3}


def test_where_nothing_has_begun_a_deadline_decides_what_is_held():
    receiver = BlockReceiver(N_SAMPLES, expected=5, shortest_s=SHORTEST_S)
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
