"""Frozen structures with TOML in and out: what settings, scenes and layouts are made of.

A structure checks itself once, when it is made, in its ``__post_init__``: first that values are of the types of their
fields, then what they are. Unknown keys are refused.
"""

import bisect
import os
import re
import reprlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Self, get_args, get_origin

import msgspec
import tomli_w

from ertis_numba import checks
from ertis_numba.errors import ArgumentError, SettingsError

__all__ = ["MAX_KEY_PARTS", "TomlDocument", "TomlTable"]

_HEADER = re.compile(r"\s*\[[\w\[. -]*\]")
_KEY = re.compile(r"\s*([\w.-]+)\s*=")
MAX_KEY_PARTS: Final = 16
"""Limit on the parts of a dotted key, such as 2 of ``call.duration_s``: the parser's time grows with their square."""

_NAME = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_NAME}(?:[ \t]*+\.[ \t]*+{_NAME}){{{MAX_KEY_PARTS}}}")
_PATH_PART = re.compile(r"\.(\w+)|\[(\d+)\]")
_EXPECTED = re.compile(r"Expected `([^`]*)`(?: of length (\d+), got (\d+))?")
_TYPE_NAMES = {
    "array": "a list",
    "bool": "true or false",
    "float": "a number",
    "int": "a whole number",
    "null": "None",
    "str": "text",
}
"""What msgspec calls types, in words."""


class TomlTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of a TOML file.

    Lists may stand for tuples, whole numbers for numbers, those and arrays of NumPy for Python's own, and paths for
    their text; fields hold what a file would give.
    """

    def __post_init__(self) -> None:
        try:
            typed = msgspec.convert(self, _type_checking_struct(type(self)), from_attributes=True)
        except msgspec.ValidationError:
            given = {name: _to_builtin(getattr(self, name)) for name in self.__struct_fields__}
            try:
                typed = msgspec.convert(given, _type_checking_struct(type(self)))
            except msgspec.ValidationError as error:
                raise ArgumentError(_type_error(self, given, str(error))) from None
        for name in self.__struct_fields__:
            msgspec.structs.force_setattr(self, name, getattr(typed, name))

    @classmethod
    def label(cls) -> str:
        """Return what errors call it."""
        return cls.__name__.lower().lstrip("_")

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed, checked again.

        Raises
        ------
        ArgumentError
            There is no such field, or a value cannot be used.
        """
        unknown = set(changes) - set(self.__struct_fields__)
        if unknown:
            checks.choice(f"{type(self).__name__} field", min(unknown), self.__struct_fields__)
        return msgspec.structs.replace(self, **changes)


class TomlDocument(TomlTable, frozen=True, kw_only=True):
    """A whole TOML file.

    Attributes
    ----------
    former_keys : dict of str to str
        Names that keys had, and have now: recordings hold documents, and those of before stay readable.
    max_bytes : int
        Limit on the length of a document in UTF-8.
    max_items : int
        Limit on its lines and commas, which bound the time to parse it.
    """

    former_keys: ClassVar[dict[str, str]] = {}
    max_bytes: ClassVar[int] = 16 * 2**20
    max_items: ClassVar[int] = 2**20

    @classmethod
    def from_toml(cls, text: str, source: str | None = None, *, find_line: bool = True) -> Self:
        """Read a document.

        Parameters
        ----------
        text : str
        source : str, optional
            Name of the document in errors, such as its path.
        find_line : bool
            Name the line of an error. This parses the text several times; switch it off for text that nobody edits.

        Raises
        ------
        SettingsError
            The text is not TOML, has unknown keys, is too long, or a value cannot be used.
        """
        cls._require_size(text, source)
        text = cls._renamed(text)
        try:
            return msgspec.toml.decode(text, type=cls)
        except msgspec.ValidationError as error:
            line = _line_of_error(cls, text, error) if find_line else 0
            raise SettingsError(_document_error(cls, source, error, f", line {line}" if line else "")) from error
        except msgspec.DecodeError as error:  # a syntax error, which names its line itself
            raise SettingsError(_document_error(cls, source, error)) from error
        except RecursionError as error:
            raise SettingsError(
                f"{source or cls.label()}: lists or tables are nested too deeply; flatten them"
            ) from error
        except ValueError as error:  # a number of thousands of digits
            raise SettingsError(
                f"{source or cls.label()}: {' '.join(str(error).split())}; give a shorter number"
            ) from error

    @classmethod
    def _require_size(cls, text: str, source: str | None) -> None:
        """Refuse text that the parser could not read in bounded time."""
        n_bytes = len(text) if text.isascii() else len(text.encode("utf-8", "surrogatepass"))
        if n_bytes > cls.max_bytes:
            raise SettingsError(f"{source or cls.label()}: {n_bytes} bytes; the limit is {cls.max_bytes}")
        n_items = text.count("\n") + text.count(",")
        if n_items > cls.max_items:
            raise SettingsError(f"{source or cls.label()}: {n_items} lines and commas; the limit is {cls.max_items}")
        found = _LONG_KEY.search(text)
        if found is not None:
            line = text.count("\n", 0, found.start()) + 1
            raise SettingsError(
                f"{source or cls.label()}, line {line}: a dotted key has more than {MAX_KEY_PARTS} parts; give fewer"
            )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file.

        Raises
        ------
        SettingsError
            The file cannot be read or used.
        """
        return cls._load(Path(path))[0]

    @classmethod
    def _load(cls, path: Path) -> tuple[Self, dict[str, Any]]:
        """Return what is in a file, and the tables of it as they are written, by the keys of now."""
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise SettingsError(f"{path}: {reason}; give a readable {cls.__name__.lower()} file") from error
        return cls.from_toml(text, str(path)), msgspec.toml.decode(cls._renamed(text))

    @classmethod
    def _renamed(cls, text: str) -> str:
        for former, key in cls.former_keys.items():
            text = re.sub(rf"\b{former}(?=\s*=)", key, text)
        return text

    def to_toml(self) -> str:
        """Return TOML text that `from_toml` reads back to an equal structure."""
        return tomli_w.dumps(_without_none(msgspec.to_builtins(self)))


@cache
def _type_checking_struct(kind: type[TomlTable]) -> type[msgspec.Struct]:
    """Return a structure of the same fields that checks their types only; choices are left to their own check."""
    fields = [
        (field.name, str if get_origin(field.type) is Literal else field.type) for field in msgspec.structs.fields(kind)
    ]
    return msgspec.defstruct(kind.__name__, fields, kw_only=True)


def _to_builtin(value: Any) -> Any:
    """Return what is of NumPy, such as a position that was computed, or a path, as Python's own."""
    if isinstance(value, dict):
        return {key: _to_builtin(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_builtin(item) for item in value]
    if hasattr(value, "tolist"):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _type_error(table: TomlTable, given: dict[str, Any], error: str) -> str:
    """Return an error of types in the words of this package: the key, what came, what was wanted."""
    reason, _, path = error.partition(" - at `$")
    expected = _EXPECTED.match(reason)
    if expected is None and reason != "Number out of range":  # a table's own, given as a dictionary
        return reason
    value: Any = given
    for name, place in _PATH_PART.findall(path):
        value = value[name or int(place)]
    key = f"{table.label()}{path.rstrip('`')}"
    if expected is None:
        return f"{key} is beyond all numbers; give a finite number"
    if expected[2]:
        return f"{key} has shape ({expected[3]},); give shape ({expected[2]},)"
    field = next(field for field in msgspec.structs.fields(table) if field.name == _PATH_PART.findall(path)[0][0])
    tables = " or ".join(f"{kind.__name__}(...)" for kind in _tables(field.type))
    wanted = [_TYPE_NAMES.get(name, tables) for name in expected[1].split(" | ")]
    return f"{key} is {' '.join(reprlib.repr(value).split())}; give {' or '.join(wanted)}"


def _tables(kind: Any) -> Iterator[type[TomlTable]]:
    """Yield the tables that a field may hold."""
    if isinstance(kind, type) and issubclass(kind, TomlTable):
        yield kind
    for part in get_args(kind):
        yield from _tables(part)


def _without_none(value: Any) -> Any:
    """TOML has no null: what is not given is left out."""
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value


def _document_error(kind: type[TomlDocument], source: str | None, error: msgspec.MsgspecError, line: str = "") -> str:
    """Return an error in the words of this package: where, what came, the remedy."""
    reason, _, path = str(error).partition(" - at `$")
    path = f", {path.strip('.`')}" if path.strip(".`") else ""
    reason = reason.replace("Object contains unknown field", "unknown key")
    if reason.startswith("Object missing required field "):
        reason = f"{reason.removeprefix('Object missing required field ')} is missing; give it"
    remedy = "" if ";" in reason else "; correct it or take it out"
    return f"{source or kind.__name__.lower()}{line}{path}: {reason}{remedy}"


def _line_of_error(kind: type[TomlDocument], text: str, error: msgspec.ValidationError) -> int:
    """Return the number of the line that an error is about, counted from 1.

    That is the line in the erring table whose key the error names, or the first line of the table; 0 if there is none.
    """
    lines = text.splitlines()
    starts = [1, *(n for n, line in enumerate(lines, 1) if n > 1 and _HEADER.match(line))]
    stops = [*starts[1:], len(lines) + 1]
    # Tables are read one after the other, and what errs once keeps erring: the first one is found by halves.
    table = bisect.bisect_left(stops[:-1], x=True, key=lambda stop: _error(kind, lines[: stop - 1]) == str(error))
    begin, stop = starts[table], stops[table]
    reported, _, path = str(error).partition(" - at `$")
    named = {*re.findall(r"\w+", reported.partition(";")[0]), *re.findall(r"\w+", path.rpartition(".")[2])}
    keys = ((n, _KEY.match(lines[n - 1])) for n in range(begin, stop))
    is_table = bool(lines and _HEADER.match(lines[begin - 1]))
    return next((n for n, key in keys if key and not named.isdisjoint(key[1].split("."))), begin if is_table else 0)


def _error(kind: type[TomlDocument], lines: list[str]) -> str:
    try:
        msgspec.toml.decode("\n".join(lines), type=kind)
    except msgspec.DecodeError as error:
        return str(error)
    return ""
