"""``ertis sensors send``: send commands to a sensor."""

import click

from ertis_cli import options

__all__ = ["command"]


@click.command("send")
@click.option("--port", "-p", required=True, metavar="PORT", help="Path, serial number or name of the sensor.")
@click.argument("texts", nargs=-1, required=True, metavar="TEXT...")
@options.as_json
def command(*, port: str, texts: tuple[str, ...], as_json: bool) -> None:
    """Send commands to a sensor and print its answers.

    A command is a line such as '!Y,0,0,0'. The documentation of the serial protocol lists the known commands. The
    command that starts a measurement is refused; use 'ertis capture' instead. 'ertis capture' configures the sensor
    again, so it replaces settings that you changed with 'ertis sensors send'.
    """
    from ertis_numba.devices.commands import CustomCommand
    from ertis_numba.devices.driver import SonarDriver

    for text in texts:
        CustomCommand(text)
    with SonarDriver.open(port) as sonar:
        for text in texts:
            answer = sonar.command(text)
            if as_json:
                options.print_json({"command": text, "answer": answer})
            else:
                click.echo(str(answer))
