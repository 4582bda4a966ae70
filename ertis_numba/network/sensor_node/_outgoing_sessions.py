"""Outgoing sessions of sensors: their items, and the part that was sent."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, Literal

from ertis_numba.base.errors import ArgumentError
from ertis_numba.journal import Journal, JournalEntry, JournalSensor

__all__ = ["MEMORY_FULL", "NEVER_GIVEN", "OutgoingSession", "UnackedItem"]

MEMORY_FULL: Final = "the sensor node's memory was full"
NEVER_GIVEN: Final = "the sensor node never had it"

_GAPS = 64  # Limit at the front of a session. With more, the memory is too full to keep them apart.
_PATIENCE_S = 1.0  # Time without progress before everything under way is sent again; doubled while there is none.
_MAX_PATIENCE_S = 8.0


@dataclass(slots=True, eq=False)
class UnackedItem:
    """Measurement or gap that waits for its acknowledgement."""

    first: int
    last: int  # equal to first for a measurement
    reason: str = ""  # of a gap; empty for a measurement
    n_bytes: int = 0
    entry: JournalEntry | None = None  # measurement, if in memory


@dataclass(slots=True, eq=False)
class OutgoingSession:
    """Items of one session of a sensor, oldest first, with a send window: go-back-N; one thread at a time."""

    sensor: JournalSensor
    session_id: int
    journal: Journal | None = None
    items: deque[UnackedItem] = field(default_factory=deque)
    following: int | None = None  # number after the last item
    acked_through: int = -1  # the central node has everything up to here
    sent: int = -1  # sent up to here
    reached: int = -1  # ever sent up to here: an ack beyond it belongs to other items
    stage: Literal["new", "asked", "welcome", "waiting"] = "new"
    since_s: float = 0.0  # beginning of the stage, end of "waiting"
    window: int = 1
    _under_way: int = 0  # Number of sent items at the front.
    _patience_s: float = field(default_factory=lambda: _PATIENCE_S)
    _moved_s: float = 0.0
    _dropped: deque[int] = field(default_factory=lambda: deque(maxlen=256))

    @property
    def key(self) -> tuple[str, int]:
        """Sensor and session."""
        return self.sensor.name, self.session_id

    def add_measurement(self, number: int, n_bytes: int, *, entry: JournalEntry | None) -> UnackedItem:
        """Add a measurement at the end; missing numbers before it become a gap."""
        self.require_above(number)
        self._fill(number)
        return self._add(UnackedItem(number, number, "", n_bytes, entry))

    def require_above(self, number: int) -> None:
        """Refuse a number that does not rise."""
        if self.following is not None and number < self.following:
            raise ArgumentError(
                f"measurement {number} of sensor {self.sensor.name} follows {self.following - 1}; pass increasing "
                "numbers, or another session_id"
            )

    def add_gap(self, first: int, last: int, reason: str) -> None:
        """Add a gap at the end; known numbers stay."""
        if self.following is not None:
            first = max(first, self.following)
        if first > last:
            return
        self._fill(first)
        before = self.items[-1] if self.items else None
        # The extended gap is sent again, even if its beginning was sent.
        if before is not None and before.reason == reason:
            before.last = last
            self._under_way = min(self._under_way, len(self.items) - 1)
            self.following = last + 1
        else:
            self._add(UnackedItem(first, last, reason))

    def _fill(self, number: int) -> None:
        if self.following is not None and self.following < number:
            self.add_gap(self.following, number - 1, NEVER_GIVEN)

    def _add(self, item: UnackedItem) -> UnackedItem:
        if self.following is None:
            self.acked_through = self.sent = self.reached = item.first - 1
        self.items.append(item)
        self.following = item.last + 1
        return item

    def forget_oldest(self) -> UnackedItem | None:
        """Replace the oldest measurement by a gap, and return the measurement."""
        gaps = []
        while self.items and self.items[0].reason:
            gaps.append(self.items.popleft())
        if not self.items:
            self.items.extend(gaps)
            return None
        oldest = self.items.popleft()
        gaps.append(UnackedItem(oldest.first, oldest.last, MEMORY_FULL))
        while len(gaps) > 1 and (gaps[-2].reason == MEMORY_FULL or len(gaps) > _GAPS):
            gaps[-2:] = [UnackedItem(gaps[-2].first, gaps[-1].last, MEMORY_FULL)]
        self.items.extendleft(reversed(gaps))
        self._under_way = 0  # `to_send` counts again.
        return oldest

    def to_send(self, window: int) -> UnackedItem | None:
        """Return the first unsent item, if the window has room for it."""
        self._count_under_way()
        if self._under_way >= min(window, len(self.items)):
            return None
        return self.items[self._under_way]

    def _count_under_way(self) -> None:
        while self._under_way < len(self.items) and self.items[self._under_way].last <= self.sent:
            self._under_way += 1

    def under_way(self) -> Iterator[UnackedItem]:
        """Yield sent but unacknowledged items."""
        self._count_under_way()
        return islice(self.items, self._under_way)

    def mark_sent(self, last: int, now_s: float) -> None:
        """Mark an item as sent."""
        if not self._under_way:
            self._moved_s = now_s
        self.sent = max(self.sent, last)
        self.reached = max(self.reached, last)
        self._count_under_way()

    def go_back(self, now_s: float) -> None:
        """Send all unacknowledged items again."""
        self.sent, self._under_way, self._moved_s = self.acked_through, 0, now_s

    def welcome(self, acked_through: int, window: int, now_s: float) -> list[UnackedItem]:
        """Start to send, and return the items that the central node has already."""
        self.stage, self.since_s, self.window = "welcome", now_s, window
        last = -1 if self.following is None else self.following - 1
        acked_through = min(
            acked_through, last
        )  # The central node may have more than is left here, for example if the end of a spool was lost.
        self.reached = max(self.reached, acked_through)
        done = self.settle(acked_through, now_s)
        self.go_back(now_s)
        return done

    def settle(self, number: int, now_s: float) -> list[UnackedItem]:
        """Remove and return the items that an ack covers; none for a late or foreign ack."""
        if not self.acked_through < number <= self.reached:
            return []
        self.acked_through, self._moved_s, self._patience_s = number, now_s, _PATIENCE_S
        self.sent = max(self.sent, number)
        done = []
        while self.items and self.items[0].last <= number:
            done.append(self.items.popleft())
        self._under_way = max(0, self._under_way - len(done))
        if self.items and self.items[0].first <= number:
            self.items[0].first = number + 1
        return done

    def is_stuck(self, now_s: float) -> bool:
        """Return True if acks have made no progress for too long; each time, it waits longer."""
        if not self._under_way or now_s - self._moved_s < self._patience_s:
            return False
        self._patience_s = min(2 * self._patience_s, _MAX_PATIENCE_S)
        return True

    def newly_dropped(self, dropped: tuple[tuple[int, str], ...]) -> tuple[tuple[int, str], ...]:
        """Return the drops of an ack that no earlier ack contained."""
        new = tuple((number, reason) for number, reason in dropped if number not in self._dropped)
        self._dropped.extend(number for number, _ in new)
        return new
