"""Stable links to the ports of emulated devices, like those of ``/dev/serial/by-id``."""

import os
import stat
import time
from contextlib import suppress
from pathlib import Path

import platformdirs

from ertis_numba.base.errors import ArgumentError, SonarError

try:
    import fcntl
except ImportError:  # Not available outside POSIX.
    _HAS_TERMINALS = False
else:
    _HAS_TERMINALS = True

__all__ = ["HeldLink", "emulated_folder", "is_held", "require_terminals"]

_LOOKS_S = 0.1  # Longest wait for a lock that a mere check may hold.
_RETRY_S = 0.002


def require_terminals() -> None:
    """Refuse to emulate on a system without pseudo terminals."""
    if not _HAS_TERMINALS:
        raise SonarError("this system has no pseudo terminals; emulate sensors on Linux or macOS")


def emulated_folder() -> Path:
    """Return the folder of links to emulated devices, which may not exist: $ERTIS_EMULATED_DIR, or in the cache."""
    folder = Path(os.environ.get("ERTIS_EMULATED_DIR") or Path(platformdirs.user_cache_dir("ertis"), "emulated"))
    with suppress(FileNotFoundError):
        found = folder.stat()
        if _HAS_TERMINALS and (found.st_uid != os.getuid() or found.st_mode & stat.S_IWOTH):
            raise ArgumentError(
                f"folder {folder} of emulated devices belongs to another user, or others may write to it; set "
                "ERTIS_EMULATED_DIR to a folder of your own"
            )
    return folder


class HeldLink:
    """Symbolic link that belongs to one emulated device during its life; replaces that of a killed device."""

    # A lock on a hidden file shows if the device is alive; the system reuses numbers of ports.

    def __init__(self, path: Path) -> None:
        require_terminals()
        self.path = path
        if os.path.lexists(path) and not (path.is_symlink() and str(path.readlink()).startswith("/dev/")):
            raise ArgumentError(f"link {path} exists but is not a link to a port; choose another name")
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
                # The owner may have removed the file between the two calls, and the lock would then be ineffective.
                with suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(lock), self._lock_path.stat()):
                        return lock
            except BlockingIOError:
                if time.monotonic() > latest_s:
                    os.close(lock)
                    raise ArgumentError(
                        f"link {self.path} belongs to a running emulated device; end that one, or choose another name"
                    ) from None
                time.sleep(_RETRY_S)  # `is_held` holds the lock for an instant.
            os.close(lock)

    def point_to(self, port: str) -> None:
        """Point the link to a port atomically."""
        new = self.path.with_name(f".{self.path.name}.new")
        new.unlink(missing_ok=True)
        new.symlink_to(port)
        new.replace(self.path)

    def clear(self) -> None:
        """Remove the link, as when a device is unplugged."""
        self.path.unlink(missing_ok=True)

    def release(self) -> None:
        """Remove the link permanently."""
        self.clear()
        self._lock_path.unlink(missing_ok=True)
        os.close(self._lock)


def is_held(link: Path) -> bool:
    """Return True if a link belongs to a running device; the port of a dead one may soon belong to a shell."""
    if not link.name:
        return True
    try:
        lock = os.open(link.with_name(f".{link.name}.lock"), os.O_RDONLY)
    except OSError:  # It is not a link of an emulator.
        return True
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False
