"""Serial driver on pseudo terminals: commands to the device, received measurements and error messages."""

import errno
import itertools
import os
import resource
import select
import threading
import time
import tty
import zlib
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pytest
import serial
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ertis_numba.base.errors import ArgumentError, SonarDisconnectedError, SonarError
from ertis_numba.devices.blocks import encode_block
from ertis_numba.devices.commands import encode_answer
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator import Emulator, Quirks, SyncChain
from ertis_numba.devices.line import SerialLine
from ertis_numba.devices.setup import Setup, call_hash
from ertis_numba.settings import Call, Recording, Settings
from tests.emulated import N_SAMPLES, PATIENT, TIMEOUT_S, WORDS, Log, patient

__all__ = ["patient"]  # A fixture, imported for use here.

pytestmark = PATIENT

SETTINGS = Settings(recording=Recording(n_samples=N_SAMPLES))
BLOCK_BYTES = 4 * N_SAMPLES + 12
PASSIVE = [words[::-1].copy() for words in WORDS]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    return tmp_path


@contextmanager
def impatient(margin_s=0.5):
    """Let drivers give up a measurement that does not arrive."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ertis_numba.devices.driver._MARGIN_S", margin_s)
        yield


@pytest.fixture
def device(folder):
    with Emulator(WORDS, passive=PASSIVE, link=folder / "left") as device:
        yield device


@pytest.fixture
def sonar(device):
    with SonarDriver.open("left") as sonar:
        sonar.configure(Setup.of(SETTINGS))
        yield sonar
    assert device.refused == 0


@pytest.fixture
def armed(device):
    with SonarDriver.open(device.port) as sonar:
        sonar.configure(Setup.of(SETTINGS))
        sonar.arm()
        yield sonar


class Fake:
    """Fake device with scripted answers: ``answer`` receives each line and a function that writes."""

    def __init__(self, answer):
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._answer = answer
        self._ended, self._end = os.pipe()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        os.write(self._end, b"!")
        self._thread.join()
        for number in (self.master, self._slave, self._ended, self._end):
            os.close(number)

    def write(self, data):
        os.write(self.master, data)

    def _run(self):
        rest = b""
        while self._ended not in select.select([self.master, self._ended], [], [])[0]:
            *lines, rest = (rest + os.read(self.master, 65_536)).split(b"\n")
            for line in lines:
                self._answer(line, self.write)


def answer_correctly(line, write):
    if not line.startswith(b"!A"):
        write(encode_answer(call_hash(Setup.of(SETTINGS).codes) if line.startswith(b"!L") else 1))


def wait_for_bytes(device):
    """Wait until the host can read bytes, and leave them unread."""
    port = os.open(device.port, os.O_RDONLY | os.O_NOCTTY)
    assert select.select([port], [], [], TIMEOUT_S)[0]
    os.close(port)


def is_block(block, counter, words):
    return block.counter == counter and np.array_equal(block.data, words)


def receive_blocks(sonar, count):
    return list(itertools.islice(sonar.listen(stop=lambda: False, timeout_s=TIMEOUT_S), count))


def refusal(device, *, timeout_s=1.0):
    """Return the error of opening a fake device."""
    with device, pytest.raises(SonarError) as caught:
        SonarDriver.open(device.port, timeout_s=timeout_s)
    return caught.value


# Opening.


def test_driver_opens_a_device(device):
    with SonarDriver.open(device.port) as sonar:
        assert (sonar.port, sonar.serial_number, sonar.firmware) == (device.port, "left", "1.0.0")
        assert sonar.call_hash() == 0
        assert sonar.dropped == 0


def test_port_in_use_is_refused(device):
    with serial.Serial(device.port, exclusive=True), pytest.raises(SonarError, match="is in use by another") as caught:
        SonarDriver.open("left")
    assert caught.value.errno == errno.EBUSY
    SonarDriver.open("left").close()
    SonarDriver.open("left").close()


def test_path_other_than_a_serial_port_is_refused(tmp_path):
    (tmp_path / "file.txt").touch()
    with pytest.raises(SonarError, match=r"file\.txt is not a usable serial port \(.*; choose another"):
        SonarDriver.open(str(tmp_path / "file.txt"))


def test_driver_errors_name_the_port_and_the_fault(tmp_path, monkeypatch):
    (tmp_path / "file.txt").touch()
    with pytest.raises(SonarError) as caught:
        SonarDriver.open(str(tmp_path / "file.txt"))
    assert caught.value.errno == errno.EINVAL
    with pytest.raises(SonarError, match=r"serial port .* does not exist") as caught:
        SonarDriver.open(str(tmp_path / "nothing"))
    assert caught.value.errno == errno.ENOENT

    same = [ListPortInfo("/dev/ttyACM0"), ListPortInfo("/dev/ttyACM1")]
    for port in same:
        port.vid, port.serial_number = 0x0483, "SN7"
    monkeypatch.setattr(list_ports, "comports", lambda: same)
    with pytest.raises(SonarError, match="'SN7' matches 2 ports") as caught:
        SonarDriver.open("SN7")
    assert caught.value.errno == errno.EINVAL


def test_driver_works_with_more_than_1000_open_files(device):
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, before[1]), before[1]))
    with ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, before)
        null = os.open(os.devnull, os.O_RDONLY)
        stack.callback(os.close, null)
        for _ in range(1100):
            stack.callback(os.close, os.dup(null))
        with SonarDriver.open(device.port) as sonar:
            sonar.configure(Setup.of(SETTINGS))
            assert is_block(sonar.measure(), 0, WORDS[0])


@pytest.mark.parametrize(
    ("code", "text"), [(errno.EACCES, "requires permission; .*dialout"), (errno.EIO, "does not exist any more")]
)
def test_port_without_permission_is_refused(device, monkeypatch, code, text):
    def refuse(*_, **__):
        raise serial.SerialException(code, "could not open port")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(SonarError, match=text) as caught:
        SonarDriver.open(device.port)
    assert caught.value.errno == (errno.ENOENT if code == errno.EIO else code)


def test_silent_device_is_reported(device):
    device.quirks = Quirks(silent=True)
    wanted = r"does not answer 'firmware version\?' within 0.2 s; is it an eRTIS"
    with pytest.raises(SonarError, match=wanted) as caught:
        SonarDriver.open("left", timeout_s=0.2)
    assert caught.value.errno == errno.ETIMEDOUT


def test_device_of_another_kind_is_reported():
    error = refusal(Fake(lambda _, write: write(b"OK")))
    assert "does not answer 'firmware version?' within 1 s, but sends b'OK'" in str(error)
    error = refusal(Fake(lambda _, write: write(b"unknown command\r\n")))
    assert "answers 'firmware version?' with more than a number, first b'unkn'" in str(error)
    numbers = itertools.count()
    error = refusal(Fake(lambda _, write: write(encode_answer(next(numbers)))))
    assert "answers 'firmware version?' with 1 and then with 2" in str(error)


def test_endlessly_sending_device_is_reported():
    ended = threading.Event()
    with Fake(answer_correctly) as device:

        def talk():
            while not ended.wait(0.01):
                device.write(b"$GPGGA,")

        talker = threading.Thread(target=talk)
        talker.start()
        try:
            with pytest.raises(SonarError, match=r"keeps sending after a stop command; is it an eRTIS\?"):
                SonarDriver.open(device.port, timeout_s=0.2)
        finally:
            ended.set()
            talker.join()


def test_stream_left_by_a_crashed_program_is_discarded(device):
    registers = device.registers
    registers.n_bytes, registers.armed = 4 * N_SAMPLES, 1
    with SyncChain([device], 50.0):
        wait_for_bytes(device)
        with SonarDriver.open("left") as sonar:
            assert registers.armed == 0
            assert 0 < sonar.dropped < 20 * BLOCK_BYTES
            sonar.configure(Setup.of(SETTINGS), counter=7)
            assert is_block(sonar.measure(), 7, WORDS[7 % len(WORDS)])
            assert not sonar.receiver.rejected


def test_partial_command_left_by_a_crashed_program_is_discarded(device):
    with serial.Serial(device.port) as port:
        port.write(b"!C,12")
    SonarDriver.open("left").close()


# Configuration.


def test_driver_sends_the_whole_configuration(device, caplog):
    setup = Setup.of(SETTINGS.replace(recording=Recording(n_samples=65_536, sample_rate_hz=1_125_000.0)), emissions=3)
    with SonarDriver.open("left") as sonar:
        assert device.registers.armed == 0
        caplog.set_level("INFO", "ertis_numba")
        sonar.configure(setup, counter=11)
        reported = device.registers
        assert (reported.n_bytes, reported.clock, reported.dac_rate_hz, reported.n_codes) == (
            262_144,
            1,
            450_000,
            len(setup.codes),
        )
        assert (reported.emissions, reported.active, reported.amplifier, reported.counter) == (3, 1, 1, 11)
        assert np.array_equal(reported.codes[: reported.n_codes], setup.codes)
        assert sonar.call_hash() == call_hash(setup.codes)
        assert "a call of 1126 samples was sent" in caplog.text
        caplog.clear()
        sonar.configure(setup, counter=12)
        assert (reported.counter, caplog.text) == (12, "")


def test_slow_device_receives_its_call(device):
    device.quirks = Quirks(answer_delay_s=20e-3)
    setup = Setup.of(SETTINGS.replace(call=Call(duration_s=2e-4)))
    with SonarDriver.open("left", timeout_s=1.5) as sonar:  # The answers to its samples take longer.
        sonar.configure(setup)
        assert np.array_equal(device.registers.codes[: len(setup.codes)], setup.codes)


def test_call_that_did_not_arrive_is_reported(device):
    device.quirks = Quirks(wrong_hash=True)
    setup = Setup.of(SETTINGS)
    wanted, held = f"{call_hash(setup.codes):#06x}", f"{call_hash(setup.codes) ^ 1:#06x}"
    with (
        SonarDriver.open("left") as sonar,
        pytest.raises(SonarError, match=f"sent a call with hash {wanted} but has one with {held}; unplug"),
    ):
        sonar.configure(setup)


def test_device_that_falls_silent_is_reported(device):
    with SonarDriver.open("left") as sonar:
        device.quirks = Quirks(silent=True)
        sonar._line._timeout_s = 0.1  # noqa: SLF001
        with pytest.raises(SonarError, match=r"does not answer 'SYNC input 1: off' within 0\.1 s"):
            sonar.configure(Setup.of(SETTINGS))


def test_missing_answers_name_their_command():
    def forgetful(line, write):
        if not line.startswith((b"!C,21,", b"!L")):
            answer_correctly(line, write)
        elif line.startswith(b"!L"):
            write(encode_answer(0))

    with (
        Fake(forgetful) as device,
        SonarDriver.open(device.port) as sonar,
        pytest.raises(SonarError, match=r"does not answer 'sample 31 of the call: \d+' within 1 s"),
    ):
        sonar.configure(Setup.of(SETTINGS))  # The missing answer of sixteen is unknown, so the last is named.


# Active measurements.


def test_driver_measures_on_command(sonar):
    before = time.monotonic_ns(), time.time_ns()
    blocks = [sonar.measure() for _ in range(4)]
    assert all(is_block(block, index, WORDS[index % 3]) for index, block in enumerate(blocks))
    times_ns = [block.arrived.monotonic_ns for block in blocks]
    assert sorted({before[0], *times_ns, time.monotonic_ns()})[1:-1] == times_ns
    assert before[1] < blocks[0].arrived.realtime_ns < time.time_ns()
    assert all(1_000_000 <= block.arrived.uncertainty_ns < 1_000_000_000 for block in blocks)
    assert is_block(sonar.measure(active=False), 4, PASSIVE[1])
    assert (sonar.dropped, sonar.receiver.lost, sonar.receiver.rejected.total()) == (0, 0, 0)


def test_unplayable_call_is_refused(device):
    setup = Setup.of(SETTINGS, active=False)
    with SonarDriver.open("left") as sonar:
        sonar.configure(setup)
        with pytest.raises(ArgumentError, match="and would emit nothing; configure a setup with amplifier=True"):
            sonar.measure(active=True)
        assert device.registers.counter == 0
        assert is_block(sonar.measure(), 0, PASSIVE[0])
        sonar.configure(replace(setup, amplifier=True), counter=1)
        assert is_block(sonar.measure(active=True), 1, WORDS[1])
        assert is_block(sonar.measure(), 2, PASSIVE[2])


def test_stale_bytes_are_dropped(sonar, device):
    device.registers.armed = 1
    assert device.trigger()
    wait_for_bytes(device)
    assert is_block(sonar.measure(), 1, WORDS[1])
    assert sonar.dropped == BLOCK_BYTES


def test_measurement_whose_bytes_still_arrive_is_not_late(sonar, device):
    """A busy machine transfers slowly; the whole measurement takes longer than its usual timeout of 0.53 s."""
    device.quirks = Quirks(bytes_per_s=200_000)
    with impatient():
        usual_s = sonar.deadline_s
    began_s = time.monotonic()
    assert is_block(sonar.measure(), 0, WORDS[0])
    assert time.monotonic() - began_s > usual_s


def test_late_measurement_is_not_taken_for_the_next(sonar, device):
    device.quirks = Quirks(bytes_per_s=50_000)
    with (
        impatient(),
        pytest.raises(
            SonarError, match=r"no complete measurement within \d\.\d\d s; \d+ of 131084 bytes arrived: measure"
        ),
    ):
        sonar.measure()
    device.quirks = Quirks()
    assert is_block(sonar.measure(), 1, WORDS[1])
    assert is_block(sonar.measure(), 2, WORDS[2])
    n_answers, rest = divmod(sonar.dropped + sonar.receiver.rejected.total() - BLOCK_BYTES, 4)
    assert (n_answers < 3, rest) == (True, 0)  # Answers to the repeated counter command.


@pytest.mark.parametrize("pause_s", [0.0, 0.02])
def test_delayed_measurement_is_recognised_by_its_number(pause_s):
    """The delayed measurement is complete, but its number is that of the previous command."""
    asked = []

    def slow(line, write):
        answer_correctly(line, write)
        asked.extend([line] * line.startswith(b"!A"))
        if len(asked) == 2:
            asked.append(b"")
            write(encode_block(0, WORDS[0]))
            time.sleep(pause_s)  # Time of the measurement.
            write(encode_block(1, WORDS[1]))

    with Fake(slow) as device, SonarDriver.open(device.port) as sonar:
        sonar.configure(Setup.of(SETTINGS))
        with impatient(), pytest.raises(SonarError, match="; 0 of 131084 bytes arrived"):
            sonar.measure()
        assert is_block(sonar.measure(), 1, WORDS[1])
        assert sonar.receiver.rejected == {"counter": BLOCK_BYTES}


def test_lost_byte_loses_one_measurement():
    counters = itertools.count()

    def lossy(line, write):
        answer_correctly(line, write)
        if line.startswith(b"!A"):
            counter = next(counters)
            data = encode_block(counter, WORDS[counter])
            write(data[:5_000] + data[5_001:] if counter == 0 else data)

    with Fake(lossy) as device, SonarDriver.open(device.port) as sonar:
        sonar.configure(Setup.of(SETTINGS))
        with impatient(2.0), pytest.raises(SonarError, match="; 131083 of 131084 bytes arrived"):
            sonar.measure()
        assert is_block(sonar.measure(), 1, WORDS[1])
        assert sonar.receiver.rejected == {"cut short": BLOCK_BYTES - 1}


def test_lost_command_does_not_shift_the_numbers():
    """The driver sets a number for each measurement, even if the device missed the previous command."""
    counters = []

    def deaf_once(line, write):
        answer_correctly(line, write)
        if line.startswith(b"!B"):
            counters.append(int(line.split(b",")[1]))
        elif line.startswith(b"!A") and len(counters) > 1:
            write(encode_block(counters[-1], WORDS[1]))

    with Fake(deaf_once) as device, SonarDriver.open(device.port) as sonar:
        sonar.configure(Setup.of(SETTINGS))
        with impatient(), pytest.raises(SonarError, match="; 0 of 131084 bytes arrived"):
            sonar.measure()
        assert is_block(sonar.measure(), 1, WORDS[1])


@pytest.mark.usefixtures("device")
def test_implausible_bits_are_refused():
    with SonarDriver.open("left") as sonar:
        sonar.configure(Setup.of(SETTINGS), bits=lambda words: "odd" if np.array_equal(words, WORDS[0]) else None)
        with impatient(2.0), pytest.raises(SonarError, match="no complete measurement"):
            sonar.measure()
        assert sonar.receiver.rejected_blocks == {"odd": 1}
        assert is_block(sonar.measure(), 1, WORDS[1])


# Passive measurements.


def test_driver_receives_twenty_pulses_per_second(folder):
    """The driver receives every measurement sent; on a busy machine the device drops and counts unread ones."""
    log = Log()
    with Emulator(WORDS, link=folder / "right", log=log) as device, SonarDriver.open("right") as sonar:
        sonar.configure(Setup.of(SETTINGS))
        sonar.arm()
        with SyncChain([device], 20.0):
            blocks = receive_blocks(sonar, 20)
        reported = log.lines(blocks[-1].counter + 1)
        sent = [(line["counter"], line["crc32"]) for line in reported if line["fault"] != "dropped"]
        assert [(block.counter, zlib.crc32(block.data)) for block in blocks] == sent
        receiver = sonar.receiver
        assert (sonar.dropped, receiver.lost, receiver.rejected.total()) == (0, len(reported) - len(sent), 0)
        sonar.disarm()
        assert device.registers.armed == 0


def test_listening_stops_at_once(armed):
    asked = itertools.count()
    assert list(armed.listen(stop=lambda: next(asked) == 20, timeout_s=TIMEOUT_S)) == []
    assert next(asked) == 21


def test_stopped_command_fails_and_can_be_repeated(device):
    setup = Setup.of(SETTINGS)
    with pytest.raises(SonarError):
        SonarDriver.open(device.port, stop=lambda: True)
    polls = itertools.count()
    with SonarDriver.open(device.port) as sonar:
        with pytest.raises(SonarError):
            sonar.configure(setup, stop=lambda: next(polls) > 20)
        assert sonar.call_hash() != call_hash(setup.codes)
        sonar.configure(setup)
        assert sonar.call_hash() == call_hash(setup.codes)
        assert sonar.measure().data.shape == WORDS[0].shape


def test_close_ends_listening_and_disarms_the_trigger(armed, device):
    timer = threading.Timer(0.1, armed.close)
    timer.start()
    assert list(armed.listen(stop=lambda: False, timeout_s=TIMEOUT_S)) == []
    timer.join()
    with serial.Serial(device.port, timeout=TIMEOUT_S) as port:
        port.write(b"!L,0,0,0\n")
        assert len(port.read(4)) == 4  # The device has processed the command sent by closing.
    assert device.registers.armed == 0
    with pytest.raises(SonarError, match="was closed; open it again"):
        armed.disarm()
    with pytest.raises(SonarError, match="was closed; open it again"):
        list(armed.listen(stop=lambda: False, timeout_s=TIMEOUT_S))


def test_listening_without_pulses_ends(armed):
    with (
        impatient(),
        pytest.raises(SonarError, match=r"nothing arrived within 0\.\d+ s; check the trigger and its cable"),
    ):
        list(armed.listen(stop=lambda: False, timeout_s=0.1))


def test_listening_needs_no_sent_byte(device):
    """Another program has configured the device, so its counter may have any value."""
    registers = device.registers
    registers.n_bytes, registers.armed, registers.counter = 4 * N_SAMPLES, 1, 40
    with SonarDriver.open("left", listen_only=True) as sonar, SyncChain([device], 50.0):
        assert sonar.firmware == ""
        sonar.configure(Setup.of(SETTINGS))
        counters = [block.counter for block in receive_blocks(sonar, 3)]
        assert 40 <= counters[0] < counters[1] < counters[2]  # Some may be dropped on a busy machine.
        with pytest.raises(SonarError, match="is open with listen_only"):
            sonar.measure()
    assert registers.armed == 1
    assert device.registers.n_codes == 0


def test_listening_with_another_record_length_is_reported(device):
    registers = device.registers
    registers.n_bytes, registers.armed = 4 * N_SAMPLES, 1
    with SonarDriver.open("left", listen_only=True) as sonar, SyncChain([device], 50.0):
        sonar.configure(Setup.of(SETTINGS.replace(recording=Recording(n_samples=2 * N_SAMPLES))))
        with (
            impatient(2.0),
            pytest.raises(
                SonarError, match=r"\d+ bytes arrived within .* no complete measurement of 65536 samples; use"
            ),
        ):
            list(sonar.listen(stop=lambda: False, timeout_s=0.1))


def test_pause_within_a_measurement_drops_it(monkeypatch):
    """The driver discards the partial measurement and receives the next one completely."""
    monkeypatch.setattr("ertis_numba.devices.driver._MARGIN_S", 0.1)

    def stalling(line, write):
        answer_correctly(line, write)
        if line.startswith(b"!J,1"):
            write(encode_block(0, WORDS[0])[:1_000])

    with Fake(stalling) as device, SonarDriver.open(device.port) as sonar:
        sonar.configure(Setup.of(SETTINGS))
        sonar.arm()
        writer = threading.Thread(target=device.write, args=[encode_block(1, WORDS[1])])

        def go_on():
            if sonar.receiver.rejected and writer.ident is None:
                writer.start()
            return False

        [block] = itertools.islice(sonar.listen(stop=go_on, timeout_s=TIMEOUT_S), 1)
        assert is_block(block, 1, WORDS[1])
        assert sonar.receiver.rejected == {"cut short": 1_000}
        writer.join()


@pytest.mark.usefixtures("device")
def test_operations_out_of_order_are_refused():
    with SonarDriver.open("left") as sonar:
        with pytest.raises(SonarError, match=r"is not configured; call configure\(\) first"):
            sonar.measure()
        sonar.configure(Setup.of(SETTINGS))
        with pytest.raises(SonarError, match=r"is not armed; call arm\(\) first"):
            receive_blocks(sonar, 1)
        sonar.arm()
        with pytest.raises(SonarError, match="is armed, and SYNC pulses trigger it"):
            sonar.measure()


# Unplugged devices.


def test_unplugging_within_a_measurement_is_reported(sonar, device):
    first = sonar.port
    assert is_block(sonar.measure(), 0, WORDS[0])
    device.quirks = Quirks(bytes_per_s=50_000)
    receive = sonar._line.receive  # noqa: SLF001

    def receive_and_unplug(missing):
        data, arrived = receive(missing)
        if data:
            device.unplug()
        return data, arrived

    sonar._line.receive = receive_and_unplug  # noqa: SLF001
    with pytest.raises(SonarDisconnectedError, match=f"{first} was unplugged; plug it in again"):
        sonar.measure()
    with pytest.raises(SonarDisconnectedError, match="was unplugged"):
        sonar.measure()
    device.quirks = Quirks()
    device.replug()
    assert sonar.reconnect(within_s=TIMEOUT_S)
    assert sonar.port == device.port != first  # The old number stays in use until the driver closes it.
    assert is_block(sonar.measure(), 2, WORDS[2])


@pytest.mark.alone
def test_unplugging_while_listening_is_reported(armed, device):
    with SyncChain([device], 50.0) as chain:
        blocks = receive_blocks(armed, 3)
        device.unplug()
        with pytest.raises(SonarDisconnectedError):
            blocks += receive_blocks(armed, 100)
        device.replug()
        before_s = time.monotonic()
        assert armed.reconnect(within_s=TIMEOUT_S)
        assert time.monotonic() - before_s < 3
        [back] = receive_blocks(armed, 1)
    # On a busy machine the driver may read too late, and the device drops some measurements.
    counters = [block.counter for block in blocks]
    assert counters == sorted(set(counters))
    assert counters[-1] + 1 <= back.counter < chain.pulses


def test_device_that_does_not_return_is_reported(sonar, device):
    device.unplug()
    with pytest.raises(SonarDisconnectedError, match=r"did not return within 0\.1 s: serial port .* does not exist"):
        sonar.reconnect(within_s=0.1)
    assert not sonar.reconnect(within_s=TIMEOUT_S, stop=lambda: True)
    timer = threading.Timer(0.1, sonar.close)
    timer.start()
    assert not sonar.reconnect(within_s=TIMEOUT_S)
    timer.join()


def test_device_that_reads_nothing_is_reported(monkeypatch):
    """The device does not read, so its input buffer is full."""
    monkeypatch.setattr("ertis_numba.devices.line._WRITE_S", 0.05)
    master, slave = os.openpty()
    tty.setraw(slave)
    line = SerialLine(os.ttyname(slave), stop=lambda: False)
    with pytest.raises(SonarError, match="accepts no commands; unplug it and plug it in again"):
        line.send(bytes(1_000_000))
    line.close()
    os.close(master)
    os.close(slave)
