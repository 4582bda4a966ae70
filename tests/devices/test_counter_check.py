"""Block numbers accepted by a receiver: all numbers that were sent, and no others."""

import numpy as np
import pytest

from ertis_numba.devices.block_receiver import BlockReceiver
from tests.wire import N_BYTES, N_SAMPLES, at, block_of, counters

SHORTEST_S = 0.04
REGULAR = [0.05 * index for index in range(40)]
IRREGULAR = np.cumsum(0.041 + np.random.default_rng(5).exponential(0.1, 40)).tolist()
FIRST = 2**32 - 17  # the counter wraps around
RESET = 10**9


def receive_all(stream, **changes):
    """Return the numbers accepted from (time, bytes) pairs, including those of finish(), and the receiver."""
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
def test_receiver_accepts_consecutive_numbers_at_once(times_s):
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(times_s)):
        assert counters(receiver.feed(data, at(time_s))) == [(FIRST + index) % 2**32]
    assert receiver.lost == 0
    assert not receiver.rejected
    assert not receiver.rejected_blocks


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
@pytest.mark.parametrize("bit", range(32))
def test_receiver_rejects_counter_with_a_flipped_bit(times_s, bit):
    stream = stream_of(times_s)
    damaged = bytearray(stream[20][1])
    damaged[4 + bit // 8] ^= 1 << bit % 8
    stream[20] = (stream[20][0], bytes(damaged))
    found, receiver = receive_all(stream)
    assert found == [index for index in range(40) if index != 20]
    assert receiver.rejected_blocks == {"counter": 1}
    assert receiver.lost == 1


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
@pytest.mark.parametrize("place", [0, 1, 2, 3, 28, 29, 30, 31])
def test_receiver_loses_only_the_block_with_a_damaged_frame(times_s, place):
    stream = stream_of(times_s)
    damaged = bytearray(stream[20][1])
    damaged[place] ^= 0x5A
    stream[20] = (stream[20][0], bytes(damaged))
    found, receiver = receive_all(stream)
    assert found == [index for index in range(40) if index != 20]
    assert receiver.rejected == {"no header" if place < 4 else "footer": N_BYTES}
    assert receiver.lost == 1


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
@pytest.mark.parametrize("n_missing", [1, 2, 5])
@pytest.mark.parametrize("first", [0, 20])
def test_receiver_accepts_blocks_after_missing_ones(times_s, n_missing, first):
    if (first, n_missing) == (0, 5):
        n_missing = 3
    stream = stream_of(times_s)
    del stream[first : first + n_missing]
    found, receiver = receive_all(stream)
    assert found == [index for index in range(40) if not first <= index < first + n_missing]
    assert not receiver.rejected
    assert receiver.lost in ({n_missing} if first else {n_missing - 1, n_missing})


def test_receiver_counts_regular_triggers_by_the_clock():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    stream = stream_of(REGULAR)
    for time_s, data in [*stream[:20], *stream[24:]]:
        assert len(receiver.feed(data, at(time_s))) == 1  # no block is held
    assert receiver.lost == 4


def test_receiver_counts_irregular_triggers_by_partial_blocks():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(IRREGULAR)):
        found = receiver.feed(data[:9] if index in {20, 21} else data, at(time_s))
        assert counters(found) == ([] if index in {20, 21} else [(FIRST + index) % 2**32])
    assert receiver.lost == 2


def test_receiver_holds_uncertain_number_until_confirmed():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    stream = stream_of(IRREGULAR)
    for time_s, data in stream[:20]:
        receiver.feed(data, at(time_s))
    assert receiver.feed(stream[21][1], at(stream[21][0])) == []
    assert receiver.held == 1
    found = receiver.feed(stream[22][1], at(stream[22][0]))
    assert counters(found) == [FIRST + 21 - 2**32, FIRST + 22 - 2**32]
    assert found[0].arrived == at(stream[21][0])


def test_receiver_follows_a_counter_reset():
    stream = stream_of(REGULAR)[:20] + [(time_s, block_of(RESET + index)) for index, time_s in enumerate(REGULAR[20:])]
    found, receiver = receive_all(stream)
    assert found == [*range(20), *range(RESET + 17, RESET + 17 + 20)]
    assert receiver.lost == 0


def test_receiver_recovers_from_a_wrong_first_number():
    stream = stream_of(REGULAR)
    stream[0] = (0.0, block_of(FIRST + 2**20))
    found, _ = receive_all(stream, expected=None)
    assert found == [2**20, *range(1, 40)]


def with_strays(stream):
    """Insert stray bytes between blocks, so that neither clock nor bursts reveal the number of triggers."""
    times_s = [time_s for time_s, _ in stream[1:]]
    return sorted(stream + [(time_s - early_s, b"stray") for time_s in times_s for early_s in (0.05, 0.1, 0.15)])


SPARSE = np.cumsum(0.2 + np.random.default_rng(6).exponential(0.2, 40)).tolist()


def test_receiver_accepts_blocks_between_stray_bytes():
    found, receiver = receive_all(with_strays(stream_of(SPARSE)))
    assert found == list(range(40))
    assert receiver.lost == 0


def test_receiver_follows_counter_reset_between_stray_bytes():
    stream = stream_of(SPARSE)[:5] + [(time_s, block_of(RESET + index)) for index, time_s in enumerate(SPARSE[5:])]
    found, receiver = receive_all(with_strays(stream))
    assert found == [*range(4), *range(RESET + 17, RESET + 17 + 35)]  # the last block before the reset stays uncertain
    assert receiver.lost == 0


def test_receiver_reports_no_gap_for_a_pulse_the_sensor_missed():
    """The next number is accepted at once although the clock predicts a later one."""
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    times_s = REGULAR[:20] + REGULAR[21:30] + REGULAR[33:]
    for time_s, data in stream_of(times_s):
        assert len(receiver.feed(data, at(time_s))) == 1
    assert receiver.lost == 0


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
def test_receiver_accepts_numbers_in_steps_of_two(times_s):
    """The sensor counts all pulses but measures on every second one from some moment on."""
    stream = stream_of(times_s)[:10]
    stream += [(time_s, block_of(FIRST + 10 + 2 * index)) for index, time_s in enumerate(times_s[10:])]
    found, receiver = receive_all(stream)
    assert found == [*range(10), *range(10, 70, 2)]
    assert receiver.lost == 29
    assert not receiver.rejected


def test_receiver_accepts_consistent_blocks_around_a_damaged_one():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    for index, (time_s, data) in enumerate(stream_of(IRREGULAR)[:24]):
        if index != 20:
            found = receiver.feed(data[:-9] if index == 22 else data, at(time_s))
    assert counters(found) == [FIRST + 21 - 2**32, FIRST + 23 - 2**32]


def test_receiver_keeps_a_true_number_among_wrong_ones():
    stream = stream_of(IRREGULAR)
    for index, wrong in ((22, 2**20), (23, 2**21), (24, 2**29)):
        stream[index] = (stream[index][0], block_of(FIRST + index + wrong))
    found, receiver = receive_all(stream[:20] + stream[21:])
    assert found == [index for index in range(40) if index not in {20, 22, 23, 24}]
    assert receiver.rejected_blocks == {"counter": 3}


@pytest.mark.parametrize("times_s", [REGULAR, IRREGULAR])
def test_receiver_rejects_reused_number_of_a_damaged_block(times_s):
    """The counter of the block after a damaged one is flipped to the number of the damaged block."""
    stream = stream_of(times_s)
    stream[20] = (stream[20][0], stream[20][1][:-9])
    stream[21] = (stream[21][0], block_of(FIRST + 20, np.zeros(N_SAMPLES)))
    expected = [index for index in range(40) if index not in {20, 21}]
    assert receive_all(stream)[0] == expected
    assert receive_all(stream[:22] + stream[23:])[0] == [index for index in expected if index != 22]


def test_finish_rejects_reused_number_of_a_damaged_block():
    stream = stream_of(REGULAR)
    stream[20] = (stream[20][0], stream[20][1][:-9])
    stream[21] = (stream[21][0], block_of(FIRST + 20))
    assert receive_all(stream[:22])[0] == list(range(20))


def test_receiver_does_not_count_late_bytes_as_a_trigger():
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    sent = [block_of(FIRST + index) for index in range(3)]
    assert receiver.feed(sent[0][:15], at(0.0)) == []
    assert len(receiver.feed(sent[0][15:], at(0.035))) == 1
    assert receiver.feed(sent[1][:15], at(0.1)) == []
    assert len(receiver.feed(sent[2], at(0.27))) == 1
    assert receiver.lost == 1


def test_finish_counts_blocks_of_one_burst_by_their_bytes():
    """After a pause of the program, a dozen damaged blocks and a whole one arrive together."""
    waiting = b"".join(block_of(FIRST + index)[:-1] for index in range(1, 13))
    assert receive_all([(0, block_of(FIRST)), (0, waiting + block_of(FIRST + 13))])[0] == [0, 13]


def test_receiver_rejects_repeated_blocks():
    stream = stream_of(REGULAR)
    found, receiver = receive_all([(time_s, 2 * data) for time_s, data in stream])
    assert found == list(range(40))
    assert receiver.rejected_blocks == {"counter": 40}


def test_finish_accepts_only_plausible_numbers():
    stream = stream_of(IRREGULAR)
    assert receive_all([*stream[:20], stream[21]])[0] == [*range(20), 21]
    assert receive_all([*stream[:20], stream[30]])[0] == list(range(20))
    found, receiver = receive_all([*stream[:20], (stream[20][0], block_of(FIRST + 120))])
    assert found == list(range(20))
    assert receiver.rejected == {"counter": N_BYTES}


def test_finish_accepts_the_next_number_after_stray_bytes():
    stream = stream_of(IRREGULAR)[:20]
    stray = [(stream[19][0] - 0.04, b"s"), (stream[19][0] - 0.005, b"s")]
    assert receive_all([*stream[:19], *stray, stream[19]])[0] == list(range(20))


@pytest.mark.parametrize(("first", "taken"), [(-1, False), (0, True), (1, True), (2, False), (2**31, False)])
def test_receiver_accepts_expected_number_or_the_next(first, taken):
    receiver = BlockReceiver(N_SAMPLES, expected=FIRST, shortest_s=SHORTEST_S)
    assert len(receiver.feed(block_of(FIRST + first), at(0))) == taken
    assert receiver.held == (not taken)
    assert receiver.lost == 0


def test_receiver_without_expectation_accepts_any_first_number():
    receiver = BlockReceiver(N_SAMPLES, shortest_s=SHORTEST_S)
    assert counters(receiver.feed(block_of(123_456), at(0))) == [123_456]


def test_receiver_finds_expected_number_after_damaged_blocks():
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


def test_expect_discards_held_and_partial_blocks():
    receiver = BlockReceiver(N_SAMPLES, expected=0, shortest_s=SHORTEST_S)
    receiver.feed(block_of(0) + block_of(77) + block_of(1)[:20] + b"\x12", at(0))
    assert (receiver.held, receiver.missing) == (1, N_BYTES - 21)
    receiver.expect(500)
    assert (receiver.held, receiver.missing) == (0, 0)
    assert receiver.rejected_blocks == {"counter": 1, "cut short": 1}
    assert receiver.rejected == {"counter": N_BYTES, "cut short": 21}
    assert counters(receiver.feed(b"late" + block_of(501), at(1))) == [501]


def test_receiver_accepts_next_block_after_a_truncated_one():
    """A commanded measurement is truncated, and the next one is whole."""
    receiver = BlockReceiver(N_SAMPLES, expected=5, shortest_s=SHORTEST_S)
    receiver.feed(block_of(5)[:-3], at(0))
    assert receiver.missing == 3
    assert receiver.expire() == []
    assert counters(receiver.feed(block_of(6), at(0.5))) == [6]
    assert receiver.rejected == {"cut short": N_BYTES - 3}


def test_expire_releases_a_held_block():
    receiver = BlockReceiver(N_SAMPLES, expected=5, shortest_s=SHORTEST_S)
    assert receiver.feed(block_of(7), at(0)) == []
    assert counters(receiver.expire()) == [7]
    assert receiver.held == 0


def test_receiver_rejects_block_with_implausible_samples():
    def reason(words):
        return "too quiet" if not words.any() else None

    stream = stream_of(REGULAR)
    stream[20] = (stream[20][0], block_of(FIRST + 20, [0] * N_SAMPLES))
    found, receiver = receive_all(stream, bits=reason)
    assert found == [index for index in range(40) if index != 20]
    assert receiver.rejected == {"too quiet": N_BYTES}
    assert receiver.rejected_blocks == {"too quiet": 1}
    assert receiver.lost == 0  # its number arrived


def test_receiver_accepts_a_block_that_a_split_burst_makes_seem_early():
    """The clock confirms number 13: it is two intervals before number 15."""
    stream = stream_of(REGULAR)
    stream[10] = (0.52, stream[10][1])  # It is late, so that the clock cannot count from it.
    damaged = block_of(FIRST + 11)[:-8]
    stream[11:13] = [(0.55, damaged[:10]), (0.58, damaged[10:]), (0.612, block_of(FIRST + 12)[:-8])]
    del stream[15]  # Number 14 leaves no trace.
    found, receiver = receive_all(stream)
    assert found == [index for index in range(40) if index not in {11, 12, 14}]
    assert receiver.lost == 3
