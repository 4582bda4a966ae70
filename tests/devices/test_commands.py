"""Commands, answers and blocks as bytes, and the commands that settings produce."""

import dataclasses
import math
import struct

import numpy as np
import pytest
from hypothesis import given, strategies as st

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.devices import blocks, commands
from ertis_numba.devices.commands import Command
from ertis_numba.devices.setup import Setup, call_codes, call_hash
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Array, Call, Recording, Settings
from tests.cases import LINE_8

NUMBERS = st.integers(0, 2**32 - 1)
WIDE = tuple((0.0, 0.001 * channel, 0.0) for channel in range(33))


@given(st.sampled_from(commands.CODES), NUMBERS, NUMBERS, NUMBERS)
def test_command_encoding_round_trips(code, first, second, third):
    command = Command(code, first, second, third)
    line = command.encode()
    assert Command.decode(line) == Command.decode(line.removesuffix(b"\n")) == command
    assert line.isascii()
    assert line.endswith(b"\n")
    assert len(command.about.splitlines()) == 1


def test_command_bytes_are_fixed():
    assert Command("G", 655_360).encode() == b"!G,655360,0,0\n"
    assert Command("C", 17, 4095).encode() == b"!C,17,4095,0\n"


@given(st.binary(max_size=30))
def test_command_decode_of_any_bytes_succeeds_or_raises(line):
    try:
        command = Command.decode(line)
    except DataError:
        return
    assert Command.decode(command.encode()) == command


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"\n",
        b"!G,1,2\n",
        b"!G,1,2,3,4\n",
        b"!G,1,2,3\r\n",
        b"!G,1,2,3\n\n",
        b"G,1,2,3\n",
        b"!g,1,2,3\n",
        b"!X,0,0,0\n",
        b"!GG,1,2,3\n",
        b"!G,-1,0,0\n",
        b"!G,1.5,0,0\n",
        b"!G, 1,0,0\n",
        b"!G,,0,0\n",
        b"!G,4294967296,0,0\n",
        b"!G,\xd9\xa1,0,0\n",
    ],
)
def test_command_decode_rejects_invalid_lines(line):
    with pytest.raises(
        DataError,
        match="is not a command; a command is '!X,i,j,k' with X one of YGFDECLIHJKBA and whole numbers from 0 to",
    ) as caught:
        Command.decode(line)
    assert "\n" not in str(caught.value)


def test_command_decode_error_truncates_long_lines():
    with pytest.raises(DataError, match=r"^b'A{40}' is not a command"):
        Command.decode(b"A" * 10_000)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("Q",), "command 'Q' is unknown; known are Y, G, F"),
        (("G", -1), "first number of command G is -1; use a whole number from 0 to 4294967295"),
        (("C", 0, 2**32), "second number of command C is 4294967296; use a whole number from 0 to 4294967295"),
        (("C", 0, 0, 1.0), "third number of command C is 1.0; use a whole number"),
    ],
)
def test_command_rejects_unknown_letter_and_invalid_numbers(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        Command(*arguments)


def test_command_about_describes_each_command():
    reported = [Command(code, 1, 2).about for code in commands.CODES]
    assert reported == [
        "firmware version?",
        "measurement length: 1 bytes",
        "PDM clock: 1125000 Hz",
        "rate of the call: 1 Hz",
        "length of the call: 1 samples",
        "sample 1 of the call: 2",
        "hash of the call?",
        "emissions per measurement: 1",
        "triggered measurements: active",
        "SYNC input 2: on",
        "amplifier: on",
        "measurement counter: 1",
        "measure now: active",
    ]
    assert [Command(code).about for code in "FHJKA"] == [
        "PDM clock: 4500000 Hz",
        "triggered measurements: passive",
        "SYNC input 0: off",
        "amplifier: off",
        "measure now: passive",
    ]
    assert Command("F", 2).about == "PDM clock: mode 2"


def test_every_command_but_measure_has_an_answer():
    assert [code for code in commands.CODES if not Command(code).answers] == ["A"]


@given(NUMBERS)
def test_answer_encoding_round_trips(value):
    assert commands.decode_answer(commands.encode_answer(value)) == value


def test_answer_bytes_are_fixed():
    assert commands.encode_answer(0x01020304) == b"\x04\x03\x02\x01"
    assert commands.firmware_version(0xFF_02_10_00) == "2.16.0"


@pytest.mark.parametrize("data", [b"", b"abc", b"abcde"])
def test_answer_of_wrong_length_is_refused(data):
    with pytest.raises(DataError, match=f"answer has {len(data)} bytes; an answer has 4: ask again"):
        commands.decode_answer(data)


def test_answer_above_32_bits_is_refused():
    with pytest.raises(ArgumentError, match="answer is 4294967296; use a whole number from 0 to 4294967295"):
        commands.encode_answer(2**32)


def test_block_bytes_are_fixed():
    words = np.array([1, 0xA0B0C0D0], dtype=np.uint32)
    expected = struct.pack("<IIIII", 0x51534E12, 7, 1, 0xA0B0C0D0, 0x2F418672)
    assert blocks.encode_block(7, words) == expected
    assert blocks.encode_block(7, words.astype(">u4")) == expected
    assert len(expected) == blocks.FRAME_BYTES + 4 * len(words)


@pytest.mark.parametrize(
    ("counter", "words", "message"),
    [
        (-1, np.zeros(1, np.uint32), "counter is -1; use a whole number from 0 to 4294967295"),
        (0, np.zeros(1, np.int32), r"words are int32 of shape \(1,\); use \(sample,\) uint32"),
        (0, np.zeros(1, np.uint64), r"words are uint64 of shape \(1,\); use \(sample,\) uint32"),
        (0, np.zeros((1, 2), np.uint32), r"words are uint32 of shape \(1, 2\); use \(sample,\) uint32"),
    ],
)
def test_encode_block_rejects_invalid_counter_and_samples(counter, words, message):
    with pytest.raises(ArgumentError, match=message):
        blocks.encode_block(counter, words)


def test_call_codes_follow_the_documented_phase():
    """The reference is the phase formula of the manufacturer, evaluated sample by sample."""
    call = Call()
    codes = call_codes(call)
    assert (len(codes), codes.dtype) == (1126, np.uint16)  # t = 0 … T inclusive
    low, high, duration_s = 1 / call.start_frequency_hz, 1 / call.stop_frequency_hz, call.duration_s
    for sample in range(113, 1013):  # between the ramps
        time_s = sample / call.sample_rate_hz
        slope = (high - low) / duration_s
        phase = 2 * math.pi / slope * (math.log(low + time_s * slope) - math.log(low))
        assert abs(codes[sample] - math.floor(2047 * math.sin(phase) + 2048)) <= 1
    assert codes.tolist() == [math.floor(2047 * value + 2048) for value in call_samples(call).tolist()]
    assert codes[0] == codes[-1] == 2048
    assert 1 <= codes.min() < 10
    assert 4085 < codes.max() <= 4095


def test_call_hash_is_the_xor_of_its_codes():
    assert call_hash(np.array([0b0101, 0b0011, 0b1000], np.uint16)) == 0b1110
    assert call_hash(np.array([], np.uint16)) == 0


def test_setup_of_default_settings_gives_expected_commands():
    setup = Setup.of(Settings())
    assert [command.encode() for command in setup.before_call()] == [
        b"!J,0,1,0\n",
        b"!G,655360,0,0\n",
        b"!F,0,0,0\n",
        b"!D,450000,0,0\n",
        b"!E,1126,0,0\n",
    ]
    assert [(command.code, command.first, command.second) for command in setup.call()] == [
        ("C", index, code) for index, code in enumerate(call_codes(Call()))
    ]
    assert [command.encode() for command in setup.after_call()] == [b"!I,1,0,0\n", b"!K,1,0,0\n", b"!H,1,0,0\n"]
    assert setup.n_bytes == 655_360


def test_setup_of_a_passive_sensor_gives_expected_commands():
    settings = Settings().replace(recording=Recording(n_samples=32_768, sample_rate_hz=1_125_000.0), call=_slow())
    setup = Setup.of(settings, active=False, pin=2, emissions=3)
    assert b"".join(command.encode() for command in setup.before_call()[:3]) == b"!J,0,2,0\n!G,131072,0,0\n!F,1,0,0\n"
    assert b"".join(command.encode() for command in setup.after_call()) == b"!I,3,0,0\n!K,0,0,0\n!H,0,0,0\n"
    assert not setup.amplifier


def _slow():
    return Call(start_frequency_hz=12_000.0, stop_frequency_hz=6_000.0, sample_rate_hz=160_000.0)


@pytest.mark.parametrize("preset", ["short_20_80", "default_25_50", "long_20_80"])
def test_setup_accepts_presets(preset):
    assert Setup.of(Settings.from_preset(preset)).n_samples % commands.LENGTH_STEP == 0


def test_setup_accepts_the_longest_measurement():
    setup = Setup.of(Settings(recording=Recording(n_samples=commands.MAX_WORDS)))
    assert setup.before_call()[1] == Command("G", 2**26)


def _call(**changes):
    return {"call": Call().replace(**changes)}


def _recording(**changes):
    return {"recording": Recording().replace(**changes)}


REFUSED = [
    (_recording(n_samples=100_000), "recording.n_samples is 100000, but a sensor measures multiples .*; use 98304"),
    (_recording(n_samples=100), "recording.n_samples is 100, but a sensor measures multiples .*; use 32768"),
    (_recording(n_samples=2**25), "recording.n_samples is 33554432, but .* up to 16777216; use 16777216"),
    (
        _recording(sample_rate_hz=4_000_000.0),
        "recording.sample_rate_hz is 4000000, but .* clocks are 4500000 and 1125000; choose one",
    ),
    (_call(sample_rate_hz=450_000.5), "call.sample_rate_hz is 450000.5; use a whole number from 160000 to 2000000"),
    (_call(sample_rate_hz=159_999.0), "call.sample_rate_hz is 159999; use a whole number from 160000 to 2000000"),
    (_call(sample_rate_hz=2e6 + 1), "call.sample_rate_hz is 2000001; use a whole number from 160000 to 2000000"),
    (
        _call(duration_s=1e-4),
        "call has 46 samples, .* plays 64 to 65535; use call.delay_s and call.duration_s that add up to 0.00014 to",
    ),
    (_call(duration_s=0.15), "call has 67501 samples, but a sensor plays 64 to 65535; .* to 0.146"),
    (
        {"array": Array(layout="wide", positions_m=WIDE)},
        "array has 33 channels, but a sensor has 32; use at most 32 positions",
    ),
    (
        {"array": Array(layout="line", positions_m=LINE_8, word_bits=8)},
        "array.word_bits is 8, but .* words have 32 bits; use 32",
    ),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_setup_rejects_settings_beyond_the_hardware(changes, message):
    settings = Settings().replace(**changes)
    with pytest.raises(ArgumentError, match=message) as caught:
        Setup.of(settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("n_samples", [64, 65_535])
def test_setup_accepts_the_shortest_and_longest_call(n_samples):
    setup = Setup.of(Settings().replace(**_call(duration_s=(n_samples - 1) / 450_000)))
    assert setup.before_call()[-1] == Command("E", n_samples)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pin": 3}, "pin is 3; use a whole number from 1 to 2"),
        ({"emissions": 0}, "emissions is 0; use a whole number from 1 to"),
    ],
)
def test_setup_of_settings_rejects_invalid_options(changes, message):
    with pytest.raises(ArgumentError, match=message):
        Setup.of(Settings(), **changes)


CODES = call_codes(Call())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"n_samples": 100_000},
            r"recording\.n_samples is 100000, but a sensor measures multiples of 32768 up to 16777216",
        ),
        ({"n_samples": 0}, "n_samples is 0; use a whole number of at least 1"),
        ({"n_samples": 32_768.0}, "n_samples is 32768.0; use a whole number"),
        ({"pdm_rate_hz": 4e6}, "sample_rate_hz is 4000000, but a sensor's clocks are 4500000 and 1125000"),
        ({"dac_rate_hz": 100_000}, "sample_rate_hz is 100000; use a whole number from 160000 to 2000000"),
        ({"codes": CODES[:63]}, "call has 63 samples, but a sensor plays 64 to 65535"),
        ({"codes": CODES.astype(int)}, r"codes are int64 of shape \(1126,\); use \(sample,\) uint16"),
        ({"codes": CODES[None]}, r"codes are uint16 of shape \(1, 1126\); use \(sample,\) uint16"),
        ({"codes": CODES + np.uint16(2_000)}, r"codes reach \d+, but a sensor's converter accepts 0 to 4095"),
        ({"emissions": 0}, "emissions is 0; use a whole number from 1 to"),
        ({"pin": 3}, "pin is 3; use a whole number from 1 to 2"),
        (
            {"amplifier": False},
            "active is True with the amplifier off, which emits nothing; switch it on",
        ),
    ],
)
def test_setup_constructor_rejects_invalid_arguments(changes, message):
    right = {"n_samples": 32_768, "pdm_rate_hz": 4.5e6, "codes": CODES, "dac_rate_hz": 450_000}
    with pytest.raises(ArgumentError, match=message) as caught:
        Setup(**right | changes)
    assert "\n" not in str(caught.value)
    assert Setup(**right).before_call() == Setup.of(Settings(recording=Recording(n_samples=32_768))).before_call()


def test_setup_accepts_fewer_channels_than_bits():
    setup = Setup.of(Settings().replace(array=Array(layout="line", positions_m=LINE_8)))
    assert setup.n_samples == Recording().n_samples


def test_setup_is_immutable():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Setup.of(Settings()).pin = 2
