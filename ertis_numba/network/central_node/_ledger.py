"""Ledger of a folder: a small file with its sessions, readable without the journals and recordings."""

import contextlib
import os
import sys
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeAlias

import msgspec

from ertis_numba.base.atomic_files import atomic_write
from ertis_numba.base.errors import DataError, FormatVersionError, JournalInUseError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import sessions_in_recordings
from ertis_numba.network.central_node._received_items import SensorSession

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["Ledger", "Lock", "read_acked_through"]

_NAME: Final = ".ertis-ledger"
_LOCK: Final = ".ertis-lock"
_VERSION: Final = 3
_MAX_SESSIONS: Final = 64  # Limit per sensor.
_ALL_RUNS_KEPT: Final = 16_384


class _Begin(msgspec.Struct, tag="ertis-ledger", array_like=True):
    version: int


class _AckedSession(msgspec.Struct, tag="run", array_like=True):
    sensor: str
    session_id: int
    last: int


class _Open(msgspec.Struct, tag="open", array_like=True):
    name: str


class _Unsealed(msgspec.Struct, tag="unsealed", array_like=True):
    name: str


class _Gap(msgspec.Struct, tag="gap", array_like=True):
    sensor: str
    session_id: int
    first: int
    last: int
    reason: str


class _Tail(msgspec.Struct, tag="crc32", array_like=True):
    sensor: str
    session_id: int
    numbers: list[tuple[int, int]]


class _End(msgspec.Struct, tag="end", array_like=True):
    n_lines: int


_Line: TypeAlias = _Begin | _AckedSession | _Open | _Unsealed | _Gap | _Tail | _End


class Ledger:
    """Durable record of the highest acknowledged number of the newest 64 sessions of each sensor.

    Each line has the CRC-32 of an entry in hexadecimal, and the entry as a JSON array; wrong ones are omitted, and
    ``damage`` describes them. In ``acked_through``, the session that grew last comes last. ``open`` journals may
    contain more; ``gaps`` are in no recording yet. ``tails`` has the CRC-32 of the newest measurements, by number.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / _NAME
        self.is_new = not self._path.exists()
        self.damage = ""
        self.acked_through: dict[SensorSession, int] = {}
        self.open: list[str] = []
        self.unsealed: list[str] = []
        self.gaps: list[SequenceGap] = []
        self.tails: dict[SensorSession, dict[int, int]] = {}
        if not self.is_new:
            self._read()

    def _read(self) -> None:
        try:
            content = self._path.read_bytes()
        except OSError as error:
            raise DataError(f"{self._path}: {error.strerror}; make it readable") from error
        lines = content.split(b"\n")[:-1]
        n_bad, n_ended = 0, -1
        for number, text in enumerate(lines):
            try:
                entry = _decoded(text)
                self._add(entry)
            except FormatVersionError:
                raise
            except ValueError:
                n_bad += 1
                continue
            if isinstance(entry, _End) and entry.n_lines == number:
                n_ended = number + 1
        if n_bad:
            self._note_damage(f"{n_bad} of {len(lines)} entries cannot be read")
        elif n_ended != len(lines) or not lines:
            self._note_damage("its end is missing")

    def _add(self, entry: _Line) -> None:
        match entry:
            case _Begin(version) if version > _VERSION:
                raise FormatVersionError(
                    f"{self._path} has version {version}, but this package reads {_VERSION}; update ertis-numba"
                )
            case _AckedSession(sensor, session_id, last):
                self.acked_through[SensorSession(sensor, session_id)] = last
            case _Open(name):
                self.open.append(name)
            case _Unsealed(name):
                self.unsealed.append(name)
            case _Gap(sensor, session_id, first, last, reason):
                self.gaps.append(SequenceGap(sensor, first, last, reason, session_id))
            case _Tail(sensor, session_id, numbers):
                self.tails[SensorSession(sensor, session_id)] = dict(numbers)

    def _note_damage(self, damage: str) -> None:
        self.damage = (
            f"{self._path} is damaged: {damage}. Its content is read again from the recordings and journals beside it; "
            "measurements in recordings that were moved elsewhere may be stored a second time"
        )

    def save(
        self,
        acked_through: Mapping[SensorSession, int],
        *,
        open_: Iterable[str],
        unsealed: Iterable[str],
        gaps: Sequence[SequenceGap] = (),
        tails: Mapping[SensorSession, Mapping[int, int]] | None = None,
    ) -> None:
        """Replace the file durably, the session that grew last at the end; after an error, the old content stays."""
        kept = _newest(acked_through)
        opened, left = list(open_), list(unsealed)
        lines: list[_Line] = [
            _Begin(_VERSION),
            *(_AckedSession(run.sensor, run.session_id, last) for run, last in kept.items()),
            *map(_Open, opened),
            *map(_Unsealed, left),
            *(_Gap(gap.sensor, gap.session_id, gap.first, gap.last, gap.reason) for gap in gaps),
            *(
                _Tail(run.sensor, run.session_id, list(numbers.items()))
                for run, numbers in (tails or {}).items()
                if run in kept
            ),
        ]
        with atomic_write(self._path, overwrite=True, token="new") as part:  # noqa: S106  who has the lock writes alone
            part.write_bytes(b"".join(map(_encoded, [*lines, _End(len(lines))])))
        self.acked_through, self.open, self.unsealed = kept, opened, left
        self.gaps, self.tails, self.damage = list(gaps), {run: dict(each) for run, each in (tails or {}).items()}, ""


def _newest(acked_through: Mapping[SensorSession, int]) -> dict[SensorSession, int]:
    """Return the newest sessions of each sensor, in their order."""
    counts: Counter[str] = Counter()
    kept: list[SensorSession] = []
    for run in list(acked_through)[: -_ALL_RUNS_KEPT - 1 : -1]:
        counts[run.sensor] += 1
        if counts[run.sensor] <= _MAX_SESSIONS:
            kept.append(run)
    return {run: acked_through[run] for run in reversed(kept)}


def _encoded(line: _Line) -> bytes:
    text = msgspec.json.encode(line)
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _decoded(line: bytes) -> _Line:
    """Return an entry; raise a `ValueError` if it is damaged."""
    check, _, text = line.partition(b" ")
    if check != b"%08x" % zlib.crc32(text):
        raise ValueError("wrong CRC-32")
    return _LINES.decode(text)


_LINES: Final[msgspec.json.Decoder[_Line]] = msgspec.json.Decoder(_Line)


class Lock:
    """Lock of a folder for one process; it ends with the process."""

    def __init__(self, folder: Path) -> None:
        path = folder / _LOCK
        try:
            self._descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o666)
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; choose a writable folder") from error
        try:
            if sys.platform == "win32":
                msvcrt.locking(self._descriptor, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._descriptor)
            raise JournalInUseError(
                f"{folder} is in use by another central node; use a different folder for each, or end the other"
            ) from error

    def release(self) -> None:
        """Release the folder; releasing twice is harmless."""
        if self._descriptor >= 0:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = -1


def read_acked_through(recordings: Iterable[Path]) -> dict[SensorSession, int]:
    """Return the highest acknowledged number of each session in recordings, read by a separate process."""
    paths = list(recordings)
    acked_through: dict[SensorSession, int] = {}
    for sensor, session_id, last in sessions_in_recordings(paths) if paths else ():
        run = SensorSession(sensor, session_id)
        acked_through[run] = max(last, acked_through.get(run, -1))
    return acked_through
