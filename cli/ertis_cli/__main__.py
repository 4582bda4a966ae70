"""Entry point of the ``ertis`` command, also as ``python -m ertis_cli``."""

import sys


def main() -> None:
    """Install the signal handlers, then load and run the command line; by default, Ctrl-C would print a traceback."""
    import gc
    import signal

    gc.set_threshold(
        50_000
    )  # imports make hundreds of thousands of objects that stay; looking through them takes 60 ms
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the handlers are installed, after some imports
    from ertis_cli._signals import interruption, leave, obey_signals

    obey_signals()
    code: str | int | None = 0
    try:
        from ertis_cli.main import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("ertis: error: interrupted\n")
        code = 130
    except SystemExit as error:
        code = error.code
    finally:
        interruption.end()
    if interruption.asked and isinstance(code, int | None):
        leave(code or 0)
    sys.exit(code)


if __name__ == "__main__":
    main()
