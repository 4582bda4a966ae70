"""Check that a network object is used in the process that opened it, not in a fork of it."""

import os

from ertis_numba.base.errors import NetworkError

__all__ = ["Owner"]


class Owner:
    """Process that has opened an object. Its sockets and threads do not work in a fork, which would wait for ever."""

    def __init__(self, name: str) -> None:
        self._name, self._process_id = name, os.getpid()

    @property
    def is_this_process(self) -> bool:
        """True except in forks."""
        return os.getpid() == self._process_id

    def require_this_process(self) -> None:
        """Raise NetworkError in a fork."""
        if not self.is_this_process:
            raise NetworkError(
                f"this {self._name} was opened before the process forked, and works only in the parent process; open "
                f"a {self._name} in each worker"
            )
