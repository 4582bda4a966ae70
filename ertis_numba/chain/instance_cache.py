"""Cache of a method's results that lives as long as the instance."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, TypeVarTuple

__all__ = ["cached_in_instance"]

_Self = TypeVar("_Self")
_Arguments = TypeVarTuple("_Arguments")
_Result = TypeVar("_Result")


def cached_in_instance(method: Callable[[_Self, *_Arguments], _Result]) -> Callable[[_Self, *_Arguments], _Result]:
    """Return a method that computes each result once; its arguments are hashable and positional."""
    # Unlike with `functools.cache`, nothing here keeps the instance alive.
    attribute = f"_results_of_{method.__name__}"

    @functools.wraps(method)
    def call(self: _Self, *arguments: *_Arguments) -> _Result:
        results: dict[Any, _Result] = vars(self).setdefault(attribute, {})
        if arguments not in results:
            results[arguments] = method(self, *arguments)
        return results[arguments]

    return call
