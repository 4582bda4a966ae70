"""``ertis sensors list``: list plugged-in and emulated sensors."""

from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _tables, options

if TYPE_CHECKING:
    from ertis_numba.devices.survey import Answer

__all__ = ["devices"]

_COLUMNS: dict[str, _tables.Side] = dict.fromkeys(
    ("port", "serial number", "state", "firmware", "call", "description"), "left"
)


@click.command("list")
@click.option("--port", "-p", "names", multiple=True, metavar="PORT", help="Query this port only; repeatable.")
@options.as_json
def devices(*, names: tuple[str, ...], as_json: bool) -> None:
    """List plugged-in and emulated eRTIS devices.

    The command queries USB CDC-ACM ports for their firmware and the hash of their call. This stops a device that still
    measures for a program that has ended. Ports that another program uses are listed but not queried. With --port, the
    command also queries any other serial port, given by its path, serial number or name.

    The exit code is 0 even if no device is found. With --port, it is 1 unless each port is an eRTIS or in use.
    """
    from ertis_numba.devices.ports import find_ports, resolve
    from ertis_numba.devices.survey import survey

    found = [resolve(name) for name in names] if names else [port for port in find_ports() if port.may_be_sonar]
    answers = survey(found)
    listed = [answer for answer in answers if names or answer.state != "no answer"]
    if as_json:
        options.print_json({"devices": [_report(answer) for answer in listed]})
    elif listed:
        _tables.TextTable(_COLUMNS, [_row(answer) for answer in listed]).print()
    for answer in answers:
        if not names and answer.error is not None and answer.state != "in use":
            click.echo(str(answer.error), err=True)
    if not listed:
        click.echo("no eRTIS found; plug one in, or start an emulated one with 'ertis sensors emulate'", err=True)
    for answer in answers:
        if names and answer.error is not None and answer.state != "in use":
            raise answer.error


def _report(answer: "Answer") -> dict[str, Any]:
    port = answer.port
    return {
        "port": port.path,
        "link": port.link,
        "serial_number": port.serial_number,
        "description": port.description,
        "emulated": port.emulated,
        "state": answer.state,
        "firmware": answer.firmware,
        "call_hash": answer.call_hash,
    }


def _row(answer: "Answer") -> tuple[str, ...]:
    port = answer.port
    call = "-" if answer.call_hash is None else f"{answer.call_hash:#06x}"
    return (
        port.path,
        port.serial_number or "-",
        answer.state,
        answer.firmware or "-",
        call,
        port.description or "-",
    )
