"""Refusal of outputs that would overwrite any input of a command, such as its settings or its trajectory."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

__all__ = ["protect_inputs"]

_OUTPUTS = {"--output", "--save", "--save-html"}


def protect_inputs(command: click.Command) -> None:
    """Let a command refuse an output that is the same file as another parameter, even with --force."""
    for each in command.commands.values() if isinstance(command, click.Group) else ():
        protect_inputs(each)
    run = command.callback
    if run is None or hasattr(run, "protects_inputs") or not any(map(_is_output, command.params)):
        return

    @functools.wraps(run)
    def guarded(*args: Any, **values: Any) -> Any:
        _require_own_output(click.get_current_context())
        return run(*args, **values)

    guarded.protects_inputs = True  # type: ignore[attr-defined]  # A command is found several times in tests.
    command.callback = guarded


def _is_output(parameter: click.Parameter) -> bool:
    return bool(_OUTPUTS & {*parameter.opts})


def _require_own_output(ctx: click.Context) -> None:
    from ertis_numba.base.errors import ArgumentError

    parameters = [(each, ctx.params.get(each.name or "")) for each in ctx.command.params]
    inputs = [path for each, value in parameters if not _is_output(each) for path in _files(value)]
    outputs = [path for each, value in parameters if _is_output(each) for path in _files(value)]
    for output in outputs:
        if any(output.samefile(path) for path in inputs):
            raise ArgumentError(f"output {output} is the input itself; choose another name")


def _files(value: Any) -> Iterator[Path]:
    """Yield the existing files that the value of a parameter names."""
    for each in value if isinstance(value, tuple) else (value,):
        if isinstance(each, str | Path) and str(each) and "\0" not in str(each):
            path = Path(each)
            try:
                exists = path.is_file()
            except OSError:  # such as a name that is too long
                continue
            if exists:
                yield path
