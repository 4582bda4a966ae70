"""What is said to a sensor and what it answers, as bytes (facts: rtisdev 2.16.0, the makers' public package).

A command is a line ``!X,i,j,k``. Every one but `A`, measure now, is answered by a number of 32 bits. A measurement
comes as a block: header, counter, PDM words, footer; nothing in it tells its length or its time.
"""

import re
from dataclasses import dataclass
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.constants import ERTIS_PDM_RATE_HZ
from ertis_numba.errors import ArgumentError, DataError
from ertis_numba.geometry import microphones
from ertis_numba.settings import Array, Call, Settings
from ertis_numba.waveform import call_samples

__all__ = [
    "CODES",
    "FOOTER",
    "FRAME_BYTES",
    "HEADER",
    "LENGTH_STEP",
    "MOST_WORDS",
    "PDM_RATES_HZ",
    "Command",
    "Setup",
    "call_codes",
    "call_hash",
    "decode_answer",
    "encode_answer",
    "encode_block",
    "firmware_version",
]

CODES: Final = "YGFDECLIHJKBA"
"""Commands by their letter, in the order in which a sensor is set up."""

HEADER: Final = 1_364_413_970
"""First word of a block."""

FOOTER: Final = 792_823_410
"""Last word of a block."""

FRAME_BYTES: Final = 12
"""Header, counter and footer."""

LENGTH_STEP: Final = 32_768
"""Measurements are so many words long, or a multiple."""

MOST_WORDS: Final = 16_777_216
"""Of one measurement."""

PDM_RATES_HZ: Final = (ERTIS_PDM_RATE_HZ, 1_125_000.0)
"""Clocks by the mode that selects them: ultrasonic and audible."""

_MOST: Final = 2**32 - 1
_DAC_RATES_HZ: Final = (160_000, 2_000_000)
_DAC_SAMPLES: Final = (64, 65_535)
_CHANNELS: Final = 32
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
            checks.whole(f"{name} number of command {self.code}", getattr(self, name), 0, _MOST)

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
        if match is None or match[1].decode() not in CODES or max(numbers) > _MOST:
            raise DataError(
                f"{line[:40]!r} is no command; a command is '!X,i,j,k' with X one of {CODES} and whole numbers "
                f"from 0 to {_MOST}"
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
    return checks.whole("answer", value, 0, _MOST).to_bytes(4, "little")


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


def encode_block(counter: int, words: NDArray[np.uint32]) -> bytes:
    """Return a measurement as a sensor sends it.

    Parameters
    ----------
    counter : int
    words : (sample,) uint32

    Raises
    ------
    ArgumentError
        The counter does not fit into 32 bits, or the words are no uint32.
    """
    counter = checks.whole("counter", counter, 0, _MOST)
    if words.dtype.kind != "u" or words.dtype.itemsize != 4 or words.ndim != 1:
        raise ArgumentError(f"words are {words.dtype} of shape {words.shape}; give (sample,) uint32")
    payload = words.astype("<u4", copy=False).tobytes()
    return HEADER.to_bytes(4, "little") + counter.to_bytes(4, "little") + payload + FOOTER.to_bytes(4, "little")


def call_codes(call: Call) -> NDArray[np.uint16]:
    """Return a call as the codes of the 12-bit converter, ``floor(2047 s + 2048)``: (sample,) uint16."""
    return np.floor(2047 * call_samples(call) + 2048).astype(np.uint16)


def call_hash(codes: NDArray[np.uint16]) -> int:
    """Return the XOR of all codes, which is what a sensor answers to `L`."""
    return int(np.bitwise_xor.reduce(codes, initial=0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setup:
    """All that a sensor is told before it measures; make it by `Setup.of`, which refuses what no sensor can do.

    Attributes
    ----------
    n_samples : int
        Words of one measurement.
    pdm_rate_hz : float
        One of `PDM_RATES_HZ`.
    codes : (sample,) uint16
        The call.
    dac_rate_hz : int
        Rate at which it is played.
    emissions : int
        Calls per measurement.
    active : bool
        Whether triggered measurements emit the call.
    trigger : {"command", "sync"}
    pin : {1, 2}
        SYNC input.
    amplifier : bool
        Whether the high-voltage amplifier is on, without which nothing is emitted.
    """

    n_samples: int
    pdm_rate_hz: float
    codes: NDArray[np.uint16]
    dac_rate_hz: int
    emissions: int = 1
    active: bool = True
    trigger: Literal["command", "sync"] = "command"
    pin: int = 1
    amplifier: bool = True

    @classmethod
    def of(
        cls,
        settings: Settings,
        *,
        active: bool = True,
        trigger: Literal["command", "sync"] = "command",
        pin: int = 1,
        emissions: int = 1,
    ) -> Self:
        """Return what a sensor has to be told for ``settings``.

        A call is loaded even where nothing is to be emitted, so that a single measurement may be made active.

        Raises
        ------
        ArgumentError
            A sensor cannot do it.
        """
        checks.choice("trigger", trigger, ("command", "sync"))
        recording = settings.recording
        if recording.n_samples % LENGTH_STEP or recording.n_samples > MOST_WORDS:
            near = min(max(round(recording.n_samples / LENGTH_STEP), 1) * LENGTH_STEP, MOST_WORDS)
            raise ArgumentError(
                f"recording.n_samples is {recording.n_samples}; a sensor measures multiples of {LENGTH_STEP} up to "
                f"{MOST_WORDS}: give {near}"
            )
        if recording.pdm_rate_hz not in PDM_RATES_HZ:
            raise ArgumentError(
                f"recording.pdm_rate_hz is {recording.pdm_rate_hz:.10g}; a sensor's clocks are "
                f"{PDM_RATES_HZ[0]:.0f} and {PDM_RATES_HZ[1]:.0f}: give one of them"
            )
        _check_array(settings.array)
        return cls(
            n_samples=recording.n_samples,
            pdm_rate_hz=recording.pdm_rate_hz,
            codes=_playable(settings.call),
            dac_rate_hz=int(settings.call.sample_rate_hz),
            emissions=checks.whole("emissions", emissions, 1, _MOST),
            active=active,
            trigger=trigger,
            pin=checks.whole("pin", pin, 1, 2),
            amplifier=active,
        )

    @property
    def n_bytes(self) -> int:
        """Of the words of one measurement; a block has `FRAME_BYTES` more."""
        return 4 * self.n_samples

    def before_call(self) -> list[Command]:
        """Return what comes first: nothing triggers, then lengths and rates."""
        return [
            Command("J", 0, self.pin),
            Command("G", self.n_bytes),
            Command("F", PDM_RATES_HZ.index(self.pdm_rate_hz)),
            Command("D", self.dac_rate_hz),
            Command("E", len(self.codes)),
        ]

    def call(self) -> list[Command]:
        """Return the samples of the call, one command each."""
        return [Command("C", index, code) for index, code in enumerate(self.codes.tolist())]

    def after_call(self) -> list[Command]:
        """Return what comes last; then the counter may be set and the trigger switched on."""
        return [Command("I", self.emissions), Command("K", int(self.amplifier)), Command("H", int(self.active))]


def _check_array(array: Array) -> None:
    layout = microphones(array)
    if layout.word_bits != _CHANNELS:
        raise ArgumentError(f"array.word_bits is {layout.word_bits}; a sensor's words have {_CHANNELS}: give that")
    if len(layout.enabled) > _CHANNELS:
        raise ArgumentError(
            f"array has {len(layout.enabled)} channels; a sensor has {_CHANNELS}: give so many positions, or fewer"
        )


def _playable(call: Call) -> NDArray[np.uint16]:
    """Return the codes of a call that the converter can play."""
    slowest_hz, fastest_hz = _DAC_RATES_HZ
    if not (call.sample_rate_hz.is_integer() and slowest_hz <= call.sample_rate_hz <= fastest_hz):
        raise ArgumentError(
            f"call.sample_rate_hz is {call.sample_rate_hz:.10g}; give a whole number from {slowest_hz} to {fastest_hz}"
        )
    codes = call_codes(call)
    fewest, most = _DAC_SAMPLES
    if not fewest <= len(codes) <= most:
        raise ArgumentError(
            f"call has {len(codes)} samples; a sensor plays {fewest} to {most}: give a call.duration_s from "
            f"{(fewest - 1) / call.sample_rate_hz:.3g} to {(most - 1) / call.sample_rate_hz:.3g}"
        )
    return codes
