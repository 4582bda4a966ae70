"""What a folder holds of each run, in a small file: journals and recordings need not be there to know it."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from ertis_numba.atomic import replacing
from ertis_numba.errors import DataError, FormatVersionError, InUseError
from ertis_numba.journal import Gap
from ertis_numba.network.central_node._items import Run

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["Ledger", "Lock", "look"]

_NAME: Final = ".ertis-ledger"
_LOCK: Final = ".ertis-lock"
_VERSION: Final = 2  # 1 had no gaps


class _Content(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """What is in the file, as JSON.

    ``settled`` holds the highest settled number by sensor and epoch (in decimal); ``open`` the journals that may hold
    more; ``unsealed`` journals that are to become recordings; ``gaps`` what is missing, and no recording tells yet:
    sensor, epoch (in decimal), first, last, reason.
    """

    version: int = _VERSION
    settled: dict[str, dict[str, int]] = {}
    open: list[str] = []
    unsealed: list[str] = []
    gaps: list[tuple[str, str, int, int, str]] = []


class _Version(msgspec.Struct):
    """Of any content, however much of it is not known here."""

    version: int = _VERSION


class Ledger:
    """The highest settled number of each run of a folder, durable.

    Parameters
    ----------
    folder : Path

    Attributes
    ----------
    is_new : bool
        There was none.
    settled : dict of Run to int
    open, unsealed : list of str
        Names of journals that may hold more than is in ``settled``, and of those that are to be sealed.
    gaps : list of Gap
        What is missing, and no recording tells yet.

    Raises
    ------
    DataError
        It cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / _NAME
        self.is_new = not self._path.exists()
        content = _Content() if self.is_new else self._read()
        self.settled = {
            Run(sensor, int(epoch)): last for sensor, runs in content.settled.items() for epoch, last in runs.items()
        }
        self.open, self.unsealed = content.open, content.unsealed
        self.gaps = [Gap(sensor, first, last, why, int(epoch)) for sensor, epoch, first, last, why in content.gaps]

    def _read(self) -> _Content:
        try:
            text = self._path.read_bytes()
            version = msgspec.json.decode(text, type=_Version).version
            if version not in range(1, _VERSION + 1):
                raise FormatVersionError(
                    f"{self._path} has version {version}, this package reads {_VERSION}; update ertis-numba"
                )
            content = msgspec.json.decode(text, type=_Content)
        except OSError as error:
            raise DataError(f"{self._path}: {error.strerror}; allow reading it") from error
        except msgspec.MsgspecError as error:
            raise DataError(
                f"{self._path} is damaged ({error}); remove it: it is made anew from the recordings beside it"
            ) from error
        return content

    def save(
        self, settled: Mapping[Run, int], *, open_: Iterable[str], unsealed: Iterable[str], gaps: Sequence[Gap] = ()
    ) -> None:
        """Replace what is in the file; when this returns, it is durable.

        Raises
        ------
        OSError, DataError
            It cannot be written; the old content stays.
        """
        runs: dict[str, dict[str, int]] = {}
        for run, last in settled.items():
            runs.setdefault(run.sensor, {})[str(run.epoch)] = last
        told = [(gap.sensor, str(gap.epoch), gap.first, gap.last, gap.reason) for gap in gaps]
        content = _Content(settled=runs, open=list(open_), unsealed=list(unsealed), gaps=told)
        with replacing(self._path, overwrite=True, token="new") as part:  # noqa: S106  who has the lock writes alone
            part.write_bytes(msgspec.json.encode(content))
        self.settled, self.open, self.unsealed = dict(settled), content.open, content.unsealed
        self.gaps = list(gaps)


class Lock:
    """Keeps a folder for one process; it ends with the process, however that ends.

    Raises
    ------
    InUseError
        Another process has it.
    DataError
        The folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / _LOCK
        try:
            self._descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; give a folder that can be written") from error
        try:
            if sys.platform == "win32":
                msvcrt.locking(self._descriptor, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._descriptor)
            raise InUseError(
                f"{folder} is in use by another central node; give a folder of its own to each, or end the other"
            ) from error

    def release(self) -> None:
        """Let others have the folder; to release it twice does no harm."""
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = -1


def look(recordings: Iterable[Path]) -> dict[Run, int]:
    """Return the highest settled number of each run in recordings, read by a process of its own.

    Raises
    ------
    DataError
        One cannot be read.
    """
    paths = [str(path) for path in recordings]
    if not paths:
        return {}
    command = [sys.executable, "-P", "-m", "ertis_numba.storage._runs_process", "--", *paths]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)  # noqa: S603  our own
    if done.returncode:
        said = done.stderr.decode(errors="backslashreplace").strip().splitlines() or ["nothing"]
        raise DataError(f"recordings cannot be looked at ({said[-1]}); move those that are damaged elsewhere")
    settled: dict[Run, int] = {}
    for sensor, epoch, last in msgspec.json.decode(done.stdout, type=list[tuple[str, int, int]]):
        run = Run(sensor, epoch)
        settled[run] = max(last, settled.get(run, -1))
    return settled
