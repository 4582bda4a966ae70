"""Decoding of messages, checks of their senders' roles, and their handlers, by the declarations of the messages."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import zmq

from ertis_numba.errors import DataError, FormatVersionError
from ertis_numba.network import messages
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.central_node._roles import Unwanted
from ertis_numba.network.messages import MESSAGES, Message, Subscribe

__all__ = ["Received", "handlers_of", "read", "require_role"]

ACCEPTED: Final = tuple(kind for kind in MESSAGES if kind.senders_to("central"))


@dataclass(slots=True, eq=False)
class Received:
    """Sender and frames of a message.

    Attributes
    ----------
    frames : list of zmq.Frame
        Sender, header and payload.
    who : Permission
    arrived_ns : int
        Time of arrival, by `time.monotonic_ns`.
    """

    frames: list[zmq.Frame]
    who: Permission
    arrived_ns: int

    @property
    def sender(self) -> bytes:
        """Identifier of the sender."""
        return self.frames[0].bytes

    @property
    def payload(self) -> list[zmq.Frame]:
        """Frames after the header."""
        return self.frames[2:]


def handlers_of(node: object) -> dict[type[Message], Callable[[Any, Received], None]]:
    """Return the handlers of all messages to the central node: its methods ``_on_KIND``.

    Raises
    ------
    TypeError
        A message has no handler.
    """
    missing = [kind.kind() for kind in ACCEPTED if not hasattr(node, f"_on_{kind.kind()}")]
    if missing:
        raise TypeError(
            f"{type(node).__name__} has no handler of {', '.join(missing)}; define _on_{missing[0]}, or remove the "
            "route to the central node from the declaration"
        )
    return {kind: getattr(node, f"_on_{kind.kind()}") for kind in ACCEPTED}


def read(frames: list[zmq.Frame]) -> Message:
    """Return the message in frames, or refuse invalid ones."""
    if len(frames) < 2:
        raise Unwanted("message", "a message is empty; send a header", "message")
    try:
        message: Message = messages.decode(frames[1].buffer, (*ACCEPTED, Subscribe))
    except FormatVersionError as error:
        raise Unwanted("version", str(error), "version") from error
    except DataError as error:
        raise Unwanted("message", str(error), "message") from error
    if isinstance(message, Subscribe):
        raise Unwanted(
            "message",
            "this address is for sensor nodes; applications use the address that 'ertis serve' prints as publish",
            "message",
        )
    return message


def require_role(who: Permission, message: Message) -> None:
    """Refuse a message that its sender's role does not allow."""
    if who.role not in ("admin", *message.senders_to("central")):
        action = "request the status" if who.role == "sensor" else "send measurements"
        raise Unwanted("role", f"key {who.name} has the role {who.role}, which may not {action}", "role")
    sensor = getattr(message, "sensor", None)
    if sensor is not None and not who.may_send(sensor):
        raise Unwanted(
            "serial", f"key {who.name} may not send for sensor {sensor}; allow it with 'ertis keys allow'", "serial"
        )
