"""Limits of fields, declared in their annotations; checks, errors, the reference of keys and options derive from them.

``Annotated[float, Limits(0.0, 1.0)]`` limits a number; on a tuple of two numbers, it limits an interval.
"""

import math
import types
from collections.abc import Callable
from typing import Annotated, Any, Final, Literal, NamedTuple, Union, get_args, get_origin

__all__ = ["AVERAGES", "CLEANING_DB", "EMITTER_M", "FOCUS_M", "Limits", "checker"]

_Check = Callable[[str, Any], object]


class Limits(NamedTuple):
    """Limits of a number; ``part`` names it in errors, from the name of its field."""

    low: float
    high: float = math.inf
    part: str = "{}"

    def __str__(self) -> str:
        low, high = (str(each) if isinstance(each, int) else f"{each:g}" for each in self[:2])
        return f"of at least {low}" if math.isinf(self.high) else f"from {low} to {high}"

    def checker(self, kind: Any) -> _Check:
        """Return a function that raises ArgumentError for a value of a type unless it is within the limits."""
        from ertis_numba.base import checks  # noqa: PLC0415  The help of commands needs limits, but not NumPy.

        low, high, part = self
        if get_origin(kind) is tuple:
            return lambda name, value: checks.interval(part.format(name), value, low, high)
        if kind is int:
            highest = None if math.isinf(high) else int(high)
            return lambda name, value: checks.integer(part.format(name), value, int(low), highest)
        return lambda name, value: checks.between(part.format(name), value, low, high)


def checker(kind: Any) -> _Check | None:
    """Return the check of a field's type by the limits and choices in it; None if it has none."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return next((each.checker(parts[0]) for each in parts[1:] if isinstance(each, Limits)), None)
    if origin is Literal:
        from ertis_numba.base import checks  # noqa: PLC0415  as above

        return lambda name, value: checks.choice(name, value, parts)
    if origin in {Union, types.UnionType}:
        every = [(get_origin(part) is Literal, check) for part in parts if (check := checker(part)) is not None]
        found = dict(every)
        if len(found) < len(every):
            raise TypeError(f"{kind} has two parts with limits; declare one of them only")
        return _of_kind(found.get(True), found.get(False)) if found else None
    if origin is tuple:
        return _of_items(parts)
    return None


def _of_kind(of_text: _Check | None, of_others: _Check | None) -> _Check:
    """Return the check of a value that may be text, another one, or None."""

    def check(name: str, value: Any) -> None:
        chosen = of_text if isinstance(value, str) else of_others
        if chosen is not None and value is not None:
            chosen(name, value)

    return check


def _of_items(parts: tuple[Any, ...]) -> _Check | None:
    """Return the check of a tuple; errors about a list name the index, and those about a vector do not."""
    checks = [checker(part) for part in parts if part is not ...]
    if not any(checks):
        return None
    is_list = parts[-1] is ...

    def check(name: str, values: tuple[Any, ...]) -> None:
        for index, value in enumerate(values):
            inner = checks[0 if is_list else index]
            if inner is not None:
                inner(f"{name}[{index}]" if is_list else name, value)

    return check


AVERAGES: Final = Limits(1, 100_000)
CLEANING_DB: Final = Limits(0.0, 1000.0)
EMITTER_M: Final = Limits(0.0, 0.2)
"""Diameter of an emitter or of a microphone's port."""
FOCUS_M: Final = Limits(0.01, 10_000.0)
