"""``ertis reference``: layouts, presets, keys of settings, and the completion script."""

import click

from ertis_cli.completion import completion
from ertis_cli.layouts import layouts
from ertis_cli.presets import presets
from ertis_cli.settings import settings

__all__ = ["reference"]


@click.group()
def reference() -> None:
    """Print layouts, presets, the keys of settings, or a completion script."""


for each in (completion, layouts, presets, settings):
    reference.add_command(each)
