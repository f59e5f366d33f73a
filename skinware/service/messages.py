"""What goes over a service's request socket: one JSON object per packet."""

from __future__ import annotations

import socket
from typing import Any, Literal, TypeVar

import msgspec

MAX_PACKET = 1 << 16
_UNREADABLE = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding somebody else's packet can raise: not JSON, not UTF-8, nested too deeply."""
UNSPEAKABLE = (TypeError, ValueError, OverflowError, RecursionError)
"""What encoding can raise: no JSON type, half a surrogate pair, a number or a nesting without an end."""
ACQUIRE = "acquire"
"""Operation of every service: publish a frame whose acquisition begins after the request was received."""
OPERATIONS = "operations"
"""Operation of every service: the operations that it declares, by name, with a description each."""
CANCEL = "cancel"
"""Not an operation: takes the request of the same id back."""


MessageT = TypeVar("MessageT", bound=msgspec.Struct)


class Ask(msgspec.Struct):
    """From a program to a service.

    Attributes:
        id: unique on this connection.
        operation: what to do.
        arguments: by name.
    """

    id: int
    operation: str
    arguments: dict[str, Any] = msgspec.field(default_factory=dict)


class Answer(msgspec.Struct):
    """From a service to a program.

    Attributes:
        id: of the request.
        generation, sequence: a frame that was published after the request was carried out; 0: none was.
        result: what the operation returned.
        error: what went wrong, None if nothing did.
        why: kind of error.
    """

    id: int
    generation: int = 0
    sequence: int = 0
    result: Any = None
    error: str | None = None
    why: Literal["", "refused", "failed", "paused", "cancelled"] = ""


def receive(connection: socket.socket, message: type[MessageT]) -> MessageT | None:
    """The next message of a connection; None if the other end hung up or speaks nonsense.

    Raises:
        BlockingIOError: there is none yet.
    """
    try:
        packet = connection.recv(MAX_PACKET)
        return msgspec.json.decode(packet, type=message) if packet else None
    except BlockingIOError:
        raise
    except (OSError, *_UNREADABLE):
        return None
