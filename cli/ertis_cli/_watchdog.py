"""Signs of life of a node for systemd: sd_notify(3) without a library."""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

__all__ = ["beat", "follow"]

_next_s = 0.0


def beat() -> None:
    """Report that the node works; a node calls this in its loop, and most calls return at once."""
    global _next_s  # noqa: PLW0603  a property of the process
    now_s = time.monotonic()
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address or now_s < _next_s:
        return
    _next_s = now_s + 1e-6 * int(os.environ.get("WATCHDOG_USEC", "10000000")) / 4
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as to:
        to.sendto(b"READY=1\nWATCHDOG=1", f"\0{address[1:]}" if address.startswith("@") else address)


@contextmanager
def follow(progress: Callable[[], object], interval_s: float = 0.5) -> Iterator[None]:
    """Beat whenever the progress of a loop in another thread has changed, until the ``with`` block ends."""
    ended = threading.Event()

    def check() -> None:
        before = None
        while not ended.wait(interval_s):
            now = progress()
            if now != before:
                beat()
            before = now

    if not os.environ.get("NOTIFY_SOCKET"):
        yield
        return
    thread = threading.Thread(target=check, name="ertis-watchdog", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
