"""Model of a disk after a power cut.

Synced data is durable. Other data may be lost, torn or reordered, in sectors. Names are durable after a sync of their
folder. On a disk with an ordered journal, such as ext4, they are also durable after any later sync. A write whose sync
failed never reaches the disk, because Linux marks its pages as written.
"""

import random
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Final, Literal

from tests.faults.powercuts.log import DiskOperation, DiskRecord

__all__ = ["Disk", "Order"]

Order = Literal["any", "journal"]
"""Order in which changes of names reach the disk."""

_SECTORS: Final = (512, 4096)
_KEEP: Final = (0.0, 0.1, 0.5, 0.9, 1.0)
"""Possible shares of unsynced data that survive a power cut."""


@dataclass(slots=True, eq=False)
class _FileState:
    durable: bytearray = field(default_factory=bytearray)
    pending: list[tuple[int, int, bytes | None]] = field(default_factory=list)
    """Time, offset and data. Without data, the entry is a truncation."""

    def sync(self, before: int) -> None:
        """Make data durable that was written before a time."""
        for time, offset, data in self.pending:
            if time < before:
                _apply(self.durable, offset, data)
        self.pending = [each for each in self.pending if each[0] >= before]

    def fail(self, before: int) -> None:
        """Lose data that was written before a time."""
        self.pending = [each for each in self.pending if each[0] >= before or each[2] is None]

    def after_cut(self, rng: random.Random) -> bytearray:
        """Return the content after a power cut."""
        content = bytearray(self.durable)
        keep, sector = rng.choice(_KEEP), rng.choice(_SECTORS)
        for _, offset, data in self.pending:
            if data is None:
                if rng.random() < keep:
                    _apply(content, offset, None)
                continue
            start = offset
            while start < offset + len(data):
                end = min(offset + len(data), (start // sector + 1) * sector)
                if rng.random() < keep:
                    _apply(content, start, data[start - offset : end - offset])
                start = end
        return content


def _apply(content: bytearray, offset: int, data: bytes | None) -> None:
    if data is None:
        del content[offset:]
        content.extend(bytes(offset - len(content)))
        return
    if len(content) < offset:
        content.extend(bytes(offset - len(content)))
    content[offset : offset + len(data)] = data


@dataclass(frozen=True, slots=True, eq=False)
class _Change:
    """Change of names.

    ``path`` is removed. ``target`` becomes a file, or a folder if the change has no file.
    """

    time: int
    gone: str
    target: str = ""
    file: _FileState | None = None

    def apply(self, names: dict[str, _FileState | None]) -> None:
        if self.gone:
            names.pop(self.gone, None)
        if self.target:
            names[self.target] = self.file

    @property
    def folders(self) -> set[str]:
        return {str(PurePosixPath(name).parent) for name in (self.gone, self.target) if name}


class _Names:
    """Durable names, and changes of names that are not durable yet."""

    def __init__(self, order: Order) -> None:
        self._order: Final = order
        self._durable: dict[str, _FileState | None] = {}
        self._pending: list[_Change] = []

    def add(self, change: _Change) -> None:
        self._pending.append(change)

    def sync(self, folder: str | None, before: int) -> None:
        """Make changes before a time durable.

        On a disk with order "any", only the changes of ``folder`` become durable. On one with order "journal", each
        sync flushes the disk's journal, and all changes become durable. ``folder`` is None after the sync of a file.
        """
        if folder is None and self._order == "any":
            return
        left = []
        for change in self._pending:
            if change.time < before and (self._order == "journal" or folder in change.folders):
                change.apply(self._durable)
            else:
                left.append(change)
        self._pending = left

    def after_cut(self, rng: random.Random) -> dict[str, _FileState | None]:
        names = dict(self._durable)
        kept = self._pending
        if self._order == "journal":
            kept = kept[: rng.randint(0, len(kept))]
        else:
            share = rng.choice(_KEEP)
            kept = [change for change in kept if rng.random() < share]
        for change in kept:
            change.apply(names)
        return names


class Disk:
    """History of a folder so far.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path) -> None:
        self._folder: Final = str(folder.resolve())
        self._time = 0
        self._files: dict[int, _FileState] = {}
        self._live: dict[str, _FileState | None] = {}
        self._names: Final[dict[Order, _Names]] = {"any": _Names("any"), "journal": _Names("journal")}
        self._syncs: dict[tuple[int, int, str], int] = {}

    def take(self, record: DiskRecord) -> None:
        """Apply the next record."""
        self._time += 1
        path = record.path
        match record.kind:
            case DiskOperation.CREATE:
                file = self._files[record.inode] = _FileState()
                self._change("", path, file)
            case DiskOperation.WRITE | DiskOperation.TRUNCATE:
                data = record.data if record.kind is DiskOperation.WRITE else None
                self._file(record.inode).pending.append((self._time, record.offset, data))
            case DiskOperation.SYNC_BEGIN:
                self._syncs[record.pid, record.inode, path] = self._time
            case DiskOperation.SYNC_END | DiskOperation.SYNC_FAIL:
                before = self._syncs.pop((record.pid, record.inode, path))
                self._sync(record, before)
            case DiskOperation.RENAME:
                self._change(path, record.data.decode(errors="surrogateescape"), self._live.get(path))
            case DiskOperation.UNLINK | DiskOperation.RMDIR:
                self._change(path, "", None)
            case DiskOperation.MKDIR:
                self._change("", path, None)

    def _sync(self, record: DiskRecord, before: int) -> None:
        is_folder = bool(record.offset)
        if record.kind is DiskOperation.SYNC_FAIL:
            if not is_folder:
                self._file(record.inode).fail(before)
            return
        if not is_folder:
            self._file(record.inode).sync(before)
        for names in self._names.values():
            names.sync(record.path if is_folder else None, before)

    def _file(self, inode: int) -> _FileState:
        return self._files.setdefault(inode, _FileState())

    def _change(self, gone: str, target: str, file: _FileState | None) -> None:
        change = _Change(self._time, gone, target, file)
        change.apply(self._live)
        for names in self._names.values():
            names.add(change)

    def cut(self, target: Path, rng: random.Random) -> None:
        """Write a possible state of the disk after a power cut into a new folder."""
        order: Order = rng.choice(("any", "journal"))
        names = self._names[order].after_cut(rng)
        target.mkdir()
        for name, file in sorted(names.items()):
            place = target / name[len(self._folder) + 1 :]
            if not place.parent.is_dir():  # The name of the folder was lost.
                continue
            if file is None:
                place.mkdir()
            else:
                place.write_bytes(file.after_cut(rng))
