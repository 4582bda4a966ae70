"""Sealing of full journals, in parallel to the intake."""

import queue
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import JournalInUseError
from ertis_numba.journal import SUFFIX, SealingResult, seal_in_subprocess

__all__ = ["Sealing"]

_AGAIN_S: Final = 5.0
"""Delay before a failed journal is sealed again; doubled after each failure, …"""

_LATEST_S: Final = 300.0
"""… up to this limit."""

_RESTS: Final = 4.0
"""Rest after each step of sealing, relative to its duration.

Sealing then takes a fifth of the disk's time, and the backlog grows, …
"""

_FEW_RESTS: Final = 0.5
"""… until the backlog exceeds …"""

_SHARE: Final = 0.25
"""… this share of the free space."""


class Sealing:
    """Thread that seals journals one by one, each in a process; calls both functions, on_failed with a line."""

    def __init__(self, on_sealed: Callable[[SealingResult], None], on_failed: Callable[[str], None]) -> None:
        self._on_sealed, self._on_failed = on_sealed, on_failed
        self._given: queue.SimpleQueue[Path | None] = queue.SimpleQueue()
        self._waiting: list[tuple[float, float, Path]] = []  # Due time, previous delay, journal.
        self._left: set[Path] = set()
        self._ends = False
        self.sealed = self.failed = self.set_aside = 0
        self._thread = threading.Thread(target=self._run, name="sealing", daemon=True)
        self._thread.start()

    @property
    def left(self) -> int:
        """Number of journals that are not recordings yet."""
        return len(self._left)

    def give(self, path: Path) -> None:
        """Queue a journal for sealing."""
        self._left.add(path)
        self._given.put(path)

    def hurry(self) -> None:
        """Stop yielding processors and disk, from the next journal on."""
        self._ends = True

    def close(self) -> None:
        """Seal the queued journals, each tried once more, and return afterwards."""
        self.hurry()
        self._given.put(None)
        self._thread.join()

    def _run(self) -> None:
        while True:
            due = min(self._waiting, default=None)
            try:
                path = self._given.get(timeout=None if due is None else max(0.0, due[0] - time.monotonic()))
            except queue.Empty:
                if due is not None:
                    self._waiting.remove(due)
                    self._seal(due[2], due[1])
                continue
            if path is None:
                break
            self._seal(path, 0.0)
        for _, waited_s, path in sorted(self._waiting):
            self._seal(path, waited_s)

    def _seal(self, path: Path, waited_s: float) -> None:
        try:
            sealed = seal_in_subprocess(path, rests=None if self._ends else self._rests(path.parent))
        except Exception as error:  # noqa: BLE001  whatever it is, the journal is still there and ingest goes on
            if not path.exists() and path.with_name(path.name.removesuffix(SUFFIX)).exists():
                self._left.discard(path)  # Another process has made the recording.
                return
            if isinstance(error, JournalInUseError) and not self._ends:
                waits_s = _AGAIN_S  # The process that seals it now will end soon.
            else:
                self.failed += 1
                waits_s = min(max(_AGAIN_S, 2 * waited_s), _LATEST_S)
            self._waiting.append((time.monotonic() + waits_s, waits_s, path))
            self._on_failed(f"{path.name} is not sealed yet: {' '.join(str(error).split())}")
            return
        self._left.discard(path)
        self.sealed += sealed.recording is not None
        self.set_aside += sealed.set_aside is not None
        self._on_sealed(sealed)

    def _rests(self, folder: Path) -> float:
        """Return the relative rest of sealing: long for the sake of the intake, until free space gets scarce."""
        n_bytes = sum(path.stat().st_size for path in tuple(self._left) if path.exists())
        return _RESTS if n_bytes < _SHARE * shutil.disk_usage(folder).free else _FEW_RESTS
