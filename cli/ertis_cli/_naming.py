"""Names and exit codes of refused option values: ``--min-level is 3`` and 2 for ``min_level_db is 3``."""

import functools
import re
from collections.abc import Callable, Iterator
from typing import Any, Final

import click

from ertis_cli._config import long_name

__all__ = ["name_options"]

_UNITS: Final = ("", "_bytes", "_c", "_db", "_deg", "_hz", "_m", "_ms", "_s")
_NAMED: Final = re.compile(
    r"(?P<before>option )?(?P<quote>'?)(?:(?:accuracy|air|processing)\.)?(?P<name>[a-z_]+)(?P=quote)"
    r"(?= (?:is|holds|runs from)\b)"
)
_TYPED: Final = re.compile(r"--(?P<name>[a-z-]+) (?:'.*?' cannot\b|(?:is|holds|runs from) [^,;]*; give\b)")
"""Messages about a value that is wrong by itself: other reasons follow a comma."""
_QUOTED: Final = re.compile(
    r"(?!sensor ['\"])(?:count of )?(?P<name>[a-z_]+)(?: name)? (?P<quote>['\"])(?P<value>.*?)(?P=quote) "
    r"(?:cannot (?:be used|name)|has no count|is (?:not a grid|unknown|\d+;))"
)
"""The same for quoted values, such as ``layout 'eRTIS_v9' is unknown``; sensors depend on files."""
_OF_FILES: Final = frozenset({"--measurement"})
"""Options whose limits are those of a file. A value beyond them is no wrong usage."""


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

            if not isinstance(error, ArgumentError):
                raise
            ctx = click.get_current_context()
            message = _named(str(error), ctx)
            option = _refused(message, ctx)
            if option is not None and max(option.opts, key=len) not in _OF_FILES:
                usage = click.UsageError(message, ctx=ctx)
                usage.param = option  # type: ignore[attr-defined]  # as for click.BadParameter
                raise usage from error
            error.args = (message, *error.args[1:])
            raise

    return call


def _named(message: str, ctx: click.Context) -> str:
    """Return a message with the leading parameter name replaced by the name of the given option."""
    found = _NAMED.match(message)
    if found is None:
        return message
    for option in _given(ctx):
        if isinstance(option, click.Option) and found["name"] in {f"{option.name}{unit}" for unit in _UNITS}:
            return f"{found['before'] or ''}--{long_name(option)}{message[found.end() :]}"
    return message


def _refused(message: str, ctx: click.Context) -> click.Parameter | None:
    """Return the given parameter whose value a message refuses, whatever the files contain; None if there is none."""
    typed, quoted = _TYPED.match(message), _QUOTED.match(message)
    for option in _given(ctx):
        if typed and isinstance(option, click.Option) and typed["name"] == long_name(option):
            return option
        names = {option.name, str(option.name).removesuffix("s")}
        if quoted and (quoted["name"] in names or (message.startswith("sensor name ") and "name" in names)):
            values = ctx.params.get(str(option.name))
            if quoted["value"] in map(str, values if isinstance(values, tuple) else [values]):
                return option
    return None


def _given(ctx: click.Context) -> Iterator[click.Parameter]:
    """Yield the parameters that do not have their default."""
    for option in ctx.command.params:
        if option.name and ctx.get_parameter_source(option.name) is not click.core.ParameterSource.DEFAULT:
            yield option
