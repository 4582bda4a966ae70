"""``ertis sensors``: commands that concern sensors rather than files."""

import click

from ertis_cli import _config
from ertis_cli.calibrate import calibrate
from ertis_cli.check import check
from ertis_cli.command import command
from ertis_cli.configure import configure
from ertis_cli.devices import devices
from ertis_cli.emulate import emulate
from ertis_cli.reset import reset
from ertis_cli.rtisdev import rtisdev
from ertis_cli.service import service
from ertis_cli.status import status

__all__ = ["sensors"]


@click.group()
def sensors() -> None:
    """List, check, calibrate, control and emulate sensors."""


_config.add_variables(rtisdev, ("rtisdev",))  # named like those that scripts without this command read
for each in (calibrate, check, command, configure, devices, emulate, reset, rtisdev, service, status):
    sensors.add_command(each)
