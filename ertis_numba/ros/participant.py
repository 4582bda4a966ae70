"""Participant of a DDS domain that publishes ready-made ROS 2 messages.

ROS 2 maps its names to those of DDS [1]_: the topic ``/front/points`` is ``rt/front/points``, and the type
``sensor_msgs/msg/PointCloud2`` is ``sensor_msgs::msg::dds_::PointCloud2_``. The payload is the CDR encoding of the
message, which files in MCAP hold as well.

References
----------
.. [1] "Topic and Service name mapping to DDS", https://design.ros2.org/articles/topic_and_service_names.html
"""

import functools
import os
import socket
import time
from contextlib import suppress
from typing import Any, Final, Literal, Self

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, DeviceError
from ertis_numba.base.extras import extra
from ertis_numba.interop.ros_definitions import encoder, fields

__all__ = ["Participant", "Topic", "interfaces"]

_MAX_DOMAIN: Final = 232
"""Largest domain id whose ports exist."""
_PATIENCE_S: Final = 0.02
"""Time for which a message waits for a reliable subscriber that does not keep up; then it is dropped and counted."""
_FAREWELL_S: Final = 1.0
"""Longest time for which the end of a participant waits for reliable subscribers."""
_UNACKNOWLEDGED: Final = "64 MiB"
"""Size of unacknowledged messages above which writers wait."""
_RENAMED: Final = {"char": "uint8"}
_Reliability = Literal["reliable", "best_effort"]


def interfaces() -> tuple[str, ...]:
    """Return the names of the network interfaces of this machine."""
    return tuple(name for _, name in socket.if_nameindex())


class Participant:
    """Participant of a DDS domain; use it in a ``with`` statement.

    Parameters
    ----------
    domain : int, optional
        Domain id, 0 to 232; by default that of the environment variable ``ROS_DOMAIN_ID``, otherwise 0.
    interface : str
        Network interface. Everyone on its network can read what is published. The default is the loopback interface,
        which no other machine reaches.
    reliability : {"reliable", "best_effort"}
        Reliable messages are sent again if they are lost, until ``depth`` newer ones exist.
    depth : int
        Number of messages of each topic that are kept for reliable subscribers.

    Raises
    ------
    ArgumentError
        The domain id or the interface does not exist, or the packages of the extra ``ros`` are missing.
    DeviceError
        The domain cannot be joined on the interface.
    """

    def __init__(
        self,
        *,
        domain: int | None = None,
        interface: str = "lo",
        reliability: _Reliability = "reliable",
        depth: int = 10,
    ) -> None:
        self.domain = _domain_id(domain)
        checks.choice("interface", interface, interfaces())
        checks.choice("reliability", reliability, ("reliable", "best_effort"))
        checks.integer("depth", depth, 1, 1000)
        with extra("ros", "ROS 2 needs cyclonedds and mcap-ros2-support"):
            from cyclonedds.core import DDSException  # noqa: PLC0415  an extra
            from cyclonedds.domain import Domain, DomainParticipant  # noqa: PLC0415  an extra
            from mcap_ros2 import _dynamic  # noqa: F401, PLC0415  an extra
        self._writers: list[Any] = []
        self.interface, self._reliability, self._depth = interface, reliability, depth
        try:
            self._domain: Any = Domain(self.domain, _configuration(interface))
            self._participant: Any = DomainParticipant(self.domain)
        except DDSException as error:
            raise DeviceError(
                f"cannot join domain {self.domain} on interface {interface}: {error}; choose another domain or "
                "interface (domain, interface), or end programs that use too many participants"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def domain_participant(self) -> Any:
        """Participant of Cyclone DDS."""
        return self._participant

    def topic(self, name: str, message: str, *, latched: bool = False) -> "Topic":
        """Return a topic to publish on.

        Parameters
        ----------
        name : str
            ROS name, as in ``/front/points``.
        message : str
            Type, a key of `ertis_numba.interop.ros_definitions.DEFINITIONS`.
        latched : bool
            Subscribers that come later receive the last message, as those of ``/tf_static`` expect.
        """
        from cyclonedds.pub import DataWriter  # noqa: PLC0415  an extra
        from cyclonedds.qos import Policy, Qos  # noqa: PLC0415  an extra
        from cyclonedds.topic import Topic as DdsTopic  # noqa: PLC0415  an extra
        from cyclonedds.util import duration  # noqa: PLC0415  an extra

        reliable = latched or self._reliability == "reliable"
        qos = Qos(
            Policy.Reliability.Reliable(duration(seconds=_PATIENCE_S)) if reliable else Policy.Reliability.BestEffort,
            Policy.History.KeepLast(1 if latched else self._depth),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        )
        kind = _type(message)
        writer = DataWriter(self._participant, DdsTopic(self._participant, f"rt{name}", kind), qos=qos)
        self._writers.append(writer)
        return Topic(name, message, kind, writer)

    def close(self) -> None:
        """Leave the domain, once reliable subscribers have received all messages, or after a second."""
        from cyclonedds.util import duration  # noqa: PLC0415  an extra

        end_s = time.monotonic() + _FAREWELL_S
        for writer in self._writers:
            with suppress(AttributeError):  # Cyclone DDS 11.0 raises it in place of returning False at a timeout.
                writer.wait_for_acks(duration(seconds=max(0.0, end_s - time.monotonic())))
        self._writers.clear()
        # A domain that ends while Python finalises may crash.
        self._participant = self._domain = None


class Topic:
    """Topic with counts of published messages, and of those dropped because a reliable subscriber was slow."""

    def __init__(self, name: str, message: str, kind: Any, writer: Any) -> None:
        self.name, self.message = name, message
        self.published = self.dropped = 0
        self._kind, self._writer = kind, writer

    @property
    def n_subscribers(self) -> int:
        """Number of subscribers that are present and compatible."""
        while True:
            with suppress(IndexError):  # Cyclone DDS 11.0 raises it if a subscriber appears between its two calls.
                return len(self._writer.get_matched_subscriptions())

    def publish(self, message: dict[str, Any]) -> bool:
        """Publish a message, a dict of its fields; return False if it was dropped."""
        from cyclonedds.core import DDSException  # noqa: PLC0415  an extra

        sample = object.__new__(self._kind)
        sample.cdr = encoder(self.message)(message)
        try:
            self._writer.write(sample)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            self.dropped += 1
            return False
        self.published += 1
        return True


def _domain_id(given: int | None) -> int:
    """Return the domain id, by default that of the environment."""
    name, value = "domain", given
    if value is None:
        name, text = "ROS_DOMAIN_ID", os.environ.get("ROS_DOMAIN_ID", "") or "0"
        if not text.isdecimal():
            raise ArgumentError(f"ROS_DOMAIN_ID is {text!r}; use a number from 0 to {_MAX_DOMAIN}, or unset it")
        value = int(text)
    return checks.integer(name, value, 0, _MAX_DOMAIN)


def _configuration(interface: str) -> str:
    """Return the configuration of Cyclone DDS."""
    # Fast DDS announces types in a form that Cyclone DDS rejects, so it is ignored (vendor 1.15).
    return (
        "<CycloneDDS><Domain><General>"
        f'<Interfaces><NetworkInterface name="{interface}"/></Interfaces><AllowMulticast>true</AllowMulticast>'
        "</General><Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
        f"<Internal><Watermarks><WhcHigh>{_UNACKNOWLEDGED}</WhcHigh></Watermarks></Internal>"
        "</Domain></CycloneDDS>"
    )


@functools.cache
def _type(message: str) -> Any:
    """Return the type of a message for Cyclone DDS, whose samples hold ready-made CDR in ``cdr``."""
    from cyclonedds.idl import make_idl_struct, types  # noqa: PLC0415  an extra

    made: dict[str, Any] = {}
    sequence: Any = types.sequence  # Their annotations do not show that they are generic.
    array: Any = types.array
    for name, kind in fields(message).items():
        element, _, size = kind.removesuffix("]").partition("[")
        if "/" in element:
            package, _, nested = element.partition("/")
            value: Any = _type(f"{package}/msg/{nested}")
        else:
            value = {"bool": bool, "string": str}.get(element) or getattr(types, _RENAMED.get(element, element))
        if size:
            value = array[value, int(size)]
        made[name] = sequence[value] if kind.endswith("[]") else value
    package, _, name = message.split("/")
    struct: Any = make_idl_struct(name, f"{package}.msg.dds_.{name}_", made)
    # The Python encoder of Cyclone DDS takes 49 ms per megabyte.
    struct.serialize = lambda sample, **_: sample.cdr
    return struct
