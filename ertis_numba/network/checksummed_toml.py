"""TOML documents with a checksum, for files in which a damaged character could go unnoticed."""

import zlib
from typing import Any, Self

import msgspec

from ertis_numba.base.errors import SettingsError
from ertis_numba.settings.documents import TomlDocument

__all__ = ["Checked"]


class Checked(TomlDocument, frozen=True, kw_only=True):
    """TOML document with an optional CRC-32 of its content.

    Attributes
    ----------
    check : str
        CRC-32 in the file; empty for a document in memory.
    """

    check: str = ""

    @classmethod
    def from_toml(cls, text: str, source: str | None = None, *, find_line: bool = True) -> Self:
        """Read a document and compare its checksum, if it has one.

        Raises
        ------
        SettingsError
            The text cannot be used, or its checksum is wrong.
        """
        if not text.strip():
            raise SettingsError(
                f"{source or cls.label()} is empty; copy it again, or create a new one with 'ertis keys'"
            )
        read = super().from_toml(text, source, find_line=find_line)
        made = read.replace(check="")
        if read.check and read.check != _crc32(made):
            raise SettingsError(
                f"{source or cls.label()}: check is {read.check[:16]!r}, but the content has {_crc32(made)!r}: "
                "the file is damaged or was edited by hand. Review its content, then remove the line that "
                "begins with 'check'"
            )
        return made

    def to_toml(self) -> str:
        """Return TOML text with a checksum that `from_toml` reads back to an equal structure."""
        return super(Checked, self.replace(check=_crc32(self))).to_toml()


def _crc32(document: Checked) -> str:
    """Return the CRC-32 of the content as JSON, without empty fields, so that it survives new unused fields."""
    return f"{zlib.crc32(msgspec.json.encode(_without_empty(msgspec.to_builtins(document)))):08x}"


def _without_empty(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_empty(item) for key, item in value.items() if item not in ("", [], (), None)}
    if isinstance(value, list | tuple):
        return [_without_empty(item) for item in value]
    return value
