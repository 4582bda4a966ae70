"""Values of options that are not on the command line: environment variables, then a file, then defaults."""

import difflib
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import click

__all__ = [
    "add_variables",
    "config",
    "instead",
    "long_name",
    "origin",
    "require_config",
    "typed",
    "unknown_variables",
    "variable",
]

_GENERAL = frozenset({"device", "quiet", "threads"})
"""Options with the same meaning in every command, such as ``ERTIS_THREADS``."""

_NO_OPTIONS = frozenset(
    f"ERTIS_{name}"
    for name in (
        *("BENCH_MARK", "CACHE_DIR", "CONFIG", "EMULATED_DIR", "KEYS_DIR", "TRACE"),
        *("RTISDEV_DEVICE", "RTISDEV_METHOD", "RTISDEV_PORT"),
    )
)
"""Variables that are not options: other parts of the package read them, and benchmarks mark their processes."""

_FILE, _BROKEN = "ertis_cli.config_file", "ertis_cli.config_error"  # keys of click's `Context.meta`
_WITHOUT = frozenset({"doctor", "reference"})
"""Commands that run despite an invalid configuration: new shells run one of them, and ``doctor`` finds faults."""


def variable(path: Iterable[str], option: str) -> str:
    """Return the environment variable of a command's option, such as ``ERTIS_PROCESS_MAX_ERROR``."""
    return "_".join(("ERTIS", *path, option)).upper().replace("-", "_")


def add_variables(command: click.Command, path: tuple[str, ...]) -> None:
    """Let environment variables set the options of a command, at a path of groups, and its subcommands."""
    for option, parameter in _options(command).items():
        if parameter.envvar is None:
            general = [variable((), option)] if option in _GENERAL else []
            parameter.envvar = [variable(path, option), *general]
    if isinstance(command, click.Group):
        for name, each in command.commands.items():
            add_variables(each, (*path, name))


def unknown_variables(group: click.Group, ctx: click.Context) -> Iterator[str]:
    """Yield a message for each ``ERTIS_`` variable that no command reads, with a suggestion.

    Other software may set such variables: a cluster names variables after its services.
    """
    # A command is imported only if a variable begins with its prefix.
    commands = {variable((name,), ""): name for name in group.list_commands(ctx)}
    general = {variable((), option) for option in _GENERAL}
    for name in sorted(os.environ):
        if not name.startswith("ERTIS_") or name in general | _NO_OPTIONS:
            continue
        near = _near(name, commands)
        command = group.get_command(ctx, commands[near]) if near else None
        known = general | _NO_OPTIONS | set(_variables(command) if command else ())
        if name not in known:
            close = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.8)
            meant = f"did you mean {close[0]!r}?" if close else "unset it if no other program needs it"
            yield f"no command reads the variable {name}; {meant}"


def _near(name: str, prefixes: Iterable[str]) -> str:
    """Return the longest prefix of a variable, or else one that resembles its first two words, or an empty text."""
    exact = max((each for each in prefixes if name.startswith(each)), key=len, default="")
    close = difflib.get_close_matches("_".join(name.split("_")[:2]) + "_", [*prefixes], n=1)
    return exact or "".join(close)


def _variables(command: click.Command) -> Iterator[str]:
    """Yield the variables of a command and its subcommands."""
    for option in _options(command).values():
        yield from [option.envvar] if isinstance(option.envvar, str) else option.envvar or ()
    if isinstance(command, click.Group):
        for each in command.commands.values():
            yield from _variables(each)


def _options(command: click.Command) -> dict[str, click.Option]:
    """Return the options of a command by long name without dashes."""
    return {
        long_name(parameter): parameter
        for parameter in command.params
        if isinstance(parameter, click.Option) and parameter.expose_value
    }


def long_name(option: click.Option) -> str:
    """Return the longest name of an option, without dashes."""
    return max(option.opts, key=len).lstrip("-")


def _load(ctx: click.Context, _: click.Parameter, path: Path | None) -> None:
    """Load the defaults of all commands from a file; `require_config` raises its errors later."""
    if path is not None:
        try:
            _take(ctx, path)
        except click.ClickException as error:
            ctx.meta[_BROKEN] = error


def require_config(ctx: click.Context) -> str:
    """Raise the error of the configuration file; for commands that run without one, return its message."""
    error: click.ClickException | None = ctx.meta.get(_BROKEN)
    if error is None:
        return ""
    if ctx.invoked_subcommand not in _WITHOUT:
        raise error
    return error.format_message()


def _take(ctx: click.Context, path: Path) -> None:
    try:
        tables = tomllib.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        from ertis_numba.base import checks

        reason = checks.reason_unreadable(error) if isinstance(error, OSError | UnicodeDecodeError) else error
        raise click.ClickException(f"{path}: {reason}; choose a readable TOML file (--config)") from error
    ctx.default_map = _defaults(ctx, cast("click.Group", ctx.command), tables, f"{path}: ")
    ctx.meta[_FILE] = path


def _defaults(ctx: click.Context, group: click.Group, tables: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the defaults of a group's commands by click's parameter names."""
    found: dict[str, Any] = {}
    names = group.list_commands(ctx)
    for name, table in tables.items():
        command = group.get_command(ctx, name)
        if command is None:
            raise click.ClickException(f"{where}{name!r} is not a command; {instead(name, names)}")
        if not isinstance(table, dict):
            raise click.ClickException(f"{where}{name} is {table!r}; write a table of options, as in [{name}]")
        if isinstance(command, click.Group):
            found[name] = _defaults(ctx, command, table, f"{where}{name} ")
            continue
        options = _options(command)
        for key in table:
            if key not in options:
                raise click.ClickException(f"{where}{name} has no option {key!r}; {instead(key, options)}")
        found[name] = {str(options[key].name): _values(options[key], value) for key, value in table.items()}
    return found


def _values(option: click.Option, value: Any) -> Any:
    """Return the value of an option, in a list if the option may be repeated."""
    return _value([value] if option.multiple and not isinstance(value, list) else value)


def _value(value: Any) -> Any:
    """Return a value as click expects it: text as on the command line, a bool, or a list of these."""
    if isinstance(value, list):
        return [_value(each) for each in value]
    return value if isinstance(value, bool) else str(value)


def instead(name: str, known: Iterable[str]) -> str:
    """Return a suggestion for an unknown name: the closest known name, or all known names."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(known)}"


def typed(name: str) -> bool:
    """Return True if an option of the running command, given by its Python name, is on the command line.

    Options from variables or a file apply only where they fit: with two workers as default, one recording still works.
    """
    source = click.get_current_context().get_parameter_source(name)
    return source is click.core.ParameterSource.COMMANDLINE


def origin(error: click.UsageError) -> str:
    """Return the variable or file that set a value; empty for a value on the command line."""
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
    help="Default options, in one table per command; the command line and variables override them.",
)
