"""``ertis view``: what sensors see, live or of a file, on a page in the browser."""

import gc
import ipaddress
import math
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _network, options
from ertis_cli._watch import stopped_by_signals

if TYPE_CHECKING:
    from ertis_numba.viewer import Film, Live

__all__ = ["view"]

_COLOURS = ("inferno", "viridis", "cividis", "magma")


@click.command()
@click.argument("what", metavar="ADDRESS|REC.h5|IMG.h5")
@click.option("--sensor", "sensors", multiple=True, metavar="NAME", help="Of these only; of all by default.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Where to serve the page.")
@click.option("--port", type=click.IntRange(0, 65_535), default=8080, show_default=True, help="0 for any that is free.")
@click.option("--open/--no-open", "opened", default=None, help="Open a browser; done by default on a terminal.")
@click.option("--threshold", type=float, default=-20.0, show_default=True, metavar="DB", help="Weakest points to show.")
@click.option(
    "--dynamic-range", type=float, default=40.0, show_default=True, metavar="DB", help="Range of the colours."
)
@click.option("--range", "range_m", type=options.INTERVAL, metavar="A:B", help="Window of the range axis in metres.")
@click.option("--decay", type=float, default=0.0, show_default=True, metavar="S", help="For how long points stay.")
@click.option("--colours", type=click.Choice(_COLOURS), default="inferno", show_default=True, help="Colours of levels.")
@click.option("--loop", is_flag=True, help="Begin a file anew at its end.")
@click.option("--duration", type=float, metavar="S", help="Seconds; until Ctrl-C by default.")
@click.option(
    "--save-html",
    "html",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write what is shown as a page that needs no server: all of a file at once, or a live view at its end.",
)
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
    key: str | None,
    server_key: str | None,
    device: Any,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Show what sensors see on a page in the browser.

    ADDRESS is where a central node publishes. Of a file, recordings are processed with their own settings while they
    are shown, at the speed at which they were recorded. The page shows range and azimuth of each sensor, and all of
    them on their platform in three dimensions. It needs the extra view, and no other host.
    """
    _network.require_duration(duration)
    if html is not None:
        from ertis_numba.storage import check_target

        check_target(html, overwrite=force)
    try:
        from ertis_numba.viewer import Choices, View
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        raise click.ClickException("viser is not installed; pip install 'ertis-numba[view]'") from error
    choices = Choices(
        threshold_db=threshold, dynamic_range_db=dynamic_range, range_m=range_m, decay_s=decay, colours=colours
    )
    live = "://" in what
    with (
        stopped_by_signals() as signals,
        _source(what, sensors, live=live, keys=(key, server_key), device=device, loop=loop) as source,
        View(
            source,
            host=host,
            port=0 if html is not None and not live else port,
            choices=choices,
            on_note=lambda text: options.say(text, quiet=quiet),
        ) as shown,
    ):
        signals.obey(shown.stop)
        if html is not None and not live:
            shown.record(html, overwrite=force)
        else:
            _tell(what, shown.url, host, quiet=quiet, as_json=as_json)
            if sys.stderr.isatty() if opened is None else opened:
                webbrowser.open(shown.url)
            shown.run(duration_s=math.inf if duration is None else duration, html=html, overwrite=force)
    gc.freeze()  # to look through all that libraries have made would take a fifth of a second that nobody waits for
    if html is not None:
        options.say(f"{html}: {options.counted(shown.shown, 'frame')} of {what}", quiet=quiet)


def _source(
    what: str, sensors: tuple[str, ...], *, live: bool, keys: tuple[str | None, str | None], device: Any, loop: bool
) -> "Live | Film":
    if live:
        from ertis_numba.viewer import Live

        return Live(what, sensors=sensors or None, keys=_network.client_keys(*keys))
    if any(keys):
        raise click.UsageError("--key is for an address, and a file is given")
    from ertis_numba.viewer import Film

    return Film(what, sensors=sensors or None, device=device, loop=loop)


def _tell(what: str, url: str, host: str, *, quiet: bool, as_json: bool) -> None:
    """Tell where the page is, and who else may reach it."""
    if as_json:
        options.print_json({"event": "viewing", "source": what, "url": url})
    options.say(f"{what} at {url}; Ctrl-C ends", quiet=quiet)
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        options.say("whoever reaches that host sees and steers this view; it asks for no password", quiet=False)
