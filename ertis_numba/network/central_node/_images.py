"""Image processing of the central node, whose errors never stop the intake."""

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ertis_numba.network.messages import Data, Hello
from ertis_numba.network.status import Status
from ertis_numba.settings import Settings

if TYPE_CHECKING:
    from ertis_numba.network.processing import ImageProcessing

__all__ = ["Guarded"]

_Result = TypeVar("_Result")


class Guarded:
    """Image processing whose errors are reported and cost measurements at most."""

    def __init__(self, images: "ImageProcessing", on_error: Callable[[Exception], None]) -> None:
        self._images, self._on_error = images, on_error

    def _try(self, act: Callable[[], _Result], instead: _Result) -> _Result:
        try:
            return act()
        except Exception as error:  # noqa: BLE001  whatever it is, ingest goes on
            self._on_error(error)
            return instead

    def start(self, stopping: Callable[[], bool]) -> None:
        """Start; raise the errors of `ImageProcessing.start`."""
        self._images.start(stopping)

    def require_usable(self, settings: Settings) -> None:
        """Raise an ArgumentError if no image can be computed with the settings; any thread may call this."""
        self._images.require_usable(settings)

    def register(self, hello: Hello, settings: Settings) -> None:
        """Register a sensor."""
        self._try(lambda: self._images.register(hello, settings), None)

    def offer(self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int) -> None:
        """Accept a measurement."""
        self._try(lambda: self._images.offer(data, words, arrived_ns), None)

    def fds(self) -> list[int]:
        """Return the descriptors to poll."""
        return self._try(lambda: list(self._images.fds()), [])

    def ready(self, fd: int) -> None:
        """Read from a descriptor."""
        self._try(lambda: self._images.ready(fd), None)

    def tick(self, now_s: float) -> None:
        """Do periodic work."""
        self._try(lambda: self._images.tick(now_s), None)

    def drain_dropped(self) -> list[tuple[str, int, int, str]]:
        """Return new drops."""
        return self._try(self._images.drain_dropped, [])

    def refused(self) -> Counter[str]:
        """Return refused applications, by reason."""
        return self._try(lambda: Counter(self._images.refused), Counter())

    def fill(self, status: Status) -> None:
        """Add the state of processing to a status."""
        self._try(lambda: self._fill(status), None)

    def _fill(self, status: Status) -> None:
        status.processing = self._images.status()
        for name, sensor in status.sensors.items():
            counts = self._images.counts(name)
            sensor.published, sensor.passive = counts.published, counts.passive
            sensor.dropped = dict(counts.dropped)
            sensor.in_flight, sensor.queue = counts.in_flight, counts.queue
            sensor.image_latency = counts.latency

    def publish_status(self, status: Status) -> None:
        """Publish the status to applications."""
        self._try(lambda: self._images.publish_status(status), None)

    def close(self, timeout_s: float) -> None:
        """Close."""
        self._try(lambda: self._images.close(timeout_s), None)
