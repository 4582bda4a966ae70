"""Messages that rclpy decodes have the values that were encoded, for any values of the fields."""

import pytest
from hypothesis import given, settings, strategies as st

from ertis_numba.interop.ros_definitions import DEFINITIONS, encoder, fields, schema

pytest.importorskip("rclpy.serialization")  # Wheels exist for some versions of Python only.

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre:DeprecationWarning")  # a dependency of rclpy imports them

WITHOUT_WHEELS = ("marine_acoustic_msgs", "tf2_msgs")  # `test_export_mcap` compares them with rosbags.
MESSAGES = [name for name in DEFINITIONS if not name.startswith(WITHOUT_WHEELS)]


PLAIN = {
    "uint8[]": st.binary(max_size=40),
    "byte": st.integers(0, 255),
    "bool": st.booleans(),
    "string": st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12),
    **{f"float{bits}": st.floats(width=bits, allow_nan=False) for bits in (32, 64)},
    **{f"uint{bits}": st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    **{f"int{bits}": st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
}


def values(kind):
    """Values of a field of this type."""
    if kind in PLAIN:
        return PLAIN[kind]
    if kind == "float64[36]":
        return st.lists(PLAIN["float64"], min_size=36, max_size=36)
    if kind.endswith("[]"):
        return st.lists(values(kind.removesuffix("[]")), max_size=3)
    package, _, name = kind.partition("/")
    return message(f"{package}/msg/{name}")


def message(name):
    return st.fixed_dictionaries({field: values(kind) for field, kind in fields(name).items()})


def ros_class(name):
    package, _, kind = name.split("/")
    return getattr(pytest.importorskip(f"{package}.msg"), kind)


def ros_message(name, content):
    """Message of rclpy with the same content."""
    made = ros_class(name)()
    for field, kind in fields(name).items():
        value = content[field]
        element = kind.removesuffix("[]")
        if "/" in element:
            nested = element.replace("/", "/msg/")
            value = [ros_message(nested, each) for each in value] if kind != element else ros_message(nested, value)
        setattr(made, field, bytes([value]) if kind == "byte" else value)
    return made


@pytest.mark.parametrize("name", MESSAGES)
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_rclpy_decodes_what_was_encoded(name, data):
    from rclpy.serialization import deserialize_message, serialize_message  # noqa: PLC0415  wheels may be missing

    content = data.draw(message(name))
    encoded, expected = encoder(name)(content), ros_message(name, content)
    decoded = deserialize_message(encoded, ros_class(name))
    # Messages of rclpy with NumPy arrays cannot be compared as a whole.
    assert repr(decoded) == repr(expected) if "float64[36]" in schema(name) else decoded == expected
    # The bytes themselves cannot be compared, because Fast CDR leaves those between fields undefined.
    assert 0 <= len(serialize_message(expected)) - len(encoded) < 4
