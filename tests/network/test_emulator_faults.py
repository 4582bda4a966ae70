"""Configured faults of emulated devices: damaged bytes, unplugging and silence; and exclusive links."""

import fcntl
import os
import queue
import threading
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import serial

from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.blocks import FOOTER, HEADER
from ertis_numba.devices.emulator import Emulator, Quirks
from ertis_numba.devices.emulator.faults import Faults
from ertis_numba.devices.links import HeldLink, emulated_folder
from tests.emulated import N_SAMPLES, TIMEOUT_S, WORDS, Log, Numbered, ask, opened


def test_emulator_faults_damage_blocks_and_are_logged():
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


def test_replugged_emulator_has_registers_of_power_up(tmp_path):
    link = tmp_path / "deep" / "front"
    with Emulator(WORDS, link=link) as device:
        assert link.readlink() == Path(device.port)
        assert link.parent.stat().st_mode & 0o777 == 0o700
        with opened(device) as port:
            assert ask(port, b"!I,9,0,0\n") == 1
            ask(port, b"junk\n")
            device.unplug()
            with pytest.raises((serial.SerialException, OSError)):  # pyserial raises either on a hang-up
                ask(port, b"!Y,0,0,0\n")
            assert not link.is_symlink()
            assert not device.trigger()
            before = device.port
            device.replug()
            assert device.port != before  # the host still has the old port open
        assert link.readlink() == Path(device.port)
        with serial.Serial(str(link), timeout=TIMEOUT_S) as port:
            assert ask(port, b"!Y,0,0,0\n") == 0x010000
        assert device.registers.emissions == 1
        assert device.refused == 1
    assert not list(link.parent.iterdir())


def test_unplug_fault_reconnects_the_emulator_after_a_time():
    back = queue.Queue()
    log = Log()
    faults, quirks = Faults(1, {"unplug": 1.0}), Quirks(away_s=0.05)
    with Emulator(WORDS, faults=faults, quirks=quirks, on_port=back.put, log=log) as device:
        with opened(device) as port:
            port.write(b"!A,1,0,0\n")
            with pytest.raises((serial.SerialException, OSError)):
                port.read(10**9)
        assert back.get(timeout=TIMEOUT_S) == device.port
        first, last = log.lines(2)
        assert first["fault"].startswith("unplug")
        assert last["fault"] == f"{first['fault']}, unplugged"
        with opened(device) as port:
            assert ask(port, b"!Y,0,0,0\n") == 0x010000


def test_unplug_for_some_seconds_reconnects_the_emulator():
    back = queue.Queue()
    with Emulator(WORDS, on_port=back.put) as device:
        began_s = time.monotonic()
        device.unplug(for_s=0.03)
        assert back.get(timeout=TIMEOUT_S) == device.port
        assert time.monotonic() - began_s >= 0.03


def test_unreadable_samples_stop_the_emulator():
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
        device.replug()  # has no effect
        assert str(device.error) == "disk is gone"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "number of measurements to emulate is 0; use a whole number of at least 1"),
        ([np.zeros(4, np.uint8)], "measurements to emulate are 1-dimensional uint8; use one uint32 word per sample"),
        ([np.zeros((4, 2), np.uint32)], "measurements to emulate are 2-dimensional uint32"),
    ],
)
def test_emulator_rejects_invalid_samples(words, message):
    with pytest.raises(ArgumentError, match=message):
        Emulator(words)
    with pytest.raises(ArgumentError, match=message):
        Emulator(WORDS, passive=words)


def test_emulator_link_is_exclusive_to_one_device(tmp_path):
    link = tmp_path / "front"
    with Emulator(WORDS, link=link) as device:
        with pytest.raises(ArgumentError, match="front belongs to a running emulated device; end that one"):
            Emulator(WORDS, link=link)
        assert link.readlink() == Path(device.port)
    link.symlink_to("/dev/pts/0")  # a killed emulator leaves such a link
    (tmp_path / ".front.lock").touch()
    with Emulator(WORDS, link=link) as device:
        assert link.readlink() == Path(device.port)
    link.write_text("precious")
    with pytest.raises(ArgumentError, match="front exists but is not a link to a port; choose another name"):
        HeldLink(link)
    assert link.read_text() == "precious"


def test_held_link_waits_for_a_short_shared_lock(tmp_path):
    """A process that checks a link holds a shared lock for an instant."""
    looker = os.open(tmp_path / ".front.lock", os.O_CREAT | os.O_RDONLY)
    fcntl.flock(looker, fcntl.LOCK_SH)
    timer = threading.Timer(0.02, os.close, [looker])
    timer.start()
    HeldLink(tmp_path / "front").release()
    timer.join()


def test_emulated_folder_follows_its_environment_variable_only(monkeypatch, tmp_path):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    assert emulated_folder() == tmp_path
    monkeypatch.delenv("ERTIS_EMULATED_DIR")
    usual = emulated_folder()
    assert usual.parts[-2:] == ("ertis", "emulated")
    for name in ("TMPDIR", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path))
    assert emulated_folder() == usual


def test_emulated_folder_that_others_may_change_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    tmp_path.chmod(0o777)
    with pytest.raises(ArgumentError, match="others may write to it; set ERTIS_EMULATED_DIR"):
        emulated_folder()
    tmp_path.chmod(0o700)
    monkeypatch.setattr("os.getuid", lambda: 12345)
    with pytest.raises(ArgumentError, match="belongs to another user"):
        emulated_folder()
