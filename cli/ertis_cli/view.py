"""``ertis view``: live or recorded images on a page in the browser."""

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
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ertis_cli import _mountings, _network, options
from ertis_cli._stop_signals import Signals, stopped_by_signals

if TYPE_CHECKING:
    from ertis_numba.viewer import Choices, Live, Playback, Viewer

__all__ = ["view"]

_COLOURS = ("inferno", "viridis", "cividis", "magma")
_LIVE, _PLAYBACK, _PAGE = "an address", "playback of a file", "a file that --save-html writes as a page"
_HOST_PORT = re.compile(r"(tcp:)?([^/\\]+:\d{1,5})")
_IMAGES, _MAPS = "images", "acoustic maps"
_RANGE_DB, _MAP_RANGE_DB = 40.0, 20.0
_PAGES = (".html", ".htm")
_TWICE_S = 0.5  # between two signals of which the second is not an echo of the first
_ENDING = "ending after the current image; press Ctrl-C to end at once ..."
_ONLY = {
    "host": (_LIVE, _PLAYBACK),
    "port": (_LIVE, _PLAYBACK),
    "opened": (_LIVE, _PLAYBACK),
    "loop": (_PLAYBACK,),
    "duration": (_LIVE, _PLAYBACK),
    "key": (_LIVE,),
    "server_key": (_LIVE,),
    "device": (_PLAYBACK, _PAGE, _MAPS),
    "threshold": (_IMAGES,),
    "range_m": (_IMAGES,),
    "decay": (_IMAGES,),
    "clean": (_IMAGES,),
    "band": (_MAPS,),
    "max_level": (_MAPS,),
}
"""Sources or contents of views that each of these options is for."""


@click.command()
@click.argument("location", metavar="ADDRESS|REC.h5|IMG.h5|MAPS.h5")
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    metavar="NAME",
    help="Show this sensor only; repeatable; all sensors by default.",
)
@click.option(
    "--acoustic-maps/--images",
    "acoustic_maps",
    default=None,
    help="Show acoustic maps of the sound in measurements, or images of echoes; by default, maps of recordings without "
    "calls, and images of others.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    help="Host at which to serve the page. If other machines can reach it, the printed address has a token.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65_535),
    default=8080,
    show_default=True,
    help="Port of the page; 0 chooses a free port.",
)
@click.option(
    "--open/--no-open",
    "opened",
    default=None,
    help="Open a browser; the default on a terminal, unless the browser runs in the terminal.",
)
@click.option(
    "--threshold",
    type=float,
    default=-20.0,
    show_default=True,
    metavar="DB",
    help="Level of the weakest points to show.",
)
@click.option(
    "--dynamic-range",
    type=float,
    metavar="DB",
    help="Dynamic range of the colour scale, in dB below the maximum; 40 by default, and 20 for acoustic maps.",
)
@click.option(
    "--max-level",
    type=float,
    metavar="DB",
    help="Level of the brightest colour of acoustic maps; by default, the level of the loudest direction, rounded up.",
)
@click.option(
    "--band",
    type=float,
    metavar="HZ",
    help="Show the band of acoustic maps that contains this frequency; the sum of all bands by default.",
)
@click.option("--range", "range_m", type=options.INTERVAL, metavar="A:B", help="Window of the range axis in metres.")
@click.option(
    "--decay", type=float, default=0.0, show_default=True, metavar="S", help="Time for which points stay visible."
)
@click.option("--colours", type=click.Choice(_COLOURS), default="inferno", show_default=True, help="Colour map.")
@options.cleaning("; no further cleaning by default")
@click.option("--loop", is_flag=True, help="Restart a file at its end.")
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@click.option(
    "--save-html",
    "html",
    type=options.FILE,
    metavar="FILE",
    help="Write the view as a page that needs no server: a whole file at once, or a live view at its end; "
    "at most 256 MB.",
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
    location: str,
    sensors: tuple[str, ...],
    acoustic_maps: bool | None,
    host: str,
    port: int,
    opened: bool | None,
    threshold: float,
    dynamic_range: float | None,
    max_level: float | None,
    band: float | None,
    range_m: tuple[float, float] | None,
    decay: float,
    colours: str,
    clean: dict[str, float] | None,
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
    """Show live or recorded images in a browser.

    ADDRESS is the address at which a central node publishes. A recording is processed with its own settings during
    playback, and is shown at its original speed. The page shows range versus azimuth, or sound levels over direction,
    for each sensor, and all sensors on their platform in three dimensions. The command needs the extra 'view'; the page
    loads nothing from other hosts.
    """
    live = _is_address(location)
    kind = _LIVE if live else _PLAYBACK if html is None else _PAGE
    is_known = live or acoustic_maps is not None
    _require_use(kind, (_MAPS if acoustic_maps else _IMAGES,) if is_known else (_IMAGES, _MAPS))
    _network.require_duration(duration)
    _require_files(None if live else Path(location), html, overwrite=force)
    from ertis_numba.viewer import Choices, Viewer

    choices = Choices(
        threshold_db=threshold,
        range_m=range_m,
        decay_s=decay,
        colours=colours,
        band_hz=band,
        max_level_db=max_level,
        dynamic_range_db=_RANGE_DB if dynamic_range is None else dynamic_range,
    )
    at_once = html is not None and not live
    with (
        stopped_by_signals() as signals,
        _source(
            signals,
            location,
            sensors,
            live=live,
            keys=(key, server_key),
            device=device,
            loop=loop,
            mounting=mounting,
            acoustic_maps=acoustic_maps,
            quiet=quiet,
        ) as source,
        nullcontext() if live and not acoustic_maps else _ended(source, signals, quiet=quiet),
        Viewer(
            source,
            host="127.0.0.1" if at_once else host,  # no other machine may connect while the page is written
            port=0 if at_once else port,
            choices=_fitting(choices, kind, source, dynamic_range=dynamic_range),
            **(clean or {}),
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
            _emit_event(location, shown, quiet=quiet, as_json=as_json)
            if sys.stderr.isatty() if opened is None else opened:
                # Some browsers return when they are closed, and others only after seconds.
                asked = {"asked": bool(opened)}
                threading.Thread(target=_open, args=(shown.url,), kwargs=asked, name="ertis-open", daemon=True).start()
            shown.run(duration_s=math.inf if duration is None else duration, html=html, overwrite=force)
    if html is not None:
        _report_recorded(location, html, shown.recorded, quiet=quiet, as_json=as_json)


def _is_address(location: str) -> bool:
    """Return True for an address, and False for a file."""
    live = "://" in location
    host_port = None if live or Path(location).exists() else _HOST_PORT.fullmatch(location)
    if host_port:
        raise click.UsageError(
            f"{location!r} is not a file; for the address of a central node, use tcp://{host_port[2]}"
        )
    return live


def _require_files(source: Path | None, html: Path | None, *, overwrite: bool) -> None:
    """Raise an error for a page that cannot be written, or for a file that cannot be shown."""
    from ertis_numba.base import checks
    from ertis_numba.storage import check_target, file_kind

    if html is not None:
        check_target(html, overwrite=overwrite, sources=[] if source is None else [source])
        checks.file_ending("page", html, _PAGES)
    if source is not None:
        file_kind(source)  # The viewer loads kernels, so other files are refused before.


def _require_use(kind: str, contents: tuple[str, ...]) -> None:
    """Raise an error for options without effect on possible contents, unless from a configuration file."""
    context = click.get_current_context()
    names = {each.name: each.opts[0] for each in context.command.params}
    for name, kinds in _ONLY.items():
        if not {kind, *contents} & {*kinds} and context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            with_this = contents[0] if {*kinds} <= {_IMAGES, _MAPS} else kind
            raise click.UsageError(f"{names[name]} is for {' or '.join(kinds)}; remove it with {with_this}", context)
    if context.params["html"] is None and context.get_parameter_source("force") is ParameterSource.COMMANDLINE:
        raise click.UsageError("--force is for --save-html; remove it", context)


def _fitting(choices: "Choices", kind: str, source: "Live | Playback", *, dynamic_range: float | None) -> "Choices":
    """Return choices with the default range of the colours, and raise an error for options without effect."""
    _require_use(kind, (_MAPS if source.shows_maps else _IMAGES,))
    by_default = _MAP_RANGE_DB if source.shows_maps else _RANGE_DB
    return replace(choices, dynamic_range_db=by_default if dynamic_range is None else dynamic_range)


def _source(
    signals: Signals,
    location: str,
    sensors: tuple[str, ...],
    *,
    live: bool,
    keys: tuple[str | None, str | None],
    device: Any,
    loop: bool,
    mounting: Path | None,
    acoustic_maps: bool | None,
    quiet: bool,
) -> "Live | Playback":
    if live:
        from ertis_numba.viewer import Live

        given = _mountings.mountings(mounting, sensors or None)
        with _compiling(options.PREPARING, signals, quiet=quiet) if acoustic_maps else nullcontext():
            return Live(
                location,
                sensors=sensors or None,
                keys=_network.client_keys(*keys),
                mounting=given,
                acoustic_maps=bool(acoustic_maps),
                device=device,
            )
    from ertis_numba.storage import sensor_names
    from ertis_numba.viewer import Playback

    given = None if mounting is None else _mountings.mountings(mounting, sensors or sensor_names(location))
    return Playback(
        location, sensors=sensors or None, device=device, loop=loop, mounting=given, acoustic_maps=acoustic_maps
    )


@contextmanager
def _ended(source: "Live | Playback", signals: Signals, *, quiet: bool) -> Iterator[None]:
    """Close a source after the block, and print a message if that takes long."""
    try:
        yield
    finally:
        with _compiling(_ENDING, signals, quiet=quiet, ending=True):
            source.__exit__()


@contextmanager
def _compiling(note: str, signals: Signals, *, quiet: bool, ending: bool = False) -> Iterator[None]:
    """Print a message if the block takes long, and delay signals until its end; the second one ends the process."""
    # The interpreter crashes if it exits during a compilation. If `ending`, the first signal counts as the second.
    first_s = math.inf if not ending else time.monotonic() if signals.came else -math.inf

    def come(number: int, frame: object) -> None:
        nonlocal first_s
        now_s = time.monotonic()
        if now_s - first_s > _TWICE_S:
            os._exit(128 + number)
        if math.isinf(first_s):
            first_s = now_s
            signals(number, frame)
            options.say("ending after this step; press Ctrl-C again to end at once", quiet=quiet)

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
    """Open a browser; a browser inside the terminal is opened only if ``asked``."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:  # no browser; the address of the page was already printed
        return
    if asked or _has_window(browser):
        browser.open(url)


def _has_window(browser: webbrowser.BaseBrowser) -> bool:
    """Return True if Python starts this browser in the background, unlike terminal browsers such as w3m."""
    if isinstance(browser, webbrowser.GenericBrowser):
        return isinstance(browser, webbrowser.BackgroundBrowser)
    return getattr(browser, "background", True)


def _emit_event(location: str, shown: "Viewer", *, quiet: bool, as_json: bool) -> None:
    """Report the address of the page, and the need for its token."""
    if as_json:
        options.print_json({"event": "viewing", "source": location, "url": shown.url})
    options.say(f"{location} at {shown.url}; Ctrl-C ends", quiet=quiet)
    if not shown.is_local:
        options.say(
            "other machines need the token in this address; anyone who has it can control this view", quiet=quiet
        )


def _report_recorded(location: str, html: Path, n_frames: int | None, *, quiet: bool, as_json: bool) -> None:
    """Report the written page; raise an error if no image was recorded."""
    if n_frames is None:
        raise click.ClickException(
            f"{html} is not written, because no image of {location} was shown; check that sensors send measurements"
        )
    options.say(f"{html}: {options.counted(n_frames, 'frame')} of {location}", quiet=quiet)
    if as_json:
        options.print_json({"event": "recorded", "source": location, "output": str(html), "frames": n_frames})
