"""Implementation of ``ertis view``, which shows images and points in the browser."""

import gc
import math
import os
import re
import signal
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ertis_cli import _mountings, _network, options
from ertis_cli._signals import Signals, stopped_by_signals

if TYPE_CHECKING:
    from ertis_numba.viewer import Live, Playback, Viewer

__all__ = ["view"]

_COLOURS = ("inferno", "viridis", "cividis", "magma")
_LIVE, _PLAYBACK, _PAGE = "an address", "a file on display", "a file written by --save-html"
_HOST_PORT = re.compile(r"(tcp:)?([^/\\]+:\d{1,5})")
_PAGES = (".html", ".htm")
_TWICE_S = 0.5  # Shorter intervals between signals are repetitions of the first by a shell or terminal.
_ENDING = "ending after the current image; Ctrl-C ends at once ..."
_ONLY = {
    "host": (_LIVE, _PLAYBACK),
    "port": (_LIVE, _PLAYBACK),
    "opened": (_LIVE, _PLAYBACK),
    "loop": (_PLAYBACK,),
    "duration": (_LIVE, _PLAYBACK),
    "key": (_LIVE,),
    "server_key": (_LIVE,),
    "device": (_PLAYBACK, _PAGE),
}
"""Options that apply to some sources only, and these sources."""


@click.command()
@click.argument("what", metavar="ADDRESS|REC.h5|IMG.h5")
@click.option("--sensor", "sensors", multiple=True, metavar="NAME", help="Sensors to show; all by default.")
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Host at which to serve the page. If other machines can reach it, the printed address contains a token.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8080,
    show_default=True,
    help="Port of the page; 0 chooses a free one.",
)
@click.option(
    "--open/--no-open",
    "opened",
    default=None,
    help="Open a browser; done by default on a terminal, except for browsers that run inside the terminal.",
)
@click.option(
    "--threshold", type=float, default=-20.0, show_default=True, metavar="DB", help="Lowest level of points to show."
)
@click.option(
    "--dynamic-range", type=float, default=40.0, show_default=True, metavar="DB", help="Dynamic range of the colours."
)
@click.option("--range", "range_m", type=options.INTERVAL, metavar="A:B", help="Window of the range axis in metres.")
@click.option("--decay", type=float, default=0.0, show_default=True, metavar="S", help="Persistence of points.")
@click.option(
    "--colours", type=click.Choice(_COLOURS), default="inferno", show_default=True, help="Colour map of levels."
)
@click.option("--loop", is_flag=True, help="Repeat a file at its end.")
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@click.option(
    "--save-html",
    "html",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a page that needs no server: all of a file at once, or a live view at its end; at most 256 MB.",
)
@_mountings.mounting
@_network.key
@_network.server_key
@options.device
@options.force
@options.quiet
@options.as_json
def view(
    *,
    what: str,
    sensors: tuple[str, ...],
    host: str,
    port: int,
    opened: bool | None,
    threshold: float,
    dynamic_range: float,
    range_m: tuple[float, float] | None,
    decay: float,
    colours: str,
    loop: bool,
    duration: float | None,
    html: Path | None,
    mounting: Path | None,
    key: str | None,
    server_key: str | None,
    device: Any,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Show images and points in the browser.

    ADDRESS is the address at which a central node publishes. Recordings are processed with their own settings during
    playback, at their recorded speed. The page shows range and azimuth of each sensor, and all sensors on their
    platform in three dimensions. It needs the extra view, and no other host.
    """
    live = _is_address(what)
    _require_use(_LIVE if live else _PLAYBACK if html is None else _PAGE)
    _network.require_duration(duration)
    if html is not None:
        from ertis_numba import checks
        from ertis_numba.storage import check_target

        check_target(html, overwrite=force, sources=[] if live else [Path(what)])
        checks.choice("page format", html.suffix.lower(), _PAGES)
    from ertis_numba.viewer import Choices, Viewer

    choices = Choices(
        threshold_db=threshold, dynamic_range_db=dynamic_range, range_m=range_m, decay_s=decay, colours=colours
    )
    at_once = html is not None and not live
    with (
        stopped_by_signals() as signals,
        _source(
            what, sensors, live=live, keys=(key, server_key), device=device, loop=loop, mounting=mounting
        ) as source,
        nullcontext() if live else _ended(source, signals, quiet=quiet),
        Viewer(
            source,
            host="127.0.0.1" if at_once else host,  # Nobody can connect while a file is written as a page.
            port=0 if at_once else port,
            choices=choices,
            on_note=lambda text: options.say(text, quiet=quiet),
        ) as shown,
    ):
        signals.obey(shown.stop)
        if html is not None and at_once:
            with _compiling(options.PREPARING, signals, quiet=quiet):
                shown.prepare()
            shown.record(html, overwrite=force)
            if shown.recorded is None:
                signals.end()
        else:
            _emit_event(what, shown, quiet=quiet, as_json=as_json)
            if sys.stderr.isatty() if opened is None else opened:
                # Some threads end when they are closed, and others only after seconds.
                asked = {"asked": bool(opened)}
                threading.Thread(target=_open, args=(shown.url,), kwargs=asked, name="ertis-open", daemon=True).start()
            shown.run(duration_s=math.inf if duration is None else duration, html=html, overwrite=force)
    gc.freeze()  # Scanning all objects of the libraries would take a fifth of a second.
    if html is not None:
        _report_recorded(what, html, shown.recorded, quiet=quiet, as_json=as_json)


def _is_address(what: str) -> bool:
    """Return True if the source is an address rather than a file."""
    live = "://" in what
    host_port = None if live or Path(what).exists() else _HOST_PORT.fullmatch(what)
    if host_port:
        raise click.UsageError(f"{what!r} is not a file; give tcp://{host_port[2]}, if a central node publishes there")
    return live


def _require_use(kind: str) -> None:
    """Refuse options that have no effect; a configuration file may set them for other sources."""
    context = click.get_current_context()
    names = {each.name: each.opts[0] for each in context.command.params}
    for name, kinds in _ONLY.items():
        if kind not in kinds and context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"{names[name]} applies to {' or '.join(kinds)}; leave it out with {kind}", context)
    if context.params["html"] is None and context.get_parameter_source("force") is ParameterSource.COMMANDLINE:
        raise click.UsageError("--force applies to --save-html; leave it out", context)


def _source(
    what: str,
    sensors: tuple[str, ...],
    *,
    live: bool,
    keys: tuple[str | None, str | None],
    device: Any,
    loop: bool,
    mounting: Path | None,
) -> "Live | Playback":
    if live:
        from ertis_numba.viewer import Live

        given = _mountings.mountings(mounting, sensors or None)
        return Live(what, sensors=sensors or None, keys=_network.client_keys(*keys), mounting=given)
    from ertis_numba.storage import sensor_names
    from ertis_numba.viewer import Playback

    given = None if mounting is None else _mountings.mountings(mounting, sensors or sensor_names(what))
    return Playback(what, sensors=sensors or None, device=device, loop=loop, mounting=given)


@contextmanager
def _ended(source: "Live | Playback", signals: Signals, *, quiet: bool) -> Iterator[None]:
    """Close a source after the block; print the reason for a delay."""
    try:
        yield
    finally:
        with _compiling(_ENDING, signals, quiet=quiet, ending=True):
            source.__exit__()


@contextmanager
def _compiling(note: str, signals: Signals, *, quiet: bool, ending: bool = False) -> Iterator[None]:
    """Print a note if a block takes long, and hold signals until it ends; a second signal ends the process at once.

    An exception inside the compiler would be swallowed, and finalising the interpreter meanwhile would crash. If the
    program is ``ending`` anyway, the first signal counts as the second.
    """
    first_s = math.inf if not ending else time.monotonic() if signals.came else -math.inf

    def come(number: int, frame: object) -> None:
        nonlocal first_s
        now_s = time.monotonic()
        if now_s - first_s > _TWICE_S:
            os._exit(128 + number)
        if math.isinf(first_s):
            first_s = now_s
            signals(number, frame)
            options.say("ending after compilation; Ctrl-C again ends at once", quiet=quiet)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            signal.signal(number, come)
        with options.note_when_slow(note, quiet=quiet):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _open(url: str, *, asked: bool) -> None:
    """Open a browser, unless it would take over the terminal without a request."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:  # There is no browser; the address is printed already.
        return
    if asked or _has_window(browser):
        browser.open(url)


def _has_window(browser: webbrowser.BaseBrowser) -> bool:
    """Return True if a browser opens a window, and False for terminal browsers such as w3m."""
    if isinstance(browser, webbrowser.GenericBrowser):
        return isinstance(browser, webbrowser.BackgroundBrowser)
    return getattr(browser, "background", True)


def _emit_event(what: str, shown: "Viewer", *, quiet: bool, as_json: bool) -> None:
    """Print the address of the page, and a note if other machines can reach it."""
    if as_json:
        options.print_json({"event": "viewing", "source": what, "url": shown.url})
    options.say(f"{what} at {shown.url}; Ctrl-C ends", quiet=quiet)
    if not shown.is_local:
        options.say("other machines need the token in that address; anyone with it can control this view", quiet=quiet)


def _report_recorded(what: str, html: Path, n_frames: int | None, *, quiet: bool, as_json: bool) -> None:
    """Print the written frames; raise an error if there are none."""
    if n_frames is None:
        raise click.ClickException(f"no image of {what} was shown, so {html} is not written; check that sensors send")
    options.say(f"{html}: {options.counted(n_frames, 'frame')} of {what}", quiet=quiet)
    if as_json:
        options.print_json({"event": "recorded", "source": what, "output": str(html), "frames": n_frames})
