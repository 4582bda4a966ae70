"""Emulated devices on real pseudo terminals, through pyserial: they answer, measure, and fail as they are told."""

import json
import os
import queue
import select
import signal
import subprocess
import sys
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import serial

from ertis_numba.devices.commands import FOOTER, HEADER, call_codes, call_hash
from ertis_numba.devices.emulator import Emulator, Quirks
from ertis_numba.devices.faults import Faults
from ertis_numba.devices.places import HeldLink, emulated_folder
from ertis_numba.devices.sync_chain import SyncChain
from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.settings import Call, Recording, Settings
from ertis_numba.storage import write_recording

N_SAMPLES = 32_768
DURATION_S = N_SAMPLES / 4.5e6
WORDS = [np.random.default_rng(index).integers(0, 2**32, N_SAMPLES, dtype=np.uint32) for index in range(3)]
PASSIVE = [words[::-1].copy() for words in WORDS[:2]]
MODULE = [sys.executable, "-m", "ertis_cli", "emulate"]
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
TIMEOUT_S = 20.0


class Log(queue.Queue):
    """A log whose lines can be waited for."""

    def write(self, text):
        self.put(json.loads(text))

    def flush(self):
        pass

    def lines(self, count):
        return [self.get(timeout=TIMEOUT_S) for _ in range(count)]


class Numbered:
    """Measurements whose words tell their number."""

    def __len__(self):
        return 1_000_000

    def __getitem__(self, index):
        return np.full(N_SAMPLES, index, np.uint32)


def opened(device):
    return serial.Serial(device.port, 115_200, timeout=TIMEOUT_S)


def ask(port, line):
    port.write(line)
    return int.from_bytes(port.read(4), "little")


def block(port, n_samples=N_SAMPLES):
    data = np.frombuffer(port.read(4 * n_samples + 12), "<u4")
    assert (data[0], data[-1], len(data)) == (HEADER, FOOTER, n_samples + 3)
    return int(data[1]), data[2:-1]


def is_block(came, counter, words):
    return came[0] == counter and np.array_equal(came[1], words)


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
    """A device that pulses trigger, with a log, and its port."""
    log = Log()
    with Emulator(WORDS, log=log) as device, opened(device) as port:
        for line in (b"!G,%d,0,0\n" % (4 * N_SAMPLES), b"!H,1,0,0\n", b"!J,1,1,0\n"):
            assert ask(port, line) == 1
        yield device, port, log


def test_it_remembers_what_it_is_told(device, port):
    assert ask(port, b"!Y,0,0,0\n") == 0x010000
    told = device.registers
    assert (told.amplifier, told.armed, told.counter) == (1, 0, 0)
    for line in (b"!F,1,0,0\n", b"!D,500000,0,0\n", b"!I,7,0,0\n", b"!H,1,0,0\n", b"!J,1,2,0\n", b"!K,0,0,0\n"):
        assert ask(port, line) == 1
    assert (told.n_bytes, told.clock, told.dac_rate_hz, told.emissions) == (4 * N_SAMPLES, 1, 500_000, 7)
    assert (told.active, told.armed, told.pin, told.amplifier) == (1, 1, 2, 0)
    assert device.refused == 0


def test_its_hash_is_that_of_the_call(port):
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
def test_what_is_no_command_is_answered_by_0_and_counted(device, port, line):
    before = {name: value for name, value in vars(device.registers).items() if name != "codes"}
    assert ask(port, line) == 0
    assert device.refused == 1
    assert {name: value for name, value in vars(device.registers).items() if name != "codes"} == before


def test_measurements_are_numbered_and_have_the_words_of_their_number(port):
    for counter in range(4):
        port.write(b"!A,1,0,0\n")
        assert is_block(block(port), counter, WORDS[counter % 3])
    ask(port, b"!B,4294967295,0,0\n")
    for counter in (2**32 - 1, 0):
        port.write(b"!A,1,0,0\n")
        assert is_block(block(port), counter, WORDS[counter % 3])


@pytest.mark.parametrize(
    ("lines", "given"), [((b"!A,0,0,0\n",), PASSIVE), ((b"!K,0,0,0\n", b"!A,1,0,0\n"), PASSIVE), ((b"!A,1,0,0\n",), WORDS)]
)
def test_without_emission_the_passive_words_are_heard(port, lines, given):
    for line in lines[:-1]:
        ask(port, line)
    for counter in range(3):
        port.write(lines[-1])
        assert is_block(block(port), counter, given[counter % len(given)])


def test_words_are_cut_or_go_on_from_the_beginning():
    words = WORDS[0][:40_000]
    with Emulator([np.concatenate([WORDS[0], WORDS[1]])]) as device, opened(device) as port:
        for n_samples in (N_SAMPLES, 3 * N_SAMPLES):
            ask(port, b"!G,%d,0,0\n" % (4 * n_samples))
            port.write(b"!A,0,0,0\n")
            _, words = block(port, n_samples)
            assert np.array_equal(words, np.concatenate([WORDS[0], WORDS[1], WORDS[0]])[:n_samples])


@pytest.mark.parametrize(("clock", "rate_hz"), [(0, 4.5e6), (1, 1.125e6)])
def test_the_first_byte_comes_when_the_measurement_is_complete(port, clock, rate_hz):
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


def test_a_line_without_end_is_taken_when_it_is_left_or_the_next_begins(device, port):
    port.write(b"!A,1,0,0")
    assert block(port)[0] == 0
    port.write(b"!K,0,0,0!H,1,0,0!Y,0,0,0\n")
    assert port.read(12) == b"\x01\0\0\0\x01\0\0\0\0\0\x01\0"
    assert ask(port, b"!J,1,2,0,0\n") == 1  # the authors' code for Linux
    assert (device.registers.amplifier, device.registers.active, device.registers.pin) == (0, 1, 2)
    assert device.refused == 0


def test_a_line_that_is_no_command_yet_waits_for_the_rest(device, port):
    port.write(b"!Y,0,")
    assert not select.select([port.fd], [], [], 0.06)[0]
    assert ask(port, b"0,0\n") == 0x010000
    assert device.refused == 0


def test_pulses_count_while_the_trigger_is_on(armed):
    device, port, log = armed
    assert device.trigger()
    assert not device.trigger()  # it records
    assert is_block(block(port), 0, WORDS[0])
    assert device.trigger(5)
    assert is_block(block(port), 1, WORDS[2])
    ask(port, b"!J,0,1,0\n")
    assert not device.trigger()
    entries = log.lines(2)
    assert [(entry["index"], entry["counter"], entry["active"]) for entry in entries] == [(0, 0, True), (2, 1, True)]


def test_it_records_while_it_sends(armed):
    device, port, log = armed
    device.quirks = Quirks(bytes_per_s=2e6)  # 66 ms for one, which is recorded in 7
    assert device.trigger()
    log.lines(1)
    assert device.trigger()
    log.lines(1)  # the second is complete
    assert is_block(block(port), 0, WORDS[0])
    assert is_block(block(port), 1, WORDS[1])


def test_what_nobody_reads_is_dropped_as_a_whole(armed):
    device, port, log = armed
    for _ in range(5):
        assert device.trigger()
        log.lines(1)
    assert is_block(block(port), 0, WORDS[0])
    assert is_block(block(port), 1, WORDS[1])
    assert device.trigger()
    assert is_block(block(port), 5, WORDS[2])


def test_the_log_tells_what_was_sent_and_what_was_not(armed):
    device, port, log = armed
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


def test_a_measurement_that_was_sent_but_not_read_is_logged_as_lost(armed):
    device, port, log = armed
    device.trigger()
    assert log.lines(1)[0]["fault"] == ""
    assert ask_after(port, device) == 1
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


def ask_after(port, device):
    block(port)
    return ask(port, b"!H,1,0,0\n")


def test_commands_are_obeyed_while_nobody_reads_measurements(armed):
    device, port, log = armed
    for _ in range(3):
        device.trigger()
        log.lines(1)
    port.write(b"!I,9,0,0\n")
    assert block(port)[0] == 0
    assert block(port)[0] == 1
    assert port.read(4) == b"\x01\0\0\0"  # in the order in which they came about
    assert device.registers.emissions == 9


def test_a_host_may_open_the_port_for_every_command(device):
    for line, answer in ((b"!Y,0,0,0\n", 0x010000), (b"!G,131072,0,0\n", 1), (b"!B,3,0,0\n", 1)):
        with opened(device) as port:
            port.reset_input_buffer()
            assert ask(port, line) == answer
    with opened(device) as port:
        port.write(b"!A,1,0,0")
        assert is_block(block(port), 3, WORDS[0])


def test_faults_spoil_what_is_sent_and_are_logged():
    log = Log()
    faults = Faults(3, {"flip": 0.5, "short_reads": True})
    with Emulator(WORDS, log=log, faults=faults) as device, opened(device) as port:
        ask(port, b"!G,131072,0,0\n")
        changed = []
        for counter in range(6):
            port.write(b"!A,1,0,0\n")
            data = np.frombuffer(port.read(4 * N_SAMPLES + 12), np.uint8)
            true = np.array([HEADER, counter, *WORDS[counter % 3], FOOTER], dtype="<u4").view(np.uint8)
            changed.append(int(np.count_nonzero(data != true)))
        entries = log.lines(6)
    assert [bool(entry["fault"]) for entry in entries] == [bool(count) for count in changed]
    assert set(changed) == {0, 1}
    assert [entry["crc32"] for entry in entries] == 2 * [zlib.crc32(words.tobytes()) for words in WORDS]


def test_it_is_unplugged_and_comes_back_as_after_power_up(tmp_path):
    link = tmp_path / "deep" / "front"
    with Emulator(WORDS, link=link) as device:
        assert link.readlink() == Path(device.port)
        assert link.parent.stat().st_mode & 0o777 == 0o700
        with opened(device) as port:
            assert ask(port, b"!I,9,0,0\n") == 1
            ask(port, b"junk\n")
            device.unplug()
            with pytest.raises((serial.SerialException, OSError)):  # whichever pyserial makes of a hang-up
                ask(port, b"!Y,0,0,0\n")
            assert not link.is_symlink()
            assert not device.trigger()
            before = device.port
            device.replug()
            assert device.port != before  # which the host has open still
        assert link.readlink() == Path(device.port)
        with serial.Serial(str(link), timeout=TIMEOUT_S) as port:
            assert ask(port, b"!Y,0,0,0\n") == 0x010000
        assert device.registers.emissions == 1
        assert device.refused == 1
    assert not list(link.parent.iterdir())


def test_a_fault_unplugs_it_for_a_while():
    back = queue.Queue()
    log = Log()
    faults, quirks = Faults(1, {"unplug": 1.0}), Quirks(away_s=0.05)
    with Emulator(WORDS, faults=faults, quirks=quirks, on_port=back.put, log=log) as device:
        with opened(device) as port:
            port.write(b"!A,1,0,0\n")
            with pytest.raises((serial.SerialException, OSError)):
                while port.read(100_000):
                    pass
        assert back.get(timeout=TIMEOUT_S) == device.port
        first, last = log.lines(2)
        assert first["fault"].startswith("unplug")
        assert last["fault"] == f"{first['fault']}, unplugged"
        with opened(device) as port:
            assert ask(port, b"!Y,0,0,0\n") == 0x010000


def test_it_comes_back_after_a_time(device):
    device.unplug(for_s=0.02)
    came = threading.Event()
    device._on_port = lambda _: came.set()  # noqa: SLF001
    assert came.wait(TIMEOUT_S)


def test_a_device_may_be_silent_slow_or_wrong(device, port):
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
    assert 0.1 < time.monotonic() - began_s - DURATION_S < 1.0  # of 0.131


def test_closing_does_not_wait_for_a_reader(armed):
    device, _, log = armed
    device.trigger()
    log.lines(1)
    began_s = time.monotonic()
    device.close()
    device.close()
    assert time.monotonic() - began_s < 1.0
    assert not any(thread.name == "emulated emulated" for thread in threading.enumerate())


def test_words_that_cannot_be_read_end_the_device(device):
    class Broken(Numbered):
        def __getitem__(self, index):
            if index:
                raise OSError("disk is gone")
            return super().__getitem__(index)

    with Emulator(Broken()) as device, opened(device) as port:
        ask(port, b"!B,1,0,0\n")
        port.write(b"!A,1,0,0\n")
        with pytest.raises((serial.SerialException, OSError)):
            port.read(1)
        device.replug()  # in vain
        assert str(device.error) == "disk is gone"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "number of measurements to emulate is 0; give a whole number of at least 1"),
        ([np.zeros(4, np.uint8)], "measurements to emulate are 1-dimensional uint8; give one uint32 word per sample"),
        ([np.zeros((4, 2), np.uint32)], "measurements to emulate are 2-dimensional uint32"),
    ],
)
def test_other_words_are_refused(words, message):
    with pytest.raises(ArgumentError, match=message):
        Emulator(words)
    with pytest.raises(ArgumentError, match=message):
        Emulator(WORDS, passive=words)


def test_a_link_belongs_to_one_device(tmp_path):
    link = tmp_path / "front"
    with Emulator(WORDS, link=link) as device:
        with pytest.raises(ArgumentError, match="front belongs to an emulated device that runs; end that one"):
            Emulator(WORDS, link=link)
        assert link.readlink() == Path(device.port)
    link.symlink_to("/dev/pts/0")  # as one that was killed leaves it
    (tmp_path / ".front.lock").touch()
    with Emulator(WORDS, link=link) as device:
        assert link.readlink() == Path(device.port)
    link.write_text("precious")
    with pytest.raises(ArgumentError, match="front exists and leads to no port; give another name"):
        HeldLink(link)
    assert link.read_text() == "precious"


def test_the_folder_of_links_can_be_chosen(monkeypatch, tmp_path):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    assert emulated_folder() == tmp_path
    monkeypatch.delenv("ERTIS_EMULATED_DIR")
    assert emulated_folder().parts[-2:] == ("ertis", "emulated")


class Listener:
    """Stands in a chain and notes its pulses."""

    def __init__(self, *, takes):
        self.takes = takes
        self.came = queue.Queue()

    def trigger(self, pulse, *, at_ns):
        self.came.put((pulse, at_ns))
        return self.takes


def test_pulses_are_steady_and_pass_from_device_to_device():
    devices = [Listener(takes=False), Listener(takes=True)]
    with SyncChain(devices, 200.0):
        first, second = ([device.came.get(timeout=TIMEOUT_S) for _ in range(10)] for device in devices)
    assert [pulse for pulse, _ in first] == [pulse for pulse, _ in second] == list(range(10))
    assert {late - early for (_, early), (_, late) in zip(first, second, strict=True)} == {400}
    periods = np.diff([at_ns for _, at_ns in first]) / 5e6
    assert np.all(periods == np.rint(periods))  # one that is missed is left out, and none is moved
    assert np.median(periods) == 1


def test_pulses_are_numbered_from_the_first_that_counts():
    device = Listener(takes=False)
    with SyncChain([device], 500.0) as chain:
        assert [device.came.get(timeout=TIMEOUT_S)[0] for _ in range(3)] == [0, 0, 0]
        device.takes = True
        pulses = [device.came.get(timeout=TIMEOUT_S)[0] for _ in range(20)]
        chain.start()  # it runs already
    assert pulses[-1] > 10
    assert set(np.diff(pulses)) == {0, 1} or set(np.diff(pulses)) == {1}


def test_a_rate_that_is_none_is_refused():
    with pytest.raises(ArgumentError, match="rate_hz is 0; give a number from 0.001 to 1000"):
        SyncChain([], 0.0)


def test_four_devices_on_a_chain_hear_the_same_moments():
    begun = [threading.Event() for _ in range(5)]
    begun[0].set()

    def listen(place, port):
        """Begin when the one before has: the later ones miss pulses."""
        assert begun[place].wait(TIMEOUT_S)
        ask(port, b"!J,1,1,0\n")
        for _ in range(6):
            yield block(port)
            begun[place + 1].set()

    with ExitStack() as stack:
        devices = [stack.enter_context(Emulator(Numbered())) for _ in range(4)]
        ports = [stack.enter_context(opened(device)) for device in devices]
        for place, port in enumerate(ports):
            ask(port, b"!G,131072,0,0\n")
            ask(port, b"!B,%d,0,0\n" % (100 * place))
        stack.enter_context(SyncChain(devices, 20.0))
        hosts = stack.enter_context(ThreadPoolExecutor(4))
        came = list(hosts.map(lambda place, port: list(listen(place, port)), range(4), ports))
    assert [[counter for counter, _ in blocks] for blocks in came] == [
        list(range(100 * place, 100 * place + 6)) for place in range(4)
    ]
    assert all(np.all(words == words[0]) for blocks in came for _, words in blocks)
    pulses = [[int(words[0]) for _, words in blocks] for blocks in came]
    assert all(np.all(np.diff(row) == 1) for row in pulses)
    firsts = [row[0] for row in pulses]
    assert firsts[0] == 0
    assert firsts == sorted(set(firsts))  # each hears what the others hear then
