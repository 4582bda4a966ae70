"""Copies of frames with some fields changed."""

import difflib
from dataclasses import fields, replace
from typing import Any, TypeVar

from ertis_numba.base.errors import ArgumentError

__all__ = ["replaced"]

_Frame = TypeVar("_Frame")


def replaced(name: str, given: _Frame, changes: dict[str, Any]) -> _Frame:
    """Return a copy of a dataclass with some fields changed; raise ArgumentError for other fields."""
    known = [each.name for each in fields(given)]  # type: ignore[arg-type]  # a dataclass, which has no type of its own
    for field in sorted(changes.keys() - set(known)):
        near = difflib.get_close_matches(field, known, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise ArgumentError(f"{name} has no field {field!r}{hint}; choose from {', '.join(known)}")
    return replace(given, **changes)  # type: ignore[type-var]
