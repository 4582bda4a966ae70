"""``ertis import signals``: recordings from signals and journals, and poses for them."""

import click

from ertis_cli.import_poses import import_poses
from ertis_cli.import_raw import import_raw
from ertis_cli.recover import recover

__all__ = ["imports"]


class _Imports(click.Group):
    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Import signals if the first argument is no command, as of ``ertis import FILE.wav``."""
        is_command = args[0] in self.commands or args[0] in ctx.help_option_names
        return super().resolve_command(ctx, args if is_command else ["signals", *args])


@click.group("import", cls=_Imports, context_settings={"ignore_unknown_options": True})
def imports() -> None:
    """Import signals, journals left by a crash, or poses into recordings.

    If the first argument is none of these commands, it is a file of signals.
    """


for each in (import_raw, import_poses, recover):
    imports.add_command(each)
