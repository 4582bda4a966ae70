"""Messages that no node sends: corrupted valid messages, invalid headers, and meaningless lists of frames."""

import random
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Final

import msgspec
from msgspec import inspect

from ertis_numba.network.messages import MAGIC, MESSAGES, PRODUCTS, VERSION, Message
from ertis_numba.settings import Recording, Settings

__all__ = ["VALID", "inputs"]

_MAGIC: Final = MAGIC + bytes([VERSION])
_BYTES: Final = 4 * 4096
_SETTINGS: Final = Settings(recording=Recording(n_samples=_BYTES // 4)).to_toml().encode()
_VALUES: Final[dict[str, object]] = {
    "session_id": 1,
    "settings_crc32": zlib.crc32(_SETTINGS),
    "temperature_c": 20.0,
    "humidity_percent": 50.0,
    "pressure_pa": 101_325.0,
    "crc32": 1,
    "last": 3,
    "acked_through": 5,
    "products": ["energyscape", "status"],
    "sensors": ["fuzz"],
    "rotation_xyzw": [0.0, 0.0, 0.0, 1.0],
}
"""Values of fields by name; other fields get a value of their type."""


def _value(declared: inspect.Type) -> object:
    """Return a valid value of a type."""
    match declared:
        case inspect.IntType():
            return max(0, declared.ge or 0)
        case inspect.FloatType():
            return 0.0
        case inspect.StrType():
            return "fuzz"
        case inspect.LiteralType():
            return declared.values[0]
        case inspect.TupleType():
            return [_value(item) for item in declared.item_types]
        case inspect.VarTupleType():
            return []
    raise TypeError(f"no value of {declared} is defined; add a case, or the field to _VALUES")


def _fields(kind: type[Message]) -> dict[str, object]:
    """Return the required fields of a message, all valid."""
    declared = inspect.type_info(kind)
    if not isinstance(declared, inspect.StructType):
        raise TypeError(f"{kind.__name__} is not a structure; declare messages as in ertis_numba.network.messages")
    return {
        field.name: _VALUES[field.name] if field.name in _VALUES else _value(field.type)
        for field in declared.fields
        if field.required
    }


_FIELDS: Final = {kind.kind(): _fields(kind) for kind in MESSAGES}


def _header(kind: str, fields: dict[str, object]) -> bytes:
    return _MAGIC + msgspec.msgpack.encode({"kind": kind} | fields)


VALID: Final = {kind: _header(kind, fields) for kind, fields in _FIELDS.items()}
"""Valid header of each message. None of them delivers a measurement."""

_ODD_VALUES: Final[tuple[object, ...]] = (
    None, True, -1, 2**63, 2**64 - 1, -(2**63), 1e308, float("nan"), float("inf"), "", "x" * 300, "../../etc", "\0",
    "a\nb", b"", b"\xff" * 100, [], [[[[[]]]]], {}, {"a": {}}, ["status"] * 100, "\N{SNOWMAN}",
)  # fmt: skip
_ODD_HEADERS: Final = (
    b"",
    b"\0",
    _MAGIC[:4],
    _MAGIC,
    _MAGIC + b"\xc1",
    _MAGIC + b"\x80",
    MAGIC + bytes([VERSION + 1]) + VALID["ping"][5:],
    b"eRTN\x00" + VALID["ping"][5:],
    _MAGIC + b"\xdf\xff\xff\xff\xff",
    _MAGIC + b"\xdd\xff\xff\xff\xff",
    _MAGIC + b"\xc6\xff\xff\xff\xff",
    _MAGIC + b"\xdb\xff\xff\xff\xff",
    _MAGIC + b"\x91" * 3000,
    _MAGIC + b"\x81\xa4kind" * 500,
    _MAGIC + bytes(5000),
)


def inputs(rng: random.Random, count: int, size: int) -> Iterator[list[list[bytes]]]:
    """Yield batches of messages. Each message is a list of frames."""
    made = 0
    while made < count:
        batch = [_input(rng) for _ in range(min(size, count - made))]
        made += len(batch)
        yield batch


def _input(rng: random.Random) -> list[bytes]:
    draw = rng.random()
    if draw < 0.3:
        return _plausible(rng)
    header = rng.choice(_WAYS)(rng)
    draw = rng.random()
    if draw < 0.05:
        return [header, _SETTINGS]
    if draw < 0.6:
        return [header, rng.randbytes(rng.choice((0, 1, 7, 64, 700)))]
    if draw < 0.8:
        return [header]
    if draw < 0.9:
        return [header, *(rng.randbytes(rng.randrange(20)) for _ in range(rng.randrange(1, 40)))]
    return [b"", header] if draw < 0.95 else [rng.randbytes(5), header, header]


def _plausible(rng: random.Random) -> list[bytes]:
    """Return a well-formed message of a session that a node may know, with meaningless content."""
    number = rng.choice((0, 1, 2, 7, rng.randrange(1000), 2**31, 2**62, 2**63 - 1))
    other = rng.choice((0, number, number + 1, 2**63 - 1)) % 2**63
    fields = {"sensor": rng.choice(("fuzz", "fuzz2")), "session_id": rng.choice((1, 1, 1, 2, 2**63 - 1))}
    match rng.randrange(6):
        case 0:
            return [_header("hello", _FIELDS["hello"] | fields | {"next_sequence": number}), _SETTINGS]
        case 1:
            return [_header("gap", _FIELDS["gap"] | fields | {"first": number, "last": other})]
        case 2:
            return [_header("bye", {})]
        case 3:
            wanted = {"products": rng.sample(PRODUCTS, rng.randint(1, 5)), "consumed": number, "credit": 64}
            return [_header("subscribe", wanted)]
        case 4:
            payload = rng.randbytes(rng.choice((_BYTES, _BYTES, 0, _BYTES - 4)))
            air = {"temperature_c": rng.choice((20.0, float("nan"), 1e300, -300.0))}
            data = _FIELDS["data"] | fields | air | {"sequence": number, "sync_count": -other}
            return [_header("data", data | {"crc32": zlib.crc32(payload) ^ 1}), payload]
        case _:
            return [VALID["hello"], _SETTINGS]


def _corrupted(rng: random.Random) -> bytes:
    """Return a header with changed, additional or missing bytes."""
    data = bytearray(rng.choice(list(VALID.values())))
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(data) + 1)
        match rng.randrange(4):
            case 0 if place < len(data):
                data[place] ^= 1 << rng.randrange(8)
            case 1 if place < len(data):
                data[place] = rng.choice((0x00, 0x7F, 0x80, 0xC0, 0xC1, 0xD9, 0xDF, 0xFF))
            case 2:
                data[place:place] = rng.randbytes(rng.randint(1, 9))
            case _:
                del data[place : place + rng.randint(1, 9)]
    return bytes(data)


def _odd_field(rng: random.Random) -> bytes:
    """Return a header with an invalid value, an additional field or a missing field."""
    kind = rng.choice(list(_FIELDS))
    fields = dict(_FIELDS[kind])
    name = rng.choice([*fields, "more"])
    if rng.random() < 0.2:
        fields.pop(name, None)
    else:
        fields[name] = rng.choice(_ODD_VALUES)
    return _header(rng.choice((kind, kind, kind, "what", kind.upper(), "")), fields)


def _spliced(rng: random.Random) -> bytes:
    one, other = rng.choices(list(VALID.values()), k=2)
    return one[: rng.randrange(len(one))] + other[rng.randrange(len(other)) :]


def _random(rng: random.Random) -> bytes:
    beginning = _MAGIC if rng.random() < 0.7 else b""
    return beginning + rng.randbytes(rng.choice((1, 3, 20, 200, 4090, 4096)))


def _odd(rng: random.Random) -> bytes:
    header = rng.choice(_ODD_HEADERS)
    return header if rng.random() < 0.8 else header + struct.pack("<Q", rng.getrandbits(64))


_WAYS: Final[tuple[Callable[[random.Random], bytes], ...]] = (
    _corrupted,
    _corrupted,
    _odd_field,
    _odd_field,
    _spliced,
    _random,
    _odd,
)
