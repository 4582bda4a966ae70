"""``ertis sensors reset``: reset the hardware of a sensor."""

import shlex
import subprocess
from collections.abc import Callable
from functools import partial

import click

from ertis_cli import options

__all__ = ["reset"]


@click.command()
@click.option("--port", "-p", required=True, metavar="PORT", help="Path, serial number or name of the sensor.")
@click.option("--pin", type=click.IntRange(1, 40), metavar="N", help="Number of the pin on the board; 7 by default.")
@click.option("--hook", metavar="COMMAND", help="Program, with arguments, that resets the sensor; no pin is used.")
@click.option(
    "--within",
    "within_s",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    metavar="S",
    help="Longest time in seconds to wait for the sensor.",
)
@options.quiet
def reset(*, port: str, pin: int | None, hook: str | None, within_s: float, quiet: bool) -> None:
    """Reset a sensor and wait until it answers again.

    By default, the command pulses the pin of an NVIDIA Jetson that is wired to the sensor's reset line. This needs the
    package Jetson.GPIO. The command also works if the sensor does not answer, or if its port is missing.
    """
    from ertis_numba.devices.reset import reset_sensor
    from ertis_numba.devices.reset_pin import RESET_PIN, pulse_reset_pin

    if hook is not None and pin is not None:
        raise click.UsageError("--hook and --pin are both given; choose one of them")
    if hook is not None and not hook.strip():
        raise click.UsageError("--hook is empty; name a program")
    pulse = partial(pulse_reset_pin, pin or RESET_PIN) if hook is None else _runner(hook)
    with reset_sensor(port, pulse, within_s=within_s) as (sonar, is_certain):
        options.say(f"{sonar.port} answers again: firmware {sonar.firmware}", quiet=quiet)
    if not is_certain:
        options.warn(
            f"{sonar.port} still has its call, so the reset has probably not reached it; check the pin "
            "(--pin) or the program (--hook)"
        )


def _runner(hook: str) -> Callable[[], None]:
    """Return a function that runs a program, and fails if the program does."""

    def run() -> None:
        try:
            subprocess.run(shlex.split(hook), check=True)  # noqa: S603  the user names the program
        except (OSError, ValueError, subprocess.CalledProcessError) as error:
            raise click.ClickException(f"--hook {hook!r} has failed ({error}); correct the command") from error

    return run
