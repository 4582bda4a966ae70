"""``ertis sensors rtisdev``: run an unchanged script for RTIS Dev."""

import os
import runpy
import signal
import sys
from pathlib import Path
from types import TracebackType

import click

from ertis_cli import _output, options

__all__ = ["rtisdev"]


@click.command(context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False})
@click.option(
    "--port",
    metavar="NAME",
    help="Port to open instead of the one in the script, such as an emulated sensor.",
)
@options.device
@click.option(
    "--method",
    type=click.Choice(["exact", "fast"]),
    help="exact, the default: the script's filters. fast: this package's chain where possible; images differ slightly.",
)
@click.argument("script", type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar="SCRIPT.py")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED, metavar="ARGS...")
def rtisdev(*, port: str | None, device: str, method: str | None, script: Path, arguments: tuple[str, ...]) -> None:
    """Run a script for RTIS Dev.

    RTIS Dev is the package of the University of Antwerp for eRTIS sensors. Its scripts run unchanged and without a GPU,
    because ertis_numba.interop.rtisdev replaces the closed-source modules rtisserial and rtiscuda. The command
    needs the extra 'rtisdev'.
    """
    from ertis_numba.base.extras import extra

    if port is not None:
        os.environ["ERTIS_RTISDEV_PORT"] = port
    os.environ["ERTIS_RTISDEV_DEVICE"] = device
    if method is not None:
        os.environ["ERTIS_RTISDEV_METHOD"] = method
    with extra("rtisdev", "scripts for RTIS Dev need rtisdev"):
        _require("rtisdev")
    import ertis_numba.interop.rtisdev  # noqa: F401  puts our modules in the place of the closed ones

    # The script may handle signals itself, or catch KeyboardInterrupt and continue.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
            signal.signal(getattr(signal, name), signal.SIG_DFL)
    _output.restore_display()
    sys.argv = [str(script), *arguments]
    sys.path.insert(0, str(script.resolve().parent))
    try:
        runpy.run_path(str(script), run_name="__main__")
    except Exception as error:  # noqa: BLE001  reported as Python reports it
        error = error.with_traceback(_of_script(error.__traceback__, str(script)))
        sys.excepthook(type(error), error, error.__traceback__)
        sys.exit(1)


def _of_script(traceback: TracebackType | None, script: str) -> TracebackType | None:
    """Return a traceback from its first frame in the script on; None if the script has not begun."""
    while traceback is not None and traceback.tb_frame.f_code.co_filename != script:
        traceback = traceback.tb_next
    return traceback


def _require(module: str) -> None:
    """Raise ImportError if a module is not installed; it is not imported."""
    import importlib.util

    if importlib.util.find_spec(module) is None:
        raise ImportError(f"No module named {module!r}", name=module)
