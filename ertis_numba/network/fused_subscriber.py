"""Application node that fuses the images of all sensors as they arrive."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, Self, TypeAlias

from ertis_numba.errors import DataError
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.fusion import Fused, Fuser
from ertis_numba.fusion.pulses import PulseGroups
from ertis_numba.fusion.rig import Mountings
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.products import Arrival
from ertis_numba.network.subscriber import Subscriber, SubscriberCounts

__all__ = ["FusedArrival", "FusedSubscriber"]

_Place: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float, float]]

_POLL_S: Final = 0.05
_PATIENCE_S: Final = 0.25  # Time after which a pulse is fused without the images that are missing.
_MAX_WAITING: Final = 2  # Pulses that wait here; a slow application gets the latest ones.
_CREDIT: Final = 16  # Images under way: those of two pulses of eight sensors.
_STOP_S: Final = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class FusedArrival:
    """A fused pulse with its times.

    Attributes
    ----------
    fused : Fused
    first_ns : int
        Emission, by the monotonic clock of the sensor node; that of this machine if the node runs on it.
    ready_ns : int
        End of the fusion, by the monotonic clock of this machine.
    ready_utc_ns : int
        The same by the system clock.
    """

    fused: Fused
    first_ns: int
    ready_ns: int
    ready_utc_ns: int

    @property
    def age_s(self) -> float | None:
        """Time in s from the emission to the end of the fusion, if the clocks of both machines agree."""
        stamp = self.fused.image.stamp
        return (self.ready_utc_ns - stamp.timestamp_ns) / 1e9 if stamp.is_timed else None


@dataclass(frozen=True, slots=True, eq=False)
class _Received:
    arrival: Arrival
    image: Energyscape
    mounting: "_Place"

    @property
    def stamp(self) -> Stamp:
        return self.image.stamp


class FusedSubscriber:
    """Receiver of the images of a central node, fused for each SYNC pulse; use it in a ``with`` statement and a loop.

    Images are fused here, not at the central node, which therefore needs no more time. A pulse is complete when all
    sensors of the pulse before have sent their image. After 0.25 s, those that are here are fused. An application that
    is too slow gets the latest pulses.

    Parameters
    ----------
    address : str
        Address at which the central node publishes, ``tcp://HOST:PORT``.
    mountings : mapping of str to (translation_m, rotation_xyzw), optional
        Mountings by sensor instead of those that the central node sends.
    sensors : sequence of str, optional
        All by default.
    keys : ClientKeys, optional
        None on loopback only.
    on_note : callable, optional
        Called by a thread with a line for each change of the connection.
    emitter_diameter_m, spacing_deg, range_step_m : float
        As for `Fuser`; a planar pulse of four sensors takes some 25 ms with the default spacings.

    Attributes
    ----------
    counts : SubscriberCounts
        Counts of the images.
    n_skipped : int
        Pulses that were not fused, because the application was too slow.

    Raises
    ------
    ArgumentError
        The address or a sensor cannot be used, or the address requires keys.

    Examples
    --------
    >>> with FusedSubscriber("tcp://127.0.0.1:5602") as subscriber:  # doctest: +SKIP
    ...     for arrival in subscriber:
    ...         print(arrival.fused.sensors, arrival.fused.points.position_m[:1])
    """

    def __init__(
        self,
        address: str,
        *,
        mountings: Mountings | None = None,
        sensors: Sequence[str] | None = None,
        keys: ClientKeys | None = None,
        on_note: Callable[[str], None] | None = None,
        emitter_diameter_m: float = 0.012,
        spacing_deg: float | None = 2.0,
        range_step_m: float | None = 0.02,
    ) -> None:
        self._given = {name: _as_tuples(*place) for name, place in (mountings or {}).items()}
        self._options = {
            "emitter_diameter_m": emitter_diameter_m,
            "spacing_deg": spacing_deg,
            "range_step_m": range_step_m,
        }
        self._subscriber: Subscriber[Energyscape] = Subscriber(
            address, products=("energyscape",), sensors=sensors, keys=keys, on_note=on_note, credit=_CREDIT
        )
        self.counts: SubscriberCounts = self._subscriber.counts
        self.n_skipped = 0
        self._groups: PulseGroups[_Received] = PulseGroups.of(self._given)
        self._changed = threading.Condition()
        self._waiting: deque[dict[str, _Received]] = deque()
        self._failure: Exception | None = None
        self._mountings: dict[str, _Place] = dict(self._given)
        self._fuser: Fuser | None = None
        self._thread = threading.Thread(target=self._run, name="ertis-fused-subscriber", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[FusedArrival]:
        while (arrival := self.receive()) is not None:
            yield arrival

    @property
    def connected(self) -> bool:
        """True if a central node answers."""
        return self._subscriber.connected

    def receive(self, timeout_s: float | None = None) -> FusedArrival | None:
        """Return the next fused pulse; None after ``timeout_s``, or once the subscriber is closed.

        Parameters
        ----------
        timeout_s : float, optional
            Time to wait; unlimited by default.

        Raises
        ------
        RefusedError
            The central node has refused this application from the start.
        DataError
            The mounting of a sensor is unknown.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._failure or self._subscriber.closed, timeout_s)
            if self._failure is not None:
                raise self._failure
            if not self._waiting or self._subscriber.closed:
                return None
            group = self._waiting.popleft()
        known = self._mountings | {name: each.mounting for name, each in group.items()}
        if self._fuser is None or known != self._mountings:
            self._mountings, self._fuser = known, Fuser(known, **self._options)  # type: ignore[arg-type]  # all are numbers
        fused = self._fuser(each.image for each in group.values())
        first_ns = min(each.arrival.header.monotonic_ns for each in group.values())  # type: ignore[union-attr]  # images
        return FusedArrival(fused, first_ns, time.monotonic_ns(), time.time_ns())

    def close(self) -> None:
        """End the loop."""
        self._subscriber.close()
        with self._changed:
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(_STOP_S)

    def _run(self) -> None:
        """Form groups until `close`."""
        latest_s = time.monotonic()
        try:
            while not self._subscriber.closed:
                image = self._subscriber.receive(_POLL_S)
                if image is not None:
                    latest_s = time.monotonic()
                    for group in self._groups.add(self._received(image)):
                        self._put(group)
                elif time.monotonic() - latest_s > _PATIENCE_S and (group := self._groups.close()):
                    self._put(group)
        except Exception as error:  # noqa: BLE001  whatever it is, who waits must not do so for ever
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _received(self, image: Energyscape) -> _Received:
        arrival = self._subscriber.latest
        assert arrival is not None  # noqa: S101  it belongs to the image
        sensor = image.stamp.sensor
        mounting = self._given.get(sensor)
        if mounting is None and arrival.translation_m is not None and arrival.rotation_xyzw is not None:
            mounting = arrival.translation_m, arrival.rotation_xyzw
        if mounting is None:
            raise DataError(
                f"the mounting of sensor {sensor!r} is unknown; give its mounting here, or start 'ertis capture' with "
                "--mounting"
            )
        return _Received(replace(arrival), image, mounting)

    def _put(self, group: dict[str, _Received]) -> None:
        with self._changed:
            self._waiting.append(group)
            while len(self._waiting) > _MAX_WAITING:
                self._waiting.popleft()
                self.n_skipped += 1
            self._changed.notify_all()


def _as_tuples(translation_m: Sequence[float], rotation_xyzw: Sequence[float]) -> _Place:
    x, y, z = map(float, translation_m)
    i, j, k, w = map(float, rotation_xyzw)
    return (x, y, z), (i, j, k, w)
