"""Where options come from that are not given: environment variables, then a file, then their defaults."""

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

import click

__all__ = ["add_variables", "config", "origin", "variable"]

_GENERAL = frozenset({"device", "quiet", "threads"})
"""Options that mean the same in every command: ``ERTIS_THREADS`` is of all."""

_FILE = "ertis_cli.config_file"  # key of click's `Context.meta`


def variable(path: Iterable[str], option: str) -> str:
    """Return the environment variable of a command's option, such as ``ERTIS_PROCESS_MAX_ERROR``."""
    return "_".join(("ERTIS", *path, option)).upper().replace("-", "_")


def add_variables(command: click.Command, path: tuple[str, ...]) -> None:
    """Let the options of a command, and of those in it, come from the environment, too.

    Parameters
    ----------
    command : click.Command
    path : tuple of str
        Its name, after those of the groups it is in.
    """
    for option, parameter in _options(command).items():
        if parameter.envvar is None:
            general = [variable((), option)] if option in _GENERAL else []
            parameter.envvar = [variable(path, option), *general]
    if isinstance(command, click.Group):
        for name, each in command.commands.items():
            add_variables(each, (*path, name))


def _options(command: click.Command) -> dict[str, click.Option]:
    """Return options by their long names without dashes."""
    return {
        _long_name(parameter): parameter
        for parameter in command.params
        if isinstance(parameter, click.Option) and parameter.expose_value
    }


def _long_name(option: click.Option) -> str:
    return max(option.opts, key=len).lstrip("-")


def _load(ctx: click.Context, _: click.Parameter, path: Path | None) -> None:
    """Take the defaults of all commands from a file."""
    if path is None:
        return
    try:
        tables = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise click.ClickException(f"{path}: {reason}; give a readable TOML file (--config)") from error
    ctx.default_map = _defaults(ctx, cast("click.Group", ctx.command), tables, f"{path}: ")
    ctx.meta[_FILE] = path


def _defaults(ctx: click.Context, group: click.Group, tables: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the defaults of a group's commands, by the names that click has for their parameters."""
    found: dict[str, Any] = {}
    names = group.list_commands(ctx)
    for name, table in tables.items():
        command = group.get_command(ctx, name)
        if command is None:
            raise click.ClickException(f"{where}{name!r} is no command; {_instead(name, names)}")
        if not isinstance(table, dict):
            raise click.ClickException(f"{where}{name} is {table!r}; give a table of options, as in [{name}]")
        if isinstance(command, click.Group):
            found[name] = _defaults(ctx, command, table, f"{where}{name} ")
            continue
        options = _options(command)
        for key in table:
            if key not in options:
                raise click.ClickException(f"{where}{name} has no option {key!r}; {_instead(key, options)}")
        found[name] = {str(options[key].name): _value(value) for key, value in table.items()}
    return found


def _value(value: Any) -> Any:
    """Return a value as click wants it: what is no list is as it would be typed."""
    if isinstance(value, list):
        return [_value(each) for each in value]
    return value if isinstance(value, bool) else str(value)


def _instead(name: str, known: Iterable[str]) -> str:
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"


def origin(error: click.UsageError) -> str:
    """Return where a value came from that is not on the command line; empty where it is."""
    ctx, parameter = error.ctx, getattr(error, "param", None)
    if ctx is None or not isinstance(parameter, click.Option) or parameter.name is None:
        return ""
    source = ctx.get_parameter_source(parameter.name)
    if source is click.core.ParameterSource.ENVIRONMENT:
        names = [parameter.envvar] if isinstance(parameter.envvar, str) else list(parameter.envvar or ())
        return f" (from the variable {next((name for name in names if os.environ.get(name)), names[0])})"
    if source is click.core.ParameterSource.DEFAULT_MAP:
        return f" (from {ctx.meta.get(_FILE, 'the configuration')})"
    return ""


config = click.option(
    "--config",
    type=click.Path(path_type=Path),
    metavar="FILE.toml",
    envvar="ERTIS_CONFIG",
    is_eager=True,
    expose_value=False,
    callback=_load,
    help="Options of commands, in tables of their names; what is given, or in a variable, comes first.",
)
