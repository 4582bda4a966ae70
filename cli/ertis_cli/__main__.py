"""Entry point of the ``ertis`` command, also as ``python -m ertis_cli``."""

import gc
import os
import sys

_INTERRUPTED = 130


def main() -> None:
    """Install the signal handlers, then run the command line. By default, Ctrl-C would print a traceback."""
    try:
        code = _run()
    except KeyboardInterrupt:  # before the handlers are installed
        code = _interrupted()
    gc.freeze()  # the last collection would scan all modules and free nothing that matters; it takes 0.1 to 0.3 s
    sys.exit(code)


def _run() -> str | int | None:
    import signal

    # NumPy's idle threads wait for 2^26 cycles in a loop, which takes 0.3 s of a short command, or a core from others.
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "16")
    gc.set_threshold(50_000)  # imports create many permanent objects; scanning them takes 60 ms
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the handlers are installed, after some imports
    from ertis_cli._stop_signals import interruption, leave, obey_signals

    obey_signals()
    code: str | int | None = 0
    try:
        from ertis_cli.main import main as run

        run()
    except KeyboardInterrupt:
        code = _interrupted()
    except SystemExit as error:
        code = error.code
    except Exception as error:
        if not interruption.caused(error):
            raise
        # Python turns the exception of a signal into a RuntimeError while a class is created.
        code = _interrupted() if interruption.code == _INTERRUPTED else interruption.code
    finally:
        interruption.end()
    if interruption.asked and isinstance(code, int | None):
        leave(code or 0)
    return code


def _interrupted() -> int:
    sys.stderr.write("ertis: error: interrupted\n")
    return _INTERRUPTED


if __name__ == "__main__":
    main()
