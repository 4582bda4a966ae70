"""Numbers shown beside the view."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from ertis_numba.frames import Stamp
from ertis_numba.viewer._recordings import MAX_BYTES
from ertis_numba.viewer._shapes import Drawn

if TYPE_CHECKING:
    from ertis_numba.viewer._live import Live
    from ertis_numba.viewer._playback import Playback

__all__ = ["FrameCounts", "rows_of"]

_RATE_S: Final = 2.0
_COARSE_S: Final = 10.0
_NONE: Final = "–"


class FrameCounts:
    """Counts of frames, ``shown`` with a new image; ``latency_s`` is from the emission to the display."""

    def __init__(self) -> None:
        self.shown = 0
        self.latency_s: float | None = None
        self._at_s: deque[float] = deque()

    def count(self, now_s: float, latency_s: float | None) -> None:
        """Count a new frame."""
        self.shown += 1
        self.latency_s = latency_s
        self._at_s.append(now_s)

    @property
    def rate_hz(self) -> float:
        """Recent rate."""
        now_s = time.monotonic()
        while self._at_s and now_s - self._at_s[0] > _RATE_S:
            self._at_s.popleft()
        return len(self._at_s) / _RATE_S


def rows_of(
    source: "Live | Playback",
    sensors: Mapping[str, Drawn],
    counts: FrameCounts,
    *,
    paused: bool,
    n_held: int,
    n_bytes: int | None,
) -> dict[str, tuple[str, str]]:
    """Return the rows by name: label and value."""
    latest = max((each.stamp for each in sensors.values()), key=lambda stamp: stamp.timestamp_ns, default=Stamp())
    live = source.is_playback is False
    silent = live and bool(sensors) and all(each.overdue for each in sensors.values())
    latency_s = None if silent else counts.latency_s  # It would refer to an old image.
    rows = {
        "state": ("state", _state(source, sensors, paused=paused and live)),
        "frames": ("frames shown", str(counts.shown)),
        "sequence": ("measurement", _of_each(sensors, lambda drawn: str(drawn.stamp.sequence))),
        "captured": ("captured", latest.utc or _NONE),
        "age": ("age", _of_each(sensors, lambda drawn: _age(drawn, source.clock_s))),
        "rate": ("rate", f"{counts.rate_hz:.1f} Hz"),
        "latency": ("capture to shown", _NONE if latency_s is None else f"{1e3 * latency_s:.0f} ms"),
        "dropped": ("dropped, skipped", f"{source.dropped}, {source.skipped}"),
    }
    if not source.shows_maps:
        rows["points"] = ("points", str(sum(each.n_points for each in sensors.values())))
    if live:
        rows["held"] = ("not shown, paused", str(n_held))
    unplaced = [name for name, each in sensors.items() if each.pose is None]
    if unplaced:
        rows["unplaced"] = ("place not known", f"{', '.join(unplaced)}: not on the platform")
    if n_bytes is not None:
        rows["recording"] = ("HTML recording", f"{n_bytes / 1e6:.1f} MB, at most {MAX_BYTES / 1e6:g} MB")
    return rows


def _state(source: "Live | Playback", sensors: Mapping[str, Drawn], *, paused: bool) -> str:
    """Return the state of the source and, for a connected live source, of its sensors."""
    if paused:
        return f"{source.state}, paused"
    if source.is_playback is True or not source.connected:
        return source.state
    if not sensors:
        return "connected, no sensor sends"
    return "all sensors overdue" if all(each.overdue for each in sensors.values()) else source.state


def _age(drawn: Drawn, clock_s: float) -> str:
    """Return the age of a sensor's shown image."""
    age_s = max(0.0, clock_s - drawn.time_s)
    return (f"{age_s:.1f} s" if age_s < _COARSE_S else f"{age_s:.0f} s") + (" (overdue)" if drawn.overdue else "")


def _of_each(sensors: Mapping[str, Drawn], reported: Callable[[Drawn], str]) -> str:
    """Return the values of each sensor, with its name if there are several."""
    several = len(sensors) > 1
    return (
        ", ".join(f"{name} {reported(each)}" if several else reported(each) for name, each in sensors.items()) or _NONE
    )
