"""``ertis sensors configure``: change the settings of a sensor in a network."""

from typing import Any

import click

from ertis_cli import _network, options
from ertis_cli._recording_settings import recording_settings, settings_from, warn_without_images

__all__ = ["configure"]


@click.command()
@click.argument("address", metavar="ADDRESS")
@click.argument("sensor", metavar="SENSOR")
@_network.key
@_network.server_key
@recording_settings
@click.option(
    "--patience",
    "patience_s",
    type=float,
    default=30.0,
    show_default=True,
    metavar="S",
    help="Longest time in seconds to wait for an answer.",
)
@options.as_json
def configure(
    *,
    address: str,
    sensor: str,
    key: str | None,
    server_key: str | None,
    patience_s: float,
    as_json: bool,
    **given: Any,
) -> None:
    """Change the settings of a sensor that sends to a central node.

    ADDRESS is the address that sensors send to. Pass the new settings with --preset or --settings; they replace all
    former ones. The settings apply to all sensors of the same 'ertis capture --to', between two measurements. If one
    sensor cannot use them, all keep their former settings. A central node that computes images refuses settings from
    which it cannot compute any. If the central node uses keys, pass the key of an admin.
    """
    from ertis_numba.base import checks
    from ertis_numba.network.central_client import CentralClient

    checks.positive("--patience", patience_s)
    checks.sensor_name(sensor)
    if given["preset"] is None and given["settings_file"] is None:
        raise click.UsageError("all settings of the sensor are replaced; add --preset or --settings")
    settings = settings_from(**given)
    warn_without_images(settings)
    with CentralClient(address, keys=_network.client_keys(key, server_key)) as central:
        sensors = central.configure(sensor, settings, patience_s)
    if as_json:
        options.print_json({"configured": list(sensors)})
    else:
        click.echo(f"configured: {' '.join(sensors)}")
