"""``ertis reference completion``: shell completion of commands and options."""

import click

__all__ = ["completion"]


@click.command()
@click.argument("shell", type=click.Choice(["bash", "fish", "zsh"]))
@click.pass_context
def completion(ctx: click.Context, *, shell: str) -> None:
    """Print a script that completes commands and options in a shell.

    For bash, add eval "$(ertis reference completion bash)" to ~/.bashrc. For zsh, add eval "$(ertis reference
    completion zsh)" to ~/.zshrc, after 'autoload -U compinit; compinit'. For fish, save the output as
    ~/.config/fish/completions/ertis.fish.
    """
    from click.shell_completion import BashComplete, FishComplete, ZshComplete

    how = {"bash": BashComplete, "fish": FishComplete, "zsh": ZshComplete}[shell]
    click.echo(how(ctx.find_root().command, {}, "ertis", "_ERTIS_COMPLETE").source())
