"""Reset line of a sensor on a pin of an NVIDIA Jetson (fact: rtisdev 2.16.0 uses pin 7 of the board)."""

import importlib
import time
from typing import Final

from ertis_numba.base.errors import SonarError

__all__ = ["RESET_PIN", "pulse_reset_pin"]

RESET_PIN: Final = 7
"""Pin of the board that the reset line of an eRTIS uses."""

_PULSE_S: Final = 1.0


def pulse_reset_pin(pin: int = RESET_PIN) -> None:
    """Set a pin, numbered as on the board, to 0 for a second, and to 1 again."""
    try:
        pins = importlib.import_module("Jetson.GPIO")
        pins.setmode(pins.BOARD)
        pins.setup(pin, pins.OUT, initial=pins.HIGH)
        try:
            pins.output(pin, pins.LOW)
            time.sleep(_PULSE_S)
        finally:  # Ctrl-C must not leave the sensor in its reset.
            pins.output(pin, pins.HIGH)
    except Exception as error:  # The library raises plain exceptions, also on other computers.
        raise SonarError(
            f"pin {pin} cannot be pulsed ({error}); on a Jetson, install Jetson.GPIO; elsewhere, choose another way to "
            "reset the sensor (pulse), or unplug it and plug it in again"
        ) from error
