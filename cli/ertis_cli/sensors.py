"""``ertis sensors``: commands that concern sensors rather than files."""

import shlex
import subprocess
from collections.abc import Callable
from functools import partial
from typing import Any

import click

from ertis_cli import _config, _network, options
from ertis_cli._recording_settings import recording_settings, settings_from, warn_without_images
from ertis_cli.calibrate import calibrate
from ertis_cli.check import check
from ertis_cli.devices import devices
from ertis_cli.emulate import emulate
from ertis_cli.rtisdev import rtisdev
from ertis_cli.service import service
from ertis_cli.status import status

__all__ = ["sensors"]


@click.command("send")
@click.option("--port", "-p", required=True, metavar="PORT", help="Path, serial number or name of the sensor.")
@click.argument("texts", nargs=-1, required=True, metavar="TEXT...")
@options.as_json
def command(*, port: str, texts: tuple[str, ...], as_json: bool) -> None:
    """Send commands to a sensor and print its answers.

    A command is a line such as '!Y,0,0,0'. The documentation of the serial protocol lists the known commands. The
    command that starts a measurement is refused; use 'ertis capture' instead. 'ertis capture' configures the sensor
    again, so it replaces settings that you changed with 'ertis sensors send'.
    """
    from ertis_numba.devices.commands import CustomCommand
    from ertis_numba.devices.driver import SonarDriver

    for text in texts:
        CustomCommand(text)
    with SonarDriver.open(port) as sonar:
        for text in texts:
            answer = sonar.command(text)
            if as_json:
                options.print_json({"command": text, "answer": answer})
            else:
                click.echo(str(answer))


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


@click.command()
@click.option("--port", "-p", required=True, metavar="PORT", help="Path, serial number or name of the sensor.")
@click.option("--pin", type=click.IntRange(1, 40), metavar="N", help="Number of the pin on the board; 7 by default.")
@click.option("--hook", metavar="COMMAND", help="Program, with arguments, that resets the sensor; no pin is used.")
@click.option(
    "--within",
    "within_s",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    metavar="S",
    help="Longest time in seconds to wait for the sensor.",
)
@options.quiet
def reset(*, port: str, pin: int | None, hook: str | None, within_s: float, quiet: bool) -> None:
    """Reset a sensor and wait until it answers again.

    By default, the command pulses the pin of an NVIDIA Jetson that is wired to the sensor's reset line. This needs the
    package Jetson.GPIO. The command also works if the sensor does not answer, or if its port is missing.
    """
    from ertis_numba.devices.reset import reset_sensor
    from ertis_numba.devices.reset_pin import RESET_PIN, pulse_reset_pin

    if hook is not None and pin is not None:
        raise click.UsageError("--hook and --pin are both given; choose one of them")
    if hook is not None and not hook.strip():
        raise click.UsageError("--hook is empty; name a program")
    pulse = partial(pulse_reset_pin, pin or RESET_PIN) if hook is None else _runner(hook)
    with reset_sensor(port, pulse, within_s=within_s) as (sonar, is_certain):
        options.say(f"{sonar.port} answers again: firmware {sonar.firmware}", quiet=quiet)
    if not is_certain:
        options.warn(
            f"{sonar.port} still has its call, so the reset has probably not reached it; check the pin "
            "(--pin) or the program (--hook)"
        )


def _runner(hook: str) -> Callable[[], None]:
    """Return a function that runs a program, and fails if the program does."""

    def run() -> None:
        try:
            subprocess.run(shlex.split(hook), check=True)  # noqa: S603  the user names the program
        except (OSError, ValueError, subprocess.CalledProcessError) as error:
            raise click.ClickException(f"--hook {hook!r} has failed ({error}); correct the command") from error

    return run


@click.group()
def sensors() -> None:
    """List, check, calibrate, control and emulate sensors."""


_config.add_variables(rtisdev, ("rtisdev",))  # named like those that scripts without this command read
for each in (calibrate, check, command, configure, devices, emulate, reset, rtisdev, service, status):
    sensors.add_command(each)
