"""Page in the browser, built with viser: drawn objects and controls."""

import contextlib
import html
import io
import math
import secrets
import socket
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import viser

from ertis_numba.base.errors import NetworkError
from ertis_numba.geometry import round_step
from ertis_numba.viewer._choices import COLOURS, DYNAMIC_RANGE_DB, LEVELS_DB, LOWEST_THRESHOLD_DB, MAX_DECAY_S, Choices
from ertis_numba.viewer._origins import is_loopback, own_pages
from ertis_numba.viewer._recordings import MAX_BYTES
from ertis_numba.viewer._shapes import BandLevel, DrawnFrame, LevelScale
from ertis_numba.viewer._space import Space

if TYPE_CHECKING:
    from queue import SimpleQueue

__all__ = ["ControlRequest", "ViewerPage"]

_PANEL_PX, _PICTURES_PX = 330, 560  # The width of pictures shows them pixel by pixel.
_SMALL: Final = "<div style='margin:0 0.8em 0.6em;font-size:0.85em;color:#9aa0b0'>{}</div>"
_RANGE: Final = "Range"
_TOKEN_BYTES: Final = 24
_STEPS: Final = 100  # Steps of the range window.


_ALL: Final = "all"
_MARKS: Final = 4  # Largest number of frequencies below the slider.
_BAR_PX: Final = 70


@dataclass(frozen=True, slots=True)
class ControlRequest:
    """Request of a user: the name of a control, its value, and the browser that gets a file."""

    name: str
    value: Any = None
    client: viser.ClientHandle | None = None


Orders: TypeAlias = "SimpleQueue[ControlRequest | None]"


class ViewerPage:
    """Server of the page; choices made there go into a queue; raises NetworkError for an unusable address."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        orders: Orders,
        title: str,
        choices: Choices,
        n_time_steps: int | None = None,
        shows_maps: bool = False,
    ) -> None:
        _require_free(host, port)
        self._orders, self.is_seen = orders, False
        self._chosen: dict[str, Any] = {}  # Controls of the choices, by name.
        self._token = None if is_loopback(host) else secrets.token_urlsafe(_TOKEN_BYTES)
        with _silence(), own_pages(host, self._token):
            self._server = _Server(host=host, port=port, label=f"ertis view: {title}", verbose=False)
        if port and self._server.get_port() != port:  # viser uses the next free port.
            self.close()
            raise _taken(host, port, "the port was taken meanwhile")
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._space = Space(self._server)
        self._shown: dict[str, viser.GuiImageHandle] = {}
        self._line: Any = None
        self._range: Any = None
        self._level_controls: LevelControls | None = None
        self._recorders: dict[int, tuple[viser.GuiButtonHandle, viser.GuiHtmlHandle]] = {}
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_PANEL_PX)
        pictures = gui.add_panel()
        self._pictures = pictures.add_tab("Acoustic maps" if shows_maps else "Range and azimuth")
        pictures.dock_left()
        pictures.set_width(_PICTURES_PX)
        self._state = gui.add_html("")
        self._play = gui.add_button("Pause")
        self._play.on_click(lambda _: self._orders.put(ControlRequest("play")))
        if n_time_steps is None:
            self._button("Step", "step", value=1)
        else:
            steps = gui.add_button_group("Step", ("back", "ahead"))
            steps.on_click(
                lambda event: self._orders.put(ControlRequest("step", 1 if event.target.value == "ahead" else -1))
            )
            self._line = gui.add_slider("Measurement", 0, max(1, n_time_steps - 1), 1, 0, visible=n_time_steps > 1)
            self._obey(self._line, "seek")
        self._controls(choices, shows_maps=shows_maps)

    @property
    def url(self) -> str:
        """Address of the page, with the token that other machines need."""
        host = self._server.get_host()
        shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)  # noqa: S104
        token = "" if self._token is None else f"?token={self._token}"
        return f"http://{shown}:{self._server.get_port()}/{token}"

    def show(self, frame: DrawnFrame, place: int = 0) -> None:
        """Draw a frame, and update the time line."""
        with self._server.atomic():
            self._space.show(frame)
            for name, drawn in frame.sensors.items():
                label = f"{name} (overdue)" if drawn.overdue else name
                if name not in self._shown:
                    with self._pictures:
                        self._shown[name] = self._server.gui.add_image(drawn.picture, label=label, format="png")
                    for order, (_, each) in enumerate(sorted(self._shown.items())):  # Sensors may arrive in any order.
                        each.order = order
                shown = self._shown[name]
                shown.label, shown.visible = label, True
                if shown.image is not drawn.picture:  # Assigning it encodes and sends it to all browsers.
                    shown.image = drawn.picture
            if self._level_controls is not None and frame.scale is not None:
                self._level_controls.show(frame.scale)
            for name in self._shown.keys() - frame.sensors.keys():
                self._shown[name].visible = False
            if self._line is not None and self._line.value != place:
                self._line.value = place

    def notify(self, rows: Mapping[str, tuple[str, str]], *, playing: bool) -> None:
        """Show counters and times: label and value by name."""
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

    def serializer(self) -> Any:
        """Return a serializer of everything that is drawn from now on."""
        return self._server.get_scene_serializer()

    def report_recordings(self, n_bytes: Mapping[Hashable, int]) -> None:
        """Show in each browser the state and size of its recording."""
        for number, (button, reported) in [*self._recorders.items()]:
            here = n_bytes.get(number)
            largest = f"at most {MAX_BYTES / 1e6:g} MB"
            label = "Begin HTML recording" if here is None else "End HTML recording"
            content = _SMALL.format(largest if here is None else f"{here / 1e6:.1f} MB, {largest}")
            with contextlib.suppress(RuntimeError):  # The browser has just disconnected.
                if button.label != label:
                    button.label = label
                if reported.content != content:
                    reported.content = content

    def close(self) -> None:
        """Stop serving."""
        with _silence():
            self._server.stop()

    def _controls(self, choices: Choices, *, shows_maps: bool) -> None:
        gui = self._server.gui
        if shows_maps:
            self._level_controls = LevelControls(
                gui, choices, lambda name, value: self._orders.put(ControlRequest(name, value))
            )
        else:
            self._obey(
                gui.add_slider("Threshold (dB)", LOWEST_THRESHOLD_DB, 0.0, 1.0, choices.threshold_db), "threshold_db"
            )
        self._obey(
            gui.add_slider("Dynamic range (dB)", *DYNAMIC_RANGE_DB, 1.0, choices.dynamic_range_db), "dynamic_range_db"
        )
        if not shows_maps:
            self._range = gui.add_multi_slider(_RANGE, 0.0, 1.0, 1 / _STEPS, (0.0, 1.0), min_range=2 / _STEPS)
            self._range.visible = False  # Hidden until the extent of images is known.
            self._obey(self._range, "range_m")
            self._obey(gui.add_slider("Decay (s)", 0.0, MAX_DECAY_S, 0.1, choices.decay_s), "decay_s")
        self._obey(gui.add_dropdown("Colours", COLOURS, initial_value=choices.colours), "colours")
        self._saving = gui.add_folder("Save")
        with self._saving:
            self._button("Picture (PNG)", "picture")
            if not shows_maps:
                self._button("Points (PLY)", "points")
        self._server.on_client_connect(self._greet)
        self._server.on_client_disconnect(self._forget)

    def _greet(self, client: viser.ClientHandle) -> None:
        """Add the controls of one browser: it cannot end the recording of another."""
        self.is_seen = True
        with self._saving:
            button = client.gui.add_button("Begin HTML recording")
            button.on_click(lambda _: self._orders.put(ControlRequest("record", None, client)))
            reported = client.gui.add_html(_SMALL.format(f"at most {MAX_BYTES / 1e6:g} MB"))
        self._recorders[client.client_id] = button, reported

    def _forget(self, client: viser.ClientHandle) -> None:
        self._recorders.pop(client.client_id, None)
        self._orders.put(ControlRequest("leave", None, client))

    def _button(self, label: str, name: str, value: Any = None) -> viser.GuiButtonHandle:
        button = self._server.gui.add_button(label)
        button.on_click(lambda event: self._orders.put(ControlRequest(name, value, event.client)))
        return button

    def _obey(self, control: Any, name: str) -> None:
        """Forward a choice of a user, but not a value set by the program."""

        def chosen(event: Any) -> None:
            if event.client is not None:
                self._orders.put(ControlRequest(name, event.target.value))

        control.on_update(chosen)
        self._chosen[name] = control

    def put_back(self, choices: Choices) -> None:
        """Restore the controls after an invalid input."""
        for name, control in self._chosen.items():
            value = getattr(choices, name, None)
            if value is not None and control.value != value:
                control.value = value
        if self._level_controls is not None:
            self._level_controls.put_back(choices)

    def limit_range(self, farthest_m: float, window_m: tuple[float, float] | None) -> None:
        """Set the limits of the range window, and the shown window; acoustic maps have none."""
        if self._range is None:
            return
        far_m = max(farthest_m, 0.0 if window_m is None else window_m[1])
        step_m = round_step(far_m, _STEPS)
        top_m = math.ceil(far_m / step_m - 1e-9) * step_m
        first_m, last_m = window_m or (0.0, top_m)
        label = f"{_RANGE} {first_m:.4g}–{last_m:.4g} m"
        if self._range.label != label:
            self._range.label = label
        if top_m > self._range.max or not self._range.visible:
            self._range.step, self._range.min_range = step_m, 2 * step_m
            self._range.precision = max(0, -math.floor(math.log10(step_m)))
            self._range.max = top_m
            self._range.value = (first_m, last_m)
            self._range.visible = True


class _Server(viser.ViserServer):
    """Server without connections to other hosts."""

    def request_share_url(self, verbose: bool = True) -> None:  # noqa: FBT001, FBT002  as viser has it
        """Do nothing: a page could otherwise request a tunnel to a host of viser's makers."""


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """Return a console that keeps viser from printing on stdout."""
    return contextlib.redirect_stdout(io.StringIO())


def _require_free(host: str, port: int) -> None:
    """Refuse an address in use: viser would otherwise try further ports without end."""
    try:
        for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            with socket.socket(family, kind, protocol) as tried:
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tried.bind(address)
                tried.listen()
    except OSError as error:
        raise _taken(host, port, error.strerror or str(error)) from error


def _taken(host: str, port: int, why: str) -> NetworkError:
    return NetworkError(f"cannot serve the page at {host}:{port} ({why}); choose another host or port")


class LevelControls:
    """Controls of acoustic maps on the page; choose gets the name and the value of a choice."""

    def __init__(self, gui: viser.GuiApi, choices: Choices, choose: Callable[[str, Any], None]) -> None:
        self._gui, self._choose = gui, choose
        self._centres_hz: list[float | None] = []
        self._folder = gui.add_folder("Bands")
        self._slider: Any = None
        with self._folder:
            self._levels = gui.add_html("", order=math.inf)
        first_db = LEVELS_DB[1] if choices.max_level_db is None else choices.max_level_db
        self._automatic: Any = gui.add_checkbox("Automatic levels", choices.max_level_db is None)
        self._highest: Any = gui.add_slider("Max. level (dB)", *LEVELS_DB, 1.0, first_db)
        self._automatic.on_update(self._on_automatic)
        self._highest.on_update(self._on_highest)

    def show(self, scale: LevelScale) -> None:
        """Show the bands, their levels, and the automatic scale."""
        centres_hz = [each.centre_hz for each in scale.bands]
        if centres_hz != self._centres_hz:
            self._centres_hz = centres_hz
            self._add_slider(next((place for place, each in enumerate(scale.bands) if each.is_shown), 0))
        content = _table(scale)
        if self._levels.content != content:
            self._levels.content = content
        if self._automatic.value and self._highest.value != scale.high_db:
            self._highest.value = min(max(scale.high_db, LEVELS_DB[0]), LEVELS_DB[1])

    def put_back(self, choices: Choices) -> None:
        """Restore the scale after an invalid input."""
        if choices.max_level_db is not None and self._highest.value != choices.max_level_db:
            self._highest.value = choices.max_level_db

    def _add_slider(self, place: int) -> None:
        """Add a slider over the bands, in place of one over others."""
        if self._slider is not None:
            self._slider.remove()
        last = len(self._centres_hz) - 1
        step = max(1, math.ceil(last / _MARKS))
        marks = [(number, _name(self._centres_hz[number])) for number in range(last, step - 1, -step)]
        with self._folder:
            self._slider = self._gui.add_slider("Band", 0, last, 1, place, marks=((0, _ALL), *marks[::-1]), order=0)
        self._slider.on_update(self._on_band)

    def _on_band(self, event: Any) -> None:
        if event.client is not None and event.target.value < len(self._centres_hz):
            self._choose("band_hz", self._centres_hz[event.target.value])

    def _on_automatic(self, event: Any) -> None:
        if event.client is not None:
            self._choose("max_level_db", None if event.target.value else self._highest.value)

    def _on_highest(self, event: Any) -> None:
        if event.client is not None:
            self._automatic.value = False
            self._choose("max_level_db", event.target.value)


def _name(centre_hz: float | None) -> str:
    return _ALL if centre_hz is None else f"{centre_hz / 1e3:.3g} k"


def _table(scale: LevelScale) -> str:
    """Return the loudest direction of each band: frequency, a bar, level, direction and sensor."""
    highest_db = max(scale.high_db, *(each.level_db for each in scale.bands))
    several = len({each.sensor for each in scale.bands}) > 1
    rows = "".join(
        _row(each, (each.level_db - scale.low_db) / (highest_db - scale.low_db), named=several) for each in scale.bands
    )
    return (
        "<div style='margin:0 0.8em 0.6em;font-size:0.85em'>"
        f"<div style='color:#9aa0b0'>loudest direction of each band, {scale.unit}</div>"
        f"<table style='line-height:1.35;font-variant-numeric:tabular-nums'>{rows}</table></div>"
    )


def _row(band: BandLevel, share: float, *, named: bool) -> str:
    colour, weight = ("#ffb347", "bold") if band.is_shown else ("#5f6b8a", "normal")
    bar = f"<div style='height:0.6em;width:{_BAR_PX * min(max(share, 0.0), 1.0):.0f}px;background:{colour}'></div>"
    name = "all bands" if band.centre_hz is None else f"{band.centre_hz / 1e3:.3g} kHz"
    cells = ["–", ""]
    if math.isfinite(band.level_db):
        elevation = f" {band.elevation_deg:+.0f}°" if band.elevation_deg else ""
        sensor = f" {html.escape(band.sensor)}" if named else ""
        cells = [f"{band.level_db:.1f}", f"{band.azimuth_deg:+.0f}°{elevation}{sensor}"]
    return (
        f"<tr data-band='{name}' style='font-weight:{weight}'><td style='padding-right:0.6em'>{name}</td>"
        f"<td style='min-width:{_BAR_PX}px'>{bar}</td>"
        + "".join(f"<td style='text-align:right;padding-left:0.6em'>{cell.replace('-', '−')}</td>" for cell in cells)
        + "</tr>"
    )
