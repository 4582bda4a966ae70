"""Notification of the first compilation in this process; kernels from the cache on disk cause none."""

from collections.abc import Callable

__all__ = ["begun", "on_compiling"]

_callbacks: list[Callable[[], None]] = []


def on_compiling(callback: Callable[[], None]) -> Callable[[], None]:
    """Register a function to be called once, when a kernel is compiled; return a function that unregisters it."""
    _callbacks.append(callback)

    def withdraw() -> None:
        if callback in _callbacks:
            _callbacks.remove(callback)

    return withdraw


def begun() -> None:
    """Report that the compilation of a kernel has begun."""
    while _callbacks:
        _callbacks.pop()()
