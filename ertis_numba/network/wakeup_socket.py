"""Wake-up socket that ends the wait of an event loop from another thread."""

import socket
from contextlib import suppress

__all__ = ["WakeupSocket"]


class WakeupSocket:
    """Socket pair with a `fileno` to poll; it becomes readable after `wake`. Both ends stay in this process."""

    def __init__(self) -> None:
        self._wakes, self._woken = socket.socketpair()
        for end in (self._wakes, self._woken):
            end.setblocking(False)  # noqa: FBT003  as the library has it

    def fileno(self) -> int:
        """Return the descriptor to poll."""
        return self._woken.fileno()

    def wake(self) -> None:
        """End the current or the next wait of the loop."""
        with suppress(OSError):  # The socket is full, so that the loop wakes anyhow, or closed.
            self._wakes.send(b"\0")

    def clear(self) -> None:
        """Discard pending wake-ups; the loop calls it before it looks for work."""
        with suppress(OSError):
            self._woken.recv(65_536)  # Any byte beyond them, which is possible in theory only, wakes the loop again.

    def close(self) -> None:
        """Close the socket; later calls of `wake` have no effect."""
        self._wakes.close()
        self._woken.close()
