"""Application node that computes the pose and velocity of a platform from images as they arrive."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ertis_numba.frames import Stamp, Trajectory
from ertis_numba.fusion.rig import Mountings
from ertis_numba.motion import EgoVelocity, PlanarPose
from ertis_numba.motion.live import LiveOdometry
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.pulse_receiver import PulseReceiver, ReceivedPulse
from ertis_numba.network.result_subscriber import ResultSubscriber

__all__ = ["OdometryArrival", "OdometrySubscriber"]


@dataclass(frozen=True, slots=True, eq=False)
class OdometryArrival:
    """Pose and velocity of a platform at a SYNC pulse.

    Attributes
    ----------
    pose : PlanarPose
        Pose relative to the first pulse.
    velocity : EgoVelocity or None
        Mean velocity since the pulse before; None at the first pulse, and if the motion is unknown, for the reason
        that ``pose.doubt`` states.
    sync_count : int
    sensors, missing : tuple of str
        Sensors whose images were used, and other mounted sensors, which sent no image of this pulse.
    n_lost : int
        Pulses since the previous result of which no image was used: no image arrived, no sensor emitted, or the
        application was too slow.
    ready_utc_ns : int
        End of the computation, by the system clock of this machine.
    is_timed : bool
        True if the time of the pulse is a date; clocks that were never set begin at 1970.
    """

    pose: PlanarPose
    velocity: EgoVelocity | None
    sync_count: int
    sensors: tuple[str, ...]
    missing: tuple[str, ...]
    n_lost: int
    ready_utc_ns: int
    is_timed: bool

    @property
    def age_s(self) -> float | None:
        """Time in s from the emission to the end of the computation, if the clocks of both machines agree."""
        return (self.ready_utc_ns - self.pose.timestamp_ns) / 1e9 if self.is_timed else None


class OdometrySubscriber(ResultSubscriber[ReceivedPulse, OdometryArrival]):
    """Receiver of the images of a central node that computes a pose and a velocity for each SYNC pulse.

    Use it in a ``with`` statement and a loop. All sensors belong to one platform. Images are grouped as by
    `FusedSubscriber`: if a sensor sends no image of a pulse, the others determine the motion. If the application is too
    slow, or pulses are lost, the next pulse is compared with the last one that was used. Pulses more than a second
    apart have no velocity. A pulse that is not later than the one before, because a clock was set back, is noted and
    left out.

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
    alone : bool, optional
        True if no sensor emits except those received, as for `Odometry`.
    on_note : callable, optional
        Called with a line for each change of the connection, by a thread, and for each pulse that cannot be used.

    Attributes
    ----------
    counts : SubscriberCounts
        Counts of the images.

    Raises
    ------
    ArgumentError
        The address or a sensor cannot be used, or the address requires keys.

    Examples
    --------
    >>> with OdometrySubscriber("tcp://127.0.0.1:5602") as subscriber:  # doctest: +SKIP
    ...     for arrival in subscriber:
    ...         print(arrival.pose.x_m, arrival.pose.y_m, arrival.velocity)
    """

    def __init__(
        self,
        address: str,
        *,
        mountings: Mountings | None = None,
        sensors: Sequence[str] | None = None,
        keys: ClientKeys | None = None,
        alone: bool | None = None,
        on_note: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(PulseReceiver(address, mountings=mountings, sensors=sensors, keys=keys, on_note=on_note))
        self._odometry = LiveOdometry(on_note or (lambda _: None), alone=alone)
        self._stamps: dict[str, Stamp] = {}  # of the last pulse, by sensor

    @property
    def trajectory(self) -> Trajectory | None:
        """Poses at all pulses so far, as those of `Odometry.trajectory`; None before the first pulse."""
        return self._odometry.trajectory

    def _result(self, received: ReceivedPulse) -> OdometryArrival | None:
        found = self._odometry.add(received.images, received.mountings)
        if found is None:
            return None
        stamps = {name: image.stamp for name, image in received.images.items()}
        n_lost, self._stamps = _lost_between(self._stamps, stamps), stamps
        first = next(iter(stamps.values()))
        return OdometryArrival(
            *found,
            first.sync_count,
            tuple(name for name in received.mountings if name in stamps),
            received.missing,
            n_lost,
            time.time_ns(),
            first.is_timed,
        )


def _lost_between(before: dict[str, Stamp], after: dict[str, Stamp]) -> int:
    """Return the number of pulses between two; 0 if no sensor has counted them in the same session."""
    counted = [
        after[name].sync_count - stamp.sync_count - 1
        for name, stamp in before.items()
        if name in after and after[name].session_id == stamp.session_id
    ]
    return max(0, *counted) if counted else 0
