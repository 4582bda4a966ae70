"""From a source to the page, at the pace of whoever is slower."""

import math
import queue
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from ertis_numba.atomic import replacing
from ertis_numba.errors import ArgumentError, ErtisError
from ertis_numba.viewer._choices import Choices
from ertis_numba.viewer._page import Order, Page
from ertis_numba.viewer._saving import picture_png, points_ply, time_of
from ertis_numba.viewer._scene import Scene

if TYPE_CHECKING:  # one brings HDF5, the other ZeroMQ
    from ertis_numba.viewer._film import Film
    from ertis_numba.viewer._live import Live
    from ertis_numba.viewer._shapes import Frame

__all__ = ["View"]

_LEAST_DRAW_S: Final = 1 / 15
_LOOK_S: Final = 1 / 60
_RATE_S: Final = 2.0
_TELL_S: Final = 0.5
_LAST_S: Final = 1.0  # for which the last of a recorded film stays


class View:
    """Shows what a source has on a page; use it in a ``with`` statement.

    Parameters
    ----------
    source : Live or Film
    host : str
        Loopback by default: there is no password, who reaches the page sees and steers it.
    port : int
        0 for any that is free.
    choices : Choices, optional
        What to begin with.
    on_note : callable, optional
        Is called with lines on what happens to the source.

    Attributes
    ----------
    choices : Choices
        Those of the moment.

    Raises
    ------
    NetworkError
        Nothing can be served there.
    """

    def __init__(
        self,
        source: "Live | Film",
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        choices: Choices | None = None,
        on_note: Callable[[str], None] | None = None,
    ) -> None:
        self.choices = choices or Choices()
        self._source, self._on_note = source, on_note
        self._film: Film | None = source if source.is_film is True else None
        self._orders: queue.SimpleQueue[Order | None] = queue.SimpleQueue()
        self._scene = Scene()
        self._frame: Frame | None = None
        self._page = Page(
            host,
            port,
            orders=self._orders,
            title=source.title,
            choices=self.choices,
            n_moments=None if self._film is None else len(self._film.moments),
        )
        self._playing, self._steps, self._changed, self._ended = True, 0, False, False
        self._shown = 0
        self._drawn_s: deque[float] = deque()
        self._told_s = -math.inf
        self._latency_s: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._page.close()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return self._page.url

    def stop(self) -> None:
        """End `run`; a signal's handler or another thread may call this."""
        self._orders.put(None)

    def run(self, *, duration_s: float = math.inf, html: Path | None = None, overwrite: bool = False) -> None:
        """Show until `stop` is called or the time is over.

        Parameters
        ----------
        duration_s : float
        html : Path, optional
            Recording of all that was shown, a page that needs neither server nor network.
        overwrite : bool
            Replace a file of this name.

        Raises
        ------
        DataError
            A file cannot be read.
        RefusedError
            The central node has refused this viewer.
        """
        end_s = time.monotonic() + duration_s
        if html is not None:
            self._page.begin_recording()
        while not self._ended and time.monotonic() < end_s:
            self._obey()
            for note in self._source.notes():
                if self._on_note is not None:
                    self._on_note(note)
            now_s = time.monotonic()
            if not self._drawn_s or now_s - self._drawn_s[-1] >= _LEAST_DRAW_S:
                self._draw(now_s)
            if now_s - self._told_s >= _TELL_S:
                self._tell()
        if html is not None and self._page.is_recording:
            self._write(html, overwrite=overwrite)

    def record(self, html: Path, *, overwrite: bool = False) -> None:
        """Write a recording of all of a film, as a page that needs neither server nor network.

        Raises
        ------
        DataError
            The file cannot be read.
        """
        film = self._film
        if film is None:
            raise TypeError("a live view is recorded by run")
        self._page.begin_recording()
        for place, moment in enumerate(film.moments):
            if self._ended or self._stopped():
                break
            for taken in film.at(place):
                self._scene.take(taken)
            self._page.show(self._scene.draw(self.choices), place)
            self._shown += 1
            after_s = film.moments[place + 1].time_s if place + 1 < len(film.moments) else moment.time_s + _LAST_S
            self._page.pass_time(after_s - moment.time_s)
        self._write(html, overwrite=overwrite)

    @property
    def shown(self) -> int:
        """How many frames were drawn."""
        return self._shown

    def _stopped(self) -> bool:
        while not self._orders.empty():
            self._ended |= self._orders.get() is None
        return self._ended

    def _write(self, html: Path, *, overwrite: bool) -> None:
        with replacing(html, overwrite=overwrite) as part:
            part.write_text(self._page.end_recording(), encoding="utf-8")

    def _draw(self, now_s: float) -> None:
        """Draw what is new, if anything."""
        taken = self._source.take()
        if self._film is None and not self._playing:
            taken = taken if self._steps and taken else []
            self._steps -= bool(taken)
        if not taken and not (self._changed and self._frame is not None):
            return
        for each in taken:
            self._scene.take(each)
        self._changed = False
        self._frame = self._scene.draw(self.choices)
        self._page.limit_range(self._scene.farthest_m)
        if self._page.is_recording and self._drawn_s:
            self._page.pass_time(now_s - self._drawn_s[-1])
        self._page.show(self._frame, 0 if self._film is None else self._film.shown)
        if taken:
            self._shown += 1
            self._latency_s = self._source.latency_s(taken)
        self._drawn_s.append(now_s)
        self._tell()

    def _tell(self) -> None:
        now_s = self._told_s = time.monotonic()
        while len(self._drawn_s) > 1 and now_s - self._drawn_s[0] > _RATE_S:
            self._drawn_s.popleft()
        sensors = {} if self._frame is None else self._frame.sensors
        latest = max(sensors.values(), key=lambda drawn: drawn.timestamp_ns, default=None)
        captured = time_of(latest.timestamp_ns) if latest else ()
        rate_hz = len([drawn_s for drawn_s in self._drawn_s if now_s - drawn_s <= _RATE_S]) / _RATE_S
        rows = {
            "state": ("state", self._source.state),
            "frames": ("frames shown", str(self._shown)),
            "sequence": ("measurement", ", ".join(str(each.sequence) for each in sensors.values()) or "–"),
            "captured": ("captured", captured[0] if captured else "–"),
            "rate": ("rate", f"{rate_hz:.1f} Hz"),
            "latency": ("capture to shown", "–" if self._latency_s is None else f"{1e3 * self._latency_s:.0f} ms"),
            "dropped": ("dropped, skipped", f"{self._source.dropped}, {self._source.skipped}"),
            "points": ("points", str(sum(each.n_points for each in sensors.values()))),
        }
        self._page.tell(rows, playing=self._playing if self._film is None else self._film.playing)

    def _obey(self) -> None:
        """Do what was ordered; wait a moment for an order."""
        try:
            order = self._orders.get(timeout=_LOOK_S)
            while True:
                if order is None:
                    self._ended = True
                    return
                self._do(order)
                order = self._orders.get_nowait()
        except queue.Empty:
            return

    def _do(self, order: Order) -> None:
        if order.name in Choices.__dataclass_fields__:
            chosen: dict[str, Any] = {order.name: order.value}
            with suppress(ArgumentError):  # half of a number that is being typed
                self.choices = replace(self.choices, **chosen)
                self._changed = True
        elif order.name == "play":
            self._play()
        elif order.name == "step":
            self._step(order.value)
        elif order.name == "seek" and self._film is not None:
            self._film.seek(order.value)
        else:
            self._save(order)

    def _play(self) -> None:
        if self._film is not None:
            self._film.play(playing=not self._film.playing)
        else:
            self._playing = not self._playing
        self._told_s = -math.inf

    def _step(self, by: int) -> None:
        if self._film is not None:
            self._film.play(playing=False)
            self._film.seek(self._film.place + by)
        else:
            self._playing, self._steps = False, self._steps + 1

    def _save(self, order: Order) -> None:
        """Send a file to who asked for it, or say why there is none."""
        if self._frame is None or order.client is None:
            return
        if order.name == "record" and not self._page.is_recording:
            self._page.begin_recording()
            return
        try:
            content, ending = self._content(order.name, self._frame)
        except ErtisError as error:
            order.client.add_notification("Nothing is saved", str(error), auto_close_seconds=10.0, color="red")
            return
        name = "live" if self._film is None else Path(self._film.title).stem
        order.client.send_file_download(f"{name}.{ending}", content, save_immediately=True)

    def _content(self, name: str, frame: "Frame") -> tuple[bytes, str]:
        """Return what a file holds, and its ending."""
        if name == "picture":
            return picture_png(frame), "png"
        if name == "points":
            return points_ply(self._scene.latest(self.choices), self.choices), "ply"
        return self._page.end_recording().encode(), "html"
