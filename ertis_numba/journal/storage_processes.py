"""Sealing and reading of recordings in separate processes, because HDF5 can crash its process on a full disk."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeAlias

import msgspec

from ertis_numba.base.errors import DataError, JournalInUseError
from ertis_numba.processes import Child

__all__ = [
    "FoundSessions",
    "FromSealing",
    "ReadSessions",
    "SealJournal",
    "Sealed",
    "SealingProgress",
    "SealingResult",
    "StorageFailed",
    "seal_in_subprocess",
    "sessions_in_recordings",
]

_SEALING: Final = "ertis_numba.storage.sealing_process"
_READING: Final = "ertis_numba.storage.sessions_process"
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class SealingResult:
    """Result of sealing a journal; ``recording`` is None if the journal had no measurement.

    Of the ``missing`` measurements, ``damaged`` ones were damaged in the journal, and ``lost`` ones noted before its
    log was damaged: each number belongs to a stored measurement or a gap, or was skipped by the sensor. ``set_aside``
    is the new path of a journal with damaged poses, or damaged or refused measurements; without any, the journal was
    removed. ``damage`` describes losses from a damaged log that no gap covers. ``refused`` has the reasons by sensor.
    ``without_pose`` counts measurements of sensors with poses. ``pose_damage`` is the number of damaged poses, or the
    reason why all were left out.
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
    without_pose: int = 0
    pose_damage: str = ""

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
        if self.pose_damage:
            reported.append(self.pose_damage)
        reported += [f"no recording can hold sensor {name} ({reason})" for name, reason in self.refused.items()]
        if self.without_pose:
            reported.append(
                "1 measurement has no pose, because poses were missing at its time"
                if self.without_pose == 1
                else f"{self.without_pose} measurements have no pose, because poses were missing at their times"
            )
        if self.set_aside is not None:
            reported.append(f"the journal is kept as {self.set_aside}")
        return "; ".join(reported)


class SealJournal(msgspec.Struct, frozen=True, tag=True):
    """Request to seal a journal, with the options of `seal_in_subprocess`."""

    journal: Path
    overwrite: bool
    rests: float | None


class SealingProgress(msgspec.Struct, frozen=True, tag=True):
    """Number of measurements written so far, and of all measurements."""

    done: int
    of: int


class Sealed(msgspec.Struct, frozen=True, tag=True):
    """A journal is sealed."""

    result: SealingResult


class StorageFailed(msgspec.Struct, frozen=True, tag=True):
    """A request failed; with ``in_use``, because another process has the journal open."""

    error: str
    in_use: bool = False


FromSealing: TypeAlias = SealingProgress | Sealed | StorageFailed


class ReadSessions(msgspec.Struct, frozen=True, tag=True):
    """Request to read the sessions in recordings."""

    recordings: list[Path]


class FoundSessions(msgspec.Struct, frozen=True, tag=True):
    """Sessions in recordings: sensor, session_id, and the highest stored or missing number."""

    sessions: list[tuple[str, int, int]]


def seal_in_subprocess(
    journal: Path,
    *,
    overwrite: bool = False,
    rests: float | None = None,
    progress: Progress = lambda _done, _of: None,
) -> SealingResult:
    """Make the recording of a journal in a separate process, which Ctrl-C does not reach."""
    # With `rests`, it pauses after each step for this multiple of its duration. Raises OSError if no process can be
    # started, and KeyboardInterrupt, whose message states where the measurements are.
    replies: list[Sealed | StorageFailed] = []
    try:
        reason = _seal(SealJournal(journal, overwrite, rests), replies, progress)
    except KeyboardInterrupt as error:
        raise KeyboardInterrupt(_interrupt_message(journal, replies)) from error
    match replies:
        case [Sealed(result=result)]:
            return result
        case [StorageFailed(error=text, in_use=True)]:
            raise JournalInUseError(text)
        case [StorageFailed(error=text)]:
            raise DataError(text)
    raise DataError(f"{journal}: the process that seals it {reason}; seal it again")


def _seal(request: SealJournal, replies: list[Sealed | StorageFailed], progress: Progress) -> str:
    """Run a sealing process, append its reply, and return how it ended."""
    child: Child[FromSealing] = Child(_SEALING, FromSealing, keep_stderr=True)
    child.pipe.send(request)
    try:
        _listen(child, replies, progress)
    except BaseException:
        child.interrupt()
        _listen(child, replies, lambda _done, _of: None)
        child.wait()
        raise
    return child.wait()


def _listen(child: Child[FromSealing], replies: list[Sealed | StorageFailed], progress: Progress) -> None:
    for note in child.pipe.messages():
        if isinstance(note, SealingProgress):
            progress(note.done, note.of)
        else:
            replies.append(note)


def _interrupt_message(journal: Path, replies: list[Sealed | StorageFailed]) -> str:
    """Return a line on where the measurements are after an interrupt; sealing may have ended before it."""
    match replies:
        case [Sealed(result=sealed)]:
            return sealed.remark or f"the measurements are in {sealed.recording}"
    return f"the measurements are safe in {journal}; recover them with 'ertis import journals {journal}'"


def sessions_in_recordings(recordings: Iterable[Path]) -> list[tuple[str, int, int]]:
    """Return the sessions in recordings, read by a separate process; see `FoundSessions`."""
    child: Child[Any] = Child(_READING, FoundSessions | StorageFailed, keep_stderr=True)
    try:
        child.pipe.send(ReadSessions(list(recordings)))
        match next(child.pipe.messages(), None):
            case FoundSessions(sessions=found):
                return found
            case StorageFailed(error=reason):
                pass
            case _:
                reason = f"the process that reads them {child.wait()}"
    finally:
        child.close()
    raise DataError(f"recordings cannot be read ({reason}); move damaged ones elsewhere")
