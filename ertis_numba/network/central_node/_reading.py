"""Decoding of messages, with checks of their senders' roles."""

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
    """Return the message in frames, or refuse invalid ones."""
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
            "this address is for sensor nodes; applications use the address that 'ertis serve' prints as publish",
            "message",
        )
    return message


def require_role(who: Permission, message: Message) -> None:
    """Refuse a message that its sender's role does not allow."""
    if isinstance(message, AskStatus):
        if not who.may_receive:
            raise Unwanted("role", f"key {who.name} has the role sensor, which may not request the status", "role")
    elif who.may_receive and who.role != "admin":
        raise Unwanted("role", f"key {who.name} has the role application, which may not send measurements", "role")
    if isinstance(message, Hello | Data | Gap) and not who.may_send(message.sensor):
        raise Unwanted(
            "serial",
            f"key {who.name} may not send for sensor {message.sensor}; allow it with 'ertis keys allow'",
            "serial",
        )
