"""Commands to a sensor and its answers, as bytes (facts: rtisdev 2.16.0, the makers' public package).

A command is a line ``!X,i,j,k``. A number of 32 bits answers each command except `A`, measure now.
"""

import re
from dataclasses import dataclass
from typing import Final, Self

from ertis_numba.base import checks
from ertis_numba.base.constants import ERTIS_PDM_RATE_HZ
from ertis_numba.base.errors import ArgumentError, DataError

__all__ = [
    "CODES",
    "DAC_CODE_MAX",
    "DAC_RATES_HZ",
    "DAC_SAMPLES",
    "LENGTH_STEP",
    "MAX_NUMBER",
    "MAX_WORDS",
    "PDM_RATES_HZ",
    "PINS",
    "Command",
    "CustomCommand",
    "decode_answer",
    "encode_answer",
    "firmware_version",
]

CODES: Final = "YGFDECLIHJKBA"
"""Commands by their letter, in the order of a configuration."""

LENGTH_STEP: Final = 32_768
"""Step of the length of measurements, in bytes."""

MAX_WORDS: Final = 16_777_216
"""Limit on the words of one measurement."""

PDM_RATES_HZ: Final = (ERTIS_PDM_RATE_HZ, 1_125_000.0)
"""PDM clock rates by mode: ultrasonic and audible."""

DAC_RATES_HZ: Final = (160_000, 2_000_000)
"""Lowest and highest sample rate of a call."""

DAC_SAMPLES: Final = (64, 65_535)
"""Number of samples of the shortest and of the longest call."""

DAC_CODE_MAX: Final = 4_095
"""Largest sample code of the call: 12 bits."""

PINS: Final = (1, 2)
"""SYNC inputs."""

MAX_NUMBER: Final = 2**32 - 1
"""Largest number in commands and answers."""

_LINE: Final = re.compile(rb"!([A-Z]),(\d{1,10}),(\d{1,10}),(\d{1,10})\n?")


@dataclass(frozen=True, slots=True)
class Command:
    """One command to a sensor: one of `CODES`, and three numbers from 0 to 2³² − 1; unused ones are 0."""

    code: str
    first: int = 0
    second: int = 0
    third: int = 0

    def __post_init__(self) -> None:
        checks.choice("command", self.code, CODES)
        for name in ("first", "second", "third"):
            checks.integer(f"{name} number of command {self.code}", getattr(self, name), 0, MAX_NUMBER)

    def encode(self) -> bytes:
        """Return the line with its line end."""
        return b"!%s,%d,%d,%d\n" % (self.code.encode(), self.first, self.second, self.third)

    @classmethod
    def decode(cls, line: bytes) -> Self:
        """Decode a line, with or without its line end."""
        match = _LINE.fullmatch(line)
        numbers = [int(group) for group in match.groups()[1:]] if match else []
        if match is None or match[1].decode() not in CODES or max(numbers) > MAX_NUMBER:
            raise DataError(
                f"{line[:40]!r} is not a command; a command is '!X,i,j,k' with X one of {CODES} and whole "
                f"numbers from 0 to {MAX_NUMBER}"
            )
        return cls(match[1].decode(), *numbers)

    @property
    def about(self) -> str:
        """Description of the command."""
        first, second = self.first, self.second
        switched = "on" if first else "off"
        emitting = "active" if first else "passive"
        return {
            "Y": "firmware version?",
            "G": f"measurement length: {first} bytes",
            "F": f"PDM clock: {PDM_RATES_HZ[first]:.0f} Hz"
            if first < len(PDM_RATES_HZ)
            else f"PDM clock: mode {first}",
            "D": f"rate of the call: {first} Hz",
            "E": f"length of the call: {first} samples",
            "C": f"sample {first} of the call: {second}",
            "L": "hash of the call?",
            "I": f"emissions per measurement: {first}",
            "H": f"triggered measurements: {emitting}",
            "J": f"SYNC input {second}: {switched}",
            "K": f"amplifier: {switched}",
            "B": f"measurement counter: {first}",
            "A": f"measure now: {emitting}",
        }[self.code]

    @property
    def answers(self) -> bool:
        """True if a number answers it; a block follows `A` instead."""
        return self.code != "A"


@dataclass(frozen=True, slots=True)
class CustomCommand:
    """One command as text ``!X,i,j,k``, such as ``!Y,0,0,0``, which must not measure."""

    text: str

    def __post_init__(self) -> None:
        match = _LINE.fullmatch(self.text.encode())
        if match is None or "\n" in self.text or max(map(int, match.groups()[1:])) > MAX_NUMBER:
            raise ArgumentError(
                f"command is {self.text!r}; use '!X,i,j,k' with a letter X and whole numbers up to {MAX_NUMBER}, "
                "such as '!Y,0,0,0'"
            )
        if match[1] == b"A":
            raise ArgumentError("command A measures, and no answer follows; call measure(), or use 'ertis capture'")

    @property
    def about(self) -> str:
        """Description of the command."""
        return self.text

    @property
    def changes_settings(self) -> bool:
        """True if the command may change the settings of a sensor: all except queries."""
        return self.text[1] not in "YL"

    def encode(self) -> bytes:
        """Return the line with its line end."""
        return self.text.encode() + b"\n"


def encode_answer(value: int) -> bytes:
    """Return a sensor's answer: four bytes, least significant first."""
    return checks.integer("answer", value, 0, MAX_NUMBER).to_bytes(4, "little")


def decode_answer(data: bytes) -> int:
    """Return the number in a sensor's answer."""
    if len(data) != 4:
        raise DataError(f"answer has {len(data)} bytes; an answer has 4: ask again")
    return int.from_bytes(data, "little")


def firmware_version(answer: int) -> str:
    """Return the answer to `Y` as major, minor and bugfix, such as ``1.2.3``."""
    return f"{answer >> 16 & 0xFF}.{answer >> 8 & 0xFF}.{answer & 0xFF}"
