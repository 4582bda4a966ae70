"""Emulated devices on real pseudo terminals, through pyserial: answers, measurements and configured quirks."""

import select
import threading
import time
import zlib

import numpy as np
import pytest

from ertis_numba.devices.emulator import Emulator, Quirks
from ertis_numba.devices.setup import call_codes, call_hash
from ertis_numba.settings import Call
from tests.emulated import N_SAMPLES, TIMEOUT_S, WORDS, Log, ask, block, is_block, opened

PASSIVE = [words[::-1].copy() for words in WORDS[:2]]


@pytest.fixture
def device():
    with Emulator(WORDS, passive=PASSIVE) as device:
        yield device


@pytest.fixture
def port(device):
    with opened(device) as port:
        ask(port, b"!G,%d,0,0\n" % (4 * N_SAMPLES))
        yield port


@pytest.fixture
def armed():
    """An armed device with its port and a log."""
    log = Log()
    with Emulator(WORDS, log=log) as device, opened(device) as port:
        for line in (b"!G,%d,0,0\n" % (4 * N_SAMPLES), b"!H,1,0,0\n", b"!J,1,1,0\n"):
            assert ask(port, line) == 1
        yield device, port, log


def test_emulator_stores_configured_registers(device, port):
    assert ask(port, b"!Y,0,0,0\n") == 0x010000
    reported = device.registers
    assert (reported.amplifier, reported.armed, reported.counter) == (1, 0, 0)
    for line in (b"!F,1,0,0\n", b"!D,500000,0,0\n", b"!I,7,0,0\n", b"!H,1,0,0\n", b"!J,1,2,0\n", b"!K,0,0,0\n"):
        assert ask(port, line) == 1
    assert (reported.n_bytes, reported.clock, reported.dac_rate_hz, reported.emissions) == (
        4 * N_SAMPLES,
        1,
        500_000,
        7,
    )
    assert (reported.active, reported.armed, reported.pin, reported.amplifier) == (1, 1, 2, 0)
    assert device.refused == 0


def test_emulator_hash_equals_the_call_hash(port):
    codes = call_codes(Call(duration_s=2e-4))
    assert ask(port, b"!E,%d,0,0\n" % len(codes)) == 1
    for index, code in enumerate(codes):
        port.write(b"!C,%d,%d,0\n" % (index, code))
    assert port.read(4 * len(codes)) == b"\x01\0\0\0" * len(codes)
    assert ask(port, b"!L,0,0,0\n") == call_hash(codes)
    ask(port, b"!E,64,0,0\n")
    assert ask(port, b"!L,0,0,0\n") == call_hash(codes[:64])


@pytest.mark.parametrize(
    "line",
    [
        b"!G,100,0,0\n",
        b"!G,134217728,0,0\n",
        b"!F,2,0,0\n",
        b"!D,159999,0,0\n",
        b"!E,63,0,0\n",
        b"!C,0,1,0\n",
        b"!I,0,0,0\n",
        b"!J,1,3,0\n",
        b"!Z,0,0,0\n",
        b"!G,131072\n",
        b"!J,1,1\n",
        b"hello\n",
        b"!B,4294967296,0,0\n",
        b"x" * 300,
    ],
)
def test_emulator_answers_0_to_invalid_commands_and_counts_them(device, port, line):
    before = {name: value for name, value in vars(device.registers).items() if name != "codes"}
    assert ask(port, line) == 0
    assert device.refused == 1
    assert {name: value for name, value in vars(device.registers).items() if name != "codes"} == before


def test_emulator_numbers_blocks_and_cycles_measurements(port):
    for counter in range(4):
        port.write(b"!A,1,0,0\n")
        assert is_block(block(port), counter, WORDS[counter % 3])
    ask(port, b"!B,4294967295,0,0\n")
    for counter in (2**32 - 1, 0):
        port.write(b"!A,1,0,0\n")
        assert is_block(block(port), counter, WORDS[counter % 3])


@pytest.mark.parametrize(
    ("lines", "given"),
    [((b"!A,0,0,0\n",), PASSIVE), ((b"!K,0,0,0\n", b"!A,1,0,0\n"), PASSIVE), ((b"!A,1,0,0\n",), WORDS)],
)
def test_emulator_sends_passive_samples_without_emission(port, lines, given):
    for line in lines[:-1]:
        ask(port, line)
    for counter in range(3):
        port.write(lines[-1])
        assert is_block(block(port), counter, given[counter % len(given)])


def test_emulator_truncates_or_repeats_samples_to_length():
    with Emulator([np.concatenate([WORDS[0], WORDS[1]])]) as device, opened(device) as port:
        for n_samples in (N_SAMPLES, 3 * N_SAMPLES):
            ask(port, b"!G,%d,0,0\n" % (4 * n_samples))
            port.write(b"!A,0,0,0\n")
            _, words = block(port, n_samples)
            assert np.array_equal(words, np.concatenate([WORDS[0], WORDS[1], WORDS[0]])[:n_samples])


@pytest.mark.alone  # the limit of 5 ms is a wall-clock time
@pytest.mark.parametrize(("clock", "rate_hz"), [(0, 4.5e6), (1, 1.125e6)])
def test_emulator_sends_first_byte_after_measurement_duration(port, clock, rate_hz):
    ask(port, b"!F,%d,0,0\n" % clock)
    late_s = []
    for _ in range(5):
        began_s = time.monotonic()
        port.write(b"!A,1,0,0\n")
        port.read(1)
        late_s.append(time.monotonic() - began_s - N_SAMPLES / rate_hz)
        port.read(4 * N_SAMPLES + 11)
    assert min(late_s) > 0
    assert min(late_s) < 5e-3


def test_emulator_accepts_lines_without_line_feed(device, port):
    port.write(b"!A,1,0,0")
    assert block(port)[0] == 0
    port.write(b"!K,0,0,0!H,1,0,0!Y,0,0,0\n")
    assert port.read(12) == b"\x01\0\0\0\x01\0\0\0\0\0\x01\0"
    assert ask(port, b"!J,1,2,0,0\n") == 1  # as the Linux code of the manufacturer sends it
    assert (device.registers.amplifier, device.registers.active, device.registers.pin) == (0, 1, 2)
    assert device.refused == 0


def test_emulator_waits_for_the_rest_of_a_partial_line(device, port):
    port.write(b"!Y,0,")
    assert not select.select([port.fd], [], [], 0.06)[0]
    assert ask(port, b"0,0\n") == 0x010000
    assert device.refused == 0


def test_emulator_accepts_pulses_only_while_armed(armed):
    device, port, log = armed
    with device._changed:  # noqa: SLF001  its recording takes 7 ms, and cannot end meanwhile
        assert device.trigger()
        assert not device.trigger()
    assert is_block(block(port), 0, WORDS[0])
    assert device.trigger(5)
    assert is_block(block(port), 1, WORDS[2])
    ask(port, b"!J,0,1,0\n")
    assert not device.trigger()
    entries = log.lines(2)
    assert [(entry["index"], entry["counter"], entry["active"]) for entry in entries] == [(0, 0, True), (2, 1, True)]


def test_emulator_records_while_sending(armed):
    device, port, log = armed
    device.quirks = Quirks(bytes_per_s=2e6)  # sending takes 66 ms, and recording takes 7 ms
    assert device.trigger()
    log.lines(1)
    assert device.trigger()
    log.lines(1)  # the second measurement is complete
    assert is_block(block(port), 0, WORDS[0])
    assert is_block(block(port), 1, WORDS[1])


def test_emulator_drops_unread_measurements_whole(armed):
    device, port, log = armed
    for _ in range(5):
        assert device.trigger()
        log.lines(1)
    assert is_block(block(port), 0, WORDS[0])
    assert is_block(block(port), 1, WORDS[1])
    assert device.trigger()
    assert is_block(block(port), 5, WORDS[2])


def test_emulator_logs_sent_dropped_and_unplugged_measurements(armed):
    device, _, log = armed
    entries = []
    for _ in range(3):
        device.trigger()
        entries += log.lines(1)
    assert [entry["fault"] for entry in entries] == ["", "", "dropped"]
    assert [entry["crc32"] for entry in entries] == [zlib.crc32(words.tobytes()) for words in WORDS]
    assert {entry["name"] for entry in entries} == {"emulated"}
    assert abs(entries[0]["time_ns"] - time.time_ns()) < TIMEOUT_S * 1e9
    device.unplug()
    assert [(entry["counter"], entry["fault"]) for entry in log.lines(2)] == [(0, "unplugged"), (1, "unplugged")]


def test_emulator_logs_partially_read_measurement_as_unplugged(armed):
    device, port, log = armed
    device.trigger()
    assert log.lines(1)[0]["fault"] == ""
    block(port)
    assert ask(port, b"!H,1,0,0\n") == 1
    device.trigger()
    assert log.lines(1)[0]["fault"] == ""
    port.read(4 * N_SAMPLES + 12 - 100)
    device.unplug()
    assert log.lines(1)[0] | {"time_ns": 0, "crc32": 0} == {
        "name": "emulated",
        "index": 1,
        "counter": 1,
        "active": True,
        "fault": "unplugged",
        "crc32": 0,
        "time_ns": 0,
    }


def test_emulator_obeys_commands_while_measurements_are_unread(armed):
    device, port, log = armed
    for _ in range(3):
        device.trigger()
        log.lines(1)
    port.write(b"!I,9,0,0\n")
    assert block(port)[0] == 0
    assert block(port)[0] == 1
    assert port.read(4) == b"\x01\0\0\0"  # answers and blocks keep their order
    assert device.registers.emissions == 9


def test_emulator_pauses_commands_while_answers_are_unread(device, port):
    writer = threading.Thread(target=port.write, args=(b"!Y,0,0,0\n" * 60_000,))
    writer.start()
    writer.join(0.2)
    assert writer.is_alive()
    assert len(device._board.outputs) < 30_000  # noqa: SLF001
    assert port.read(240_000) == b"\0\0\1\0" * 60_000
    writer.join(TIMEOUT_S)
    assert not writer.is_alive()


def test_emulator_port_can_be_reopened_for_every_command(device):
    for line, answer in ((b"!Y,0,0,0\n", 0x010000), (b"!G,131072,0,0\n", 1), (b"!B,3,0,0\n", 1)):
        with opened(device) as port:
            port.reset_input_buffer()
            assert ask(port, line) == answer
    with opened(device) as port:
        port.write(b"!A,1,0,0")
        assert is_block(block(port), 3, WORDS[0])


def test_emulator_quirks_make_it_silent_slow_or_wrong(device, port):
    device.quirks = Quirks(wrong_hash=True)
    assert ask(port, b"!L,0,0,0\n") == 1
    device.quirks = Quirks(answer_delay_s=0.05)
    began_s = time.monotonic()
    assert ask(port, b"!Y,0,0,0\n") == 0x010000
    assert time.monotonic() - began_s >= 0.05
    device.quirks = Quirks(silent=True)
    port.write(b"!Y,0,0,0\n!I,5,0,0\n!A,1,0,0\n")
    assert block(port)[0] == 0
    assert device.registers.emissions == 5
    device.quirks = Quirks(bytes_per_s=1e6)
    began_s = time.monotonic()
    port.write(b"!A,1,0,0\n")
    assert is_block(block(port), 1, WORDS[1])
    assert time.monotonic() - began_s - N_SAMPLES / 4.5e6 > 0.1  # 0.131 MB at 1 MB/s


@pytest.mark.alone  # the limit is a wall-clock time
def test_slow_emulator_sends_at_its_rate(device, port):
    device.quirks = Quirks(bytes_per_s=1e6)
    began_s = time.monotonic()
    port.write(b"!A,1,0,0\n")
    assert is_block(block(port), 0, WORDS[0])
    assert 0.1 < time.monotonic() - began_s - N_SAMPLES / 4.5e6 < 1.0  # 0.131 MB at 1 MB/s


@pytest.mark.alone
def test_emulator_close_does_not_wait_for_a_reader(armed):
    device, _, log = armed
    device.trigger()
    log.lines(1)
    began_s = time.monotonic()
    device.close()
    device.close()
    assert time.monotonic() - began_s < 1.0
    assert not any(thread.name == "emulated emulated" for thread in threading.enumerate())
