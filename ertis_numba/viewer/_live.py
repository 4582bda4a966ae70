"""Images as a central node publishes them: the latest of each sensor."""

import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Final, Literal, Self

from ertis_numba.frames import Energyscape
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.subscriber import Arrival, Subscriber
from ertis_numba.viewer._shapes import Pose, Taken

__all__ = ["Live"]

_LOOK_S: Final = 0.1
_STOP_S: Final = 2.0


class Live:
    """Subscribes in a thread of its own and keeps the latest image of each sensor, so that no queue grows.

    Parameters
    ----------
    address : str
        Where the central node publishes.
    sensors : sequence of str, optional
        All by default.
    keys : ClientKeys, optional

    Raises
    ------
    ArgumentError
        The address cannot be used, or not without keys.
    """

    is_film: Literal[False] = False

    def __init__(self, address: str, *, sensors: Sequence[str] | None = None, keys: ClientKeys | None = None) -> None:
        self.title = address
        self._notes: deque[str] = deque(maxlen=16)
        self._subscriber: Subscriber[Energyscape] = Subscriber(
            address, sensors=sensors, products=("energyscape",), keys=keys, on_note=self._notes.append
        )
        self._turn = threading.Lock()
        self._waiting: dict[str, Arrival] = {}
        self._failure: Exception | None = None
        self._superseded = 0
        self._thread = threading.Thread(target=self._run, name="ertis-view", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.close()
        self._thread.join(_STOP_S)

    @property
    def received(self) -> int:
        """How many images have come."""
        return self._subscriber.counts.received

    @property
    def dropped(self) -> int:
        """How many images the central node has dropped, as this was too slow."""
        return self._subscriber.counts.dropped

    @property
    def skipped(self) -> int:
        """How many images have come and were not shown, as a later one of the same sensor came before."""
        return self._superseded

    @property
    def state(self) -> str:
        """What to tell of the connection."""
        return "live" if self._subscriber.connected else "waiting for the central node"

    def notes(self) -> list[str]:
        """Return what has happened to the connection since this was asked last."""
        told = []
        while self._notes:
            told.append(self._notes.popleft())
        return told

    def take(self) -> list[Taken]:
        """Return the images that have come since this was asked last, the latest of each sensor.

        Raises
        ------
        RefusedError
            The central node has refused this viewer from the start.
        """
        with self._turn:
            came, self._waiting = list(self._waiting.values()), {}
        if self._failure is not None:
            raise self._failure
        return [
            Taken(arrival.item, Pose(arrival.translation_m, arrival.rotation_xyzw), arrival.arrived_ns / 1e9)
            for arrival in came
            if isinstance(arrival.item, Energyscape)
        ]

    def latency_s(self, taken: Sequence[Taken]) -> float | None:
        """Return from the emission to now, of the oldest of some images; None where their time is not known."""
        first_ns = min((each.image.stamp.timestamp_ns for each in taken), default=0)
        return (time.time_ns() - first_ns) / 1e9 if first_ns else None

    def _run(self) -> None:
        try:
            while not self._subscriber.closed:
                image = self._subscriber.receive(_LOOK_S)
                arrival = self._subscriber.latest
                if image is None or arrival is None:
                    continue
                with self._turn:
                    self._superseded += image.stamp.sensor in self._waiting
                    self._waiting[image.stamp.sensor] = arrival
        except Exception as error:  # noqa: BLE001  whoever looks is to know
            self._failure = error
