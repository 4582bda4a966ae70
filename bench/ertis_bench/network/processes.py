"""Child processes that report events: start, wait for events, kill, and search for survivors."""

import contextlib
import json
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, Self

from ertis_numba.base.errors import DataError

__all__ = ["ERTIS", "JsonLinesProcess", "ask", "central", "survivors", "until"]

ERTIS: Final = (sys.executable, "-m", "ertis_cli")
_WAIT_S: Final = 60.0  # time limit for events that need no further action
_MARK: Final = "ERTIS_BENCH_MARK"
_PAGE_BYTES: Final = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
Event = dict[str, Any]


class JsonLinesProcess:
    """Process that reports events as lines of JSON on stdout; use it in a ``with`` statement."""

    def __init__(self, command: Sequence[str], *, stated: Path, mark: str = "") -> None:
        paths = os.pathsep.join(filter(None, sys.path))
        environment = os.environ | {"PYTHONPATH": paths, _MARK: mark or secrets.token_hex(4)}
        self.events: list[Event] = []
        self._stderr_path = stated
        self._news = threading.Condition()
        with stated.open("ab") as stderr:
            self._process = subprocess.Popen(  # noqa: S603  this very package
                list(command),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=stderr,
                text=True,
                env=environment,
                start_new_session=True,
            )
        self.pid = self._process.pid
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def _listen(self) -> None:
        for line in self._process.stdout or ():
            try:
                event = json.loads(line)
            except ValueError:  # A killed process may leave a truncated line.
                continue
            with self._news:
                self.events.append(event)
                self._news.notify_all()
        with self._news:
            self._news.notify_all()

    def wait_for(self, name: str, *, timeout_s: float = _WAIT_S, since: int = 0) -> Event:
        """Return the first event with a name, after skipping ``since`` of them."""
        end_s = time.monotonic() + timeout_s
        with self._news:
            while True:
                found = next((each for each in self.events[since:] if each.get("event") == name), None)
                if found is not None:
                    return found
                ended = not self._listener.is_alive()
                if ended or not self._news.wait(min(0.5, max(0.0, end_s - time.monotonic()))):
                    if not ended and time.monotonic() < end_s:
                        continue
                    raise DataError(f"event {name!r} of {self._stderr_path.stem} did not arrive; {self.last_words()}")

    def last_words(self) -> str:
        """Return the state of the process, and the last line of its stderr."""
        if not self._listener.is_alive():  # The process has closed its stdout, and so is about to end.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
        code = self._process.poll()
        lines = self._stderr_path.read_text(errors="replace").strip().splitlines()
        state = "runs" if code is None else f"ended with {code}"
        return f"the process {state}; the last line of its stderr is {lines[-1] if lines else ''!r}"

    def ends_within(self, time_s: float) -> bool:
        """Wait for some time, and return True if the process has ended."""
        try:
            self._process.wait(time_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """Kill the process with SIGKILL. Its children continue."""
        self._process.kill()
        self.wait()

    def signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended."""
        self._process.send_signal(number)

    def stop(self, *, timeout_s: float = _WAIT_S) -> int:
        """Ask the process to end, and return its exit code."""
        self.signal(signal.SIGTERM)
        return self.wait(timeout_s=timeout_s)

    def wait(self, *, timeout_s: float = _WAIT_S) -> int:
        """Wait until the process has ended, and return its exit code."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise DataError(f"{self._stderr_path.stem} does not end within {timeout_s:g} s") from error
        self._listener.join(timeout_s)
        return code

    @property
    def running(self) -> bool:
        """True until the process has ended."""
        return self._process.poll() is None

    @property
    def node_pid(self) -> int:
        """Process id of the working process, which is the latest child of a supervisor according to its events."""
        with self._news:
            return next((each["pid"] for each in reversed(self.events) if each.get("event") == "listening"), self.pid)

    @property
    def restarts(self) -> int:
        """Number of processes of a central node that its supervisor has replaced."""
        with self._news:
            return sum(each.get("event") == "restarted" for each in self.events)

    @property
    def memory_bytes(self) -> int:
        """Resident memory in bytes, or 0 if unknown."""
        try:
            pages = Path(f"/proc/{self.node_pid}/statm").read_text("ascii").split()[1]
        except (OSError, IndexError):
            return 0
        return int(pages) * _PAGE_BYTES

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._listener.join(_WAIT_S)
        # Closing the pipe would otherwise wait for the reader.
        if self._process.stdout is not None and not self._listener.is_alive():
            self._process.stdout.close()


def central(
    command: str,
    folder: Path,
    *options: str,
    listen: str = "tcp://127.0.0.1:*",
    mark: str = "",
    ertis: Sequence[str] = ERTIS,
) -> JsonLinesProcess:
    """Start ``ertis record`` or ``ertis serve``, with stderr in ``central.txt`` of a folder."""
    line = [*ertis, command, "--listen", listen, *options, "--json", "--quiet"]
    return JsonLinesProcess(line, stated=folder / "central.txt", mark=mark)


def ask(*arguments: str, timeout_s: float = 600.0) -> "subprocess.CompletedProcess[str]":
    """Run an ``ertis`` command until it ends."""
    command = [*ERTIS, *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=timeout_s)  # noqa: S603


def survivors(mark: str) -> dict[int, str]:
    """Return the processes with a mark, and their children, with their command lines; Linux only."""
    found = {}
    wanted = f"{_MARK}={mark}".encode()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if wanted in (folder / "environ").read_bytes().split(b"\0"):
                found[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
        except OSError:  # The process has ended meanwhile.
            continue
    return {pid: line for pid, line in found.items() if line}  # A process without a command line has ended.


def until(holds: Callable[[], bool], *, timeout_s: float = _WAIT_S, every_s: float = 0.02) -> bool:
    """Wait until ``holds`` returns True, and return False after a timeout."""
    end_s = time.monotonic() + timeout_s
    while not holds():
        if time.monotonic() > end_s:
            return False
        time.sleep(every_s)
    return True
