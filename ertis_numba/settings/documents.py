"""Frozen structures that are read from TOML and written to it: the base of settings, scenes and layouts.

A structure checks its values when it is created, in ``__post_init__``: first their types, then the limits and choices
in its annotations. It refuses unknown keys.
"""

import datetime as dt
import difflib
import os
import re
import types
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Self, Union, get_args, get_origin

import msgspec
import tomli_w

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.base.file_kinds import kind_of, markup_of, problem_of
from ertis_numba.settings.document_errors import document_error, line_of_error, type_error
from ertis_numba.settings.limits import checker

__all__ = ["MAX_KEY_PARTS", "TomlDocument", "TomlTable"]

_NO_VALUE: Final = object()
"""Default of a value that was not given, because None is a value."""

MAX_KEY_PARTS: Final = 16
"""Limit on the parts of a dotted key, such as 2 of ``call.duration_s``: the parser's time grows with their square."""

_NAME = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_NAME}(?:[ \t]*+\.[ \t]*+{_NAME}){{{MAX_KEY_PARTS}}}")
_TOML_TYPES: Final = (dt.datetime, dt.date, dt.time)


class TomlTable(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table of a TOML file.

    Lists are accepted for tuples, integers for floating-point numbers, NumPy numbers and arrays for those of Python,
    and paths for text. Fields hold the same types as after reading a file.
    """

    def __post_init__(self) -> None:
        try:
            typed = msgspec.convert(self, _type_checking_struct(type(self)), from_attributes=True)
        except msgspec.ValidationError:
            given = {name: _to_builtin(getattr(self, name)) for name in self.__struct_fields__}
            try:
                typed = msgspec.convert(given, _type_checking_struct(type(self)))
            except msgspec.ValidationError as error:
                raise ArgumentError(type_error(self, given, str(error))) from None
        for name in self.__struct_fields__:
            msgspec.structs.force_setattr(self, name, getattr(typed, name))
        for name, key, check in _checks(type(self)):
            check(key, getattr(self, name))

    @classmethod
    def label(cls) -> str:
        """Return the name of the table in errors."""
        return cls.__name__.lower().lstrip("_")

    def replace(self, path: str | None = None, value: Any = _NO_VALUE, /, **changes: Any) -> Self:
        """Return a copy with some keys changed, checked again.

        Parameters
        ----------
        path : str, optional
            Key to change, such as ``range_m``, or ``processing.range_m`` in a nested table.
        value : optional
            New value of that key, required with ``path``.
        **changes
            New values by key. Keys of nested tables are given as ``**{"processing.range_m": (0.5, 3)}``. All changes
            of a table are checked together.

        Raises
        ------
        ArgumentError
            There is no such key, or a value is missing or cannot be used.

        Examples
        --------
        >>> from ertis_numba import Settings
        >>> Settings().replace("processing.range_m", (0.5, 3)).processing.range_m
        (0.5, 3.0)
        >>> changed = Settings().replace(**{"accuracy.max_error_db": -50, "processing.directions": "2d:181"})
        >>> changed.accuracy.max_error_db, changed.processing.directions
        (-50.0, '2d:181')
        """
        if path is not None:
            if value is _NO_VALUE:
                raise ArgumentError(f"{path!r} has no value; pass a value, as in replace({path!r}, value)")
            changes = {path: value, **changes}
        own: dict[str, Any] = {}
        nested: dict[str, dict[str, Any]] = {}
        for key, new in changes.items():
            name, dot, inner = key.partition(".")
            if name not in self.__struct_fields__:
                raise self._unknown_key(key)
            if not dot:
                own[name] = new
            elif isinstance(own.get(name, getattr(self, name)), TomlTable):
                nested.setdefault(name, {})[inner] = new
            else:
                raise ArgumentError(f"{self.label()} key {key!r} is unknown: {name} is not a table; use {name!r}")
        for name, within in nested.items():
            table: TomlTable = own.get(name, getattr(self, name))
            known = {inner.partition(".")[0] for inner in within} <= set(table.__struct_fields__)
            if not known:
                wrong = next(inner for inner in within if inner.partition(".")[0] not in table.__struct_fields__)
                raise self._unknown_key(f"{name}.{wrong}")
            own[name] = table.replace(**within)
        return msgspec.structs.replace(self, **self._completed(own))

    def _completed(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Return the changes of a copy with those that follow from them; none by default."""
        return changes

    def _paths(self) -> Iterator[str]:
        """Yield the keys of this table and of those in it."""
        for name in self.__struct_fields__:
            yield name
            value = getattr(self, name)
            if isinstance(value, TomlTable):
                yield from (f"{name}.{inner}" for inner in value._paths())  # noqa: SLF001  of its own kind

    def _unknown_key(self, key: str) -> ArgumentError:
        """Return an error with the most similar keys."""
        start, dot, inner = key.partition(".")
        table: TomlTable = getattr(self, start) if dot and start in self.__struct_fields__ else self
        within = "" if table is self else f" in {start!r}"
        if within:
            near = [f"{start}.{path}" for path in difflib.get_close_matches(inner, list(table._paths()), n=3)]
        else:
            paths, last = list(self._paths()), key.rpartition(".")[2]
            near = [path for path in paths if path.rpartition(".")[2] == last]
            near = near or difflib.get_close_matches(key, paths, n=3)
            near = near or [path for path in paths if difflib.get_close_matches(last, [path.rpartition(".")[2]])]
        hint = f" (did you mean {' or '.join(map(repr, near[:3]))}?)" if near else ""
        known = ", ".join(table.__struct_fields__)
        return ArgumentError(f"{self.label()} key {key[:80]!r} is unknown{hint}; known{within} are {known}")


class TomlDocument(TomlTable, frozen=True, kw_only=True):
    """Content of a TOML file.

    Attributes
    ----------
    max_bytes : int
        Limit on the length of a document in UTF-8.
    max_items : int
        Limit on its lines and commas, on which the time to parse it depends.
    """

    max_bytes: ClassVar[int] = 16 * 2**20
    max_items: ClassVar[int] = 2**20

    @classmethod
    def from_toml(cls, text: str, source: str | None = None, *, find_line: bool = True) -> Self:
        """Read a document.

        Parameters
        ----------
        source : str, optional
            Name of the document in errors, such as its path.
        find_line : bool
            Name the line of an error. This parses the text several times; switch it off for text that no one edits.

        Raises
        ------
        SettingsError
            The text is not TOML, has unknown keys, is too long, or a value cannot be used.
        """
        cls._require_size(text, source)
        try:
            return cls._decoded(text)
        except msgspec.ValidationError as error:
            line = line_of_error(cls, text, error) if find_line else 0
            raise SettingsError(document_error(cls, source, error, f", line {line}" if line else "")) from error
        except msgspec.DecodeError as error:  # A syntax error names its line itself.
            raise SettingsError(document_error(cls, source, error)) from error
        except RecursionError as error:
            raise SettingsError(
                f"{source or cls.label()}: lists or tables are nested too deeply; flatten them"
            ) from error
        except ValueError as error:  # a number with thousands of digits
            raise SettingsError(
                f"{source or cls.label()}: {' '.join(str(error).split())}; use a shorter number"
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
                f"{source or cls.label()}, line {line}: a dotted key has more than {MAX_KEY_PARTS} parts; use fewer "
                "parts"
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
        """Return the content of a file, and its tables as written."""
        wanted = f"a {cls.__name__.lower()} file (TOML)"
        text = _text_of(path, wanted)
        try:
            return cls.from_toml(text, str(path)), cls._tables(text)
        except SettingsError as error:
            if type(error.__cause__) is not msgspec.DecodeError or path.suffix.lower() == ".toml":
                raise
            raise SettingsError(f"{path} is not TOML; choose {wanted}") from error

    @classmethod
    def _decoded(cls, text: str) -> Self:
        return msgspec.convert(cls._tables(text), cls, builtin_types=_TOML_TYPES, str_keys=True)

    @classmethod
    def _tables(cls, text: str) -> dict[str, Any]:
        """Return the tables of a text; a document may have further spellings of its keys."""
        tables: dict[str, Any] = msgspec.toml.decode(text)
        return tables

    def to_toml(self) -> str:
        """Return TOML text that `from_toml` reads back to an equal structure."""
        return tomli_w.dumps(_without_none(msgspec.to_builtins(self)))


def _text_of(path: Path, wanted: str) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 with its byte-order mark, as PowerShell writes it."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SettingsError(f"{path}: {checks.reason_unreadable(error)}; choose {wanted}") from error
    kind = kind_of(path)
    if kind is not None and not kind.is_text:
        raise SettingsError(f"{path} {problem_of(path, wanted)}")
    try:
        text = content.decode("utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig")
    except UnicodeDecodeError as error:
        remedy = f"choose {wanted}" if kind is None else "save it as UTF-8"
        raise SettingsError(f"{path}: {checks.reason_unreadable(error)}; {remedy}") from error
    if markup := markup_of(text):
        raise SettingsError(f"{path} is {markup}, not TOML; choose {wanted}")
    return text


@cache
def _type_checking_struct(kind: type[TomlTable]) -> type[msgspec.Struct]:
    """Return a structure with the same fields that checks only types; choices are checked elsewhere."""
    fields = [(field.name, _with_any_text(field.type)) for field in msgspec.structs.fields(kind)]
    return msgspec.defstruct(kind.__name__, fields, kw_only=True)


def _with_any_text(kind: Any) -> Any:
    """Return a type with text in place of choices."""
    if get_origin(kind) in {Union, types.UnionType}:
        return Union[tuple(map(_with_any_text, get_args(kind)))]  # noqa: UP007  of a computed list
    return str if get_origin(kind) is Literal else kind


@cache
def _checks(kind: type[TomlTable]) -> list[tuple[str, str, Callable[[str, Any], object]]]:
    """Return fields with limits or choices: name, name in errors, and check."""
    found = ((field.name, checker(field.type)) for field in msgspec.structs.fields(kind))
    return [(name, f"{kind.label()}.{name}", check) for name, check in found if check is not None]


def _to_builtin(value: Any) -> Any:
    """Convert NumPy numbers and arrays, and paths, to types of Python."""
    if isinstance(value, dict):
        return {key: _to_builtin(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_builtin(item) for item in value]
    if hasattr(value, "tolist"):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _without_none(value: Any) -> Any:
    """Remove keys without a value, because TOML has no null."""
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value
