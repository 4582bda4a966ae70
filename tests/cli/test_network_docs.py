"""docs/reference/network-protocol.md agrees with the messages on the wire."""

import msgspec

from ertis_numba.network import messages
from tests.pages import page

PAGE = page("network-protocol")


def row_of(kind):
    """Return the row of a message in the table of the page."""
    routes = {}
    for sender, receiver in kind.routes:
        routes.setdefault(sender, []).append(receiver)
    arrows = "; ".join(f"{sender} → {', '.join(receivers)}" for sender, receivers in routes.items())
    fields = ", ".join(f"`{field.name}`" for field in msgspec.structs.fields(kind))
    cells = (f"`{kind.kind()}`", arrows, kind.payload, fields)
    return "|" + "".join(f" {cell} |" if cell else " |" for cell in cells)


def test_table_of_messages_is_that_of_the_declarations():
    rows = [line for line in PAGE.splitlines() if line.startswith("| `") and " → " in line]
    wanted = [row_of(kind) for kind in messages.MESSAGES]
    assert rows == wanted, "put these rows into the page:\n" + "\n".join(wanted)


def test_documented_version_and_limits_match_the_code():
    assert f"## Wire format, version {messages.VERSION}" in PAGE
    assert f"`{messages.MAGIC.decode()}`" in PAGE
    assert f"{messages.HEADER_BYTES:,} bytes" in PAGE


def test_documented_products_are_those_of_the_declarations():
    *others, last = [f"`{product}`" for product in messages.PRODUCTS]
    assert f"products of a subscription are {', '.join(others)} and {last}." in PAGE
