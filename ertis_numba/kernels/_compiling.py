"""Notice of the first compilation in this process; kernels in the cache on disk need none."""

from collections.abc import Callable

__all__ = ["begun", "on_compiling"]

_callbacks: list[Callable[[], None]] = []


def on_compiling(callback: Callable[[], None]) -> Callable[[], None]:
    """Call a function once, when a kernel is compiled; return a function that withdraws it."""
    _callbacks.append(callback)

    def withdraw() -> None:
        if callback in _callbacks:
            _callbacks.remove(callback)

    return withdraw


def begun() -> None:
    """Report that the compilation of a kernel has begun."""
    while _callbacks:
        _callbacks.pop()()
