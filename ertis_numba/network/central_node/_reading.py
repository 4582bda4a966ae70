"""Reads what comes: messages of this protocol, of who may send them."""

from typing import Final

import zmq

from ertis_numba.errors import DataError, FormatVersionError
from ertis_numba.network import messages
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.central_node._roles import Unwanted
from ertis_numba.network.messages import AskStatus, Bye, Data, Gap, Hello, Message, Ping, Subscribe

__all__ = ["read", "require_role"]

_TAKEN: Final = (Hello, Data, Gap, Ping, Bye, AskStatus)


def read(frames: list[zmq.Frame]) -> Message:
    """Return the message in frames, or refuse what is none."""
    if len(frames) < 2:
        raise Unwanted("message", "a message is empty; send a header", "message")
    try:
        message: Message = messages.decode(frames[1].buffer, (*_TAKEN, Subscribe))
    except FormatVersionError as error:
        raise Unwanted("version", str(error), "version") from error
    except DataError as error:
        raise Unwanted("message", str(error), "message") from error
    if isinstance(message, Subscribe):
        raise Unwanted(
            "message",
            "sensors send to this address; give the one that 'ertis serve' prints as publish, where images are",
            "message",
        )
    return message


def require_role(who: Permission, message: Message) -> None:
    """Refuse what its sender may not say."""
    if isinstance(message, AskStatus):
        if not who.may_receive:
            raise Unwanted("role", f"key {who.name} is a sensor's, which may not ask for the status", "role")
    elif who.may_receive and who.role != "admin":
        raise Unwanted("role", f"key {who.name} is an application's, which may not send measurements", "role")
    if isinstance(message, Hello | Data | Gap) and not who.may_send(message.sensor):
        raise Unwanted("serial", f"key {who.name} may not speak for sensor {message.sensor}; allow it", "serial")
