"""Groups of simultaneous measurements, formed by the SYNC chain's counts."""

import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final, Literal

from ertis_numba.devices.capture.sync_counts import PulseAligner
from ertis_numba.network.messages import Data, Group

__all__ = ["Groups"]

_RUNS: Final = 32  # Limit on the sessions that are compared.
_OPEN: Final = 32
_MAX: Final = 32  # Limit on the members in the header of a group.
_SHORTEST_S: Final = 0.02  # Assumed interval between pulses, until it is known.
_MIN_S, _INTERVALS = 1.0, 10.0  # Time that an incomplete group stays open: this long, or this number of intervals.
_RECENT: Final = 256  # Number of closed groups that are not opened again.
_FUTURE_S: Final = 0.5
_PACE_S, _PACE = 2.0, 0.1  # A clock is wrong if it lags by this share over this time.
_FAR: Final = 128  # Allowed difference between a count and the time, in pulses: less than `_RECENT`.
_MAX_NS: Final = 2**63 - 1
_AWAY: Final = 3.0  # Multiple of that time after which a silent sensor is not waited for.

Flag = Literal["incomplete", "clock", "pulse"]


@dataclass(slots=True)
class _SessionClock:
    """Session of a sensor: its measurements share a counter and a clock."""

    slot: str
    ahead_ns: int  # Offset from its monotonic clock to the common clock.
    count: int  # Count at the start …
    began_ns: int  # … and the start by the common clock.
    paced_ns: tuple[int, int]  # Start of the observation of its lag, by the common clock and by this node's.
    used_ns: int = 0


@dataclass(slots=True)
class _Group:
    opened_ns: int
    members: dict[str, Data] = field(default_factory=dict)
    flags: set[Flag] = field(default_factory=set)


class Groups:
    """Grouping of measurements with the same pulse number; wrong data of one sensor never moves groups of others.

    Counts of sessions differ by an offset, from the timestamps of the first measurements, and then from the node's
    monotonic clock, which no one sets. The time of arrival replaces impossible timestamps. ``closed`` counts groups.
    """

    def __init__(self) -> None:
        slots = [str(number) for number in range(_RUNS)]
        self._pulses: PulseAligner[tuple[Data, int]] = PulseAligner(slots, shortest_s=_SHORTEST_S)
        self._free = slots
        self._runs: dict[int, _SessionClock] = {}
        self._seen_ns: dict[str, int] = {}
        self._groups: dict[int, _Group] = {}
        self._recent: deque[int] = deque(maxlen=_RECENT)
        self._realigned = 0
        self._joined_ns: int | None = None  # Time at which the latest new sensor joined.
        self._ahead_ns: int | None = None  # Offset from the common clock to this node's.
        self.closed: Counter[str] = Counter()

    def register(self, sensor: str, now_ns: int) -> None:
        """Wait for a sensor from now on."""
        if sensor not in self._seen_ns:
            self._joined_ns = now_ns
        self._seen_ns[sensor] = now_ns

    def add(self, data: Data, arrived_ns: int) -> list[Group]:
        """Add a measurement, and return the groups that are now closed."""
        run = self._checked(self._run(data, arrived_ns), data, arrived_ns)
        run.used_ns = self._seen_ns[data.sensor] = arrived_ns
        self._place(self._pulses.add(run.slot, (data, arrived_ns), data.sync_count, data.monotonic_ns + run.ahead_ns))
        return self._close(arrived_ns)

    def tick(self, now_ns: int) -> list[Group]:
        """Return the groups that are now closed because of elapsed time."""
        if self._ahead_ns is not None:
            self._place(self._pulses.release(now_ns + self._ahead_ns))
        return self._close(now_ns)

    def _run(self, data: Data, arrived_ns: int) -> _SessionClock:
        if data.session_id in self._runs:
            return self._runs[data.session_id]
        if not self._free:
            oldest = min(self._runs, key=lambda session_id: self._runs[session_id].used_ns)
            slot = self._runs.pop(oldest).slot
            self._place(self._pulses.reset(slot))
            self._free.append(slot)
        return self._begun(self._free.pop(0), data, arrived_ns, data.timestamp_ns)

    def _begun(self, slot: str, data: Data, arrived_ns: int, at_ns: int) -> _SessionClock:
        if self._ahead_ns is None:
            self._ahead_ns = min(at_ns, time.time_ns()) - arrived_ns
        now_ns = arrived_ns + self._ahead_ns
        if at_ns - now_ns > _FUTURE_S * 1e9:
            at_ns = now_ns  # A measurement cannot arrive before its emission: that clock is wrong.
        made = _SessionClock(slot, at_ns - data.monotonic_ns, data.sync_count, at_ns, (at_ns, arrived_ns))
        self._runs[data.session_id] = made
        return made

    def _checked(self, run: _SessionClock, data: Data, arrived_ns: int) -> _SessionClock:
        """Return the session to use: a new one if its time or its count cannot be right."""
        at_ns = data.monotonic_ns + run.ahead_ns
        if self._ahead_ns is None:
            return run
        if at_ns - arrived_ns > self._ahead_ns and at_ns <= time.time_ns():
            self._ahead_ns = at_ns - arrived_ns  # Measurements until now were old ones that the node catches up with.
        now_ns = arrived_ns + self._ahead_ns
        since_ns, came_ns = run.paced_ns
        behind = now_ns - at_ns > _MIN_S * 1e9
        if behind and arrived_ns - came_ns > _PACE_S * 1e9:
            behind = abs((at_ns - since_ns) - (arrived_ns - came_ns)) > _PACE * (arrived_ns - came_ns)
            at_ns = at_ns if behind else now_ns
        if not behind or arrived_ns - came_ns > _PACE_S * 1e9:
            run.paced_ns = at_ns, arrived_ns
        expected = (at_ns - run.began_ns) / self._pulses.interval_ns
        is_far = abs(data.sync_count - run.count - expected) > _FAR
        if not is_far and at_ns == data.monotonic_ns + run.ahead_ns and at_ns - now_ns <= _FUTURE_S * 1e9:
            return run
        self._place(self._pulses.reset(run.slot))
        return self._begun(run.slot, data, arrived_ns, at_ns)

    def _place(self, found: list[tuple[tuple[Data, int], int]]) -> None:
        realigned = self._pulses.realigned > self._realigned
        self._realigned = self._pulses.realigned
        for (data, arrived_ns), number in found:
            if number in self._recent or (self._recent and number < min(self._recent)):
                self.closed["measurement too late"] += 1
                continue
            group = self._groups.setdefault(number, _Group(arrived_ns))
            if realigned or data.sensor in group.members:
                group.flags.add("pulse")
            group.members.setdefault(data.sensor, data)

    def _close(self, now_ns: int) -> list[Group]:
        """Close groups in order: one closes when it is complete, too old, or followed by too many."""
        patience_ns = max(_MIN_S * 1e9, _INTERVALS * self._pulses.interval_ns)
        sensors = {name for name, seen_ns in self._seen_ns.items() if now_ns - seen_ns < _AWAY * patience_ns}
        # At first, sensors join one after the other; until then, the set of sensors is unknown.
        all_here = self._joined_ns is not None and now_ns - self._joined_ns > _MIN_S * 1e9
        ready = [
            number
            for number, group in self._groups.items()
            if (all_here and sensors <= group.members.keys()) or now_ns - group.opened_ns > patience_ns
        ]
        while len(self._groups) - len(ready) > _OPEN:
            ready.append(min(self._groups.keys() - set(ready)))
        return [self._made(number, self._groups.pop(number), sensors) for number in sorted(ready)]

    def _made(self, number: int, group: _Group, sensors: set[str]) -> Group:
        missing = sorted(sensors - group.members.keys())
        members = sorted(group.members.values(), key=lambda data: data.sensor)
        times_ns = [data.timestamp_ns for data in members]
        spread_ns = max(times_ns) - min(times_ns)
        if missing:
            group.flags.add("incomplete")
        if spread_ns > self._pulses.interval_ns / 2:
            group.flags.add("clock")
        self._recent.append(number)
        self.closed.update(set[str](group.flags) or {"complete"})
        return Group(
            number=0,
            dropped=0,
            group=number,
            members=tuple((data.sensor, data.session_id, data.sequence) for data in members[:_MAX]),
            missing=tuple(missing[:_MAX]),
            spread_ns=min(spread_ns, _MAX_NS),
            flags=tuple(sorted(group.flags)),
        )
