"""Images or acoustic maps from a central node: the latest of each sensor."""

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, Literal, Self

from ertis_numba import kernels
from ertis_numba.frames import AcousticMap, Energyscape
from ertis_numba.network.acoustic_map_subscriber import AcousticMapSubscriber
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.status import Status
from ertis_numba.network.subscriber import Arrival, Subscriber
from ertis_numba.storage.recording import Mounting
from ertis_numba.viewer._acoustic_maps import masked_note
from ertis_numba.viewer._result_notes import ResultNotes
from ertis_numba.viewer._shapes import Pose, ReceivedImage
from ertis_numba.viewer._time_steps import usual_s

if TYPE_CHECKING:
    from ertis_numba.network.messages import Product
    from ertis_numba.network.products import Item

__all__ = ["Live"]

_POLL_INTERVAL_S: Final = 0.1
_STOP_S: Final = 2.0
_SOON_S: Final = 3.0  # Delay before missing answers or sensors are reported.
_INTERVALS: Final = 9  # Number of intervals for the median, so that a single pause has no effect.


class Live:
    """Subscriber in a separate thread that keeps the latest image of each sensor, so that no queue grows.

    Parameters
    ----------
    address : str
        Address at which the central node publishes.
    sensors : str or sequence of str, optional
        All by default.
    keys : ClientKeys, optional
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Poses of sensors on their platform, in place of those that the central node sends.
    acoustic_maps : bool
        Show acoustic maps, which the thread makes from the measurements. Those with a call are used without its time.
    device : {"auto", "cpu", "cuda", "numpy"}
        Device that makes acoustic maps.

    Attributes
    ----------
    received : int
        Number of received images or maps.
    shows_maps : bool
        True for acoustic maps.

    Raises
    ------
    ArgumentError
        The address cannot be used, or needs keys.
    """

    is_playback: Literal[False] = False

    def __init__(
        self,
        address: str,
        *,
        sensors: Sequence[str] | None = None,
        keys: ClientKeys | None = None,
        mounting: Mapping[str, Mounting] | None = None,
        acoustic_maps: bool = False,
        device: Literal["auto", "cpu", "cuda", "numpy"] = "auto",
    ) -> None:
        self._given = {sensor: Pose.of(*place) for sensor, place in (mounting or {}).items()}
        self.title = address
        self.received, self.shows_maps = 0, acoustic_maps
        self._notes: deque[str] = deque(maxlen=16)
        self._subscriber: Subscriber[Item] | AcousticMapSubscriber
        if acoustic_maps:
            self._subscriber = AcousticMapSubscriber(
                address,
                sensors=sensors,
                keys=keys,
                on_note=self._notes.append,
                changes={"processing.mode": "passive"},
                device=device,
            )
        else:
            kernels.load_points()  # Importing Numba takes a second, in which the central node would drop images.
            # The status lists the sensors. If all are subscribed, it would only take the bandwidth of images.
            products: tuple[Product, ...] = ("energyscape", "status") if sensors else ("energyscape",)
            self._subscriber = Subscriber(
                address, sensors=sensors, products=products, keys=keys, on_note=self._notes.append
            )
        self._wanted = set([sensors] if isinstance(sensors, str) else sensors or ())
        self._begun_s = time.monotonic()
        self._connected_s: float | None = None  # Time of the first connection.
        self._is_reported = False  # The missing answer.
        self._turn = threading.Lock()
        self._waiting: dict[str, tuple[Energyscape | AcousticMap, Arrival]] = {}
        self._arrived_s: dict[str, deque[float]] = {}
        self._failure: Exception | None = None
        self._superseded = 0
        self._result_notes = ResultNotes()
        self._masked: set[str] = set()  # Sensors whose measurements have a call.
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ertis-view", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        if isinstance(self._subscriber, AcousticMapSubscriber):  # It is in use until the thread ends.
            self._thread.join()
        self._subscriber.close()
        self._thread.join(_STOP_S)

    @property
    def dropped(self) -> int:
        """Number of images that the central node has dropped because this viewer was too slow."""
        return self._subscriber.counts.dropped

    @property
    def skipped(self) -> int:
        """Number of received images that were not shown, because a later one of the same sensor replaced them."""
        return self._superseded

    @property
    def clock_s(self) -> float:
        """Current time, by the clock of the images."""
        return time.monotonic()

    @property
    def state(self) -> str:
        """Description of the connection."""
        return "live" if self.connected else "waiting for the central node"

    @property
    def connected(self) -> bool:
        """True if a central node answers."""
        return self._subscriber.connected

    def notes(self) -> list[str]:
        """Return new events of the connection.

        Events before the first answer are delayed, because `take` raises a refusal.
        """
        waited_s = time.monotonic() - self._begun_s
        if self._connected_s is None and not self.connected and (waited_s < _SOON_S or self._failure is not None):
            return []
        reported = []
        while self._notes:
            reported.append(self._notes.popleft())
        if self._connected_s is None and self.connected:
            self._connected_s = time.monotonic()
        if self._connected_s is None and not reported and not self._is_reported:
            reported.append(f"no publisher at {self.title} yet; is 'ertis serve' running?")
        self._is_reported = True
        return reported

    def take(self) -> list[ReceivedImage[Any]]:
        """Return new images, the latest of each sensor.

        Raises
        ------
        RefusedError
            The central node has refused this viewer from the start.
        """
        with self._turn:
            came, self._waiting = list(self._waiting.values()), {}
            between_s = {name: usual_s(arrived_s) for name, arrived_s in self._arrived_s.items()}
        if self._failure is not None:
            raise self._failure
        return [
            ReceivedImage(
                item,
                self._given.get(item.stamp.sensor) or Pose.of(arrival.translation_m, arrival.rotation_xyzw),
                arrival.arrived_ns / 1e9,
                between_s[item.stamp.sensor],
            )
            for item, arrival in came
        ]

    def latency_s(self, taken: Sequence[ReceivedImage[Any]]) -> float | None:
        """Return the time since the emission of the oldest of some images; None without timestamps."""
        known_ns = [each.image.stamp.timestamp_ns for each in taken if each.image.stamp.is_timed]
        return (time.time_ns() - min(known_ns)) / 1e9 if known_ns else None

    def _find_sensors(self, status: Status) -> None:
        """Report, once, the requested sensors that do not exist."""
        if not self._wanted or self._connected_s is None or time.monotonic() - self._connected_s < _SOON_S:
            return
        missing, self._wanted = self._wanted - status.sensors.keys(), set()
        if missing:
            there = f"choose one of {', '.join(sorted(status.sensors))}" if status.sensors else "no sensor is connected"
            self._notes.append(f"no sensor {', '.join(map(repr, sorted(missing)))} yet; {there}")

    def _run(self) -> None:
        try:
            while not self._closed.is_set():
                item = self._subscriber.receive(_POLL_INTERVAL_S)
                arrival = self._subscriber.latest
                if isinstance(item, Status):
                    self._find_sensors(item)
                if not isinstance(item, Energyscape | AcousticMap) or arrival is None:
                    continue
                sensor = item.stamp.sensor
                if isinstance(item, AcousticMap) and item.masked_s and sensor not in self._masked:
                    self._masked.add(sensor)
                    self._notes.append(masked_note(sensor))
                band_note = getattr(self._subscriber, "band_note", None)  # Of the last map.
                self._notes.extend(self._result_notes.of(item, band_note))
                with self._turn:
                    self.received += 1
                    self._superseded += sensor in self._waiting
                    self._waiting[sensor] = item, arrival
                    self._arrived_s.setdefault(sensor, deque(maxlen=_INTERVALS)).append(arrival.arrived_ns / 1e9)
        except Exception as error:  # noqa: BLE001  whoever looks is to know
            self._failure = error
