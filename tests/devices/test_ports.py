"""Discovery of serial ports, lookup by name, and the survey of connected sensors."""

import errno
import json
import os
import re
import threading
from contextlib import ExitStack

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from ertis_numba.base.errors import SonarError
from ertis_numba.devices import ports
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator import Emulator, Quirks
from ertis_numba.devices.ports import Port, find_again, find_ports, resolve
from ertis_numba.devices.survey import survey
from tests.emulated import TIMEOUT_S

WORDS = [np.zeros(32_768, dtype=np.uint32)]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Folder of emulated devices on a machine without other devices."""
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path / "emulated"))
    monkeypatch.setattr(ports, "_BY_ID", tmp_path / "by-id")
    monkeypatch.setattr(list_ports, "comports", list)
    return tmp_path / "emulated"


def plug_in(monkeypatch, **serial_numbers):
    """Emulate USB devices, given as name=serial number."""

    def info(name, serial_number):
        port = ListPortInfo(f"/dev/{name}")
        port.vid, port.serial_number, port.description = 0x0483, serial_number, "eRTIS"
        return port

    found = [info(*item) for item in serial_numbers.items()]
    monkeypatch.setattr(list_ports, "comports", lambda: [ListPortInfo("/dev/ttyS0"), *found])


def test_emulated_device_is_found_by_all_its_names(folder, tmp_path):
    assert find_ports() == []
    link = folder / "left"
    with Emulator(WORDS, link=link) as device, Emulator(WORDS, link=folder / "right"):
        left, right = find_ports()
        assert left == Port(
            path=device.port, link=str(link), serial_number="left", description="emulated eRTIS", emulated=True
        )
        assert (right.serial_number, left.may_be_sonar) == ("right", True)
        for name in ("left", device.port, str(link), os.path.relpath(link)):
            assert resolve(name) == left
        (tmp_path / "mine").symlink_to(device.port)
        assert resolve(str(tmp_path / "mine")) == Port(
            path=device.port,
            link=str(tmp_path / "mine"),
            serial_number="left",
            description="emulated eRTIS",
            emulated=True,
        )
        device.unplug()
        assert find_ports() == [right]
        with pytest.raises(SonarError, match=re.escape(f"serial port '{link}' does not exist")):
            find_again(left)
        device.replug()
        assert find_again(left).path == device.port
    assert find_ports() == []


def test_link_of_a_killed_emulator_is_not_followed(folder):
    """The system soon gives the number of its pseudo terminal to another process, such as a shell."""
    with Emulator(WORDS) as device:
        folder.mkdir()
        (folder / "left").symlink_to(device.port)
        (folder / ".left.lock").touch()
        assert find_ports() == []
        for name in ("left", str(folder / "left")):
            with pytest.raises(SonarError, match=r"serial port .* does not exist"):
                resolve(name)


def test_usb_device_is_found_by_all_its_names(monkeypatch, tmp_path):
    plug_in(monkeypatch, ttyACM1="SN7", ttyACM0="SN8", ttyUSB0=None)
    (tmp_path / "by-id").mkdir()
    link = tmp_path / "by-id" / "usb-CoSys_eRTIS_SN7-if00"
    link.symlink_to("/dev/ttyACM1")
    first, seventh, adapter = find_ports()
    assert seventh == Port(path="/dev/ttyACM1", link=str(link), serial_number="SN7", description="eRTIS")
    assert [port.may_be_sonar for port in (first, seventh, adapter)] == [True, True, False]
    for name in ("SN7", "/dev/ttyACM1", "ttyACM1", link.name, str(link)):
        assert resolve(name) == seventh
    assert [str(port) for port in (first, adapter)] == ["/dev/ttyACM0 (SN8)", "/dev/ttyUSB0 (eRTIS)"]


def test_usb_device_is_found_under_a_new_port_number(monkeypatch):
    plug_in(monkeypatch, ttyACM0="SN7", ttyACM1="SN8")
    seventh = resolve("/dev/ttyACM0")
    plug_in(monkeypatch, ttyACM0="SN8", ttyACM5="SN7")
    assert find_again(seventh).path == "/dev/ttyACM5"


def test_ports_without_file_or_usb_are_handled(monkeypatch):
    monkeypatch.setattr(list_ports, "comports", lambda: [ListPortInfo("COM7")])
    assert resolve("COM7") == Port(path="COM7")
    with Emulator(WORDS) as device:
        assert resolve(device.port) == Port(path=device.port)
        assert not resolve(device.port).may_be_sonar


def test_several_ports_of_one_serial_number_are_refused(monkeypatch):
    plug_in(monkeypatch, ttyACM0="SN7", ttyACM1="SN7")
    wanted = re.escape("'SN7' matches 2 ports: /dev/ttyACM0 (SN7), /dev/ttyACM1 (SN7); choose the path of one")
    with pytest.raises(SonarError, match=wanted) as caught:
        resolve("SN7")
    assert caught.value.errno == errno.EINVAL


def test_missing_port_is_refused(monkeypatch):
    with pytest.raises(
        SonarError, match=r"serial port 'SN7' does not exist; no port exists: .* 'ertis sensors emulate'"
    ) as caught:
        resolve("SN7")
    assert caught.value.errno == errno.ENOENT
    plug_in(monkeypatch, ttyACM0="SN8")
    with pytest.raises(
        SonarError, match=r"serial port '/dev/ttyACM7' does not exist; choose one of /dev/ttyACM0 \(SN8\)"
    ):
        resolve("/dev/ttyACM7")


class PatientDriver(SonarDriver):
    """Driver that waits longer than usual for answers of a busy machine, unless the device is silent."""

    begin = staticmethod(lambda: None)

    def __init__(self, port, *, timeout_s):
        self.begin()
        super().__init__(port, timeout_s=timeout_s if port.serial_number == "mute" else TIMEOUT_S)


@pytest.fixture
def four_devices(folder, monkeypatch):
    """Four devices: a new one, one with a call, one in use and a silent one."""
    monkeypatch.setattr("ertis_numba.devices.survey.SonarDriver", PatientDriver)
    with ExitStack() as stack:
        emulators = {
            name: stack.enter_context(Emulator(WORDS, link=folder / name)) for name in ("call", "mute", "new", "used")
        }
        registers = emulators["call"].registers
        registers.n_codes, registers.codes[:3] = 3, (0x120, 0x003, 0x400)
        emulators["mute"].quirks = Quirks(silent=True)
        stack.enter_context(SonarDriver.open("used"))
        yield emulators


def listed(*arguments, code=0):
    done = CliRunner().invoke(cli, ["sensors", "list", *arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


@pytest.mark.usefixtures("four_devices")
def test_ports_are_queried_in_parallel(monkeypatch):
    begun = threading.Barrier(4, timeout=TIMEOUT_S)
    monkeypatch.setattr(PatientDriver, "begin", begun.wait)
    answers = {answer.port.serial_number: answer for answer in survey(find_ports())}
    assert not begun.broken
    assert {name: answer.state for name, answer in answers.items()} == {
        "call": "ready",
        "mute": "no answer",
        "new": "ready",
        "used": "in use",
    }
    assert (answers["call"].firmware, answers["call"].call_hash) == ("1.0.0", 0x523)
    assert (answers["mute"].firmware, answers["mute"].call_hash) == ("", None)
    assert "does not answer" in str(answers["mute"].error)


def test_devices_command_prints_a_table(four_devices):
    done = listed()
    assert [re.split("  +", line) for line in done.stdout.splitlines()] == [
        ["port", "serial number", "state", "firmware", "call", "description"],
        [four_devices["call"].port, "call", "ready", "1.0.0", "0x0523", "emulated eRTIS"],
        [four_devices["new"].port, "new", "ready", "1.0.0", "0x0000", "emulated eRTIS"],
        [four_devices["used"].port, "used", "in use", "-", "-", "emulated eRTIS"],
    ]
    assert done.stderr.count("\n") == 1
    assert f"{four_devices['mute'].port} does not answer" in done.stderr


def test_devices_command_prints_json(four_devices):
    done = listed("--json", "--port", "call", "-p", four_devices["used"].port)
    assert (done.stdout.count("\n"), done.stderr) == (1, "")
    ready, used = json.loads(done.stdout)["devices"]
    assert ready == {
        "port": four_devices["call"].port,
        "link": str(four_devices["call"].link),
        "serial_number": "call",
        "description": "emulated eRTIS",
        "emulated": True,
        "state": "ready",
        "firmware": "1.0.0",
        "call_hash": 0x523,
    }
    assert (used["state"], used["call_hash"]) == ("in use", None)


@pytest.mark.usefixtures("four_devices")
def test_devices_command_reports_a_port_without_a_sensor():
    done = listed("-p", "mute", "-p", "new", code=1)
    assert [re.split("  +", line)[2] for line in done.stdout.splitlines()[1:]] == ["no answer", "ready"]
    assert "does not answer 'firmware version?'" in done.stderr
    assert "serial port 'moot' does not exist" in listed("-p", "moot", code=1).stderr


def test_devices_command_prints_nothing_without_devices(monkeypatch):
    assert survey([]) == []
    plug_in(monkeypatch, ttyUSB0="FTDI")  # The survey queries CDC-ACM ports only.
    done = listed()
    assert (done.stdout, done.stderr) == (
        "",
        "no eRTIS found; plug one in, or start an emulated one with 'ertis sensors emulate'\n",
    )
    assert json.loads(listed("--json").stdout) == {"devices": []}
