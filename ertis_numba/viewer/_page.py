"""The page in the browser: what is drawn and chosen there, handed to viser and taken from it."""

import contextlib
import functools
import html
import io
import math
import re
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import viser
import websockets.asyncio.server

from ertis_numba.errors import NetworkError
from ertis_numba.viewer._choices import COLOURS, DYNAMIC_RANGE_DB, LOWEST_THRESHOLD_DB, MOST_DECAY_S, Choices
from ertis_numba.viewer._shapes import Frame
from ertis_numba.viewer._space import Space

if TYPE_CHECKING:
    from queue import SimpleQueue

__all__ = ["Order", "Page"]

_PANEL_PX, _PICTURES_PX = 330, 560  # the latter such that pictures are shown pixel by pixel
_LOOPBACK: Final = ("127.0.0.1", "localhost", "[::1]", "::1")
_STEP_M: Final = 0.05  # of the window of ranges


@dataclass(frozen=True, slots=True)
class Order:
    """What somebody wants: the name of a control, its value, and who is to get a file."""

    name: str
    value: Any = None
    client: viser.ClientHandle | None = None


Orders: TypeAlias = "SimpleQueue[Order | None]"


class Page:
    """Serves the page; what is chosen there goes into a queue.

    Parameters
    ----------
    host : str
    port : int
        0 for any that is free.
    orders : queue.SimpleQueue
    title : str
        What is shown.
    choices : Choices
        What to begin with.
    n_moments : int, optional
        Length of the time line; there is none by default.

    Raises
    ------
    NetworkError
        Nothing can be served there.
    """

    def __init__(
        self, host: str, port: int, *, orders: Orders, title: str, choices: Choices, n_moments: int | None = None
    ) -> None:
        _require_free(host, port)
        self._orders, self._choices = orders, choices
        with _silence(), _own_pages(host):
            self._server = _Server(host=host, port=port, label=f"ertis view: {title}", verbose=False)
        if port and self._server.get_port() != port:  # viser goes on to the next that is free
            self.close()
            raise _taken(host, port, "it was taken meanwhile")
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._space = Space(self._server)
        self._shown: dict[str, viser.GuiImageHandle] = {}
        self._line: Any = None
        self._recorder: Any = None
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        pictures = gui.add_panel()
        self._pictures = pictures.add_tab("Range and azimuth")
        pictures.dock_left()
        pictures.set_width(_PICTURES_PX)
        self._state = gui.add_html("")
        self._play = gui.add_button("Pause")
        self._play.on_click(lambda _: self._orders.put(Order("play")))
        if n_moments is None:
            self._button("Step", "step", value=1)
        else:
            steps = gui.add_button_group("Step", ("back", "ahead"))
            steps.on_click(lambda event: self._orders.put(Order("step", 1 if event.target.value == "ahead" else -1)))
            self._line = gui.add_slider("Measurement", 0, max(1, n_moments - 1), 1, 0, visible=n_moments > 1)
            self._obey(self._line, "seek")
        self._controls(choices)

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        host = self._server.get_host()
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104
        return f"http://{shown}:{self._server.get_port()}/"

    def show(self, frame: Frame, place: int = 0) -> None:
        """Draw a frame, and where it is on the time line."""
        with self._server.atomic():
            self._space.show(frame)
            for name, drawn in frame.sensors.items():
                if name in self._shown:
                    self._shown[name].image = drawn.picture
                else:
                    with self._pictures:
                        self._shown[name] = self._server.gui.add_image(drawn.picture, label=name, format="png")
            if self._line is not None and self._line.value != place:
                self._line.value = place

    def tell(self, rows: Mapping[str, tuple[str, str]], *, playing: bool) -> None:
        """Tell counters and times: by their names what they are and their values."""
        cells = "".join(
            f"<tr><td style='color:#9aa0b0;padding-right:1em'>{html.escape(label)}</td>"
            f"<td data-name='{name}' style='font-variant-numeric:tabular-nums'>{html.escape(value)}</td></tr>"
            for name, (label, value) in rows.items()
        )
        content = f"<table style='margin:0 0.8em 0.6em;font-size:0.85em;line-height:1.5'>{cells}</table>"
        if self._state.content != content:
            self._state.content = content
        label = "Pause" if playing else "Play"
        if self._play.label != label:
            self._play.label = label

    def begin_recording(self) -> None:
        """Keep all that is drawn in the scene from now on."""
        self._recorder = self._server.get_scene_serializer()
        self._record.label = "End HTML recording"

    def pass_time(self, time_s: float) -> None:
        """Note how long what was drawn last has been shown, where that is recorded."""
        if self._recorder is not None:
            self._recorder.insert_sleep(time_s)

    def end_recording(self) -> str:
        """Return what was drawn as a page that needs neither server nor network."""
        recorder, self._recorder = self._recorder, None
        self._record.label = "Begin HTML recording"
        return str(recorder.as_html(dark_mode=True))

    @property
    def is_recording(self) -> bool:
        """Whether what is drawn is kept."""
        return self._recorder is not None

    def close(self) -> None:
        """Serve no longer."""
        with _silence():
            self._server.stop()

    def _controls(self, choices: Choices) -> None:
        gui = self._server.gui
        self._obey(
            gui.add_slider("Threshold (dB)", LOWEST_THRESHOLD_DB, 0.0, 1.0, choices.threshold_db), "threshold_db"
        )
        self._obey(
            gui.add_slider("Dynamic range (dB)", *DYNAMIC_RANGE_DB, 1.0, choices.dynamic_range_db), "dynamic_range_db"
        )
        self._range: Any = gui.add_multi_slider("Range (m)", 0.0, 1.0, _STEP_M, (0.0, 1.0), min_range=2 * _STEP_M)
        self._range.visible = False  # until it is known how far images reach
        self._obey(self._range, "range_m")
        self._obey(gui.add_slider("Decay (s)", 0.0, MOST_DECAY_S, 0.1, choices.decay_s), "decay_s")
        self._obey(gui.add_dropdown("Colours", COLOURS, initial_value=choices.colours), "colours")
        with gui.add_folder("Save"):
            self._button("Picture (PNG)", "picture")
            self._button("Points (PLY)", "points")
            self._record = self._button("Begin HTML recording", "record")

    def _button(self, label: str, name: str, value: Any = None) -> viser.GuiButtonHandle:
        button = self._server.gui.add_button(label)
        button.on_click(lambda event: self._orders.put(Order(name, value, event.client)))
        return button

    def _obey(self, control: Any, name: str) -> None:
        """Pass on what somebody chooses, not what this sets itself."""

        def chosen(event: Any) -> None:
            if event.client is not None:
                self._orders.put(Order(name, event.target.value))

        control.on_update(chosen)

    def limit_range(self, farthest_m: float) -> None:
        """Say how far images reach."""
        top_m = math.ceil(farthest_m / _STEP_M - 1e-9) * _STEP_M
        if top_m <= self._range.max and self._range.visible:
            return
        whole = not self._range.visible or self._range.value[1] >= self._range.max
        low_m, high_m = self._choices.range_m or (0.0, top_m)
        if self._range.visible:
            low_m, high_m = self._range.value[0], top_m if whole else self._range.value[1]
        self._range.max = top_m
        self._range.value = (min(low_m, top_m), min(high_m, top_m))
        self._range.visible = True


class _Server(viser.ViserServer):
    """Speaks to nobody but browsers that come to it."""

    def request_share_url(self, verbose: bool = True) -> None:  # noqa: FBT001, FBT002  as viser has it
        """Share nothing: a page could ask for a tunnel to a host of viser's makers."""


@contextlib.contextmanager
def _own_pages(host: str) -> Iterator[None]:
    """Let a server that is made in this block refuse pages of other sites, which a browser lets connect to any host.

    viser takes them all, and has no option. Whoever serves to others than this machine may do so by any name.
    """
    serve = websockets.asyncio.server.serve
    names = sorted({host, *_LOOPBACK})
    own = re.compile(rf"https?://({'|'.join(map(re.escape, names))})(:\d+)?")
    if host in _LOOPBACK:
        setattr(websockets.asyncio.server, "serve", functools.partial(serve, origins=[own, None]))  # noqa: B010
    try:
        yield
    finally:
        setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010  mypy would not have a class replaced


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """Return what keeps viser from saying on stdout that it begins and ends, whatever one asks for."""
    return contextlib.redirect_stdout(io.StringIO())


def _require_free(host: str, port: int) -> None:
    """Refuse what cannot be listened at: viser would try other ports without end."""
    try:
        for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.socket(family, kind, protocol) as tried:
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tried.bind(address)
                tried.listen()
    except OSError as error:
        raise _taken(host, port, error.strerror or str(error)) from error


def _taken(host: str, port: int, why: str) -> NetworkError:
    return NetworkError(f"nothing can be served at {host}:{port} ({why}); give another host or port")
