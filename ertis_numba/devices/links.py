"""Where emulated devices are found: stable links to their ports, like those of ``/dev/serial/by-id``."""

import os
import time
import warnings
from contextlib import suppress
from pathlib import Path

import platformdirs

from ertis_numba.errors import ArgumentError, SonarError

try:
    import fcntl
except ImportError:  # not POSIX
    _HAS_TERMINALS = False
else:
    _HAS_TERMINALS = True

__all__ = ["HeldLink", "emulated_folder", "is_held", "require_terminals"]

_LOOKS_S = 0.1  # how long at most a lock is waited for that may be of one who only looks
_RETRY_S = 0.002


def require_terminals() -> None:
    """Refuse to emulate where there is nothing to emulate with.

    Raises
    ------
    SonarError
        This system has no pseudo terminals.
    """
    if not _HAS_TERMINALS:
        raise SonarError("this system has no pseudo terminals; emulate sensors on Linux or macOS")


def emulated_folder() -> Path:
    """Return the folder of links to emulated devices: ``$ERTIS_EMULATED_DIR``, or one in the user's runtime folder.

    It need not exist.
    """
    given = os.environ.get("ERTIS_EMULATED_DIR")
    if given:
        return Path(given)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is no such folder on this machine, and which one is taken instead
        return Path(platformdirs.user_runtime_dir("ertis")) / "emulated"


class HeldLink:
    """A symbolic link that belongs to one emulated device while that lives.

    What a killed one left is replaced. Whether it was killed tells a lock on a hidden file beside the link: that the
    port exists says nothing, since the system gives its number to the next who asks for one.

    Parameters
    ----------
    path : Path
        Its folder is made, for this user only, if it is missing.

    Raises
    ------
    ArgumentError
        The link belongs to a device that runs, or there is something else of this name.
    SonarError
        This system has no pseudo terminals, and so nothing to lead to.
    """

    def __init__(self, path: Path) -> None:
        require_terminals()
        self.path = path
        if os.path.lexists(path) and not (path.is_symlink() and str(path.readlink()).startswith("/dev/")):
            raise ArgumentError(f"link {path} exists and leads to no port; give another name")
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._lock_path = path.with_name(f".{path.name}.lock")
        self._lock = self._locked()
        self.clear()

    def _locked(self) -> int:
        latest_s = time.monotonic() + _LOOKS_S
        while True:
            lock = os.open(self._lock_path, os.O_CREAT | os.O_RDWR, 0o600)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Its owner may have taken the file away between the two calls: then the lock is one of nothing.
                with suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(lock), self._lock_path.stat()):
                        return lock
            except BlockingIOError:
                if time.monotonic() > latest_s:
                    os.close(lock)
                    raise ArgumentError(
                        f"link {self.path} belongs to an emulated device that runs; end that one, or give another name"
                    ) from None
                time.sleep(_RETRY_S)  # `is_held` holds it for an instant
            os.close(lock)

    def point_to(self, port: str) -> None:
        """Lead to a port; whoever looks finds the old one or the new one."""
        new = self.path.with_name(f".{self.path.name}.new")
        new.unlink(missing_ok=True)
        new.symlink_to(port)
        new.replace(self.path)

    def clear(self) -> None:
        """Take the link away, as happens when a device is unplugged."""
        self.path.unlink(missing_ok=True)

    def release(self) -> None:
        """Take the link away for good."""
        self.clear()
        self._lock_path.unlink(missing_ok=True)
        os.close(self._lock)


def is_held(link: Path) -> bool:
    """Whether a link leads to what it was made for, as all do but one that a killed emulator left.

    Its pseudo terminal's number is soon that of somebody's shell. See `HeldLink`.
    """
    if not link.name:
        return True
    try:
        lock = os.open(link.with_name(f".{link.name}.lock"), os.O_RDONLY)
    except OSError:  # no link of an emulator
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False
