"""Frozen structures with TOML in and out: what settings, scenes and layouts are made of.

A structure checks itself once, when it is made, in its ``__post_init__``. Unknown keys are refused.
"""

import bisect
import re
from pathlib import Path
from typing import Any, ClassVar, Self

import msgspec
import tomli_w

from ertis_numba import checks
from ertis_numba.errors import SettingsError

__all__ = ["Document", "Table"]

_HEADER = re.compile(r"\s*\[[\w\[. -]*\]")
_KEY = re.compile(r"\s*([\w.-]+)\s*=")


class Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of a TOML file."""

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


class Document(Table, frozen=True, kw_only=True):
    """A whole TOML file.

    Attributes
    ----------
    former_keys : dict of str to str
        Names that keys had, and have now: recordings hold documents, and those of before stay readable.
    """

    former_keys: ClassVar[dict[str, str]] = {}

    @classmethod
    def from_toml(cls, text: str, source: str | None = None) -> Self:
        """Read a document; ``source``, such as its path, names it in errors.

        Raises
        ------
        SettingsError
            The text is not TOML, has unknown keys, or a value cannot be used.
        """
        for former, key in cls.former_keys.items():
            text = re.sub(rf"\b{former}(?=\s*=)", key, text)
        try:
            return msgspec.toml.decode(text, type=cls)
        except msgspec.ValidationError as error:
            line = _line_to_blame(cls, text, error)
            raise SettingsError(_told(cls, source, error, f", line {line}" if line else "")) from error
        except msgspec.DecodeError as error:  # a syntax error, which names its line itself
            raise SettingsError(_told(cls, source, error)) from error

    @classmethod
    def from_tables(cls, tables: dict[str, Any], source: str | None = None) -> Self:
        """Read what a TOML parser returns; errors are those of `from_toml`, without a line."""
        try:
            return msgspec.convert(tables, type=cls)
        except msgspec.ValidationError as error:
            raise SettingsError(_told(cls, source, error)) from error

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file.

        Raises
        ------
        SettingsError
            The file cannot be read or used.
        """
        try:
            text = Path(path).read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise SettingsError(f"{path}: {reason}; give a readable {cls.__name__.lower()} file") from error
        return cls.from_toml(text, str(path))

    def to_toml(self) -> str:
        """Return TOML text that `from_toml` reads back to an equal structure."""
        return tomli_w.dumps(_without_none(msgspec.to_builtins(self, enc_hook=_plain)))


def _plain(value: Any) -> Any:
    """Return a number of NumPy, such as a position that was computed, as Python's own."""
    if hasattr(value, "item"):
        return value.item()
    raise NotImplementedError(f"{type(value).__name__} has no form in TOML")


def _without_none(value: Any) -> Any:
    """TOML has no null: what is not given is left out."""
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value


def _told(kind: type[Document], source: str | None, error: msgspec.MsgspecError, line: str = "") -> str:
    """Return an error in the words of this package: where, what came, the remedy."""
    reason, _, path = str(error).partition(" - at `$")
    path = f", {path.strip('.`')}" if path.strip(".`") else ""
    reason = reason.replace("Object contains unknown field", "unknown key")
    if reason.startswith("Object missing required field "):
        reason = f"{reason.removeprefix('Object missing required field ')} is missing; give it"
    remedy = "" if ";" in reason else "; correct it or take it out"
    return f"{source or kind.__name__.lower()}{line}{path}: {reason}{remedy}"


def _line_to_blame(kind: type[Document], text: str, error: msgspec.ValidationError) -> int:
    """Return the number of the line that an error is about, counted from 1.

    That is the first line up to which the text errs in this way, or the one of the same table whose key the error
    names.
    """
    lines = text.splitlines()
    starts = [1, *(n for n, line in enumerate(lines, 1) if n > 1 and _HEADER.match(line))]
    stops = [*starts[1:], len(lines) + 1]
    # Tables are read one after the other, and what errs once keeps erring: the first one is found by halves.
    table = bisect.bisect_left(stops[:-1], x=True, key=lambda stop: _error(kind, lines[: stop - 1]) == str(error))
    begin, stop = starts[table], stops[table]
    end = next((n for n in range(begin, stop) if _error(kind, lines[:n]) == str(error)), stop - 1)
    told, _, path = str(error).partition(" - at `$")
    named = {*re.findall(r"\w+", told.partition(";")[0]), *re.findall(r"\w+", path.rpartition(".")[2])}
    keys = ((n, _KEY.match(lines[n - 1])) for n in range(begin, stop))
    is_table = bool(lines and _HEADER.match(lines[begin - 1]))
    return next((n for n, key in keys if key and not named.isdisjoint(key[1].split("."))), begin if is_table else end)


def _error(kind: type[Document], lines: list[str]) -> str:
    try:
        msgspec.toml.decode("\n".join(lines), type=kind)
    except msgspec.DecodeError as error:
        return str(error)
    return ""
