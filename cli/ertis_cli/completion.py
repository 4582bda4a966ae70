"""``ertis completion``: commands and options at the press of a key."""

import click

__all__ = ["completion"]


@click.command()
@click.argument("shell", type=click.Choice(["bash", "fish", "zsh"]))
@click.pass_context
def completion(ctx: click.Context, *, shell: str) -> None:
    """Print what makes a shell complete commands and options.

    For bash, add eval "$(ertis completion bash)" to ~/.bashrc; for zsh, its like to ~/.zshrc, after 'autoload -U
    compinit; compinit'; for fish, save what is printed as ~/.config/fish/completions/ertis.fish.
    """
    from click.shell_completion import BashComplete, FishComplete, ZshComplete

    how = {"bash": BashComplete, "fish": FishComplete, "zsh": ZshComplete}[shell]
    click.echo(how(ctx.find_root().command, {}, "ertis", "_ERTIS_COMPLETE").source())
