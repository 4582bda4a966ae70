"""``ertis import signals``: recordings from signals and journals, and poses for them."""

import click

from ertis_cli.import_poses import import_poses
from ertis_cli.import_raw import import_raw
from ertis_cli.recover import recover

__all__ = ["imports"]


@click.group("import")
def imports() -> None:
    """Import signals, journals left by a crash, or poses into recordings."""


for each in (import_raw, import_poses, recover):
    imports.add_command(each)
