"""Publisher of the poses of a platform, which a central node stores with the measurements of its sensors."""

import collections
import secrets
import time
from collections.abc import Sequence
from typing import Any, Final, Self

import numpy as np
import zmq
from numpy.typing import ArrayLike

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, NetworkError, RefusedError
from ertis_numba.base.units import counted
from ertis_numba.frames import Trajectory
from ertis_numba.frames.pose_doubts import PoseWatch
from ertis_numba.network import addresses, messages
from ertis_numba.network.connection import Connection
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import SILENCE_LIMIT_S, Bye, Ping, PlatformPose, Pong, Refused
from ertis_numba.network.owner import Owner

__all__ = ["PosePublisher"]

_TURN_S: Final = 0.1
_FAREWELL_S: Final = 1.0
_MAX_SENSORS: Final = 32
_MAX_SOURCE: Final = 64
_BACKLOG: Final = 150  # Fewer than the central node accepts at once.


class PosePublisher:
    """Publisher of the poses of a platform; use it in a ``with`` statement.

    The central node stores the poses in the recordings that it writes, interpolated at the times of the measurements.
    While there is no connection, the latest 150 poses wait for it. Poses are not acknowledged: those of the last half
    second before a crash of the central node are lost. `flush` reports an interrupted connection. Use a publisher in
    one thread only.

    Parameters
    ----------
    address : str
        Address of the central node for sensor nodes.
    sensors : sequence of str
        Names of the sensors on the platform, at most 32.
    keys : ClientKeys, optional
        Keys that may send for these sensors; required if the address is on another machine.
    source : str, default "application"
        Origin of the poses, which recordings contain, such as ``"odometry"`` or ``"motion capture"``.

    Raises
    ------
    ArgumentError
        An argument cannot be used, or the address requires keys.

    Examples
    --------
    >>> import time
    >>> with PosePublisher("tcp://127.0.0.1:5601", ["front", "left"]) as publisher:  # doctest: +SKIP
    ...     publisher.send(time.time_ns(), (1.0, 2.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    """

    def __init__(
        self, address: str, sensors: Sequence[str], *, keys: ClientKeys | None = None, source: str = "application"
    ) -> None:
        if keys is not None:
            checks.instance("keys", keys, ClientKeys, "ertis_numba.network.keys defines")
        self._address, self._keys = addresses.endpoint(address), keys
        addresses.require_keys(self._address, keys=keys)
        if isinstance(sensors, str) or not 1 <= len(sensors) <= _MAX_SENSORS:
            raise ArgumentError(f"sensors is {sensors!r:.80}; pass a list of 1 to {_MAX_SENSORS} names of sensors")
        self._sensors = tuple(checks.sensor_name(name) for name in sensors)
        checks.instance("source", source, str, "names the origin of the poses")
        if not 1 <= len(source) <= _MAX_SOURCE:
            raise ArgumentError(f"source has {len(source)} characters; use 1 to {_MAX_SOURCE}")
        self._source, self._session_id = source, secrets.randbits(62)
        self._watch = PoseWatch()
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._connection: Connection | None = None
        self._waiting: collections.deque[bytes] = collections.deque()
        self._n_sent = self._n_uncertain = 0  # Poses since the last flush, in this connection and in earlier ones.
        self._n_disconnections = 0

    def __enter__(self) -> Self:
        self._owner = Owner("publisher")
        self._context = zmq.Context()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._owner.is_this_process:
            return
        if self._connection is not None:
            end_s = time.monotonic() + _FAREWELL_S
            while not self._has_sent(self._connection) and time.monotonic() < end_s:
                self._connection.wait(_TURN_S)
            self._connection.send(messages.encode(Bye()))
        self._hang_up(_FAREWELL_S)
        if self._context is not None:
            self._context.term()
        self._context = None

    def send(
        self,
        timestamp_ns: int,
        position_m: ArrayLike,
        rotation_xyzw: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> bool:
        """Send a pose; never blocks.

        Parameters
        ----------
        timestamp_ns : int
            Time of the pose in nanoseconds since 1970-01-01 UTC, on the clock of the sensor nodes.
        position_m : (3,) array_like of float
            Position of the platform in the world frame, in metres.
        rotation_xyzw : (4,) array_like of float
            Unit quaternion that rotates the platform frame into the world frame.
        covariance : (6, 6) array_like of float, optional
            Covariance of x, y, z and of the rotation about the world's x, y, z, in square metres and square radians.

        Returns
        -------
        bool
            False if a waiting pose was discarded, because there is no connection.

        Warns
        -----
        PoseWarning
            Most poses tilt the platform by more than 30°; once per publisher.

        Raises
        ------
        ArgumentError
            The pose is invalid.
        NetworkError
            The publisher is not open.
        RefusedError
            The central node has refused the publisher or an earlier pose; the message says why. The new pose is
            nevertheless sent, or waits for a connection.
        """
        checks.integer("timestamp_ns", timestamp_ns, -(2**63), 2**63 - 1)
        known: Any = None if covariance is None else [covariance]
        place: Any = [position_m]
        turn: Any = [rotation_xyzw]
        pose = Trajectory(np.array([timestamp_ns]), place, turn, known, self._source)  # It converts and checks them.
        self._watch(pose.position_m[0], pose.rotation_xyzw[0], stacklevel=2)
        connection = self._opened()
        message = PlatformPose(
            sensors=self._sensors,
            session_id=self._session_id,
            timestamp_ns=int(timestamp_ns),
            position_m=tuple(pose.position_m[0].tolist()),
            rotation_xyzw=tuple(pose.rotation_xyzw[0].tolist()),
            covariance=None if pose.covariance is None else tuple(pose.covariance.ravel().tolist()),
            source=self._source,
        )
        self._waiting.append(messages.encode(message))
        self._has_sent(connection)
        has_room = len(self._waiting) <= _BACKLOG
        if not has_room:
            self._waiting.popleft()
        self._hear(connection)
        return has_room

    def flush(self, patience_s: float = SILENCE_LIMIT_S) -> None:
        """Wait until the central node has received all poses that were sent since the last call.

        Call it before the first pose to wait for the connection.

        Parameters
        ----------
        patience_s : float, default 3
            Timeout in seconds.

        Raises
        ------
        ArgumentError
            The timeout is not above zero.
        NetworkError
            There was no answer within the timeout, or the publisher is not open. Or a connection was interrupted, so
            that sent poses may be lost; the message states their number at most, and later calls do not count them.
        RefusedError
            The central node has refused the publisher or a pose; the message says why.
        """
        end_s = time.monotonic() + checks.positive("patience_s", patience_s)
        connection, is_sent = self._opened(), False
        while True:
            if self._hear(connection) and is_sent:
                self._n_sent = 0
                return
            self._require_no_loss()
            if time.monotonic() >= end_s:
                break
            is_sent = is_sent or (self._has_sent(connection) and connection.send(messages.encode(Ping())))
            connection.wait(min(_TURN_S, patience_s))
        self._hang_up()  # A late answer must not end the next call.
        raise NetworkError(
            f"no answer from {self._address} within {patience_s:g} s; start a central node there with 'ertis record' "
            "or 'ertis serve', or correct the address"
        )

    def _opened(self) -> Connection:
        if self._context is None:
            raise NetworkError("this publisher is not open; use it in a with statement")
        self._owner.require_this_process()
        if self._connection is None:
            self._connection = Connection(self._context, self._address, keys=self._keys)
        return self._connection

    def _has_sent(self, connection: Connection) -> bool:
        """Send waiting poses while there is room, and return True if none is left."""
        while self._waiting and connection.send(self._waiting[0]):
            self._waiting.popleft()
            self._n_sent += 1
        return not self._waiting

    def _require_no_loss(self) -> None:
        """Raise an error if poses of an interrupted connection may be lost."""
        n_uncertain, self._n_uncertain = self._n_uncertain, 0
        if n_uncertain:
            poses = counted(n_uncertain, "sent pose")
            raise NetworkError(
                f"the connection to {self._address} was interrupted, so that up to {poses} may be lost; "
                "send again what the recording needs"
            )

    def _hang_up(self, linger_s: float = 0.0) -> None:
        if self._connection is not None:
            self._connection.close(linger_s)
        self._connection = None
        self._n_disconnections = 0
        self._interrupt()

    def _interrupt(self) -> None:
        """Count the poses of the ended connection as uncertain."""
        self._n_uncertain += self._n_sent
        self._n_sent = 0

    def _hear(self, connection: Connection) -> bool:
        """Read answers, raise a refusal, and return True if a ping was answered."""
        reasons = connection.refusals()
        if connection.n_disconnections != self._n_disconnections:
            self._n_disconnections = connection.n_disconnections
            self._interrupt()
        if connection.has_ended:
            self._hang_up()  # The next call connects again.
            raise RefusedError(f"{self._address}: {reasons[-1]}")
        has_answer = False
        while received := connection.receive():
            message = messages.decode(received[0])
            if isinstance(message, Refused):
                raise RefusedError(message.reason)
            has_answer = has_answer or isinstance(message, Pong)
        return has_answer
