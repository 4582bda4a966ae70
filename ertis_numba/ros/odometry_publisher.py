"""Publisher of the pose and velocity of a platform, computed in a thread so that no other topic waits."""

import threading
from collections.abc import Callable
from typing import Any

from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion.pulses import PulseGroups
from ertis_numba.interop._mountings import Mounting
from ertis_numba.interop.ros_messages import odometry_message, odometry_transform
from ertis_numba.motion.live import LiveOdometry
from ertis_numba.network.pulse_queue import PulseQueue
from ertis_numba.ros.participant import Topic

__all__ = ["OdometryPublisher"]

_Item = Energyscape | PointCloud
_Group = dict[str, _Item]


class OdometryPublisher:
    """Publisher of nav_msgs/msg/Odometry and the transform from ``odom`` to ``base_link``."""

    # While `is_paused` returns True, the pose is computed but not published. `alone` is as for `Odometry`.

    def __init__(
        self,
        odometry: Topic,
        transforms: Topic,
        *,
        on_note: Callable[[str], None],
        is_paused: Callable[[], bool],
        alone: bool | None = None,
    ) -> None:
        self._odometry, self._transforms = odometry, transforms
        self._note, self._is_paused = on_note, is_paused
        self._live = LiveOdometry(on_note, alone=alone)
        self._groups: PulseGroups[_Item] = PulseGroups(on_note)
        self._mountings: dict[str, Mounting] = {}
        self._left_out: set[str] = set()
        self._queue: PulseQueue[tuple[_Group, dict[str, Mounting]]] = PulseQueue()
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="ertis-ros-odometry", daemon=True)
        self._thread.start()

    @property
    def n_skipped(self) -> int:
        """Pulses that were not used, because the computer was too slow."""
        return self._queue.n_skipped

    def add(self, item: _Item, mounting: Mounting | None) -> None:
        """Add the image or the points of a sensor; return at once."""
        sensor = item.stamp.sensor
        if mounting is None:
            if sensor not in self._left_out:
                self._left_out.add(sensor)
                self._note(
                    f"odometry leaves out sensor {sensor}, whose mounting is unknown; add the mounting (mounting)"
                )
            return
        self._mountings[sensor] = mounting
        for group in self._groups.add(item):
            self._put(group)

    def close(self) -> None:
        """Publish the poses of all waiting pulses, and end the thread; raise ErtisError if it has failed."""
        while group := self._groups.close():
            self._put(group)
        self._queue.end()
        self._thread.join()
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _put(self, group: _Group) -> None:
        self._queue.put((group, dict(self._mountings)), sum(_n_bytes(item) for item in group.values()))

    def _run(self) -> None:
        try:
            while (waiting := self._queue.take()) is not None:
                self._publish(*waiting)
        except Exception as error:  # noqa: BLE001  `close` raises it in the thread of the application
            self._failure = error
            self._note(f"odometry has ended: {error}")

    def _publish(self, group: _Group, mountings: dict[str, Mounting]) -> None:
        found = self._live.add(group, mountings)
        if found is None or self._is_paused():
            return
        message: dict[str, Any] = odometry_message(*found)
        self._odometry.publish(message)
        self._transforms.publish({"transforms": [odometry_transform(found[0])]})


def _n_bytes(item: _Item) -> int:
    return (item.amplitude if isinstance(item, Energyscape) else item.position_m).nbytes
