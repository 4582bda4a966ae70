"""Entry point of the ``ertis`` command, also as ``python -m ertis_cli``."""

import sys

from ertis_cli._signals import obey_signals


def main() -> None:
    """Obey signals, then load the command line and run it: Python itself would answer Ctrl-C with a traceback."""
    obey_signals()
    try:
        from ertis_cli.main import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("ertis: error: interrupted\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
