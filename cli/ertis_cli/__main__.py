"""Run the command line as ``python -m ertis_cli``."""

from ertis_cli.main import main

main()
