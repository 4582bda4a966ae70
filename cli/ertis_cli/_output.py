"""Output in any encoding, and figures without a window system."""

import codecs
import functools
import os
import sys
import unicodedata
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

__all__ = [
    "draw_without_display",
    "escape_names",
    "escaped",
    "open_closed_streams",
    "replace_unencodable",
    "restore_display",
]

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
_CONTROLS: Final = {"Cc", "Zl", "Zp"}  # Controls, and separators of lines and paragraphs.
_ESCAPED: Final[dict[str, str]] = {}


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
    """Let stdout and stderr replace unencodable characters by readable texts, unless PYTHONIOENCODING does."""
    codecs.register_error("ertis", _replaced)
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", None) in {"strict", "surrogateescape"} and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="ertis", encoding=None if _can_encode_lines(stream.encoding) else "utf-8")


def _can_encode_lines(encoding: str) -> bool:
    """Return False for codecs that are not for lines of text, such as ``idna``."""
    try:
        return bool((100 * "x" + "\n").encode(encoding))
    except (UnicodeError, LookupError):
        return False


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


def escape_names(arguments: Iterable[str]) -> None:
    """Let stdout and stderr escape control characters in file names, and in the stems that results keep."""
    parts = (part for argument in arguments for each in argument.split("=", 1) for part in Path(each).parts)
    stems = {stem: _without_controls(stem) for stem in (Path(part).stem for part in parts) if stem.strip()}
    _ESCAPED.update({stem: readable for stem, readable in stems.items() if stem != readable})
    for stream in (sys.stdout, sys.stderr) if _ESCAPED else ():
        stream.write = functools.partial(_write_escaped, stream.write)  # type: ignore[method-assign]


def escaped(text: str) -> str:
    """Return a text whose file names with control characters are escaped, see `escape_names`."""
    for stem, readable in _ESCAPED.items():
        text = text.replace(stem, readable)
    return text


def _write_escaped(write: Callable[[str], int], text: str) -> int:
    return write(escaped(text))


def _without_controls(text: str) -> str:
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in _CONTROLS else char for char in text
    )


def draw_without_display() -> None:
    """Let Matplotlib ignore MPLBACKEND, which may name a missing window system or notebook."""
    # It may name a missing window system. Scripts of users get the variable back by `restore_display`.
    os.environ["MPLBACKEND"] = "agg"


def restore_display() -> None:
    """Restore MPLBACKEND."""
    if _BACKEND is None:
        os.environ.pop("MPLBACKEND", None)
    else:
        os.environ["MPLBACKEND"] = _BACKEND
