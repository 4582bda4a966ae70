"""Journals of an archive, and the checksums and gaps to keep when a journal is sealed."""

import re
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Self

from ertis_numba.base.errors import DamagedError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import SUFFIX, Journal, JournalEntry, JournalPose, JournalSensor
from ertis_numba.network.central_node._received_items import ReceivedItem, SensorSession

__all__ = ["Checksums", "UnrecordedGaps", "Volume", "journal_name", "same", "sessions_in"]

_SOURCE = "central node"
_KEPT: Final = 65_536  # Takes about 15 MB.
_LEARNED: Final = 1024  # Number of newest measurements of a journal left by a crash.
_TAIL: Final = 16  # Per session: the largest window of a sensor node.


def journal_name(folder: Path, name: str, *, end: str = "", taken: Iterable[str] = ()) -> str:
    """Return a new journal name; names within a second have rising numbers, even if earlier ones are gone."""
    stem = f"{name}_{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    numbered = re.compile(rf"{re.escape(stem)}(?:_(\d+))?{end}\.h5")
    found = [numbered.match(other) for other in [*taken, *(path.name for path in folder.glob(f"{stem}*"))]]
    last = max((int(match[1] or 1) for match in found if match), default=0)
    return f"{stem}{f'_{last + 1:03}' if last else ''}{end}.h5{SUFFIX}"


def sessions_in(journal: Journal) -> dict[SensorSession, int]:
    """Return the highest number of each session in a journal, gaps included."""
    last: dict[SensorSession, int] = {}
    for key in journal.index():
        run = SensorSession(key.sensor, key.session_id)
        last[run] = max(key.sequence, last.get(run, -1))
    for gap in journal.gaps:
        run = SensorSession(gap.sensor, gap.session_id)
        last[run] = max(gap.last, last.get(run, -1))
    return last


class Volume:
    """Journal in use, owned by this object."""

    # `acked` has the highest stored number of each session, and `begun_s` is by `time.monotonic`.

    def __init__(self, journal: Journal) -> None:
        self.journal = journal
        self._known: dict[str, JournalSensor] = dict(journal.sensors)
        self._counted = {SensorSession(key.sensor, key.session_id): key.sequence for key in journal.index()}
        self.n_bytes = sum(journal.sensors[key.sensor].n_bytes for key in journal.index())
        self.acked = sessions_in(journal)
        self.begun_s = time.monotonic()
        self.next_pose = 0
        self.posed: frozenset[str] = frozenset()

    @classmethod
    def create(cls, path: Path) -> Self:
        """Create a journal whose recording will lie beside it."""
        return cls(Journal.create(path, target=path.name.removesuffix(SUFFIX), source=_SOURCE))

    @property
    def path(self) -> Path:
        """Path of the journal."""
        return self.journal.path

    def __len__(self) -> int:
        return len(self.journal)

    def fits(self, item: ReceivedItem) -> bool:
        """Return True if an item can go into this journal: its sensor is the same as before, and its number rises."""
        known = self._known.get(item.source.name)
        if known is not None and known is not item.source and not same(known, item.source):
            return False
        return item.first > self._counted.get(item.run, -1)

    def register(self, source: JournalSensor) -> None:
        """Register a sensor."""
        self._known[source.name] = source

    def append(self, items: list[ReceivedItem]) -> None:
        """Store either measurements or gaps durably, all or none, as `Journal.append`."""
        for item in items:
            self._add(item.source)
        entries = [item.content for item in items if isinstance(item.content, JournalEntry)]
        if not entries:
            self.note_gaps([item.content for item in items if isinstance(item.content, SequenceGap)])
            return
        self.journal.append(entries)
        for item in items:
            self._counted[item.run] = self.acked[item.run] = item.last
            self.n_bytes += item.source.n_bytes

    def note_gaps(self, gaps: list[SequenceGap]) -> None:
        """Store gaps durably; see `Journal.note_gaps`."""
        self.journal.note_gaps(gaps)
        for gap in gaps:
            run = SensorSession(gap.sensor, gap.session_id)
            self.acked[run] = max(gap.last, self.acked.get(run, -1))

    def append_poses(self, poses: list[JournalPose]) -> None:
        """Store poses durably, all or none; see `Journal.append_poses`."""
        self.journal.append_poses(poses)
        self.n_bytes += sum(pose.n_bytes for pose in poses)

    def _add(self, source: JournalSensor) -> None:
        if source.name not in self.journal.sensors:
            self.journal.add_sensor(
                source.name,
                source.settings,
                firmware=source.firmware,
                translation_m=source.translation_m,
                rotation_xyzw=source.rotation_xyzw,
            )
        self.register(source)

    def crc32_of(self, entry: JournalEntry) -> int | None:
        """Return the CRC-32 of the stored measurement with this number; None if there is none."""
        stamp = entry.measurement.stamp
        if stamp.sensor not in self.journal.sensors:
            return None
        try:
            key = self.journal.find(stamp.sensor, stamp.session_id, stamp.sequence)
        except DamagedError:  # The journal does not contain it.
            return None
        return self.journal.entry(key).crc32

    def close(self) -> None:
        """Close the journal."""
        self.journal.close()


def same(one: JournalSensor, other: JournalSensor) -> bool:
    """Return True if one recording can contain measurements of both sensors under one name."""
    parts: tuple[Callable[[JournalSensor], object], ...] = (
        lambda sensor: sensor.settings,
        lambda sensor: sensor.firmware,
        lambda sensor: sensor.translation_m,
        lambda sensor: sensor.rotation_xyzw,
    )
    return all(part(one) == part(other) for part in parts)


class Checksums:
    """CRC-32 of the newest measurements by session and number; tails are those from earlier processes."""

    def __init__(self, tails: Mapping[SensorSession, Mapping[int, int]]) -> None:
        self._kept: OrderedDict[tuple[SensorSession, int], int] = OrderedDict()
        for run, numbers in tails.items():
            for number, crc32 in numbers.items():
                self._kept[run, number] = crc32

    def find(self, run: SensorSession, number: int) -> int | None:
        """Return the CRC-32 of a measurement; None if it is not kept."""
        return self._kept.get((run, number))

    def add(self, run: SensorSession, number: int, crc32: int) -> None:
        """Keep the CRC-32 of a measurement that is stored."""
        self._kept[run, number] = crc32
        if len(self._kept) > _KEPT:
            self._kept.popitem(last=False)

    def learn(self, journal: Journal) -> None:
        """Keep the CRC-32 of the newest measurements of a journal."""
        for sensor, session_id, number, crc32 in journal.newest(_LEARNED):
            self.add(SensorSession(sensor, session_id), number, crc32)

    def tails(self, runs: Iterable[SensorSession]) -> dict[SensorSession, dict[int, int]]:
        """Return the CRC-32 of the newest measurements of given sessions, for the next process."""
        found: dict[SensorSession, dict[int, int]] = {run: {} for run in runs}
        for (run, number), crc32 in reversed(self._kept.items()):
            if run in found and len(found[run]) < _TAIL:
                found[run][number] = crc32
        return {run: dict(sorted(numbers.items())) for run, numbers in found.items() if numbers}


class UnrecordedGaps:
    """Gaps of sensors without a measurement in their journal, so that its recording cannot contain them."""

    # Until the next recording with a measurement of the sensor contains them, the ledger keeps them.

    def __init__(self, gaps: Iterable[SequenceGap]) -> None:
        self._gaps = dict.fromkeys(gaps)

    @property
    def gaps(self) -> list[SequenceGap]:
        """All gaps, in order of arrival."""
        return list(self._gaps)

    def learn(self, journal: Journal) -> None:
        """Add the gaps of a journal to seal."""
        gaps = journal.gaps
        if gaps:
            measured = {key.sensor for key in journal.index()}
            self.reported(gap for gap in gaps if gap.sensor in measured)
            self._gaps |= dict.fromkeys(gap for gap in gaps if gap.sensor not in measured)

    def of(self, sensors: Iterable[str]) -> list[SequenceGap]:
        """Return the gaps of given sensors."""
        wanted = set(sensors) if self._gaps else set()
        return [gap for gap in self._gaps if gap.sensor in wanted]

    def reported(self, gaps: Iterable[SequenceGap]) -> None:
        """Remove gaps that a journal with measurements of their sensor now contains durably."""
        for gap in gaps:
            self._gaps.pop(gap, None)
