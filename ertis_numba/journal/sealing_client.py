"""Sealing in a separate process, because HDF5 can crash its process on a full disk."""

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

__all__ = ["SealingResult", "seal_in_subprocess"]

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class SealingResult:
    """Result of sealing a journal.

    Attributes
    ----------
    journal : Path
        Path of the journal.
    recording : Path or None
        Path of the recording; None if the journal had no measurement.
    measurements : int
        Number of measurements in the recording, by default 0.
    missing : int
        Number of missing measurements according to the recording, by default 0.
    damaged : int
        Number of missing measurements that were damaged in the journal, by default 0.
    set_aside : Path or None
        New path of the journal if it has damaged or refused measurements; otherwise None, and the journal was removed.
    lost : int
        Number of missing measurements that the journal had noted before its log was damaged, by default 0. Each number
        belongs to a stored measurement or a gap, or was skipped by the sensor.
    damage : str
        Losses from a damaged log that no gap of the recording covers; empty if there are none.
    refused : dict of str to str
        Reasons why a recording cannot contain the measurements of some sensors, by sensor.
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
        """Irregularities in one line; empty if there are none."""
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


def seal_in_subprocess(
    journal: Path,
    *,
    overwrite: bool = False,
    rests: float | None = None,
    progress: Progress = lambda _done, _of: None,
) -> SealingResult:
    """Make the recording of a journal in a separate process; see `ertis_numba.storage.sealing.seal`.

    Ctrl-C in a terminal does not reach that process. However it ends, the measurements are in the journal or in the
    recording, and sealing can be repeated.

    Parameters
    ----------
    journal : Path
        Path of the journal.
    overwrite : bool
        Replace an existing file, even if it has other content.
    rests : float, optional
        Run at low priority, and pause after each step for this multiple of its duration.
    progress : callable, optional
        Called with the number of written measurements and of all measurements, about a hundred times.

    Returns
    -------
    SealingResult
        Result.

    Raises
    ------
    JournalInUseError
        Another process has the journal open.
    DataError
        Sealing failed; the journal is still there.
    OSError
        No process can be started.
    KeyboardInterrupt
        The process was interrupted; the message states where the measurements are.
    """
    # -P: Python must not import a file of the current folder in place of a standard module.
    command = [sys.executable, "-P", "-m", "ertis_numba.storage.sealing_process", "--json"]
    reported: dict[str, Any] = {}
    try:
        chosen = [*(["--force"] if overwrite else []), *([] if rests is None else [f"--rests={rests}"])]
        reason = _run([*command, *chosen, "--", str(journal)], reported, progress)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(_interrupt_message(journal, reported)) from error
    if "recording" in reported:
        return _parse_result(reported)
    if reported.get("in_use"):
        raise JournalInUseError(reported["error"])
    raise DataError(reported.get("error") or f"{journal}: the process that seals it {reason}; seal it again")


def _run(command: list[str], reported: dict[str, Any], progress: Progress) -> str:
    """Run a process, store its result in ``reported``, and return how it ended as text."""
    with subprocess.Popen(  # noqa: S603  this very package
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="backslashreplace",
        start_new_session=True,
        # Windows has process groups instead of sessions.
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    ) as process:
        stated: deque[str] = deque(maxlen=1)
        listener = Thread(target=_keep_last_line, args=(process.stderr, stated), daemon=True)
        listener.start()
        try:
            _forward_progress(process.stdout, reported, progress)
        except BaseException:
            _interrupt(process)
            _forward_progress(process.stdout, reported, lambda _done, _of: None)
            raise
        process.wait()
        listener.join()
    return f"ended with {process.returncode}, " + (f"printing {stated[0]!r}" if stated else "printing nothing")


def _keep_last_line(stream: IO[str] | None, stated: deque[str]) -> None:
    """Keep the last line of stderr, which is the error in a traceback."""
    stated.extend(line.strip() for line in stream or () if line.strip())


def _forward_progress(stream: IO[str] | None, reported: dict[str, Any], progress: Progress) -> None:
    """Forward progress until the process ends its output."""
    for line in stream or ():
        try:
            report = json.loads(line)
        except ValueError:  # A killed process may have printed half a line.
            continue
        if "of" in report:
            progress(report["done"], report["of"])
        else:
            reported.update(report)


def _interrupt(process: "subprocess.Popen[str]") -> None:
    """Interrupt a process, so that it ends cleanly if the system allows that."""
    if os.name == "posix":
        process.send_signal(signal.SIGINT)
    else:
        process.terminate()


def _parse_result(reported: dict[str, Any]) -> SealingResult:
    paths = {name: Path(reported[name]) for name in ("journal", "recording", "set_aside") if reported[name] is not None}
    return SealingResult(**reported | paths)


def _interrupt_message(journal: Path, reported: dict[str, Any]) -> str:
    """Return a line on where the measurements are after an interrupt; sealing may have ended before it."""
    if "recording" not in reported:
        return f"the measurements are safe in {journal}; recover them with 'ertis recover {journal}'"
    sealed = _parse_result(reported)
    return sealed.remark or f"the measurements are in {sealed.recording}"
