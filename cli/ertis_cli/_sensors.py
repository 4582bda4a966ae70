"""Opening and configuration of the sensors on serial ports, for the commands that measure."""

import errno
import re
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ertis_cli import options
from ertis_cli._stop_signals import Signals

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from ertis_numba.devices.bits import BitCheck
    from ertis_numba.devices.driver import SonarDriver
    from ertis_numba.devices.setup import Setup
    from ertis_numba.settings import Settings

__all__ = ["ConfiguredSensors", "named_sensors", "opened_sensors", "require_one_each", "wait_for"]

_POLL_INTERVAL_S = 0.1  # interval between searches for ports


def require_one_each(ports: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Refuse a port that is given twice, and names that are not those of all ports."""
    for port in ports:
        if ports.count(port) > 1:
            raise click.UsageError(f"port {port} is given {ports.count(port)} times; name each sensor once")
    if names and len(names) != len(ports):
        raise click.UsageError(f"{len(names)} names are given for {len(ports)} ports; use one --name for each --port")
    from ertis_numba.base import checks

    for name in names:
        checks.sensor_name(name)


def wait_for(ports: tuple[str, ...], wait_s: float, signals: Signals, *, quiet: bool) -> None:
    """Wait until all ports exist; raise an error for the first port that is missing after ``wait_s``."""
    from ertis_numba.base.errors import SonarError
    from ertis_numba.devices.ports import resolve

    end_s = time.monotonic() + wait_s
    with options.note_when_slow(f"waiting for {', '.join(ports)} ...", quiet=quiet):
        for port in ports:
            while True:
                if signals.came:
                    signals.end()
                try:
                    resolve(port)
                    break
                except SonarError as error:
                    if error.errno != errno.ENOENT or time.monotonic() >= end_s:
                        raise
                time.sleep(_POLL_INTERVAL_S)


@contextmanager
def _interruptible(signals: Signals) -> "Iterator[Callable[[], bool]]":
    """Yield a function that returns True once a signal has arrived; a failed dialogue then ends the command."""
    from ertis_numba.base.errors import SonarError

    try:
        yield lambda: bool(signals.came)
    except SonarError:
        if signals.came:
            signals.end()
        raise


def opened_sensors(
    ports: "Sequence[str]", signals: Signals, stack: ExitStack, *, listen_only: bool
) -> "list[SonarDriver]":
    """Return the drivers of the sensors on some ports; the stack closes them."""
    from ertis_numba.devices.driver import SonarDriver

    with _interruptible(signals) as asked:
        return [stack.enter_context(SonarDriver.open(port, listen_only=listen_only, stop=asked)) for port in ports]


def named_sensors(
    ports: tuple[str, ...], names: tuple[str, ...], opened: "list[SonarDriver]"
) -> "dict[str, SonarDriver]":
    """Return sensors by name: the given names, or else their serial numbers or the names of their ports."""
    known = [sonar.serial_number or Path(port).name for port, sonar in zip(ports, opened, strict=True)]
    chosen = list(names) or [re.sub(r"[^A-Za-z0-9_.@+-]", "_", name) for name in known]
    for name in chosen:
        if chosen.count(name) > 1:
            raise click.UsageError(f"{chosen.count(name)} sensors are named {name!r}; use a different --name for each")
    return dict(zip(chosen, opened, strict=True))


class ConfiguredSensors:
    """Sensors of a capture, which can be configured again, with checks of their bits, if any."""

    def __init__(
        self,
        sonars: "dict[str, SonarDriver]",
        setup_of: "Callable[[Settings], Setup]",
        *,
        check_bits: bool,
        splices: bool,
    ) -> None:
        self._sonars, self._setup_of = sonars, setup_of
        self._check_bits, self._splices = check_bits, splices
        self.checks: dict[str, BitCheck] = {}

    def configure(self, name: str, settings: "Settings", stop: "Callable[[], bool]" = lambda: False) -> None:
        """Configure one sensor."""
        setup, check = self._setup_of(settings), None
        if self._check_bits:
            self.checks[name] = self._check(settings)
            check = self.checks[name].check
        self._sonars[name].configure(setup, bits=check, stop=stop)

    def configure_all(self, settings: "Settings", signals: Signals) -> None:
        """Configure all sensors; a signal ends the command."""
        with _interruptible(signals) as asked:
            for name in self._sonars:
                self.configure(name, settings, stop=asked)

    def _check(self, settings: "Settings") -> "BitCheck":
        import numpy as np

        from ertis_numba.devices.bits import BitCheck
        from ertis_numba.geometry import microphones

        recording, given = settings.recording, microphones(settings.array).enabled
        enabled = np.zeros(32, dtype=bool)
        enabled[: len(given)] = given
        return BitCheck(recording.n_samples, recording.sample_rate_hz, enabled, splices=self._splices)
