"""``ertis serve``: run a central node that computes and publishes images."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ertis_cli import _central_watch, _image_options, _network, _plans, _supervisor, options
from ertis_cli._config import typed
from ertis_cli._saving import withdrawn
from ertis_numba.base.constants import IMAGE_DTYPES

if TYPE_CHECKING:
    from collections.abc import Collection

    from ertis_numba.base.constants import ImageDtype
    from ertis_numba.settings import ExcludedChannels

__all__ = ["serve"]


@click.command()
@click.option("--listen", metavar="ADDRESS", help="Address for sensor nodes; tcp://127.0.0.1:5601 by default.")
@click.option("--publish", metavar="ADDRESS", help="Address for applications; tcp://127.0.0.1:5602 by default.")
@click.option("--record", "folder", type=options.FOLDER, metavar="DIR", help="Also store measurements in this folder.")
@_central_watch.name
@_central_watch.rotate_size
@_central_watch.rotate_every
@_central_watch.max_bytes
@options.workers()
@options.threads
@options.without("Channels to exclude, such as those of faulty microphones")
@_image_options.processing_preset
@click.option("--directions", metavar="GRID", help="90, 1850, 3000, 2d:N or 3d:N; the sensor's own grid by default.")
@click.option("--range", "range_m", type=options.INTERVAL, help="First and last range in m.")
@click.option("--method", type=click.Choice(["fast", "paper"]), help="Processing method; the sensor's own by default.")
@options.beamforming("; the sensor's own by default")
@options.cleaning("; the sensor's own by default")
@click.option(
    "--max-error",
    "max_error_db",
    type=options.ERROR_BUDGET,
    metavar="DB|PRESET",
    help="Error budget of images, as in -40, or draft, standard, fine, exact; the sensor's own by default.",
)
@options.plan
@options.device
@click.option(
    "--dtype",
    type=click.Choice(IMAGE_DTYPES),
    default="float32",
    show_default=True,
    help="Data type of published images; float16 halves their size, and uint8, levels in steps of 0.5 dB, quarters it.",
)
@click.option(
    "--deadline",
    type=float,
    default=2.0,
    show_default=True,
    metavar="S",
    help="Time limit per measurement; a slower worker is killed.",
)
@click.option(
    "--quarantine",
    type=options.FOLDER,
    metavar="DIR",
    help="Dead-letter folder for measurements that made two workers fail.",
)
@click.option("--duration", type=float, metavar="S", help="Duration in seconds; until Ctrl-C by default.")
@_network.key
@_network.allow
@click.option("--metrics", metavar="HOST:PORT", help="Serve Prometheus metrics at this address.")
@click.option("--every", is_flag=True, help="With --json and --record: also print a line for each measurement.")
@options.quiet
@options.as_json
def serve(
    *,
    listen: str | None,
    publish: str | None,
    folder: Path | None,
    name: str,
    rotate_size: float,
    rotate_every: float,
    max_bytes: int,
    workers: int | str | None,
    threads: int | None,
    without: "ExcludedChannels",
    preset: str | None,
    max_error_db: float | None,
    plan: Literal["nominal", "measured"],
    device: str,
    dtype: "ImageDtype",
    deadline: float,
    quarantine: Path | None,
    duration: float | None,
    key: str | None,
    allow: Path | None,
    metrics: str | None,
    every: bool,
    quiet: bool,
    as_json: bool,
    beamformer: dict[str, Any] | None,
    clean: dict[str, float] | None,
    **other: Any,
) -> None:
    """Run a central node that computes and publishes images.

    Sensors send to it with 'ertis capture --to ADDRESS', and 'ertis listen ADDRESS' shows the published products. If
    measurements arrive faster than images can be computed, the oldest are dropped and counted. With --record, the node
    acknowledges a measurement once it is durable, like 'ertis record'. Ctrl-C ends the node. With --json, there is
    one line per event.
    """
    _central_watch.require_use(stores=folder is not None, as_json=as_json)
    _plans.require_plan(other["method"])
    _require_threads(workers)
    life = _supervisor.supervised()
    from ertis_numba.network.addresses import DEFAULT_LISTEN, DEFAULT_PUBLISH, at_port
    from ertis_numba.network.central_node import CentralNode
    from ertis_numba.network.processing import ImageProcessing, ProcessingOptions
    from ertis_numba.settings import Settings

    _network.require_duration(duration)
    _network.require_address("--listen", listen)
    _network.require_address("--publish", publish)
    served = _network.metrics(metrics, lambda: node.latest)
    publish = life.addresses.get("publish") or publish or DEFAULT_PUBLISH
    changes = _processing(preset, other | (beamformer or {}) | (clean or {}))
    keys = _network.server_keys(key, allow)
    with withdrawn(folder, quarantine) as made:
        if quarantine is not None:
            _make(quarantine)
        processing = ImageProcessing(
            ProcessingOptions(
                publish=publish,
                keys=keys,
                processing=changes,
                max_error_db=max_error_db,
                without=without,
                plan=plan,
                device=device,
                workers=workers,
                threads=threads,
                deadline_s=deadline,
                dtype=dtype,
                quarantine=quarantine,
                # Most sensors use this preset. Kernels are then ready for their first measurement.
                expected=Settings.from_preset("default_25_50"),
            )
        )
        archive = None if folder is None else _central_watch.archive(folder, name, rotate_size, rotate_every)
        watch = _central_watch.CentralWatch(life, quiet=quiet, as_json=as_json)

        def on_event(event: dict[str, Any]) -> None:
            listening = event["event"] == "listening"
            watch.event(event | ({"publish": at_port(publish, processing.address)} if listening else {}))

        node = CentralNode(
            life.addresses.get("address") or listen or DEFAULT_LISTEN,
            keys=keys,
            archive=archive,
            processing=processing,
            max_bytes=max_bytes,
            on_event=on_event,
            on_stored=watch.stored if as_json and every else None,
        )
        _central_watch.run(node, watch, made=made, metrics=served, duration_s=life.remaining_s(duration))
    _central_watch.report(node.latest, watch, event="served")
    _warn_of_unknown(without, node.latest.sensors)


def _require_threads(workers: int | str | None) -> None:
    """Refuse a number of threads for the workers of a cluster, which have their own."""
    if isinstance(workers, str) and typed("threads"):
        raise click.UsageError(
            "--threads applies to processes on this machine, not to a dask cluster; remove it, or use --workers N",
            click.get_current_context(),
        )


def _processing(preset: str | None, given: dict[str, Any]) -> dict[str, Any]:
    """Return the processing settings of a preset, or none, which given options override."""
    from ertis_numba.settings import preset_tables

    chosen = {} if preset is None else preset_tables(preset, "processing")["processing"]
    return chosen | {option: value for option, value in given.items() if value is not None}


def _warn_of_unknown(without: "ExcludedChannels", sensors: "Collection[str]") -> None:
    """Warn of channels that were excluded of a sensor which never connected: its name may be wrong."""
    from ertis_numba.base.errors import ArgumentError

    try:
        without.require_known(sensors)
    except ArgumentError as error:
        options.warn(f"--without: {error}")


def _make(folder: Path) -> None:
    from ertis_numba.base.errors import DataError

    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: {error.strerror}; choose a folder that can be written") from error
