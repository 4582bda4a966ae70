"""Registers of an emulated device, and its answers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.devices.blocks import COUNTERS
from ertis_numba.devices.commands import (
    DAC_CODE_MAX,
    DAC_RATES_HZ,
    DAC_SAMPLES,
    LENGTH_STEP,
    MAX_NUMBER,
    MAX_WORDS,
    PDM_RATES_HZ,
    PINS,
    Command,
)
from ertis_numba.devices.setup import call_codes, call_from_codes
from ertis_numba.settings import Call

__all__ = ["FIRMWARE", "DeviceConfig", "Registers"]

FIRMWARE = 0x00_01_00_00
"""Firmware version of emulated devices, 1.0.0: bytes 2, 1 and 0."""

_DONE = 1
_NUMBERS = {  # By command: register and range of the first number.
    "G": ("n_bytes", 4 * LENGTH_STEP, 4 * MAX_WORDS),
    "F": ("clock", 0, 1),
    "D": ("dac_rate_hz", *DAC_RATES_HZ),
    "E": ("n_codes", *DAC_SAMPLES),
    "I": ("emissions", 1, MAX_NUMBER),
    "H": ("active", 0, 1),
    "K": ("amplifier", 0, 1),
    "B": ("counter", 0, COUNTERS - 1),
}


@dataclass(frozen=True, slots=True, eq=False)
class DeviceConfig:
    """Call and record that the host has configured."""

    codes: NDArray[np.uint16]  # samples of the call, all 0 if none was loaded
    dac_rate_hz: int
    n_samples: int
    pdm_rate_hz: float

    def holds(self, call: Call) -> bool:
        """Return True if ``call`` is loaded, or if no call is."""
        if not self.codes.any():
            return True
        return self.dac_rate_hz == call.sample_rate_hz and np.array_equal(self.codes, call_codes(call))

    def call(self) -> Call:
        """Return the loaded call as a custom waveform."""
        return call_from_codes(self.codes, float(self.dac_rate_hz))


class Registers:
    """State of a device, initially as after power-up."""

    # `clock` is 0 for 4.5 MHz and 1 for 1.125 MHz. Real devices are known to begin with amplifier on and trigger off;
    # the rest is assumed.

    def __init__(self) -> None:
        self.n_bytes = 655_360
        self.clock = 0
        self.dac_rate_hz = 450_000
        self.n_codes = 0
        self.codes = np.zeros(DAC_SAMPLES[1], dtype=np.uint16)
        self.emissions = 1
        self.active = 0
        self.amplifier = 1
        self.armed = 0
        self.pin = 1
        self.counter = 0

    @property
    def n_samples(self) -> int:
        """Number of words in one measurement."""
        return self.n_bytes // 4

    @property
    def duration_ns(self) -> int:
        """Duration of a measurement."""
        return self.n_samples * 1_000_000_000 // round(PDM_RATES_HZ[self.clock])

    @property
    def config(self) -> DeviceConfig:
        """Current call and record."""
        codes = self.codes[: self.n_codes].copy()
        return DeviceConfig(codes, self.dac_rate_hz, self.n_samples, PDM_RATES_HZ[self.clock])

    @property
    def hash(self) -> int:
        """XOR of the call's samples."""
        return int(np.bitwise_xor.reduce(self.codes[: self.n_codes], initial=0))

    def answer(self, command: Command) -> int | None:
        """Run a command; return the device's answer, or None for a refused command."""
        first, second = command.first, command.second
        if command.code in {"Y", "L"}:
            return FIRMWARE if command.code == "Y" else self.hash
        if command.code == "C":
            good = first < self.n_codes and second <= DAC_CODE_MAX
            if good:
                self.codes[first] = second
        elif command.code == "J":
            good = first in {0, 1} and second in PINS
            if good:
                self.armed, self.pin = first, second
        else:
            name, low, high = _NUMBERS[command.code]
            good = low <= first <= high and (command.code != "G" or first % low == 0)
            if good:
                setattr(self, name, first)
        return _DONE if good else None
