"""Which sensors there are: all ports asked at once."""

import errno
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

from ertis_numba.devices.ports import Port
from ertis_numba.devices.sonar import SonarDriver
from ertis_numba.errors import SonarError

__all__ = ["Answer", "State", "survey"]

State = Literal["ready", "in use", "not allowed", "no answer"]
_STATES: dict[int | None, State] = {errno.EBUSY: "in use", errno.EACCES: "not allowed"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What became of asking a port.

    Attributes
    ----------
    port : Port
    state : {"ready", "in use", "not allowed", "no answer"}
    firmware : str
        Empty unless the sensor is ready, as with the next.
    call_hash : int or None
        Of the call that it holds.
    error : SonarError or None
        Why it is not ready.
    """

    port: Port
    state: State
    firmware: str = ""
    call_hash: int | None = None
    error: SonarError | None = None


def survey(ports: Iterable[Port], *, timeout_s: float = 0.3) -> list[Answer]:
    """Ask ports whether there is a sensor, in less than a second.

    A measurement that goes on for a host that has ended is ended by that; those in use are left alone.

    Parameters
    ----------
    ports : iterable of Port
    timeout_s : float
        How long an answer may take.
    """

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
