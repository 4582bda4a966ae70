"""Sealing in a process of its own: HDF5 that meets a full disk takes its process with it."""

import json
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import IO, Any

from ertis_numba.errors import DataError, JournalInUseError

__all__ = ["Sealed", "seal_apart"]

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Sealed:
    """What became of a journal.

    Attributes
    ----------
    journal : Path
    recording : Path or None
        None where nothing had been measured.
    measurements : int
        In the recording.
    missing : int
        Measurements that the recording says to be missing; of those, …
    damaged : int
        … were damaged in the journal.
    set_aside : Path or None
        New path of the journal if it has damaged or refused measurements; otherwise the journal was removed.
    lost : int
        Missing numbers that the journal had noted before its log was damaged: each of a stored measurement, or of a
        gap, or skipped by the sensor.
    damage : str
        Losses from a damaged log that no gap of the recording covers; empty if there are none.
    refused : dict of str to str
        Sensors whose measurements no recording can hold, and the reasons.
    """

    journal: Path
    recording: Path | None
    measurements: int = 0
    missing: int = 0
    damaged: int = 0
    set_aside: Path | None = None
    lost: int = 0
    damage: str = ""
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def remark(self) -> str:
        """What is not as its user would expect, in a line; empty where all is well."""
        if self.recording is None and not self.refused:
            return f"{self.journal}: no measurement was captured"
        reported = []
        if self.lost or self.damage:
            reported.append(f"the log of {self.journal.name} was damaged; stored numbers lost: {self.lost}")
        if self.damage:
            reported.append(f"also lost: {self.damage}")
        if self.damaged:
            reported.append(
                "1 measurement is damaged" if self.damaged == 1 else f"{self.damaged} measurements are damaged"
            )
        reported += [f"no recording can hold sensor {name} ({reason})" for name, reason in self.refused.items()]
        if self.set_aside is not None:
            reported.append(f"the journal is kept as {self.set_aside}")
        return "; ".join(reported)


def seal_apart(
    journal: Path,
    *,
    overwrite: bool = False,
    rests: float | None = None,
    progress: Progress = lambda _done, _of: None,
) -> Sealed:
    """Make the recording of a journal in a process of its own; see `ertis_numba.storage.sealing.seal`.

    Ctrl-C in a terminal does not reach that process. Whatever ends it, the measurements are in the journal or in the
    recording, and it can be called again.

    Parameters
    ----------
    journal : Path
    overwrite : bool
        Replace a file of the recording's name, even if it holds something else.
    rests : float, optional
        Let others have the processors first, and the disk for so many times as long as each little step takes.
    progress : callable, optional
        Called with the number of measurements that are written and that of all, at most some hundred times.

    Raises
    ------
    InUseError
        Another process has the journal.
    DataError
        It failed; the journal is still there.
    OSError
        No process can be started.
    KeyboardInterrupt
        The process was ended; the text of this error says where the measurements are.
    """
    # -P: a file in the current folder that is named like one of Python's must not be taken for it.
    command = [sys.executable, "-P", "-m", "ertis_numba.storage.sealing_process", "--json"]
    reported: dict[str, Any] = {}
    try:
        chosen = [*(["--force"] if overwrite else []), *([] if rests is None else [f"--rests={rests}"])]
        reason = _run([*command, *chosen, "--", str(journal)], reported, progress)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(_where(journal, reported)) from error
    if "recording" in reported:
        return _sealed(reported)
    if reported.get("in_use"):
        raise JournalInUseError(reported["error"])
    raise DataError(reported.get("error") or f"{journal}: the process that seals it {reason}; seal it again")


def _run(command: list[str], reported: dict[str, Any], progress: Progress) -> str:
    """Run a process, put the result that it tells into ``reported``, and return how it ended."""
    with subprocess.Popen(  # noqa: S603  this very package
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="backslashreplace",
        start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),  # what Windows has for a session
    ) as process:
        stated: deque[str] = deque(maxlen=1)
        listener = Thread(target=_listen, args=(process.stderr, stated), daemon=True)
        listener.start()
        try:
            _take(process.stdout, reported, progress)
        except BaseException:
            _end(process)
            _take(process.stdout, reported, lambda _done, _of: None)
            raise
        process.wait()
        listener.join()
    return f"ended with {process.returncode}, " + (f"saying {stated[0]!r}" if stated else "saying nothing")


def _listen(stream: IO[str] | None, stated: deque[str]) -> None:
    """Keep the last line: of a traceback, that is the error."""
    stated.extend(line.strip() for line in stream or () if line.strip())


def _take(stream: IO[str] | None, reported: dict[str, Any], progress: Progress) -> None:
    """Pass progress on until the process has no more to tell."""
    for line in stream or ():
        try:
            report = json.loads(line)
        except ValueError:  # what is killed may have told half of it
            continue
        if "of" in report:
            progress(report["done"], report["of"])
        else:
            reported.update(report)


def _end(process: "subprocess.Popen[str]") -> None:
    """Ask a process to end, such that it leaves nothing half-written where that can be asked."""
    if os.name == "posix":
        process.send_signal(signal.SIGINT)
    else:
        process.terminate()


def _sealed(reported: dict[str, Any]) -> Sealed:
    paths = {name: Path(reported[name]) for name in ("journal", "recording", "set_aside") if reported[name] is not None}
    return Sealed(**reported | paths)


def _where(journal: Path, reported: dict[str, Any]) -> str:
    """Say where the measurements are after an interrupt, which may have come too late to matter."""
    if "recording" not in reported:
        return f"the measurements are safe in {journal}; seal them by 'ertis recover {journal}'"
    sealed = _sealed(reported)
    return sealed.remark or f"the measurements are in {sealed.recording}"
