"""Reset of a sensor that may not answer any more."""

import errno
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from ertis_numba.base.errors import SonarError
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.reset_pin import pulse_reset_pin

__all__ = ["reset_sensor"]

_RETRY_S: Final = 0.1
_SILENT: Final = {errno.ETIMEDOUT, errno.ENOENT}


@contextmanager
def reset_sensor(
    port: str, pulse: Callable[[], None] = pulse_reset_pin, *, within_s: float = 60.0
) -> Iterator[tuple[SonarDriver, bool]]:
    """Reset a sensor, even a missing one; yield its unconfigured driver and the result of `SonarDriver.reset`."""
    try:
        sonar = SonarDriver.open(port)
    except SonarError as error:
        if error.errno not in _SILENT:
            raise
    else:
        with sonar:
            yield sonar, sonar.reset(pulse, within_s=within_s)
        return
    pulse()
    with _opened(port, within_s) as sonar:
        yield sonar, True


def _opened(port: str, within_s: float) -> SonarDriver:
    """Return the driver of a silent sensor once it answers."""
    end_s = time.monotonic() + within_s
    while True:
        try:
            return SonarDriver.open(port)
        except SonarError as error:
            if error.errno not in _SILENT or time.monotonic() >= end_s:
                raise
        time.sleep(_RETRY_S)
