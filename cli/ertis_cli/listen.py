"""``ertis listen``: show or save the products that a central node publishes."""

import importlib
import math
import sys
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _listen_bearings, _listen_fused, _listen_odometry, _mountings, _network, options
from ertis_cli._config import typed
from ertis_cli._parameter_types import ranged
from ertis_cli._product_printer import PRINTERS, ProductTable
from ertis_cli._saving import PRODUCTS as FILED, saving
from ertis_cli._stop_signals import stopped_by_signals
from ertis_numba.settings.limits import AVERAGES

if TYPE_CHECKING:
    from ertis_cli._saving import Write
    from ertis_numba.network.products import Arrival

__all__ = ["listen"]

_POLL_INTERVAL_S = 0.1


@click.command()
@click.argument("address", metavar="ADDRESS")
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    metavar="NAME",
    help="Receive products of this sensor only; repeatable; all sensors by default.",
)
@click.option(
    "--product",
    "products",
    multiple=True,
    type=click.Choice(tuple(PRINTERS)),
    help="Product to receive; repeatable; energyscape by default.",
)
@click.option(
    "-n", "--count", "n", type=click.IntRange(min=1), metavar="N", help="Number of products to receive before ending."
)
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@click.option(
    "--save",
    "target",
    type=options.FILE,
    metavar="FILE.h5",
    help="Energyscape file or, with --product raw, recording to write.",
)
@click.option("--fuse", is_flag=True, help="Fuse the images of all sensors, and print one line per SYNC pulse.")
@click.option(
    "--odometry", is_flag=True, help="Print the pose and the velocity of the platform, one line per SYNC pulse."
)
@click.option("--bearings", is_flag=True, help="Print the bearings of sources of sound that the sensors did not emit.")
@click.option(
    "--average",
    type=ranged(AVERAGES),
    metavar="N",
    help="With --bearings: number of measurements of each sensor to average; that of its settings by default.",
)
@click.option(
    "--output",
    "-o",
    "trajectory",
    type=options.FILE,
    metavar="TRAJ.tum",
    help="With --odometry: trajectory to write in the TUM format at the end.",
)
@_mountings.mounting
@_network.key
@_network.server_key
@options.force
@options.quiet
@options.as_json_of("one object per line for each event; the last one is a summary")
def listen(
    *,
    address: str,
    sensors: tuple[str, ...],
    products: tuple[Any, ...],
    n: int | None,
    duration: float | None,
    target: Path | None,
    fuse: bool,
    odometry: bool,
    bearings: bool,
    average: int | None,
    trajectory: Path | None,
    mounting: Path | None,
    key: str | None,
    server_key: str | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Show or save the products that a central node publishes.

    ADDRESS is the address at which the central node publishes. The command prints one line per product: the nearest
    reflector, the time since the emission, and the time spent in the central node. The central node drops and
    counts products that this command receives too slowly. With --save, the energyscapes, or with --product raw the
    measurements, are saved to a file that appears complete at the end. If the central node disappears, the command
    waits for it. With --json, there is one line per event; the event 'subscribed' reports the connection.

    With --fuse, this command fuses the images of all sensors. With --odometry, it computes the path of their platform,
    which starts at the origin and lies in the plane; -o writes the path when the command ends, also by Ctrl-C. The
    mountings are those that 'ertis capture' has sent, or those of --mounting.

    With --bearings, this command computes acoustic maps of measurements without a call. It prints the direction of each
    source, with standard deviations, and its level, in each band. Of 1000 maps of noise, 1 has a false source.
    """
    _require_options_of({"--fuse": fuse, "--odometry": odometry, "--bearings": bearings})
    if fuse or odometry or bearings:
        _listen_specially(
            address,
            name="bearings" if bearings else "odometry" if odometry else "fused",
            average=average,
            trajectory=trajectory,
            mounting=mounting,
            force=force,
            sensors=sensors,
            keys=_network.client_keys(key, server_key),
            n=n,
            duration=duration,
            quiet=quiet,
            as_json=as_json,
        )
        return
    products = tuple(dict.fromkeys(products)) or ("energyscape",)
    _require_one_product(target, products)
    _network.require_duration(duration)
    from ertis_numba.network.subscriber import Subscriber

    if "energyscape" in products:  # import now: it takes half a second, in which the first images would be dropped
        importlib.import_module("ertis_numba.analysis.points")
    keys = _network.client_keys(key, server_key)
    notes: deque[str] = deque()
    heard = ProductTable(as_json=as_json, quiet=quiet)
    begun_s, failure = time.monotonic(), None
    written: Path | None = None
    end_s = math.inf if duration is None else begun_s + duration
    with ExitStack() as ended:
        with (
            stopped_by_signals() as signals,
            saving(target, products[0], overwrite=force) as save,
            Subscriber(
                address, sensors=sensors or None, products=products, keys=keys, on_note=notes.append
            ) as subscriber,
        ):
            signals.obey(subscriber.close)
            heard.head()
            ended.callback(lambda: heard.end(subscriber.counts, written, time.monotonic() - begun_s))
            while subscriber.counts.received != n and not signals.came and time.monotonic() < end_s and failure is None:
                item = subscriber.receive(_POLL_INTERVAL_S)
                heard.connection(subscriber, address, sensors, products, time.monotonic() - begun_s)
                heard.show_notes(notes)
                if item is not None and subscriber.latest is not None:
                    failure = _saved(save, subscriber.latest)
                    heard.product(subscriber.latest, subscriber.counts)
        written = target
        heard.silent(address, products, subscriber.counts.received, at_end=True)
    if failure is not None:
        raise failure
    if signals.came:
        sys.exit(0 if n is None and duration is None else 128 + signals.came[0])
    heard.require_answer(address, time.monotonic() - begun_s)
    if n is not None and subscriber.counts.received < n:
        raise click.ClickException(
            f"received {subscriber.counts.received} of {n} products in {duration:g} s; use a longer --duration"
        )


def _listen_specially(
    address: str,
    *,
    name: str,
    average: int | None,
    trajectory: Path | None,
    mounting: Path | None,
    force: bool,
    **common: Any,
) -> None:
    """Print bearings, odometry or fused images, which this command computes itself."""
    _network.require_duration(common["duration"])
    if name == "bearings":
        _listen_bearings.listen_bearings(address, average=average, **common)
        return
    common["mountings"] = _mountings.mountings(mounting, common["sensors"] or None)
    if name == "odometry":
        _listen_odometry.listen_odometry(address, target=trajectory, force=force, **common)
    else:
        _listen_fused.listen_fused(address, **common)


def _require_one_product(target: Path | None, products: tuple[str, ...]) -> None:
    if target is not None and (len(products) > 1 or products[0] not in FILED):
        raise click.UsageError(f"--save writes one product; combine it only with --product {' or '.join(FILED)}")


def _require_options_of(outputs: dict[str, bool]) -> None:
    """Refuse options that do not apply to the requested output, which is that of products if none is chosen."""
    context = click.get_current_context()
    chosen = [name for name, is_chosen in outputs.items() if is_chosen]
    if len(chosen) > 1:
        raise click.UsageError(f"{' and '.join(chosen)} cannot be combined; run the command once with each", context)
    for name, option in (("products", "--product"), ("target", "--save")) if chosen else ():
        if typed(name):
            raise click.UsageError(f"{option} applies only without {chosen[0]}", context)
    if typed("mounting") and chosen not in (["--fuse"], ["--odometry"]):
        raise click.UsageError("--mounting applies only with --fuse or --odometry", context)
    if typed("average") and chosen != ["--bearings"]:
        raise click.UsageError("--average applies only with --bearings", context)
    if typed("trajectory") and chosen != ["--odometry"]:
        raise click.UsageError("-o applies only with --odometry; --save FILE.h5 saves products", context)


def _saved(save: "Write", arrival: "Arrival") -> Exception | None:
    """Save a product; return the error if it does not match earlier products, which are kept."""
    from ertis_numba.base.errors import ArgumentError

    try:
        save(arrival)
    except ArgumentError as error:
        return error
    return None
