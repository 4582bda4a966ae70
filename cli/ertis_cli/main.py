"""The ``ertis`` command: find subcommands by name, and turn errors into one line and an exit code."""

import errno
import gc
import importlib
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, cast

import click

from ertis_cli import _config, _naming, _output, _own_output, _supervisor
from ertis_cli._stop_signals import interruption, obey_signals

__all__ = ["COMMANDS", "cli", "main"]

_SECTIONS = {
    "Start": {
        "demo": ("ertis_cli.demo:demo", "Run four emulated sensors, a central node and an application."),
        "doctor": ("ertis_cli.doctor:doctor", "Check this installation and suggest fixes."),
        "example": ("ertis_cli.example:example", "List or write example scenes, recordings and scripts."),
        "simulate": ("ertis_cli.simulate:simulate", "Simulate a scene and write a recording."),
    },
    "Sensors": {
        "sensors": ("ertis_cli.sensors:sensors", "List, check, calibrate, control and emulate sensors."),
        "capture": ("ertis_cli.capture:capture", "Record measurements, or send them to a central node."),
    },
    "Files": {
        "info": ("ertis_cli.info:info", "Show the contents of recordings, image files or maps."),
        "verify": ("ertis_cli.verify:verify", "Verify that files are intact, and list gaps and damage."),
        "import": ("ertis_cli.imports:imports", "Import signals, journals left by a crash, or poses into recordings."),
        "export": ("ertis_cli.export:export", "Export images or signals for other programs."),
    },
    "Results": {
        "process": ("ertis_cli.process:process", "Process recordings into energyscapes."),
        "acoustic": ("ertis_cli.acoustic:acoustic", "Process recordings of sound into acoustic maps."),
        "peaks": ("ertis_cli.peaks:peaks", "List the reflectors in an energyscape file."),
        "plot": ("ertis_cli.plot:plot", "Plot a measurement or an array."),
        "view": ("ertis_cli.view:view", "Show live or recorded images in a browser."),
        "compare": ("ertis_cli.compare:compare", "Compare an energyscape file or a map with the ground truth."),
    },
    "Several sensors": {
        "fuse": ("ertis_cli.fuse:fuse", "Fuse recordings of several sensors into one image per SYNC pulse."),
        "map": ("ertis_cli.mapping:mapping", "Compute an occupancy map from recordings and poses."),
        "odometry": ("ertis_cli.odometry:odometry", "Compute the trajectory of a platform from its echoes."),
    },
    "Network": {
        "record": ("ertis_cli.record:record", "Run a central node that stores measurements."),
        "serve": ("ertis_cli.serve:serve", "Run a central node that computes and publishes images."),
        "listen": ("ertis_cli.listen:listen", "Show or save the products that a central node publishes."),
        "ros": ("ertis_cli.ros:ros", "Publish images and points as live ROS 2 topics."),
        "keys": ("ertis_cli.keys:keys", "Create keys and manage the list of allowed keys."),
    },
    "Reference": {
        "reference": (
            "ertis_cli.reference:reference",
            "Print layouts, presets, the keys of settings, or a completion script.",
        ),
        "bench": ("ertis_cli.bench:bench", "Run benchmarks of speed and accuracy."),
    },
}
"""Commands in the order of the help: module and summary of each. A command is imported only when it runs."""

COMMANDS = dict(sorted(command for section in _SECTIONS.values() for command in section.items()))
"""Module and summary of each command, in alphabetical order."""

_GROUP_OF = {
    **dict.fromkeys(("calibrate", "check", "configure", "emulate", "reset", "rtisdev", "send", "status"), "sensors"),
    **dict.fromkeys(("completion", "layouts", "presets", "settings"), "reference"),
}
"""Commands that may be typed without their group."""
_ELSEWHERE = {
    **dict.fromkeys(("devices", "list"), "sensors list"),
    "command": "sensors send",
    "import-poses": "import poses",
    "recover": "import journals",
}
"""Commands that a user may look for at the top, and those that do the same."""

_FAILED, _USAGE, _INTERRUPTED = 1, 2, 130


class _Commands(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name][0].partition(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        _config.add_variables(command, (cmd_name,))
        _naming.name_options(command)
        _own_output.protect_inputs(command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name in _GROUP_OF:
            name, args = _GROUP_OF[name], [_GROUP_OF[name], *args]
        if not name.startswith("-") and name not in COMMANDS and not ctx.resilient_parsing:
            group = _ELSEWHERE.get(name)
            remedy = f"did you mean {group!r}?" if group else _config.instead(name, COMMANDS)
            ctx.fail(f"No such command {name!r} ({remedy})")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        width = max(map(len, COMMANDS))
        for title, section in _SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(width), about) for name, (_, about) in section.items()])

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,  # noqa: FBT001, FBT002  as click has it
        **extra: Any,
    ) -> Any:
        """Run a command and exit: 0 for success, 1 for failure, 2 for wrong usage, 130 for an interruption."""
        try:
            code = super().main(args, prog_name or "ertis", complete_var, standalone_mode=False, **extra)
        except click.exceptions.NoArgsIsHelpError as error:
            error.show()
            sys.exit(_USAGE)
        except Exception as error:
            if not standalone_mode:
                raise
            if not _is_interruption(error):
                _leave(*_reported(error))
            if interruption.code != _INTERRUPTED:
                sys.exit(interruption.code)
            _leave(_INTERRUPTED, "interrupted")
        sys.exit(code if isinstance(code, int) else 0)


def _is_interruption(error: Exception) -> bool:
    """Return True if a signal caused an error, directly or in a library.

    LLVM's callbacks swallow the exception of a signal. Numba then fails with an error that has no link to it.
    """
    return interruption.caused(error) or (interruption.code is not None and not _is_expected(error))


def _reported(error: Exception) -> tuple[int, str]:
    """Return the exit code and the message of an error; in development mode, raise a programming error again."""
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "ertis"
        return _USAGE, f"{error.format_message().rstrip('.')}{_config.origin(error)}; see '{path} --help'"
    if isinstance(error, click.ClickException):
        return _FAILED, error.format_message()
    if isinstance(error, click.Abort):
        return _INTERRUPTED, "interrupted"
    if _is_expected(error):
        return _FAILED, _of_system(error) or str(error) or type(error).__name__
    if sys.flags.dev_mode:
        raise error
    return _FAILED, _unexpected(error)


def _unexpected(error: Exception) -> str:
    """Return the type, text and place of a programming error; its cause is unknown, so nothing is blamed."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "ertis_" in frame.filename] or frames
    place = f"{Path(own[-1].filename).name}, line {own[-1].lineno}"
    return (
        f"unexpected {type(error).__name__}: {error} ({place}); report this as a bug, with the files that cause it and "
        "the output of the same command with PYTHONDEVMODE=1"
    )


def _of_system(error: Exception) -> str:
    """Return an operating-system error as file, cause and remedy; return an empty text for an error of the package."""
    from ertis_numba.base.atomic_files import remedy
    from ertis_numba.base.errors import ErtisError

    if isinstance(error, ErtisError) or not isinstance(error, OSError) or not error.strerror:
        return ""
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}; {remedy(error)}"
    # An error without a file name concerns stdout.
    return f"the output is full ({error.strerror}); {remedy(error)}" if error.errno == errno.ENOSPC else ""


def _is_expected(error: Exception) -> bool:
    """Return True if an error is reported in one line, and False for a programming error."""
    from ertis_numba.base.errors import ErtisError

    return isinstance(error, ErtisError | OSError | MemoryError)


def _leave(code: int, message: str) -> NoReturn:
    lines = filter(None, map(str.strip, _output.escaped(message).splitlines()))
    click.echo(f"ertis: error: {' '.join(lines)}", err=True)
    sys.exit(code)


def _print_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:  # noqa: FBT001  click calls it
    if wanted:
        import ertis_numba

        click.echo(f"ertis {ertis_numba.__version__}")
        ctx.exit()


@click.group("ertis", cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.option(
    "--version", is_flag=True, is_eager=True, expose_value=False, callback=_print_version, help="Print the version."
)
@_config.config
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Process in-air imaging sonar, from one-bit microphones to energyscapes.

    Results go to stdout, everything else to stderr. Exit codes: 0 success, 1 failure, 2 wrong usage, 130 interrupted.
    An option value that no file could suit is wrong usage.
    Options on the command line override environment variables such as ERTIS_PROCESS_MAX_ERROR. Variables override
    the file given with --config.
    """
    fault = _config.require_config(ctx)
    if fault:
        click.echo(f"ertis: warning: {fault}", err=True)
    for line in _config.unknown_variables(cast("click.Group", ctx.command), ctx):
        click.echo(f"ertis: warning: {line}", err=True)
    ctx.with_resource(warnings.catch_warnings())
    warnings.filterwarnings("ignore", "layout .* states no unit")  # A note says the same.


def main() -> None:
    """Run the command line."""
    _output.open_closed_streams()
    _output.replace_unencodable()
    _output.escape_names(sys.argv[1:])
    _output.draw_without_display()
    obey_signals()
    _supervisor.allow()
    # Imports create a hundred thousand permanent objects. Scanning them would take a twentieth of the run time.
    gc.set_threshold(100_000)
    try:
        cli.main()
    finally:
        interruption.end()


if __name__ == "__main__":
    main()
