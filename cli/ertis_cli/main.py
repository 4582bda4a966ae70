"""The ``ertis`` command: finds its commands by name, and turns errors into one line and an exit code."""

import errno
import gc
import importlib
import sys
from collections.abc import Sequence
from typing import Any, NoReturn, cast

import click

from ertis_cli import _config, _naming, _supervisor
from ertis_cli._signals import interruption, obey_signals

__all__ = ["COMMANDS", "cli", "main"]

COMMANDS = {
    "bench": ("ertis_cli.bench:bench", "Measure this machine; results are checked before they are timed."),
    "capture": ("ertis_cli.capture:capture", "Take measurements of sensors into a recording."),
    "compare": ("ertis_cli.compare:compare", "Say how far an energyscape file is from the truth."),
    "completion": ("ertis_cli.completion:completion", "Print what makes a shell complete commands and options."),
    "demo": ("ertis_cli.demo:demo", "Run four emulated sensors, a central node and an application."),
    "devices": ("ertis_cli.devices:devices", "List the eRTIS devices that are plugged in or emulated."),
    "doctor": ("ertis_cli.doctor:doctor", "Look whether this machine has what it takes, and say what to do."),
    "emulate": (
        "ertis_cli.emulate:emulate",
        "Be the sensors of a scene or of a recording, until interrupted.",
    ),
    "example": ("ertis_cli.example:example", "List or copy shipped scenes, recordings and scripts."),
    "export": ("ertis_cli.export:export", "Write a file for other programs."),
    "import": ("ertis_cli.import_raw:import_raw", "Turn raw eRTIS words, or PCM of other arrays, into a recording."),
    "info": ("ertis_cli.info:info", "Say what a recording or an energyscape file holds."),
    "keys": ("ertis_cli.keys:keys", "Make keys, and say who may do what."),
    "layout": ("ertis_cli.layout:layout", "List the shipped layouts, or print one as TOML."),
    "listen": ("ertis_cli.listen:listen", "Show or save what a central node publishes at ADDRESS."),
    "peaks": ("ertis_cli.peaks:peaks", "List the reflectors in an energyscape file."),
    "plot": ("ertis_cli.plot:plot", "Draw a measurement."),
    "process": ("ertis_cli.process:process", "Turn a recording into energyscapes."),
    "record": ("ertis_cli.record:record", "Be the central node that stores what sensors send."),
    "recover": ("ertis_cli.recover:recover", "Recover recordings from journals left by a crash."),
    "serve": ("ertis_cli.serve:serve", "Be the central node that makes images of what sensors send."),
    "settings": ("ertis_cli.settings:settings", "Print every key of a settings, scene, layout or mounting file."),
    "simulate": ("ertis_cli.simulate:simulate", "Turn a scene into a recording."),
    "status": ("ertis_cli.status:status", "Show how the central node at ADDRESS is, live on a terminal."),
    "verify": ("ertis_cli.verify:verify", "Check every measurement of a file, and what is missing."),
    "view": ("ertis_cli.view:view", "Show what sensors see on a page in the browser."),
}
"""Where each command is, and what its help says first: commands are imported when they are run."""

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
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if not name.startswith("-") and name not in COMMANDS and not ctx.resilient_parsing:
            ctx.fail(f"No such command {name!r} ({_config.instead(name, COMMANDS)})")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in sorted(COMMANDS)])

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,  # noqa: FBT001, FBT002  as click has it
        **extra: Any,
    ) -> Any:
        """Run, and leave with an exit code: 0 done, 1 failed, 2 wrong usage, 130 interrupted."""
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
    """Return the exit code of an error and the line to tell it; raise again what is a mistake in the program."""
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx else "ertis"
        return _USAGE, f"{error.format_message().rstrip('.')}{_config.origin(error)}; see '{path} --help'"
    if isinstance(error, click.ClickException):
        return _FAILED, error.format_message()
    if isinstance(error, click.Abort):
        return _INTERRUPTED, "interrupted"
    if _is_expected(error):
        return _FAILED, _of_system(error) or str(error) or type(error).__name__
    raise error


def _of_system(error: Exception) -> str:
    """Return an error of the system as ours are told: what it is about, what came, the remedy; empty if it is ours."""
    from ertis_numba.atomic_files import remedy
    from ertis_numba.errors import ErtisError

    if isinstance(error, ErtisError) or not isinstance(error, OSError) or not error.strerror:
        return ""
    if error.filename is not None:
        return f"{error.filename}: {error.strerror}; {remedy(error)}"
    # What has no name but could be full is what stdout goes to.
    return f"the output is full ({error.strerror}); {remedy(error)}" if error.errno == errno.ENOSPC else ""


def _is_expected(error: Exception) -> bool:
    """Whether an error is one to tell in a line, rather than a mistake in the program."""
    from ertis_numba.errors import ErtisError

    return isinstance(error, ErtisError | OSError | MemoryError)


def _leave(code: int, message: str) -> NoReturn:
    click.echo(f"ertis: error: {' '.join(message.split())}", err=True)
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
    """Imaging sonar in air: from one-bit microphones to energyscapes.

    Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 failed, 2 wrong usage,
    130 interrupted. Options come from the command line, then from variables such as ERTIS_PROCESS_MAX_ERROR,
    then from the file of --config.
    """
    fault = _config.require_config(ctx)
    if fault:
        click.echo(f"ertis: warning: {fault}", err=True)
    for line in _config.unknown_variables(cast("click.Group", ctx.command), ctx):
        click.echo(f"ertis: warning: {line}", err=True)


def main() -> None:
    """Run the command line."""
    obey_signals()
    _supervisor.allow()
    # Libraries make a hundred thousand objects that stay: to look through them is a twentieth of a command's time.
    gc.set_threshold(100_000)
    try:
        cli.main()
    finally:
        interruption.end()


if __name__ == "__main__":
    main()
