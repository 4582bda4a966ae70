"""Errors of documents: place, problem and remedy."""

import bisect
import re
import reprlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

import msgspec

from ertis_numba.base import checks

if TYPE_CHECKING:
    from ertis_numba.settings.documents import TomlDocument, TomlTable

__all__ = ["document_error", "line_of_error", "type_error"]

_HEADER = re.compile(r"\s*\[[\w\[. -]*\]")


_KEY = re.compile(r"\s*([\w.-]+)\s*=")


_PATH_PART = re.compile(r"\.(\w+)|\[(\d+)\]")


_EXPECTED = re.compile(r"Expected `([^`]*)`(?: of length (\d+), got (\d+))?")


_CHOICE = re.compile(r"Invalid enum value '(.*)'")


_TYPE_NAMES = {
    "array": "a list",
    "bool": "true or false",
    "float": "a number",
    "int": "a whole number",
    "null": "None",
    "str": "text",
}
"""Descriptions of the types that msgspec names in errors."""


def type_error(table: "TomlTable", given: dict[str, Any], error: str) -> str:
    """Return the message of a type error: key, value and accepted types."""
    reason, _, path = error.partition(" - at `$")
    expected = _EXPECTED.match(reason)
    if expected is None and reason != "Number out of range":  # the error of a table that was given as a dictionary
        return reason
    value: Any = given
    for name, place in _PATH_PART.findall(path):
        value = value[name or int(place)]
    key = f"{table.label()}{path.rstrip('`')}"
    if expected is None:
        return f"{key} exceeds the range of floating-point numbers; use a finite number"
    if expected[2]:
        return f"{key} has shape ({expected[3]},); pass shape ({expected[2]},)"
    field = next(field for field in msgspec.structs.fields(table) if field.name == _PATH_PART.findall(path)[0][0])
    tables = " or ".join(f"{kind.__name__}(...)" for kind in _tables(field.type))
    wanted = [_TYPE_NAMES.get(name, tables) for name in expected[1].split(" | ")]
    return f"{key} is {' '.join(reprlib.repr(value).split())}; use {' or '.join(wanted)}"


def _tables(kind: Any) -> Iterator[type[msgspec.Struct]]:
    """Yield the table types that a field accepts."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        yield kind
    for part in get_args(kind):
        yield from _tables(part)


def document_error(kind: "type[TomlDocument]", source: str | None, error: msgspec.MsgspecError, line: str = "") -> str:
    """Return the message of an error: place, problem and remedy."""
    reason, _, path = str(error).partition(" - at `$")
    choice = _CHOICE.fullmatch(reason)
    if choice is not None:
        reason = checks.unknown_choice("value", choice[1], list(_choices(kind, re.findall(r"[a-z]\w*", path))))
    path = f", {path.strip('.`')}" if path.strip(".`") else ""
    reason = reason.replace("Object contains unknown field", "unknown key")
    if reason.startswith("Object missing required field "):
        reason = f"{reason.removeprefix('Object missing required field ')} is missing; add it"
    remedy = "" if ";" in reason else "; correct it or remove it"
    return f"{source or kind.__name__.lower()}{line}{path}: {reason}{remedy}"


def _choices(kind: Any, keys: list[str]) -> Iterator[str]:
    """Yield the texts that a key accepts."""
    if not keys:
        if get_origin(kind) is Literal:
            yield from get_args(kind)
        for part in get_args(kind):
            yield from _choices(part, keys)
        return
    for table in _tables(kind):
        types = {field.name: field.type for field in msgspec.structs.fields(table)}
        if keys[0] in types:
            yield from _choices(types[keys[0]], keys[1:])


def line_of_error(kind: "type[TomlDocument]", text: str, error: msgspec.ValidationError) -> int:
    """Return the line, from 1, of the key with the error or of its table; 0 if there is none."""
    lines = text.splitlines()
    starts = [1, *(n for n, line in enumerate(lines, 1) if n > 1 and _HEADER.match(line))]
    stops = [*starts[1:], len(lines) + 1]
    # Tables are read in order, and an error persists as lines are added, so that bisection finds the first wrong table.
    table = bisect.bisect_left(stops[:-1], x=True, key=lambda stop: _error(kind, lines[: stop - 1]) == str(error))
    begin, stop = starts[table], stops[table]
    reported, _, path = str(error).partition(" - at `$")
    named = {*re.findall(r"\w+", reported.partition(";")[0]), *re.findall(r"\w+", path.rpartition(".")[2])}
    keys = ((n, _KEY.match(lines[n - 1])) for n in range(begin, stop))
    is_table = bool(lines and _HEADER.match(lines[begin - 1]))
    return next((n for n, key in keys if key and not named.isdisjoint(key[1].split("."))), begin if is_table else 0)


def _error(kind: "type[TomlDocument]", lines: list[str]) -> str:
    try:
        kind._decoded("\n".join(lines))  # noqa: SLF001  of its own kind
    except msgspec.DecodeError as error:
        return str(error)
    return ""
