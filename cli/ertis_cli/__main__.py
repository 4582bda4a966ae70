"""Entry point of the ``ertis`` command, also as ``python -m ertis_cli``."""

import sys

from ertis_cli._signals import obey_signals


def main() -> None:
    """Install the signal handlers, then load and run the command line; by default, Ctrl-C would print a traceback."""
    obey_signals()
    try:
        from ertis_cli.main import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("ertis: error: interrupted\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
