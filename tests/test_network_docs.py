"""docs/reference/network-protocol.md agrees with the messages on the wire."""

import re
import typing

import msgspec

from ertis_numba.network import messages
from tests.pages import page

PAGE = page("network-protocol")


def test_table_of_messages_is_complete():
    rows = [line.split("|") for line in PAGE.splitlines() if re.match(r"\| `\w+` \| \w+.* → ", line)]
    reported = {row[1].strip(" `"): re.findall(r"`(\w+)`", row[4]) for row in rows}
    kinds = [kind for kind in vars(messages).values() if isinstance(kind, type) and kind.__name__ in messages.__all__]
    spoken = {
        kind.__name__.lower(): [field.name for field in msgspec.structs.fields(kind)]
        for kind in kinds
        if issubclass(kind, messages.Message) and kind is not messages.Message
    }
    assert {kind: set(fields) for kind, fields in reported.items()} == {
        kind: set(names) for kind, names in spoken.items()
    }


def test_documented_version_and_limits_match_the_code():
    assert f"## Wire format, version {messages.VERSION}" in PAGE
    assert f"`{messages.MAGIC.decode()}`" in PAGE
    assert f"{messages.HEADER_BYTES:,} bytes" in PAGE


def test_all_products_are_documented():
    assert all(f"`{product}`" in PAGE for product in typing.get_args(messages.Product))
