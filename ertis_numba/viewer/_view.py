"""Viewer: moves images from a source to the page, at the pace of the slower one."""

import math
import queue
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from ertis_numba.base.errors import ArgumentError, ErtisError
from ertis_numba.viewer._acoustic_maps import ViewedMaps
from ertis_numba.viewer._choices import Choices
from ertis_numba.viewer._origins import is_loopback
from ertis_numba.viewer._page import ControlRequest, ViewerPage
from ertis_numba.viewer._pause import Pause
from ertis_numba.viewer._recordings import Recordings, ToBrowser, ToFile
from ertis_numba.viewer._result_notes import missing_band_note
from ertis_numba.viewer._rows import FrameCounts, rows_of
from ertis_numba.viewer._saving import picture_png, points_ply, with_legend
from ertis_numba.viewer._scene import ViewedScene

if TYPE_CHECKING:  # one brings HDF5, the other ZeroMQ
    from ertis_numba.viewer._live import Live
    from ertis_numba.viewer._playback import Playback
    from ertis_numba.viewer._shapes import DrawnFrame, ReceivedImage

__all__ = ["Viewer"]

_MAP_RANGE_DB: Final = 20.0
_MIN_DRAW_S: Final = 1 / 15
_POLL_INTERVAL_S: Final = 1 / 60
_REPORT_INTERVAL_S: Final = 0.5
_FADE_S: Final = 0.2  # between frames of a recording in which only fading changes
_TYPED_S: Final = 1.5  # after which an invalid number is not taken for one that is being typed
_LAST_S: Final = 1.0  # for which the last frame of a recording stays
_OURS: Final = "ours"  # name of the recording that no browser requested


class Viewer:
    """Page that shows the images or acoustic maps of a source; use it in a ``with`` statement.

    Parameters
    ----------
    source : Live or Playback
    host : str
        Loopback by default. On any other host the page requires the token in `url`.
    port : int
        0 selects a free one.
    choices : Choices, optional
        Initial choices; by default, colours have a range of 40 dB, and of 20 dB for acoustic maps.
    clean_within_db, clean_above_mean_db : float, optional
        Levels by which images are cleaned, as for `ertis_numba.analysis.range_cleaning.clean`.
    on_note : callable, optional
        Called with a line for each event of the source.

    Attributes
    ----------
    choices : Choices
        Present choices.
    is_local : bool
        True if other machines cannot reach the page.

    Raises
    ------
    NetworkError
        The address cannot be used.
    """

    def __init__(
        self,
        source: "Live | Playback",
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        choices: Choices | None = None,
        clean_within_db: float | None = None,
        clean_above_mean_db: float | None = None,
        on_note: Callable[[str], None] | None = None,
    ) -> None:
        self.choices = choices or (Choices(dynamic_range_db=_MAP_RANGE_DB) if source.shows_maps else Choices())
        self._source, self._on_note = source, on_note
        self._playback: Playback | None = source if source.is_playback is True else None
        self._orders: queue.SimpleQueue[ControlRequest | None] = queue.SimpleQueue()
        self._scene: ViewedScene | ViewedMaps = (
            ViewedMaps()
            if source.shows_maps
            else ViewedScene(clean_within_db=clean_within_db, clean_above_mean_db=clean_above_mean_db)
        )
        self._frame: DrawnFrame | None = None
        self.is_local = is_loopback(host)
        self._page = ViewerPage(
            host,
            port,
            orders=self._orders,
            title=source.title,
            choices=self.choices,
            n_time_steps=None if self._playback is None else len(self._playback.time_steps),
            shows_maps=source.shows_maps,
        )
        self._recordings = Recordings(self._page.serializer, self._completion)
        self._file: ToFile | None = None
        self._noted_band_hz: float | None = None
        self._pause = Pause()  # of a live view
        self._changed, self._ended = False, False
        self._refused_s = math.inf  # when a number was chosen that cannot be
        self._drawn_s = self._reported_s = -math.inf
        self._clock_drawn_s = -math.inf  # by the clock of the source
        self._counts = FrameCounts()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._page.close()

    @property
    def url(self) -> str:
        """Address of the page for a browser."""
        return self._page.url

    def stop(self) -> None:
        """End `run`; a signal handler or another thread may call this."""
        self._orders.put(None)

    def run(self, *, duration_s: float = math.inf, html: Path | None = None, overwrite: bool = False) -> None:
        """Show images until `stop` is called or the time is over.

        Parameters
        ----------
        duration_s : float
        html : Path, optional
            Recording of all frames, as a page that needs neither server nor network. Without any frame, no page is
            written.
        overwrite : bool
            Replace a file of this name.

        Raises
        ------
        DataError
            A file cannot be read, or the recording cannot be written.
        ArgumentError
            The recording cannot be written there, or would replace the source.
        RefusedError
            The central node has refused this viewer.
        """
        end_s = time.monotonic() + duration_s
        if html is not None:
            self._begin(html, overwrite=overwrite)
        if self._playback is not None:  # a short one would be over before a browser is there
            self._playback.held = html is None and not self._page.is_seen
        while not self._ended and time.monotonic() < end_s:
            self._obey()
            if self._file is not None:
                self._file.check()
            self._note(*self._source.notes())
            now_s = time.monotonic()
            if self._playback is not None and self._page.is_seen:
                self._playback.held = False
            if now_s - self._refused_s >= _TYPED_S:
                self._page.put_back(self.choices)
                self._refused_s = math.inf
            if now_s - self._drawn_s >= _MIN_DRAW_S:
                self._draw(now_s)
            if now_s - self._reported_s >= _REPORT_INTERVAL_S:
                self._emit_event()
        self._finish(time.monotonic())

    def prepare(self) -> None:
        """Process the first time step of a playback, which takes long if kernels are compiled."""
        if self._playback is not None:
            self._playback.at(0)

    def record(self, html: Path, *, overwrite: bool = False) -> None:
        """Write a recording of a whole playback, as a page that needs neither server nor network.

        After a call of `stop`, nothing is written, and `recorded` stays None.

        Raises
        ------
        DataError
            The file cannot be read, or the page cannot be written.
        ArgumentError
            The page cannot be written there, or would replace the file itself.
        """
        playback = self._playback
        if playback is None:
            raise TypeError("record needs a file; run records a live view")
        self._begin(html, overwrite=overwrite)
        for place, time_step in enumerate(playback.time_steps):
            self._note(*self._source.notes())
            if self._stopped():  # a partial recording is not written
                self._recordings.drop(_OURS)
                return
            if _OURS not in self._recordings:
                break
            for taken in playback.at(place):
                self._scene.take(taken)
            self._counts.shown += 1
            self._recordings.pass_to(time_step.time_s)
            self._show(time_step.time_s, place, new=True)
            after_s = (
                playback.time_steps[place + 1].time_s
                if place + 1 < len(playback.time_steps)
                else time_step.time_s + _LAST_S
            )
            self._fade(time_step.time_s, after_s, place)
        self._finish(playback.time_steps[-1].time_s + _LAST_S)

    @property
    def shown(self) -> int:
        """Number of frames with a new image."""
        return self._counts.shown

    @property
    def recorded(self) -> int | None:
        """Number of frames in the requested HTML recording; None if it is not written."""
        return None if self._file is None else self._file.n_frames

    def _stopped(self) -> bool:
        while not self._orders.empty():
            self._ended |= self._orders.get() is None
        return self._ended

    def _note(self, *texts: str) -> None:
        if self._on_note is not None:
            for text in texts:
                self._on_note(text)

    def _note_missing_band(self, frame: "DrawnFrame") -> None:
        """Note once that no map contains the chosen frequency."""
        band_hz = self.choices.band_hz
        if band_hz != self._noted_band_hz and (note := missing_band_note(frame, band_hz)):
            self._noted_band_hz = band_hz
            self._note(note)

    def _completion(self) -> Callable[[str], str]:
        """Return a function that adds a legend of the present view to a saved page."""
        title, frame = self._source.title, self._frame
        return lambda page: with_legend(page, title, frame)

    def _begin(self, html: Path, *, overwrite: bool) -> None:
        sources = () if self._playback is None else (self._playback.path,)
        self._file = ToFile(html, overwrite=overwrite, on_note=self._note, sources=sources)
        self._recordings.begin(_OURS, self._file, self._begun_s)

    @property
    def _begun_s(self) -> float:
        """Start of a recording of the view: now, or with the first drawn frame."""
        return math.inf if self._frame is None else time.monotonic()

    def _finish(self, now_s: float) -> None:
        """Wait for pending files; an empty recording is not written."""
        if self._frame is None:
            self._recordings.drop(_OURS)
        self._recordings.end(_OURS, now_s)
        self._recordings.wait()
        if self._file is not None:
            self._file.check()

    def _fade(self, clock_s: float, until_s: float, place: int) -> None:
        """Record fading until the next image."""
        while self._frame is not None and (next_s := max(self._frame.until_s, clock_s + _FADE_S)) < until_s:
            clock_s = next_s
            self._recordings.pass_to(clock_s)
            self._show(clock_s, place, new=False)

    def _draw(self, now_s: float) -> None:
        """Draw new or changed objects, if any."""
        taken = self._taken()
        clock_s = self._source.clock_s if self._pause.since_s is None else self._pause.since_s
        frame = self._frame
        outdated = frame is not None and (self._changed or self._clock_drawn_s < clock_s >= frame.until_s)
        if not taken and not outdated:
            return
        if taken and self._playback is not None and self._playback.anew:
            self._scene.clear()
        for each in taken:
            self._scene.take(each)
        self._changed = False
        self._recordings.pass_to(now_s)
        self._drawn_s = now_s
        self._show(clock_s, 0 if self._playback is None else self._playback.shown, new=bool(taken))
        self._page.limit_range(self._scene.farthest_m, self.choices.range_m)
        if taken:
            self._counts.count(now_s, self._source.latency_s(taken))
        self._emit_event()

    def _show(self, clock_s: float, place: int, *, new: bool) -> None:
        """Draw images as they are at a given time."""
        self._frame, self._clock_drawn_s = self._scene.draw(self.choices, clock_s), clock_s
        self._page.show(self._frame, place)
        self._note_missing_band(self._frame)
        self._recordings.add(frames=int(new))

    def _taken(self) -> "list[ReceivedImage[Any]]":
        """Return the images to show: none during a pause, except for steps."""
        taken = self._source.take()
        return taken if self._playback is not None else self._pause.shown(taken, self._source.clock_s)

    @property
    def _playing(self) -> bool:
        return self._pause.since_s is None if self._playback is None else self._playback.playing

    def _emit_event(self) -> None:
        self._reported_s = time.monotonic()
        n_bytes = self._recordings.n_bytes()
        rows = rows_of(
            self._source,
            {} if self._frame is None else self._frame.sensors,
            self._counts,
            paused=not self._playing,
            n_held=self._pause.n_held,
            n_bytes=n_bytes.get(_OURS),
        )
        self._page.notify(rows, playing=self._playing)
        self._page.report_recordings(n_bytes)

    def _obey(self) -> None:
        """Process requests; wait briefly for one."""
        try:
            order = self._orders.get(timeout=_POLL_INTERVAL_S)
            while True:
                if order is None:
                    self._ended = True
                    return
                self._do(order)
                order = self._orders.get_nowait()
        except queue.Empty:
            return

    def _do(self, order: ControlRequest) -> None:
        if order.name in Choices.__dataclass_fields__:
            chosen: dict[str, Any] = {order.name: order.value}
            try:
                self.choices = replace(self.choices, **chosen)
            except ArgumentError:  # half of a number that is being typed, or one that cannot be
                self._refused_s = time.monotonic()
            else:
                self._changed = True
        elif order.name == "play":
            self._play()
        elif order.name == "step":
            self._step(order.value)
        elif order.name == "seek" and self._playback is not None:
            self._playback.seek(order.value)
        else:
            self._save(order)

    def _play(self) -> None:
        if self._playback is not None:
            self._playback.play(playing=not self._playback.playing)
        else:
            self._pause.toggle(self._source.clock_s)
        self._reported_s = -math.inf

    def _step(self, by: int) -> None:
        if self._playback is not None:
            self._playback.play(playing=False)
            self._playback.seek(self._playback.place + by)
        else:
            self._pause.step(self._source.clock_s)

    def _save(self, order: ControlRequest) -> None:
        """Send a file to the browser that requested it, or report the reason why there is none."""
        client = order.client
        if client is None:
            return
        if order.name == "leave":
            self._recordings.drop(client.client_id)
        elif order.name == "record":
            self._record(client)
        elif self._frame is not None:
            try:
                content, ending = self._content(order.name, self._frame)
            except ErtisError as error:
                client.add_notification("Nothing is saved", str(error), auto_close_seconds=10.0, color="red")
                return
            client.send_file_download(self._name(ending), content, save_immediately=True)

    def _record(self, client: Any) -> None:
        """Begin or end the recording of a browser."""
        if client.client_id in self._recordings:
            self._recordings.end(client.client_id, time.monotonic())
        else:
            self._recordings.begin(client.client_id, ToBrowser(client, self._name("html")), self._begun_s)
        self._reported_s = -math.inf

    def _name(self, ending: str) -> str:
        return f"{'live' if self._playback is None else self._playback.path.stem}.{ending}"

    def _content(self, name: str, frame: "DrawnFrame") -> tuple[bytes, str]:
        """Return the content of a file, and its suffix."""
        is_picture = name == "picture"
        return (picture_png(frame), "png") if is_picture else (points_ply(self._scene.latest(self.choices)), "ply")
