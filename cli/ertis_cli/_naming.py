"""Replacement of parameter names by option names in errors: ``--min-level`` for ``min_level_db``."""

import functools
import re
from collections.abc import Callable
from typing import Any

import click

from ertis_cli._config import long_name

__all__ = ["name_options"]

_UNITS = ("", "_bytes", "_c", "_db", "_deg", "_hz", "_m", "_ms", "_s")
_NAMED = re.compile(r"(?P<before>option )?(?P<quote>'?)(?P<name>[a-z_]+)(?P=quote)(?= (?:is|holds|runs from)\b)")


@functools.cache  # once per command
def name_options(command: click.Command) -> None:
    """Let the errors of a command and its subcommands name options as the user types them."""
    if isinstance(command, click.Group):
        for each in command.commands.values():
            name_options(each)
    elif command.callback is not None:
        command.callback = _naming(command.callback)


def _naming(callback: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(callback)
    def call(*arguments: Any, **options: Any) -> Any:
        try:
            return callback(*arguments, **options)
        except ValueError as error:  # a builtin, so that the package need not be imported
            from ertis_numba.errors import ArgumentError

            if isinstance(error, ArgumentError):
                error.args = (_named(str(error), click.get_current_context()), *error.args[1:])
            raise

    return call


def _named(message: str, ctx: click.Context) -> str:
    """Return a message with the leading parameter name replaced by the name of the given option."""
    found = _NAMED.match(message)
    if found is None:
        return message
    for option in ctx.command.params:
        if isinstance(option, click.Option) and option.name and _is_given(option.name, ctx):
            names = {option.name + unit for unit in _UNITS}
            if found["name"] in names:
                return f"{found['before'] or ''}--{long_name(option)}{message[found.end() :]}"
    return message


def _is_given(name: str, ctx: click.Context) -> bool:
    return ctx.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT
