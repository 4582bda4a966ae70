"""What is said to a sensor and what it answers, as bytes (facts: rtisdev 2.16.0, the makers' public package).

A command is a line ``!X,i,j,k``. Every one but `A`, measure now, is answered by a number of 32 bits.
"""

import re
from dataclasses import dataclass
from typing import Final, Self

from ertis_numba import checks
from ertis_numba.constants import ERTIS_PDM_RATE_HZ
from ertis_numba.errors import DataError

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
    "decode_answer",
    "encode_answer",
    "firmware_version",
]

CODES: Final = "YGFDECLIHJKBA"
"""Commands by their letter, in the order in which a sensor is set up."""

LENGTH_STEP: Final = 32_768
"""Measurements are so many words long, or a multiple."""

MAX_WORDS: Final = 16_777_216
"""Of one measurement."""

PDM_RATES_HZ: Final = (ERTIS_PDM_RATE_HZ, 1_125_000.0)
"""Clocks by the mode that selects them: ultrasonic and audible."""

DAC_RATES_HZ: Final = (160_000, 2_000_000)
"""Slowest and fastest at which a call is played."""

DAC_SAMPLES: Final = (64, 65_535)
"""Of the shortest and of the longest call."""

DAC_CODE_MAX: Final = 4_095
"""Of a sample of the call: 12 bits."""

PINS: Final = (1, 2)
"""SYNC inputs."""

MAX_NUMBER: Final = 2**32 - 1
"""Of the numbers of commands and answers."""

_LINE: Final = re.compile(rb"!([A-Z]),(\d{1,10}),(\d{1,10}),(\d{1,10})\n?")


@dataclass(frozen=True, slots=True)
class Command:
    """One line to a sensor.

    Attributes
    ----------
    code : str
        One of `CODES`.
    first, second, third : int
        0 to 2³² − 1; those that a command has no use for are 0.

    Raises
    ------
    ArgumentError
        There is no such command, or a number does not fit into 32 bits.
    """

    code: str
    first: int = 0
    second: int = 0
    third: int = 0

    def __post_init__(self) -> None:
        checks.choice("command", self.code, CODES)
        for name in ("first", "second", "third"):
            checks.integer(f"{name} number of command {self.code}", getattr(self, name), 0, MAX_NUMBER)

    def encode(self) -> bytes:
        """Return the line with its end."""
        return b"!%s,%d,%d,%d\n" % (self.code.encode(), self.first, self.second, self.third)

    @classmethod
    def decode(cls, line: bytes) -> Self:
        """Read a line, with its end or without.

        Raises
        ------
        DataError
            It is no command.
        """
        match = _LINE.fullmatch(line)
        numbers = [int(group) for group in match.groups()[1:]] if match else []
        if match is None or match[1].decode() not in CODES or max(numbers) > MAX_NUMBER:
            raise DataError(
                f"{line[:40]!r} is no command; a command is '!X,i,j,k' with X one of {CODES} and whole numbers "
                f"from 0 to {MAX_NUMBER}"
            )
        return cls(match[1].decode(), *numbers)

    @property
    def about(self) -> str:
        """What it does, in words."""
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
        """Whether a number comes back; after `A` a block comes instead."""
        return self.code != "A"


def encode_answer(value: int) -> bytes:
    """Return what a sensor answers: four bytes, least significant first.

    Raises
    ------
    ArgumentError
        The number does not fit into 32 bits.
    """
    return checks.integer("answer", value, 0, MAX_NUMBER).to_bytes(4, "little")


def decode_answer(data: bytes) -> int:
    """Return the number that a sensor answered.

    Raises
    ------
    DataError
        It is not four bytes.
    """
    if len(data) != 4:
        raise DataError(f"answer has {len(data)} bytes; an answer has 4: ask again")
    return int.from_bytes(data, "little")


def firmware_version(answer: int) -> str:
    """Return the answer to `Y` as major, minor and bugfix, such as ``1.2.3``."""
    return f"{answer >> 16 & 0xFF}.{answer >> 8 & 0xFF}.{answer & 0xFF}"
