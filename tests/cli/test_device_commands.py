"""Commands as text, and resets, with an emulated sensor on a real pseudo terminal."""

import contextlib
import json
import os
import sys
import types

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, SonarDisconnectedError, SonarError
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.emulator import Emulator
from ertis_numba.devices.reset import reset_sensor
from ertis_numba.devices.reset_pin import pulse_reset_pin
from ertis_numba.devices.setup import Setup
from ertis_numba.settings import Call
from ertis_numba.storage import open_recording
from tests.cli.test_emulate import SHORT
from tests.emulated import N_SAMPLES, PATIENT, WORDS, patient

__all__ = ["patient"]  # A fixture, imported for use here.

pytestmark = PATIENT


@pytest.fixture
def device(tmp_path, monkeypatch):
    monkeypatch.setenv("ERTIS_EMULATED_DIR", str(tmp_path))
    with Emulator(WORDS, link=tmp_path / "mine") as device:
        yield device


def test_commands_are_answered_as_text(device):
    with SonarDriver.open("mine") as sonar:
        assert sonar.command("!Y,0,0,0") == 0x010000
        sonar.configure(Setup.of(SHORT))
        assert sonar.command("!L,0,0,0") == sonar.call_hash()
        assert len(sonar.measure().data) == N_SAMPLES
        assert sonar.command("!B,7,0,0") == 1
        assert device.registers.counter == 7
        with pytest.raises(SonarError, match=r"is not configured; call configure\(\) first"):
            sonar.measure()
        sonar.configure(Setup.of(SHORT))
        assert len(sonar.measure().data) == N_SAMPLES


def test_command_of_unknown_firmware_is_sent(device):
    with SonarDriver.open("mine") as sonar:
        assert sonar.command("!Z,1,2,3") == 0
    assert device.refused == 1


def test_command_disarms_the_sensor(device):
    with SonarDriver.open("mine") as sonar:
        sonar.configure(Setup.of(SHORT))
        sonar.arm()
        assert device.registers.armed == 1
        sonar.command("!Y,0,0,0")
        assert device.registers.armed == 0


@pytest.mark.parametrize("text", ["", "Y", "!Y,0,0", "!Y,0,0,0\n", "!y,0,0,0", "!Y,-1,0,0", "!Y,0,0,0;", "!Ü,0,0,0"])
def test_text_that_is_no_command_is_refused(device, text):
    with SonarDriver.open("mine") as sonar, pytest.raises(ArgumentError, match="use '!X,i,j,k' with a letter X"):
        sonar.command(text)
    assert device.refused == 0


@pytest.mark.usefixtures("device")
def test_command_that_measures_is_refused():
    with SonarDriver.open("mine") as sonar, pytest.raises(ArgumentError, match=r"command A measures.*call measure"):
        sonar.command("!A,1,0,0")


@pytest.mark.usefixtures("device")
def test_listening_driver_sends_no_command():
    with SonarDriver.open("mine", listen_only=True) as sonar:
        for send in (lambda: sonar.command("!Y,0,0,0"), sonar.reset):
            with pytest.raises(SonarError, match="listen_only"):
                send()


def test_reset_waits_for_the_sensor(device):
    with SonarDriver.open("mine") as sonar:
        sonar.configure(Setup.of(SHORT))
        assert sonar.reset(lambda: device.unplug(0.2))
        assert sonar.firmware == "1.0.0"
        with pytest.raises(SonarError, match="is not configured"):
            sonar.measure()
        sonar.configure(Setup.of(SHORT))
        assert len(sonar.measure().data) == N_SAMPLES
        with pytest.raises(SonarDisconnectedError, match=r"did not return within 0\.2 s"):
            sonar.reset(device.unplug, within_s=0.2)


@pytest.mark.parametrize("has_call", [False, True])
@pytest.mark.usefixtures("device")
def test_reset_that_has_not_reached_the_sensor_is_noticed(has_call):
    with SonarDriver.open("mine") as sonar:
        if has_call:
            sonar.configure(Setup.of(SHORT))
        assert not sonar.reset(lambda: None)


def test_sensor_with_a_missing_port_is_reset(device):
    device.unplug()
    with pytest.raises(SonarError, match="mine"), reset_sensor("mine", lambda: None, within_s=0.2):
        pass
    with reset_sensor("mine", device.replug) as (sonar, is_certain):
        assert (sonar.firmware, is_certain) == ("1.0.0", True)


def test_silent_sensor_is_reset(tmp_path):
    """A pseudo terminal without a device is silent, and the reset puts a device in its place."""
    first, second = os.openpty()
    link = tmp_path / "silent"
    link.symlink_to(os.ttyname(second))
    with contextlib.ExitStack() as stack:
        for each in (first, second):
            stack.callback(os.close, each)

        def begin():
            link.unlink()
            stack.enter_context(Emulator(WORDS, link=link))

        with reset_sensor(str(link), begin) as (sonar, is_certain):
            assert (sonar.firmware, is_certain) == ("1.0.0", True)


def test_sensor_that_was_not_reset_is_still_disarmed(device):
    with SonarDriver.open("mine") as sonar:
        sonar.configure(Setup.of(SHORT))
        sonar.arm()
        with pytest.raises(SonarError, match="pin 7 cannot be pulsed"):
            sonar.reset()
        sonar.command("!Y,0,0,0")
        assert device.registers.armed == 0


def test_reset_pin_is_pulsed(monkeypatch):
    steps = []
    pins = types.SimpleNamespace(
        BOARD="board", OUT="out", LOW=0, HIGH=1, setmode=steps.append, output=lambda *given: steps.append(given)
    )
    pins.setup = lambda pin, mode, initial: steps.append((pin, mode, initial))
    monkeypatch.setitem(sys.modules, "Jetson", types.SimpleNamespace(GPIO=pins))
    monkeypatch.setitem(sys.modules, "Jetson.GPIO", pins)
    monkeypatch.setattr("ertis_numba.devices.reset_pin._PULSE_S", 0.0)
    pulse_reset_pin()
    assert steps == ["board", (7, "out", 1), (7, 0), (7, 1)]
    monkeypatch.setattr("ertis_numba.devices.reset_pin.time", types.SimpleNamespace(sleep=interrupt))
    steps.clear()
    with pytest.raises(KeyboardInterrupt):
        pulse_reset_pin(9)
    assert steps[-1] == (9, 1)


def interrupt(_):
    raise KeyboardInterrupt


def test_reset_pin_of_another_computer_is_reported():
    with pytest.raises(SonarError, match=r"pin 7 cannot be pulsed \(No module named 'Jetson'\).* \(pulse\), or unplug"):
        pulse_reset_pin()


def run(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_command_line_sends_commands(device):
    done = run("sensors", "send", "--port", "mine", "!Y,0,0,0", "!K,0,0,0")
    assert (done.exit_code, done.stdout) == (0, "65536\n1\n")
    done = run("sensors", "send", "--port", "mine", "!Y,0,0,0", "--json")
    assert json.loads(done.stdout) == {"command": "!Y,0,0,0", "answer": 65536}
    refused = run("sensors", "send", "--port", "mine", "!K,1,0,0", "nonsense")
    assert (refused.exit_code, device.registers.amplifier) == (1, 0)
    assert "use '!X,i,j,k'" in refused.stderr
    refused = run("sensors", "send", "--port", "mine", f"!B,{2**32},0,0")
    assert (refused.exit_code, device.registers.counter) == (1, 0)
    assert "whole numbers up to 4294967295" in refused.stderr


@pytest.mark.usefixtures("device")
def test_command_line_resets_a_sensor(tmp_path):
    done = run("sensors", "reset", "--port", "mine", "--hook", f"touch '{tmp_path}/pulled'")
    assert (done.exit_code, (tmp_path / "pulled").exists()) == (0, True)
    assert "answers again: firmware 1.0.0" in done.stderr
    assert "still has its call, so the reset has probably not reached it; check the pin" in done.stderr
    for arguments, message in (
        (["--hook", "false"], "--hook 'false' has failed"),
        (["--hook", "no-such-program"], "--hook 'no-such-program' has failed"),
        (["--hook", "'"], "has failed"),
        ([], "another way to reset the sensor (--hook), or unplug"),
        (["--pin", 7], "pin 7 cannot be pulsed"),
        (["--pin", 9], "pin 9 cannot be pulsed"),
    ):
        refused = run("sensors", "reset", "--port", "mine", *arguments)
        assert refused.exit_code == 1
        assert message in refused.stderr
    for arguments, message in ((["--pin", 9, "--hook", "true"], "choose one of them"), (["--hook", " "], "is empty")):
        refused = run("sensors", "reset", "--port", "mine", *arguments)
        assert refused.exit_code == 2
        assert message in refused.stderr


def test_period_of_emissions_is_limited():
    with pytest.raises(ArgumentError, match=r"emission_period_s is 1 s, .* at most 65535 samples; use at most 0\.146"):
        Setup.of(SHORT, emissions=2, emission_period_s=1.0)


def test_emissions_have_a_period():
    setup = Setup.of(SHORT, emissions=3, emission_period_s=5e-3)
    assert (setup.emissions, len(setup.codes)) == (3, 2250)
    n_call = len(Setup.of(SHORT).codes)
    assert np.array_equal(setup.codes[:n_call], Setup.of(SHORT).codes)
    assert set(setup.codes[n_call:]) == {2048}
    with pytest.raises(ArgumentError, match=r"emission_period_s is 0\.001 s, but the call lasts 0\.0025 s"):
        Setup.of(SHORT, emission_period_s=1e-3)


def test_capture_emits_a_waveform_from_a_file(device, tmp_path):
    call = np.sin(2 * np.pi * 40e3 * np.arange(200) / 450e3) * np.hanning(200)
    np.savetxt(tmp_path / "call.csv", np.append(call, np.zeros(300)))
    (tmp_path / "settings.toml").write_text(SHORT.to_toml())
    files = ["--settings", tmp_path / "settings.toml", "--call", tmp_path / "call.csv", "-o", tmp_path / "rec.h5"]
    options = ["-n", 1, "--emissions", 2, "--emission-period", 0.002, "--no-check-bits"]
    done = run("capture", "--port", "mine", *files, *options)
    assert done.exit_code == 0, done.stderr
    registers = device.registers
    assert (registers.emissions, registers.n_codes) == (2, 900)  # 2 ms at 450 kHz
    assert np.abs(registers.codes[:200] - (2047 * call / np.abs(call).max() + 2048)).max() <= 1
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.settings.call.waveform == Call.from_file(tmp_path / "call.csv").waveform
    refused = run("capture", "--port", "mine", "--call", tmp_path / "none.csv", "-o", tmp_path / "b.h5")
    assert (refused.exit_code, "no such file" in refused.stderr) == (1, True)
