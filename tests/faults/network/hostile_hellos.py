"""Hello messages that a central node must refuse.

Their settings are too long, too deep or too large, or they name files.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from ertis_numba.network.messages import MAGIC, VERSION
from ertis_numba.settings import Processing, Recording, Settings

__all__ = ["HostileHello", "hello_header", "hostile_hellos", "hostile_texts"]

_MAGIC: Final = MAGIC + bytes([VERSION])
_GOOD: Final = Settings(
    recording=Recording(n_samples=32_768), processing=Processing(directions="2d:9", range_m=(0.3, 1.0))
)
_MAX: Final = 262_144
_NUMBERS: Final = {
    "call": ("start_frequency_hz", "stop_frequency_hz", "duration_s", "sample_rate_hz", "ramp_fraction"),
    "recording": ("sample_rate_hz", "n_samples"),
    "air": ("temperature_c", "humidity_percent", "pressure_pa"),
    "processing": ("range_decimation", "decimation", "dmas_order", "snapshots", "diagonal_loading"),
    "accuracy": (
        "max_error_db",
        "oversampling",
        "delay_taps",
        "beam_taps",
        "beam_density",
        "stopband_attenuation_db",
        "focal_zones",
    ),
}
_EXTREMES: Final = ("nan", "inf", "-1e300", "1e300", "9" * 4000, "0x" + "f" * 4000, "9223372036854775808", "1979-05-27")
_DIRECTIONS: Final = (
    "/etc/passwd", "/etc/passwd.csv", "/etc/passwd.csv/", "/etc/passwd.CSV", "/etc/./passwd.csv//.", "../../x.csv",
    "..\\\\..\\\\x.csv", "~/x.csv", "C:\\\\x.csv", "\\\\\\\\host\\\\share\\\\x.csv", "file:///x.csv", "//host/x.csv",
    "/dev/stdin", "/proc/self/fd/0", "x.csv\\u0000", "x\\u202e.csv", "\\u001b[31mx.csv", "", " ", ".", "90 ", "4d:9",
    "2d:", "2d:0", "2d:-1", "2d:1.5", "2d: 9", "2d:\\u0663", "2d:1000001", "3d:1000000000", "3d:" + "9" * 4000,
    "3d:9:9",
    "x" * 5000,
)  # fmt: skip
_LAYOUTS: Final = (
    "/etc/passwd", "/etc/passwd.toml", "/etc/passwd.csv", "/etc/passwd.csv/", "../eRTIS_v3D1.toml", "eRTIS_v3D1.toml",
    "ertis_v3d1", "~/x.toml", "C:\\\\x.toml", "/dev/zero", "/dev/zero.csv", "\\u0000", "\\n", "\\u2028", "",
    "y" * 100_000,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class HostileHello:
    """Hello message that must be refused.

    Attributes
    ----------
    name : str
    header : bytes
    payload : tuple of bytes
    """

    name: str
    header: bytes
    payload: tuple[bytes, ...]


def hello_header(text: bytes, **changes: Any) -> bytes:
    """Return the header of a hello message whose settings are ``text``."""
    fields = {"sensor": "bad", "session_id": 1, "next_sequence": 0, "settings_crc32": zlib.crc32(text)} | changes
    return _MAGIC + msgspec.msgpack.encode({"kind": "hello"} | fields)


def hostile_hellos() -> Iterator[HostileHello]:
    """Yield all hostile hello messages, with cheap and expensive ones mixed."""
    for name, text in hostile_texts():
        yield HostileHello(name, hello_header(text), (text,))
    good = _GOOD.to_toml().encode()
    changes: dict[str, dict[str, Any]] = {
        "header: name with a slash": {"sensor": "../bad"},
        "header: name of 65 characters": {"sensor": "b" * 65},
        "header: name that ends in a newline": {"sensor": "bad\n"},
        "header: epoch below 0": {"session_id": -1},
        "header: epoch of 64 bits": {"session_id": 2**64 - 1},
        "header: next number of 2^63": {"next_sequence": 2**63},
        "header: translation of NaN": {"translation_m": [float("nan"), 0.0, 0.0]},
        "header: translation of infinity": {"translation_m": [float("inf"), 0.0, 0.0]},
        "header: rotation of length 0": {"rotation_xyzw": [0.0, 0.0, 0.0, 0.0]},
        "header: rotation of NaN": {"rotation_xyzw": [float("nan")] * 4},
        "header: firmware with an escape": {"firmware": "\x1b[31m"},
        "header: firmware of 3,000 characters": {"firmware": "1" * 3000},
        "header: another CRC-32": {"settings_crc32": 0},
        "header: unknown field": {"more": 1},
    }
    for name, change in changes.items():
        yield HostileHello(name, hello_header(good, **change), (good,))
    yield HostileHello("payload: none", hello_header(good), ())
    yield HostileHello("payload: two", hello_header(good), (good, good))


def hostile_texts() -> Iterator[tuple[str, bytes]]:
    """Yield names and settings that are invalid in every message and file."""
    for name, text in _texts():
        yield name, text.encode("utf-8", "surrogatepass")
    yield "bytes: not UTF-8", b"\xff\xfe" * 1000
    yield "bytes: UTF-16", "[call]\n".encode("utf-16")
    yield "bytes: 1 MB", b"\n" * 1_000_000
    yield "bytes: zeros", bytes(10_000)


def _texts() -> Iterator[tuple[str, str]]:
    yield from _shapes()
    for table, keys in _NUMBERS.items():
        for key in keys:
            for value in _EXTREMES:
                yield f"number: {table}.{key} = {value[:20]}", f"[{table}]\n{key} = {value}\n"
    for directions in _DIRECTIONS:
        yield f"directions: {directions[:40]!r}", f'[processing]\ndirections = "{directions}"\n'
    for layout in _LAYOUTS:
        yield f"layout: {layout[:40]!r}", f'[array]\nlayout = "{layout}"\n'
    calls = ((1.0, 1e300), (1.0, 5e7), (1.0, 1.1e6), (0.1, 1e9), (1e-300, 1e300), (1.0, 1e-300), (16.0, 450_000.0))
    for duration_s, rate_hz in calls:
        yield (
            f"call: {duration_s:g} s at {rate_hz:g} Hz",
            f"[call]\nduration_s = {duration_s}\nsample_rate_hz = {rate_hz}\n",
        )
    for n_samples in (0, -1, 2**20 + 1, 2**28, 2**28 + 1, 2**63 - 1, 2**63, 2**64):
        yield f"recording: {n_samples} samples", f"[recording]\nn_samples = {n_samples}\n"
    for bits in (0, 1, 7, 128, 2**63):
        yield f"array: words of {bits} bits", f"[array]\nword_bits = {bits}\n"
    yield "array: 1,025 microphones", f"[array]\npositions_m = [{'[0.0, 0.0, 0.0], ' * 1025}]\n"
    yield "array: a position of NaN", "[array]\npositions_m = [[nan, 0.0, 0.0]]\n"
    yield "array: a position of 1e300", "[array]\npositions_m = [[1e300, 0.0, 0.0]]\n"
    yield "array: no microphones", "[array]\npositions_m = []\n"
    yield "array: a list of lists of lists", f"[array]\npositions_m = [{'[[0.0, 0.0, 0.0]], ' * 1000}]\n"
    yield "range: 10 km", "[processing]\nrange_m = [0.0, 10001.0]\n"
    yield "range: backwards", "[processing]\nrange_m = [5.0, 0.5]\n"
    yield "range: of NaN", "[processing]\nrange_m = [nan, nan]\n"


def _shapes() -> Iterator[tuple[str, str]]:
    """Yield texts whose length, lines, depth or keys make parsing slow."""
    end = "bogus = 1\n"
    for count in (1_000, 25_000, _MAX - 20):
        yield f"lines: {count} blank ones", "\n" * count + end
        yield f"lines: {count} spaces", " " * count + end
        yield f"lines: {count // 2} comments", "#\n" * (count // 2) + end
        yield f"lines: {count // 8} tables", "".join(f"[a{n}]\n" for n in range(count // 8)) + end
        yield f"lines: {count // 10} keys", "".join(f"a{n}=1\n" for n in range(count // 10)) + end
        yield f"lines: {count // 6} lists of tables", "[[a]]\n" * (count // 6) + end
        yield f"depth: {count} brackets", f"x = {'[' * count}"
        yield f"depth: {count // 2} lists", f"x = {'[' * (count // 2)}{']' * (count // 2)}"
        yield f"depth: {count // 4} inline tables", f"x = {'{a=' * (count // 4)}1{'}' * (count // 4)}"
        yield f"parts: {count // 2} of a key", f"a{'.a' * (count // 2)} = 1\n"
        yield f"parts: {count // 4} of a quoted key", f'"a"{".a" * (count // 4)} = 1\n'
        yield f"parts: {count // 2} of a header", f"[a{'.a' * (count // 2)}]\n"
        yield f"parts: {count // 3} with spaces", f"a{' .a' * (count // 3)} = 1\n"
        yield f"parts: {count // 20} keys of ten", "".join(f"a{n}{'.b' * 9} = 1\n" for n in range(count // 26)) + end
        yield f"text: {count} quotes", f"x = {chr(34) * count}\n"
        yield f"text: {count} characters", f'x = "{"a" * count}"\n'
        yield f"text: {count // 6} escapes", f'x = "{chr(92)}u0041{(chr(92) + "u0041") * (count // 7)}"\n'
        yield f"text: {count} blank lines", f'x = """{chr(10) * count}"""\n'
        yield f"key: {count} characters", f"{'a' * count} = 1\n"
        yield f"list: {count // 2} numbers", f"x = [{'1,' * (count // 2 - 10)}]\n"
        yield f"list: {count // 9} flat positions", f"[array]\npositions_m = [{'[0,0],' * (count // 9)}]\n"
        yield f"digits: {count}", f"x = {'9' * count}\n"
        yield f"digits: {count} hexadecimal", f"x = 0x{'f' * (count - 10)}\n"
    yield "text: half a surrogate", '[array]\nlayout = "\\ud800"\n'
    yield "text: without an end", '[array]\nlayout = "'
    yield "text: a byte-order mark", "\ufeff" * 1000
    yield "key: twice", "[call]\nduration_s = 1e-3\nduration_s = 1e-3\n"
    yield "key: unknown", "[call]\nchirp = true\n"
    yield "table: a number", "call = 3\n"
    yield "table: a list", "call = [3]\n"
