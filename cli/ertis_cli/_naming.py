"""Names and exit codes of refused option values: ``--min-level is 3`` and 2 for ``min_level_db is 3``."""

import functools
import math
import re
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import click

from ertis_cli._config import long_name

__all__ = ["name_options", "named", "require_no_pipes", "with_options"]

_UNITS: Final = ("", "_bytes", "_c", "_db", "_deg", "_hz", "_limits_deg", "_m", "_ms", "_ns", "_s")
_KEY: Final = r"(?P<section>(?:accuracy|air|array|passive|processing|scene)\.)?(?P<name>[a-z_]+)"
_NAMED: Final = re.compile(
    rf"(?P<before>option |parameter of )?(?P<quote>'?){_KEY}(?P=quote)(?:\[\d+\])?"
    r"(?(section)(?= )|(?= (?:is|holds|runs from)\b))"
)
_AGAIN: Final = re.compile(rf"(?<![\w./-]){_KEY}(?:\[\d+\])?(?![\w./])")
_OF_MAPS: Final = "passive_"
"""Parameters of acoustic maps begin with it, and their keys with ``passive.``"""
_KEYS: Final = {"without": "disabled"}
"""Keys of settings whose option has another name."""
_PYTHON: Final = {
    "attitude_xyzw": "level",
    "check_kind": "raw",
    "keys": "key",
    "level_directions": "no-level",
    "mountings": "mounting",
    "overwrite": "force",
    "pulse": "hook",
    "replace": "force",
    "server": "server-key",
    "spool_bytes": "spool-size",
}
"""Parameters of the package whose option has another name."""
_PARAMETER: Final = re.compile(
    r"(?<![\w.'/-])(?:(?P<name>[a-z]+(?:_[a-z]+)*)(?:=(?P<value>True|False|'[^']*'|[\d.]+))|"
    r"(?P<words>[a-z]+(?:_[a-z]+)+)|\((?P<hints>[a-z_]+(?:, [a-z_]+)*)\))(?![\w'(=/]|\.\w)"
)
"""Parameters in messages of the package: ``overwrite=True``, ``length_s``, or ``(sensor)`` after a remedy."""
_TYPED: Final = re.compile(
    r"(?:parameter of )?--(?P<name>[a-z-]+) "
    r"(?:'.*?' (?:cannot|is unknown)\b|(?:[a-z]+ )?(?:is|has|holds|lists|runs from) [^,;]*; "
    r"(?:add|choose|pass|set|use|write)\b)"
)
"""Messages about a value that is wrong by itself: other reasons follow a comma."""
_QUOTED: Final = re.compile(
    r"(?!sensor ['\"])(?:count of )?(?P<name>[a-z_]+)(?: name)? (?P<quote>['\"])(?P<value>.*?)(?P=quote) "
    r"(?:cannot (?:be used|name)|has (?:no count|a count of)|is (?:not a grid|unknown|\d+;))"
)
"""The same for quoted values, such as ``layout 'eRTIS_v9' is unknown``; sensors depend on files."""
_OF_FILES: Final = frozenset({"--measurement", "--without"})
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
        _require_values(click.get_current_context())
        require_no_pipes(options)
        try:
            return callback(*arguments, **options)
        except Exception as error:
            from ertis_numba.base.errors import ArgumentError, ErtisError

            if not isinstance(error, ErtisError) or not error.args:
                raise
            ctx = click.get_current_context()
            message = with_options(named(str(error), ctx) if isinstance(error, ArgumentError) else str(error))
            option = _refused(message, ctx) if isinstance(error, ArgumentError) else None
            if option is not None and max(option.opts, key=len) not in _OF_FILES:
                raise _usage_error(message, option, ctx) from error
            error.args = (message, *error.args[1:])
            raise

    return call


def _require_values(ctx: click.Context) -> None:
    """Raise an error for empty texts, and for NaN and infinity, which lie within the ranges of click."""
    for option in _given(ctx):
        value, name = ctx.params.get(str(option.name)), _typed_name(option)
        for each in value if isinstance(value, tuple) else (value,):
            if isinstance(each, float) and not math.isfinite(each):
                raise _usage_error(f"{name} is {each}; use a finite number", option, ctx)
            if each == "":
                raise _usage_error(f"{name} is empty; write a value, or leave it out", option, ctx)


def _typed_name(option: click.Parameter) -> str:
    return (
        f"--{long_name(option)}"
        if isinstance(option, click.Option)
        else option.make_metavar(click.get_current_context())
    )


def _usage_error(message: str, option: click.Parameter, ctx: click.Context) -> click.UsageError:
    error = click.UsageError(message, ctx=ctx)
    error.param = option  # type: ignore[attr-defined]  # as for click.BadParameter
    return error


def named(message: str, ctx: click.Context) -> str:
    """Return a message with the leading parameter name, and then others, replaced by the names of given options."""
    found = _NAMED.match(message)
    names = dict(_names(ctx))
    if found is None or _key(found) not in names or not _may_be_typed(found, ctx):
        return message

    def again(other: re.Match[str]) -> str:
        is_key = other["section"] or "_" in other["name"]  # other words are no names
        return names.get(_key(other), other[0]) if is_key else other[0]

    return f"{found['before'] or ''}{names[_key(found)]}{_AGAIN.sub(again, message[found.end() :])}"


def with_options(message: str, ctx: click.Context | None = None) -> str:
    """Return a message of the package with the options of the running command in place of parameters of Python."""
    # `overwrite=True` becomes `--force`. Threads other than the main one must pass the context of their command.
    ctx = ctx or click.get_current_context(silent=True)
    if ctx is None:
        return message
    options = dict(_options_by_parameter(ctx.command))

    def typed(found: re.Match[str]) -> str:
        if found["hints"]:
            names = found["hints"].split(", ")
            return f"({', '.join(options[name] for name in names)})" if options.keys() >= {*names} else found[0]
        option = options.get(found["name"] or found["words"])
        value = (found["value"] or "").strip("'")
        return found[0] if option is None else option if value in {"", "True", "False"} else f"{option} {value}"

    return _PARAMETER.sub(typed, message)


def _options_by_parameter(command: click.Command) -> Iterator[tuple[str, str]]:
    """Yield the parameters of the package for which the options of a command stand."""
    for option in command.params:
        if isinstance(option, click.Option):
            typed = {name.lstrip("-") for name in (*option.opts, *option.secondary_opts)}
            for name in {long_name(option).replace("-", "_"), str(option.name)}:
                yield from ((f"{name}{unit}", f"--{long_name(option)}") for unit in _UNITS)
            yield from ((name, f"--{other}") for name, other in _PYTHON.items() if other in typed)


def _may_be_typed(found: re.Match[str], ctx: click.Context) -> bool:
    """Return False for a channel that only the settings exclude."""
    channels = ctx.params.get("without")
    value = re.match(r" is (\d+)", found.string[found.end() :])
    return found["name"] != _KEYS["without"] or not (channels and value) or int(value[1]) in channels


def _key(found: re.Match[str]) -> str:
    """Return a name in a message, in which keys of acoustic maps differ from those of images."""
    return (_OF_MAPS if found["section"] == "passive." else "") + found["name"]


def _names(ctx: click.Context) -> Iterator[tuple[str, str]]:
    """Yield each parameter name that may stand for a given option, and the option as typed."""
    for option in _given(ctx):
        if isinstance(option, click.Option):
            name = long_name(option)
            is_of_maps = str(option.name).startswith(_OF_MAPS)
            typed = f"{_OF_MAPS if is_of_maps else ''}{name.replace('-', '_')}"
            for each in {str(option.name), typed, _KEYS.get(name, typed)}:
                yield from ((f"{each}{unit}", f"--{name}") for unit in _UNITS)


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


def require_no_pipes(options: Mapping[str, Any]) -> None:
    """Raise ArgumentError if an option or argument is a named pipe; those of a shell, such as ``<(…)``, are allowed."""
    for path in _paths(list(options.values())):
        try:
            is_pipe = stat.S_ISFIFO(path.stat().st_mode)
        except (OSError, ValueError):  # missing, or no path at all
            continue
        if is_pipe and path.parts[:2] not in {("/", "dev"), ("/", "proc")}:
            from ertis_numba.base.errors import ArgumentError

            raise ArgumentError(f"{path} is a named pipe; write its content to a file, and use the file")


def _paths(value: Any) -> Iterator[Path]:
    if isinstance(value, list | tuple):
        for each in value:
            yield from _paths(each)
    elif isinstance(value, str | Path) and str(value):
        yield Path(value)
