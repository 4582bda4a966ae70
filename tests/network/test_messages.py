"""Wire format: encoded messages are decoded, and everything else is refused with a one-line error."""

import random

import msgspec
import pytest
from ertis_cli._product_printer import PRINTERS
from hypothesis import given, settings, strategies as st

from ertis_numba.base.errors import DataError, FormatVersionError
from ertis_numba.network import messages
from ertis_numba.network.messages import (
    HEADER_BYTES,
    MAGIC,
    VERSION,
    Ack,
    Data,
    Hello,
    Message,
    Ping,
    Subscribe,
    decode,
    encode,
)
from ertis_numba.network.products import _DECODERS
from tests.faults.network.fuzz import VALID

KINDS = [
    kind
    for name in messages.__all__
    if isinstance(kind := getattr(messages, name), type) and Message in kind.__mro__[1:]
]
NAMES = st.from_regex(r"\A[A-Za-z0-9_][A-Za-z0-9_.@+-]{0,63}\Z")
COUNTS, INT64, UINT32 = (st.integers(*limits) for limits in ((0, 2**63 - 1), (-(2**63), 2**63 - 1), (0, 2**32 - 1)))
NUMBERS = st.integers(0, 2**48)
FINITE = st.floats(allow_nan=False)
REASONS = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Zl", "Zp"]), min_size=1, max_size=64)
WHOLE = Data(
    sensor="front",
    session_id=7,
    sequence=41,
    sync_count=-3,
    timestamp_ns=2**60,
    uncertainty_ns=400,
    monotonic_ns=5,
    temperature_c=20.0,
    humidity_percent=50.0,
    pressure_pa=101_325.0,
    crc32=2**32 - 1,
)


def test_each_message_is_declared_once():
    assert sorted(kind.__name__ for kind in KINDS) == sorted(kind.__name__ for kind in messages.MESSAGES)
    kinds = [kind.__struct_config__.tag for kind in messages.MESSAGES]
    assert kinds == [kind.kind() for kind in messages.MESSAGES]
    assert len(set(kinds)) == len(kinds)
    assert all(kind.routes for kind in messages.MESSAGES)


def test_each_product_is_brought_by_one_message_with_a_decoder():
    brought = {kind.product: kind for kind in messages.MESSAGES if kind.product}
    assert sorted(brought) == sorted(messages.PRODUCTS)
    assert set(brought.values()) == _DECODERS.keys()
    assert PRINTERS.keys() == brought.keys()


@pytest.mark.parametrize("kind", messages.MESSAGES)
def test_valid_header_of_each_message_is_decoded(kind):
    assert type(decode(VALID[kind.kind()])) is kind


@given(
    st.builds(
        Data,
        sensor=NAMES,
        session_id=COUNTS,
        sequence=NUMBERS,
        sync_count=INT64,
        timestamp_ns=INT64,
        uncertainty_ns=UINT32,
        monotonic_ns=INT64,
        temperature_c=FINITE,
        humidity_percent=FINITE,
        pressure_pa=FINITE,
        crc32=UINT32,
    )
    | st.builds(
        Hello,
        sensor=NAMES,
        session_id=COUNTS,
        next_sequence=NUMBERS,
        settings_crc32=UINT32,
        translation_m=st.tuples(FINITE, FINITE, FINITE),
    )
    | st.builds(
        Ack,
        sensor=NAMES,
        session_id=COUNTS,
        acked_through=st.integers(-1, 2**48),
        status=st.sampled_from(["stored", "accepted"]),
        dropped=st.lists(st.tuples(NUMBERS, REASONS), max_size=8).map(tuple),
    )
    | st.builds(
        Subscribe,
        sensors=st.none() | st.lists(NAMES, max_size=8).map(tuple),
        products=st.lists(st.sampled_from(messages.PRODUCTS), min_size=1, max_size=8).map(tuple),
        consumed=COUNTS,
        credit=st.integers(1, 64),
    )
)
def test_encoded_messages_are_decoded(message):
    header = encode(message)
    assert decode(header) == message == decode(memoryview(header), (type(message),))
    assert header[:5] == MAGIC + bytes([VERSION])


def test_encoded_header_has_the_documented_bytes():
    assert encode(Ping()) == b"eRTN\x02\x81\xa4kind\xa4ping"


@pytest.mark.parametrize(
    ("header", "reported"),
    [
        (b"", "a header begins with b''"),
        (b"eRT", "begins with b'eRT'"),
        (b"GET / HTTP/1.1", "begins with b'GET '"),
        (b"eRTN", "this node speaks|begins with|cannot be read|version"),
        (b"eRTN\x02", "cannot be decoded"),
        (b"eRTN\x02\xc1", "cannot be decoded"),
        (b"eRTN\x02\x81\xa4kind\xa4pong", "missing required field `state`"),
        (b"eRTN\x02\x82\xa4kind\xa4ping\xa1x\x01", "unknown field `x`"),
        (b"eRTN\x02\x81\xa4kind\xa4exec", "cannot be decoded"),
        (b"eRTN\x02" + b"\x91" * 4000, "cannot be decoded"),
        (b"eRTN\x02" + bytes(HEADER_BYTES), r"4101 bytes; the limit is 4096"),
        (encode(Ping()) + b"\0", "cannot be decoded"),
    ],
)
def test_invalid_header_is_refused_in_one_line(header, reported):
    with pytest.raises(DataError, match=reported) as caught:
        decode(header)
    assert ";" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("version", [0, 1, 255])
def test_other_version_is_distinguished_from_garbage(version):
    with pytest.raises(FormatVersionError, match=f"has protocol version {version}, but this node uses 2; use"):
        decode(MAGIC + bytes([version]) + b"anything")


def test_unexpected_message_is_refused():
    with pytest.raises(DataError, match="a message is 'ping'; send one of hello, data"):
        decode(encode(Ping()), (Hello, Data))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sensor", ""),
        ("sensor", "../../etc"),
        ("sensor", "a b"),
        ("sensor", "front\n"),
        ("sensor", "f" * 65),
        ("sensor", 7),
        ("session_id", -1),
        ("session_id", 2**63),
        ("sequence", 2**48 + 1),
        ("sequence", -1),
        ("sequence", 1.5),
        ("sequence", True),
        ("sync_count", 2**63),
        ("uncertainty_ns", 2**32),
        ("crc32", -1),
        ("temperature_c", "warm"),
        ("crc32", None),
    ],
)
def test_value_beyond_its_limits_is_refused(field, value):
    header = MAGIC + bytes([VERSION]) + msgspec.msgpack.encode({**msgspec.to_builtins(WHOLE), field: value})
    with pytest.raises(DataError, match="a header cannot be decoded"):
        decode(header)


@settings(max_examples=100)
@given(
    st.recursive(
        st.none() | st.booleans() | INT64 | st.floats() | st.text(max_size=20) | st.binary(max_size=20),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
        max_leaves=12,
    )
)
def test_other_messagepack_is_refused(value):
    with pytest.raises(DataError):
        decode(MAGIC + bytes([VERSION]) + msgspec.msgpack.encode(value))


def test_malformed_headers_are_refused():
    """Headers have bytes flipped, truncated, inserted, removed or replaced, or are pure noise."""
    random_ = random.Random(11)
    good = [encode(message) for message in _one_of_each()]
    taken = refused = 0
    for _ in range(10_000):
        header = _spoiled(random_, bytearray(random_.choice(good)))
        try:
            message = decode(header)
        except DataError as error:
            refused += len(str(error).splitlines())
        else:  # a header with another number in it is still a message
            taken += 1
            assert decode(encode(message)) == message or "nan" in repr(message)
    assert taken + refused == 10_000
    assert refused > 7_000


def _spoiled(random_, header):
    if random_.random() < 0.1:
        return random_.randbytes(random_.randrange(200))
    for _ in range(random_.choice([1, 1, 2, 5, 20])):
        place = random_.randrange(len(header) + 1)
        match random_.randrange(5):
            case 0 if header[5:]:
                header[random_.randrange(5, len(header))] ^= 1 << random_.randrange(8)
            case 1:
                del header[place:]
            case 2:
                header[place:place] = random_.randbytes(random_.randrange(1, 9))
            case 3:
                del header[place : place + random_.randrange(1, 9)]
            case _ if header[5:]:
                header[random_.randrange(5, len(header))] = random_.choice([0x00, 0x7F, 0xC1, 0xDD, 0xDF, 0xFF])
    return bytes(header)


def _one_of_each():
    """Return one message of each kind, with the smallest valid value of each field."""
    return [msgspec.convert({"kind": kind.__struct_config__.tag, **_smallest(kind)}, kind) for kind in KINDS]


def _smallest(kind):
    values = {}
    for field in msgspec.structs.fields(kind):
        if field.required:
            values[field.encode_name] = _value(msgspec.inspect.type_info(field.type))
    return values


def _value(info):
    match info:
        case msgspec.inspect.StrType(pattern=pattern):
            return "front" if pattern else "why"
        case msgspec.inspect.IntType(ge=ge):
            return max(ge or 0, 1)
        case msgspec.inspect.FloatType():
            return 1.5
        case msgspec.inspect.LiteralType(values=values):
            return values[0]
        case msgspec.inspect.VarTupleType(item_type=item):
            return [_value(item)]
        case msgspec.inspect.TupleType(item_types=items):
            return [_value(item) for item in items]
    raise AssertionError(info)
