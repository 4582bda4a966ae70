"""Cores of this process, and objects in forked processes, in which only the thread exists that called the fork.

A lock that another thread held stays locked in the fork for ever, and a thread pool waits for threads that are gone.
"""

import functools
import itertools
import os
import sys
import threading
import weakref
from collections.abc import Callable
from typing import Any

__all__ = ["ForkSafeLock", "call_in_forks", "usable_cores"]

_methods: set["weakref.WeakMethod[Callable[[], None]]"] = set()


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def call_in_forks(method: Callable[[], None]) -> None:
    """Call a bound method, which must not raise, at the start of each forked process while its object exists."""
    _methods.add(weakref.WeakMethod(method, _methods.discard))


class ForkSafeLock:
    """Context manager that admits one thread at a time; free in a forked process, even if another thread was inside."""

    def __init__(self, make: Callable[[], Any] = threading.Lock) -> None:
        self._make = make
        self._renew()
        call_in_forks(self._renew)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def _renew(self) -> None:
        self._lock = self._make()


def _after_fork() -> None:
    if sys.version_info < (3, 12):
        _renew_cached_properties()
    for reference in tuple(_methods):
        method = reference()
        if method is not None:
            method()


def _renew_cached_properties() -> None:
    """Replace the locks of cached properties, which Python 3.12 removed."""
    for name, module in tuple(sys.modules.items()):
        if name.startswith("ertis_numba."):
            classes = [each for each in vars(module).values() if isinstance(each, type)]
            for attribute in itertools.chain.from_iterable(vars(each).values() for each in classes):
                if isinstance(attribute, functools.cached_property):
                    attribute.lock = threading.RLock()  # type: ignore[attr-defined]  # before Python 3.12


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
