"""HTML of objects in notebooks, by a renderer that the package sets when it is imported."""

from collections.abc import Callable
from typing import Any

__all__ = ["renderer", "shown_in_notebooks"]

renderer: Callable[[Any], str] = repr
"""Function of the room `notebook`, which is above the classes that it shows."""


def shown_in_notebooks(shown: Any) -> str:
    """Return an object as HTML, for ``_repr_html_``, which Jupyter calls."""
    return renderer(shown)
