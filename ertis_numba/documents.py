"""Frozen structures with TOML in and out: what settings, scenes and layouts are made of.

A structure checks itself once, when it is made, in its ``__post_init__``. Unknown keys are refused.
"""

from pathlib import Path
from typing import Any, Self

import msgspec
import tomli_w

from ertis_numba import checks
from ertis_numba.errors import SettingsError

__all__ = ["Document", "Table"]


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
    """A whole TOML file."""

    @classmethod
    def from_toml(cls, text: str, source: str | None = None) -> Self:
        """Read a document; ``source``, such as its path, names it in errors.

        Raises
        ------
        SettingsError
            The text is not TOML, has unknown keys, or a value cannot be used.
        """
        try:
            return msgspec.toml.decode(text, type=cls)
        except msgspec.DecodeError as error:  # ValidationError is one, too
            reason = str(error).replace("Object contains unknown field", "unknown key").replace("$.", "")
            raise SettingsError(f"{source or cls.__name__.lower()}: {reason}; correct it or take it out") from error

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file.

        Raises
        ------
        SettingsError
            The file cannot be read or used.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError(f"{path}: {error}; give a readable {cls.__name__.lower()} file") from error
        return cls.from_toml(text, str(path))

    def to_toml(self) -> str:
        """Return TOML text that `from_toml` reads back to an equal structure."""
        return tomli_w.dumps(_without_none(msgspec.to_builtins(self)))


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    """TOML has no null: what is not given is left out."""
    return {
        key: _without_none(value) if isinstance(value, dict) else value
        for key, value in table.items()
        if value is not None
    }
