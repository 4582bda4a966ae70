"""Survey of connected sensors: all ports are probed at once."""

import errno
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

from ertis_numba.base.errors import SonarError
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.devices.ports import Port

__all__ = ["Answer", "State", "survey"]

State = Literal["ready", "in use", "not allowed", "no answer"]
_STATES: dict[int | None, State] = {errno.EBUSY: "in use", errno.EACCES: "not allowed"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Result of probing a port."""

    port: Port
    state: State
    firmware: str = ""  # empty unless ready
    call_hash: int | None = None  # None unless ready
    error: SonarError | None = None  # reason why the sensor is not ready


def survey(ports: Iterable[Port], *, timeout_s: float = 0.3) -> list[Answer]:
    """Probe unused ports for sensors in less than a second; this stops a measurement for a host that has ended."""

    def ask(port: Port) -> Answer:
        try:
            with SonarDriver(port, timeout_s=timeout_s) as sonar:
                return Answer(port=port, state="ready", firmware=sonar.firmware, call_hash=sonar.call_hash())
        except SonarError as error:
            return Answer(port=port, state=_STATES.get(error.errno, "no answer"), error=error)

    wanted = list(ports)
    if not wanted:
        return []
    with ThreadPoolExecutor(len(wanted)) as pool:
        return list(pool.map(ask, wanted))
