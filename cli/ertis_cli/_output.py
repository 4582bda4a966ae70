"""Output in any encoding, and figures without a window system."""

import codecs
import os
import sys
import unicodedata
from typing import Final

__all__ = ["draw_without_display", "open_closed_streams", "replace_unencodable", "restore_display"]

_BACKEND: Final = os.environ.get("MPLBACKEND")
_REPLACEMENTS: Final = {
    "°": " deg",
    "µ": "u",
    "\N{GREEK SMALL LETTER MU}": "u",
    "×": "x",
    "±": "+-",
    "·": "*",
    "−": "-",
    "–": "-",
    "—": "-",
    "⁄": "/",
    "…": "...",
    "→": "->",
    "←": "<-",
    "≤": "<=",
    "≥": ">=",
    "≈": "~",
    "√": "sqrt",
    "∞": "inf",
    "✓": "ok",
    "✗": "x",
    "─": "-",
    "│": "|",
    "├": "+",
    "└": "+",
    "“": '"',
    "”": '"',
    "‘": "'",
    "’": "'",
}
"""Readable texts for characters that an encoding lacks."""


def open_closed_streams() -> None:
    """Replace closed standard streams by the null device; otherwise, the next file would get their descriptors."""
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)
            if null != descriptor:
                os.dup2(null, descriptor)
                os.close(null)
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8"))


def replace_unencodable() -> None:
    """Let stdout and stderr print readable texts for characters that their encoding lacks, instead of failing.

    The user's choice in PYTHONIOENCODING, such as ``cp932:replace``, remains in force.
    """
    codecs.register_error("ertis", _replaced)
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", None) in {"strict", "surrogateescape"} and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="ertis")


def _replaced(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    part = error.object[error.start : error.end]
    if all("\udc80" <= char <= "\udcff" for char in part):  # bytes of a file name that are no text
        return bytes(ord(char) - 0xDC00 for char in part), error.end
    return "".join(map(_readable, part)), error.end


def _readable(char: str) -> str:
    """Return ASCII for a character: its replacement, its letters without accents, or a question mark."""
    if char in _REPLACEMENTS:
        return _REPLACEMENTS[char]
    if "GREEK" in (name := unicodedata.name(char, "")):
        return name.split()[-1].lower()
    parts = [part for part in unicodedata.normalize("NFKD", char) if not unicodedata.combining(part)]
    return "".join(part if part.isascii() else _REPLACEMENTS.get(part, "?") for part in parts)


def draw_without_display() -> None:
    """Let Matplotlib ignore MPLBACKEND, which may name a window system or a package of a notebook that is missing.

    Commands only write files. Scripts of users get the variable back by `restore_display`.
    """
    os.environ["MPLBACKEND"] = "agg"


def restore_display() -> None:
    """Restore MPLBACKEND."""
    if _BACKEND is None:
        os.environ.pop("MPLBACKEND", None)
    else:
        os.environ["MPLBACKEND"] = _BACKEND
