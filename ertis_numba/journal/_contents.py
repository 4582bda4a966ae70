"""Content of a journal."""

import os
import re
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Final, Self

from ertis_numba.base.errors import ArgumentError, DamagedError, DataError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal._database import Database
from ertis_numba.journal._entries import JournalEntry, JournalKey, JournalSensor, verified_values
from ertis_numba.journal._poses import JournalPose, pose_blocks, read_poses
from ertis_numba.journal._tables import COMPLETE_VERSION, POSES, select_statement

__all__ = ["SUFFIX", "ReadableJournal"]

SUFFIX: Final = ".journal"
"""Suffix of a journal, after the name of its recording."""

_SELECTION: Final = select_statement("measurements", "WHERE id = ?")


def _recording_name(journal: str, target: str) -> str:
    """Return the name of the recording to be made from a journal, in the folder of the journal."""
    if journal.endswith(SUFFIX) and journal != SUFFIX:
        return journal.removesuffix(SUFFIX)
    name = re.split(r"[/\\\0]", target)[-1]
    return f"{journal}.h5" if name in {"", ".", "..", journal} else name


class ReadableJournal:
    """An open journal for reading."""

    path: Path
    target: Path
    source: str

    def __init__(self, path: Path, database: Database) -> None:
        self.path = path
        self._database = database
        self._lock = threading.RLock()
        self._sensors: dict[str, JournalSensor] = {}
        self._ids: dict[str, int] = {}
        # Name, reason and number of measurements, by sensor number.
        self._unusable: dict[int, tuple[str, str, int]] = {}
        self._last: dict[tuple[str, int], int] = {}
        self._n_entries = self._held_bytes = 0
        self._has_poses = False
        self._identity = 0

    def _load(self) -> None:
        rows = self._database.execute(select_statement("journal"))
        if len(rows) != 1:
            raise DamagedError(f"{self.path} is damaged: it has no header; copy it again if you can")
        target, self.source, _ = verified_values(self.path, "the journal", rows[0])
        self.target = self.path.parent / _recording_name(self.path.name, os.fsdecode(target))
        self._identity = rows[0][-1]
        self._has_poses = self._database.has_table(POSES)
        for row in self._database.execute(select_statement("sensors", "ORDER BY id")):
            try:
                self._register(row[0], JournalSensor.from_row(self.path, row))
            except DamagedError:
                raise
            except (ArgumentError, DataError) as error:  # The settings of one sensor must not block the others.
                self._unusable[row[0]] = row[1], str(error), 0
        names = {number: name for name, number in self._ids.items()}
        counts = self._database.execute(
            "SELECT sensor, epoch, max(sequence), count(*) FROM measurements INDEXED BY key GROUP BY sensor, epoch"
        )
        for number, session_id, last, count in counts:
            if number in self._unusable:
                name, reason, before = self._unusable[number]
                self._unusable[number] = name, reason, before + count
                continue
            if number not in names:
                raise DamagedError(f"{self.path} is damaged: it has no sensor {number}; copy it again if you can")
            self._last[names[number], session_id] = last
            self._n_entries += count
            self._held_bytes += count * self._sensors[names[number]].n_bytes
        n_rows, n_listed = self._count_rows(), self._n_entries + sum(count for *_, count in self._unusable.values())
        if n_rows != n_listed:
            raise DamagedError(
                f"{self.path} is damaged: it lists {n_listed} measurements and has {n_rows}; copy it again if you can"
            )

    def _count_rows(self) -> int:
        """Count the rows of the table; a difference from the index reveals damage to one of the two trees."""
        ((version,),) = self._database.execute("PRAGMA user_version")
        if version == COMPLETE_VERSION:
            # Rows may have been deleted from the front, so the first number is not always 1. There are no other
            # holes, so the first and the last number give the count.
            rows = self._database.execute(
                "SELECT ifnull((SELECT max(id) FROM measurements) - (SELECT min(id) FROM measurements) + 1, 0)"
            )
        else:  # The numbers have holes, so this reads every page of the table except the samples.
            try:
                rows = self._database.execute("SELECT count(*) FROM measurements NOT INDEXED")
            except DamagedError:  # Some pages are damaged. Reading their rows reports it, and the others are sound.
                return self._n_entries + sum(count for *_, count in self._unusable.values())
        return int(rows[0][0])

    @property
    def sensors(self) -> Mapping[str, JournalSensor]:
        """Sensors by name, in order of registration."""
        return MappingProxyType(self._sensors)

    @property
    def unusable(self) -> Mapping[str, tuple[str, int]]:
        """Sensors with unusable settings, by name: the reason, and the number of measurements."""
        return MappingProxyType({name: (reason, count) for name, reason, count in self._unusable.values()})

    @property
    def gaps(self) -> tuple[SequenceGap, ...]:
        """Noted gaps, in order."""
        with self._lock:
            rows = self._database.execute(select_statement("gaps", "ORDER BY id"))
        names = {number: name for name, number in self._ids.items()}
        made = (verified_values(self.path, "a gap", row) for row in rows)
        return tuple(
            SequenceGap(names[number], first, last, why, session_id)
            for number, session_id, first, last, why in made
            if number not in self._unusable
        )

    def read_poses(self) -> tuple[list[JournalPose], int]:
        """Return the undamaged poses of platforms in order of arrival, and the number of damaged ones."""
        with self._lock:
            return read_poses(self._database, self.path)

    def pose_blocks(self) -> Iterator[tuple[list[JournalPose], int]]:
        """Yield the result of `read_poses` in blocks, which are read on request."""
        blocks = pose_blocks(self._database, self.path)
        while True:
            with self._lock:
                block = next(blocks, None)
            if block is None:
                return
            yield block

    def times_ns(self, sensor: str) -> list[int]:
        """Return the times of the measurements of a sensor in any order, without checking them."""
        number = self._ids[self._sensor(sensor).name]
        with self._lock:
            rows = self._database.execute("SELECT timestamp_ns FROM measurements WHERE sensor = ?", (number,))
        return [time_ns for (time_ns,) in rows if isinstance(time_ns, int)]

    def index(self, sensor: str | None = None) -> list[JournalKey]:
        """Return the keys of measurements of one sensor or of all, in order of arrival, without reading them."""
        number = None if sensor is None else self._ids[self._sensor(sensor).name]
        with self._lock:
            rows = self._database.execute(
                "SELECT id, sensor, epoch, sequence FROM measurements INDEXED BY key WHERE sensor = ifnull(?, sensor)",
                (number,),
            )
        names = {number: name for name, number in self._ids.items()}
        return sorted(
            JournalKey(place, names[number], *rest) for place, number, *rest in rows if number not in self._unusable
        )

    def newest(self, n_max: int) -> list[tuple[str, int, int, int]]:
        """Return sensor, session_id, number and CRC-32 of the newest measurements, without reading their data."""
        with self._lock:
            rows = self._database.execute(
                "SELECT sensor, epoch, sequence, crc32 FROM measurements ORDER BY id DESC LIMIT ?", (n_max,)
            )
        names = {number: name for name, number in self._ids.items()}
        return [(names[number], *rest) for number, *rest in reversed(rows) if number in names]

    def find(self, sensor: str, session_id: int, sequence: int) -> JournalKey:
        """Return the key of a measurement."""
        with self._lock:
            rows = self._database.execute(
                "SELECT id FROM measurements INDEXED BY key WHERE sensor = ? AND epoch = ? AND sequence = ?",
                (self._ids[self._sensor(sensor).name], session_id, sequence),
            )
        if not rows:
            raise DamagedError(
                f"{self.path} has no measurement {sequence} of sensor {sensor}; copy it again if you can"
            )
        return JournalKey(rows[0][0], sensor, session_id, sequence)

    def entry(self, key: JournalKey) -> JournalEntry:
        """Return a measurement with read-only data."""
        with self._lock:
            rows = self._database.execute(_SELECTION, (key.place,))
        if len(rows) != 1 or tuple(rows[0][1:4]) != (self._ids[key.sensor], key.session_id, key.sequence):
            raise DamagedError(
                f"{self.path} has lost the record of measurement {key.sequence} of sensor {key.sensor}: it is "
                "damaged; copy it again if you can"
            )
        return self._sensors[key.sensor].entry(self.path, rows[0])

    def entries(self, sensor: str | None = None) -> Iterator[JournalEntry]:
        """Yield the measurements of one sensor or of all, in order of arrival, each read when it is requested."""
        # Raises DamagedError if a measurement does not match its CRC-32, or the index does not list it.
        numbers = set(self._ids.values()) if sensor is None else {self._ids[self._sensor(sensor).name]}
        return self._in_order(self.index(sensor), numbers - self._unusable.keys())

    def _in_order(self, keys: list[JournalKey], sensors: set[int]) -> Iterator[JournalEntry]:
        """Yield measurements; before each, refuse rows of the sensors that a damaged index lists elsewhere, or not."""
        before = 0
        for key in keys:
            if key.place > before + 1:
                with self._lock:
                    rows = self._database.execute(
                        "SELECT sensor FROM measurements NOT INDEXED WHERE id > ? AND id < ?", (before, key.place)
                    )
                if any(number in sensors for (number,) in rows):
                    raise DamagedError(
                        f"{self.path} is damaged: its index omits a measurement before measurement {key.sequence} of "
                        f"sensor {key.sensor}; copy it again if you can"
                    )
            yield self.entry(key)
            before = key.place

    def _sensor(self, name: str) -> JournalSensor:
        if name not in self._sensors:
            raise ArgumentError(f"sensor {name!r} is not in {self.path}; add it first")
        return self._sensors[name]

    def _register(self, number: int, sensor: JournalSensor) -> None:
        self._ids[sensor.name] = number
        self._sensors[sensor.name] = sensor

    def __len__(self) -> int:
        return self._n_entries

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the journal; closing twice is harmless."""
        with self._lock:
            self._database.close()
