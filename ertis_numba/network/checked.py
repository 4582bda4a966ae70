"""Documents with a checksum, for files in which a damaged letter would be believed."""

import zlib
from typing import Any, Self

import msgspec

from ertis_numba.documents import Document
from ertis_numba.errors import SettingsError

__all__ = ["Checked"]


class Checked(Document, frozen=True, kw_only=True):
    """A document that is written with the CRC-32 of its content; one without it is read as well.

    Attributes
    ----------
    check : str
        As read from a file, and then compared; empty in a document that is in use.
    """

    check: str = ""

    @classmethod
    def from_toml(cls, text: str, source: str | None = None, *, find_line: bool = True) -> Self:
        """Read a document and compare its checksum, if it has one.

        Raises
        ------
        SettingsError
            The text cannot be used, or is not what was written.
        """
        if not text.strip():
            raise SettingsError(f"{source or cls.label()} is empty; copy it again, or make it anew by 'ertis keys'")
        read = super().from_toml(text, source, find_line=find_line)
        made = read.replace(check="")
        if read.check and read.check != _crc32(made):
            raise SettingsError(
                f"{source or cls.label()}: check is {read.check[:16]!r}, the content has {_crc32(made)!r}: the file is "
                "damaged or was edited by hand; look at what it says, then remove the line that begins with 'check'"
            )
        return made

    def to_toml(self) -> str:
        """Return TOML text with a checksum that `from_toml` reads back to an equal structure."""
        return super(Checked, self.replace(check=_crc32(self))).to_toml()


def _crc32(document: Checked) -> str:
    """Return the CRC-32 over the content as JSON.

    What is empty is left out, so that fields that are added later change it only where they are used.
    """
    return f"{zlib.crc32(msgspec.json.encode(_without_empty(msgspec.to_builtins(document)))):08x}"


def _without_empty(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_empty(item) for key, item in value.items() if item not in ("", [], (), None)}
    if isinstance(value, list | tuple):
        return [_without_empty(item) for item in value]
    return value
