"""Receiver of the images of all sensors of a platform, one group for each SYNC pulse."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from ertis_numba.base.forks import usable_cores
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.fusion.pulses import PulseGroups
from ertis_numba.fusion.rig import Mountings
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.owner import Owner
from ertis_numba.network.pulse_queue import PulseQueue
from ertis_numba.network.subscriber import Subscriber, SubscriberCounts

__all__ = ["PulseReceiver", "ReceivedPulse"]

_Place: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float, float]]

_POLL_S: Final = 0.05
_PATIENCE_S: Final = 0.25  # Time after which a pulse is returned without the images that are missing.
_CREDIT: Final = 16  # Images under way: those of two pulses of eight sensors.
_STOP_S: Final = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedPulse:
    """Images of a SYNC pulse, and the mountings of all sensors so far."""

    images: Mapping[str, Energyscape]  # by sensor
    mountings: Mountings  # (translation_m, rotation_xyzw) by sensor, first known first
    first_ns: int  # emission, by the node's monotonic clock

    @property
    def missing(self) -> tuple[str, ...]:
        """Sensors whose mounting is known, but not their image."""
        return tuple(name for name in self.mountings if name not in self.images)


@dataclass(frozen=True, slots=True, eq=False)
class _Received:
    image: Energyscape
    mounting: _Place
    emitted_ns: int

    @property
    def stamp(self) -> Stamp:
        return self.image.stamp


class PulseReceiver:
    """Receiver that groups the images of a central node by SYNC pulse, in a thread.

    A pulse is complete with all sensors of the two pulses before, after three later pulses, or after 0.25 s without an
    image. Sensors without a mounting, and those that send NaN, are left out with a note. Threads on all cores except
    one call ``on_image``, unless a pulse waits for `receive`.
    """

    def __init__(
        self,
        address: str,
        *,
        mountings: Mountings | None = None,
        sensors: Sequence[str] | None = None,
        keys: ClientKeys | None = None,
        on_note: Callable[[str], None] | None = None,
        on_image: Callable[[Energyscape], None] | None = None,
    ) -> None:
        wanted = {sensors} if isinstance(sensors, str) else sensors
        self._given = {
            name: _as_tuples(*place) for name, place in (mountings or {}).items() if wanted is None or name in wanted
        }
        self._subscriber: Subscriber[Energyscape] = Subscriber(
            address, products=("energyscape",), sensors=sensors, keys=keys, on_note=on_note, credit=_CREDIT
        )
        self._note, self._on_image = on_note or (lambda _: None), on_image
        self.counts: SubscriberCounts = self._subscriber.counts
        self._groups: PulseGroups[_Received] = PulseGroups.of(self._given, self._note)
        self.queue: PulseQueue[dict[str, _Received]] = PulseQueue()
        self._mountings: dict[str, _Place] = dict(self._given)
        self._left_out: set[str] = set()  # Sensors without a mounting, or with numbers that are not finite.
        self._n_cores = usable_cores()
        self._owner = Owner("receiver")
        self._thread = threading.Thread(target=self._run, name="ertis-pulse-receiver", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """True if a central node answers."""
        return self._subscriber.connected

    @property
    def n_skipped(self) -> int:
        """Pulses that were not used, because the application was too slow."""
        return self.queue.n_skipped

    def receive(self, timeout_s: float | None = None) -> ReceivedPulse | None:
        """Return the images of the next pulse; None after timeout_s, or once closed; raises RefusedError."""
        self._owner.require_this_process()
        group = self.queue.take(timeout_s)
        if group is None:
            return None
        self._mountings = self._mountings | {name: each.mounting for name, each in group.items()}
        return ReceivedPulse(
            {name: each.image for name, each in group.items()},
            self._mountings,
            min(each.emitted_ns for each in group.values()),
        )

    def close(self) -> None:
        """End waiting calls of `receive`."""
        if not self._owner.is_this_process:
            return
        self._subscriber.close()
        self.queue.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_STOP_S)

    def _run(self) -> None:
        """Form groups until `close`."""
        latest_s = time.monotonic()
        # The application fuses meanwhile, and finds what no thread has begun to find. With a thread for each core, they
        # would wait for each other.
        pool = ThreadPoolExecutor(max(1, self._n_cores - 1), thread_name_prefix="ertis-images")
        try:
            while not self._subscriber.closed:
                image = self._subscriber.receive(_POLL_S)
                if image is not None:
                    latest_s = time.monotonic()
                    received = self._received(image)
                    if received is not None:
                        self._add(received, pool)
                elif time.monotonic() - latest_s > _PATIENCE_S and (group := self._groups.close()):
                    self._put(group)
        except Exception as error:  # noqa: BLE001  whatever it is, who waits must not do so for ever
            self.queue.fail(error)
        finally:
            pool.shutdown(cancel_futures=True)

    def _add(self, received: _Received, pool: ThreadPoolExecutor) -> None:
        """Add an image to its group."""
        if self._on_image is not None and self.queue.is_empty:
            if self._n_cores == 1:  # Others would only compete with this one.
                self._on_image(received.image)
            else:
                with suppress(RuntimeError):  # No thread can start, or the main thread has ended.
                    pool.submit(self._on_image, received.image)
        for group in self._groups.add(received):
            self._put(group)

    def _received(self, image: Energyscape) -> _Received | None:
        """Return an image with its mounting; None, with one note, if that is unknown or the image is not finite."""
        arrival = self._subscriber.latest
        assert arrival is not None  # noqa: S101  it belongs to the image
        sensor = image.stamp.sensor
        mounting = self._given.get(sensor)
        if self._given and mounting is None and sensor not in self._mountings:
            self._note(f"the given mountings lack sensor {sensor}; that of the central node applies")
        if mounting is None and arrival.translation_m is not None and arrival.rotation_xyzw is not None:
            mounting = arrival.translation_m, arrival.rotation_xyzw
        if mounting is None:
            self._leave_out(
                sensor,
                "its mounting is unknown; add the mounting (mountings), or start 'ertis capture' with --mounting",
            )
            return None
        if not np.isfinite(image.amplitude).all():
            self._leave_out(sensor, "its images contain NaN or infinity; check its samples with 'ertis sensors check'")
            return None
        self._left_out.discard(sensor)
        return _Received(image, mounting, arrival.header.monotonic_ns)  # type: ignore[union-attr]  # of an image

    def _leave_out(self, sensor: str, reason: str) -> None:
        """Note once that a sensor is left out, until it is used again."""
        if sensor not in self._left_out:
            self._left_out.add(sensor)
            self._note(f"sensor {sensor} is left out, because {reason}")

    def _put(self, group: dict[str, _Received]) -> None:
        self.queue.put(group, sum(each.image.amplitude.nbytes for each in group.values()))


def _as_tuples(translation_m: Sequence[float], rotation_xyzw: Sequence[float]) -> _Place:
    x, y, z = map(float, translation_m)
    i, j, k, w = map(float, rotation_xyzw)
    return (x, y, z), (i, j, k, w)
