"""Parts of HTML pages without external resources; every text from files is escaped."""

import base64
import html
from collections.abc import Iterable, Sequence

__all__ = ["escaped", "picture", "table"]


def escaped(text: str) -> str:
    """Return a text as HTML, also if it is not valid Unicode, as names of files may be."""
    return html.escape(text.encode("utf-8", "backslashreplace").decode(), quote=True)


def table(columns: Sequence[tuple[str, str]], rows: Iterable[Sequence[tuple[str, str]]]) -> str:
    """Return a table of cells with their classes; the cells are HTML."""
    heading = "".join(f"<th class='{kind}'>{name}</th>" for name, kind in columns)
    lines = ("".join(f"<td class='{kind}'>{cell}</td>" for cell, kind in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>\n" for line in lines)
    return f"<div class=scroll><table><tr>{heading}</tr>\n{body}</table></div>"


def picture(png: bytes, alt: str) -> str:
    """Return a PNG within the page; ``alt`` is text."""
    return f"<img alt='{escaped(alt)}' src='data:image/png;base64,{base64.b64encode(png).decode()}'>"
