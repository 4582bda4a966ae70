"""What ends the wait of a loop, from another thread."""

import socket
from contextlib import suppress

__all__ = ["WakeupSocket"]


class WakeupSocket:
    """Can be polled for reading, as it has a `fileno`; that ends once somebody calls `wake`."""

    def __init__(self) -> None:
        self._wakes, self._woken = socket.socketpair()
        for end in (self._wakes, self._woken):
            end.setblocking(False)  # noqa: FBT003  as the library has it

    def fileno(self) -> int:
        """Return what is polled."""
        return self._woken.fileno()

    def wake(self) -> None:
        """End the wait of the loop, or the next one."""
        with suppress(OSError):  # it is full, so that the loop wakes anyhow, or closed
            self._wakes.send(b"\0")

    def clear(self) -> None:
        """Let the next wait be one again; called by the loop, before it looks for what there is to do."""
        with suppress(OSError):
            while self._woken.recv(4096):
                pass

    def close(self) -> None:
        """Let go of it; nobody is woken any more."""
        self._wakes.close()
        self._woken.close()
