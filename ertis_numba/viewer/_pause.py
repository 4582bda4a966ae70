"""Paused live view, with single steps."""

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ertis_numba.viewer._shapes import ReceivedImage

__all__ = ["Pause"]

_STEP_S: Final = 1.0  # Limit on the time from the first image of a step until it is shown.
_TOGETHER: Final = 0.5  # Share of the shortest interval: images within it belong to the same time step.


class Pause:
    """Latest image of each sensor during a pause, so that a step shows all sensors at once.

    ``since_s`` is by the clock of the source; None while not paused. ``n_held`` images arrived and were not shown.
    """

    def __init__(self) -> None:
        self.since_s: float | None = None
        self.n_held = 0
        self._steps = 0
        self._first_s: float | None = None  # Arrival of the first image of a step.
        self._due_s: dict[str, float] = {}  # Time from which each sensor is overdue.
        self._latest: dict[str, ReceivedImage[Any]] = {}  # Images that are not shown.
        self._new: dict[str, ReceivedImage[Any]] = {}  # Images since the step.

    def toggle(self, now_s: float) -> None:
        """Pause, or continue."""
        self.since_s = now_s if self.since_s is None else None
        self._steps, self._first_s = 0, None
        self._latest, self._new = {}, {}

    def step(self, now_s: float) -> None:
        """Show the next measurement of all sensors, and pause again."""
        if self.since_s is None:
            self.toggle(now_s)
        self._steps += 1

    def shown(self, taken: "Sequence[ReceivedImage[Any]]", now_s: float) -> "list[ReceivedImage[Any]]":
        """Return the images to show: all new ones, or during a pause those of a step."""
        came = {each.image.stamp.sensor: each for each in taken}
        self._due_s |= {name: each.due_s for name, each in came.items()}
        if self.since_s is None:
            return [*taken]
        self.n_held += len(taken)
        self._latest |= came
        if not self._steps:
            return []
        self._new |= came
        if self._first_s is None and self._new:
            self._first_s = now_s
        if self._first_s is None or not (self._is_whole(now_s) or now_s - self._first_s >= _STEP_S):
            return []
        shown = [*self._latest.values()]  # This includes sensors that measure less often than others.
        self.n_held -= len(shown)
        self.since_s, self._steps, self._first_s = now_s, self._steps - 1, None
        self._latest, self._new = {}, {}
        return shown

    def _is_whole(self, now_s: float) -> bool:
        """Return True if there is an image of each active sensor, all of one time step."""
        newest_ns = max(each.image.stamp.timestamp_ns for each in self._new.values())
        between_s = min((each.interval_s for each in self._new.values() if each.interval_s is not None), default=1.0)
        first_ns = newest_ns - _TOGETHER * 1e9 * between_s
        together = {name for name, each in self._new.items() if each.image.stamp.timestamp_ns >= first_ns}
        return together >= {name for name, due_s in self._due_s.items() if due_s > now_s}
