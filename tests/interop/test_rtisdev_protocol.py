"""The original driver, rtisdev 2.16.0, controls an emulated device with its code for Windows and for Linux.

The driver runs in a separate process, because importing it changes warning filters. Its Linux code needs the
closed-source module ``rtisserial``; a small replacement based on pyserial stands in for it.

Differences between the two code paths:

- ``A``: 1 means active on Linux, and 0 means active on Windows, so Windows requests an active measurement as a
  passive one. The device follows the number, as the protocol specifies.
- ``A`` has no line ending on Windows. Neither code path waits for an answer.
- ``J`` has four numbers on Linux and three on Windows.
- On Windows the driver opens and closes the port for every command; on Linux the port stays open.
"""

import json
import subprocess
import sys
import zlib
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest

from ertis_numba.devices.emulator import Emulator, SyncChain
from ertis_numba.devices.emulator.registers import Registers
from ertis_numba.devices.setup import call_codes, call_hash
from ertis_numba.settings import Call

N_SAMPLES = 65_536
WORDS = [np.random.default_rng(index).integers(0, 2**32, N_SAMPLES, dtype=np.uint32) for index in range(3)]
PASSIVE = [words[::-1].copy() for words in WORDS]
PULSES_HZ = 10.0

DRIVER = '''
import json, os, sys, types, zlib
import serial

way, port = sys.argv[1:]

awaited = []

class Port(serial.Serial):
    """Port with timeouts for a busy machine, which reports the first read of a listener."""

    def __init__(self, port, baud, timeout=None):
        super().__init__(port, baud, timeout=None if timeout is None else 30)

    def read(self, count=1):
        if awaited:
            print(awaited.pop(), flush=True)
        return super().read(count)

class RtisSerial(types.ModuleType):
    def connect(self, port, baud):
        self.port = Port(port, baud, timeout=30)
    def flush(self):
        self.port.reset_input_buffer()
    def command(self, line, answered):
        self.port.write(line.encode())
        return int.from_bytes(self.port.read(4), "little") if answered else 0
    def getdata(self, count):
        return numpy.frombuffer(self.port.read(count), numpy.uint8)
    def close(self):
        self.port.close()

class Windows:
    name = "nt"
    def __getattr__(self, name):
        return getattr(os, name)

if way == "linux":
    sys.modules["rtisserial"] = RtisSerial("rtisserial")

import numpy
import rtisdev
from rtisdev import RTISDev

if way == "windows":
    RTISDev.serial, RTISDev.os = types.SimpleNamespace(**vars(serial) | {"Serial": Port}), Windows()

def told(measurement):
    return int(measurement.index), zlib.crc32(measurement.rawData.tobytes())

report = {"opened": rtisdev.open_connection(port), "firmware": rtisdev.get_firmware_version()}
config = rtisdev.set_recording_settings(
    microphoneSamples=65536, callSampleFrequency=480000, callDuration=1.25, callMinimumFrequency=20000,
    callMaximumFrequency=80000, callEmissions=3, configName="test",
)
signal = rtisdev.get_current_settings(config).dacSignal
report["hash"] = RTISDev.__dict__["__get_this_pulse_hash"](signal)
report["active"] = told(rtisdev.get_raw_measurement(True))
report["passive"] = told(rtisdev.get_raw_measurement(False))
rtisdev.set_counter(77)
rtisdev.set_behaviour(True)
rtisdev.toggle_external_triggers(1, 2)
report["triggered"] = []

def came(measurement):
    report["triggered"].append(told(measurement))
    if len(report["triggered"]) == 2:
        listener.stop_thread()

listener = rtisdev.create_measure_external_trigger_callback(came, config)
awaited.append("listening")
listener.run()
rtisdev.toggle_amplifier(0)
rtisdev.close_connection()
report = {key: int(value) if key == "hash" else value for key, value in report.items()}
print(json.dumps(report), flush=True)
'''


@dataclass
class Driven:
    report: dict
    registers: Registers
    refused: int


@pytest.fixture(scope="module")
def driven():
    """Run both code paths; return the report of each driver and the registers of its device."""
    with ExitStack() as stack:
        devices = {way: stack.enter_context(Emulator(WORDS, passive=PASSIVE)) for way in ("windows", "linux")}
        drivers = {
            way: stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", DRIVER, way, device.port],
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
            for way, device in devices.items()
        }
        results = {}
        for way, driver in drivers.items():
            assert driver.stdout.readline() == "listening\n", driver.communicate(timeout=60)
            stack.enter_context(SyncChain([devices[way]], PULSES_HZ))
        for way, driver in drivers.items():
            out, errors = driver.communicate(timeout=60)
            assert driver.returncode == 0, errors
            results[way] = Driven(json.loads(out), devices[way].registers, devices[way].refused)
        return results


def crc(words):
    return zlib.crc32(words.tobytes())


@pytest.mark.parametrize("way", ["windows", "linux"])
class TestBothWays:
    def test_rtisdev_finds_the_emulator(self, driven, way):
        assert driven[way].report["opened"] is True
        assert driven[way].report["firmware"] == "v1.0.0"

    def test_rtisdev_configuration_arrives(self, driven, way):
        reported = driven[way].registers
        assert (reported.n_bytes, reported.clock, reported.emissions) == (4 * N_SAMPLES, 0, 3)
        assert (reported.dac_rate_hz, reported.n_codes) == (480_000, 601)
        assert (reported.armed, reported.pin, reported.active, reported.amplifier) == (1, 2, 1, 0)
        assert driven[way].refused == 0

    def test_rtisdev_call_equals_that_of_the_settings(self, driven, way):
        reported = driven[way].registers
        call = Call(start_frequency_hz=80e3, stop_frequency_hz=20e3, duration_s=1.25e-3, sample_rate_hz=480e3)
        assert reported.hash == driven[way].report["hash"] == call_hash(reported.codes[:601])
        error = np.abs(reported.codes[:601].astype(int) - call_codes(call))
        assert error[62:-62].max() <= 1
        assert error.max() <= 0.02 * 2047  # The driver's ramps use a Hann window of another length.

    def test_rtisdev_triggered_measurements_match_the_pulses(self, driven, way):
        # The driver sets the counter to 77; the sync chain numbers its pulses from 0.
        assert driven[way].report["triggered"] == [[77, crc(WORDS[0])], [78, crc(WORDS[1])]]


def test_rtisdev_measurements_have_the_samples_of_the_device(driven):
    assert driven["linux"].report["active"] == [0, crc(WORDS[0])]
    assert driven["linux"].report["passive"] == [1, crc(PASSIVE[1])]


def test_rtisdev_for_windows_swaps_active_and_passive(driven):
    assert driven["windows"].report["active"] == [0, crc(PASSIVE[0])]
    assert driven["windows"].report["passive"] == [1, crc(WORDS[1])]
