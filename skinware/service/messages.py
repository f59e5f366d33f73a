"""Encode and decode requests and answers."""

from __future__ import annotations

import socket
from typing import Any, Literal, TypeVar

import msgspec

MAX_PACKET = 1 << 16
_DECODING_ERRORS = (msgspec.MsgspecError, ValueError, RecursionError)
"""Errors of decoding a packet of another program: not JSON, not UTF-8, nested too deeply."""
ENCODING_ERRORS = (TypeError, ValueError, OverflowError, RecursionError)
"""Errors of encoding: no JSON type, half a surrogate pair, a number or a nesting without an end."""
ACQUIRE = "acquire"
"""Operation of every service: publish a sample whose acquisition begins after the request was received."""
OPERATIONS = "operations"
"""Operation of every service: the operations that it declares, by name, with a description each."""
CANCEL = "cancel"
"""Not an operation: takes the request of the same id back."""
TO_ALL = 0
"""Id of an answer to every request of a connection: the service takes none from it."""


MessageT = TypeVar("MessageT", bound=msgspec.Struct)


class Ask(msgspec.Struct, gc=False):
    """From a program to a service.

    Attributes:
        id: unique on this connection.
        arguments: by name; still JSON, as decoding them takes the time.
    """

    id: int
    operation: str
    arguments: msgspec.Raw = msgspec.Raw(b"{}")


class Answer(msgspec.Struct):
    """From a service to a program.

    Attributes:
        generation, sequence: a sample that was published after the request was carried out; 0: none was.
        error: what went wrong, None if nothing did.
    """

    id: int
    generation: int = 0
    sequence: int = 0
    result: Any = None
    error: str | None = None
    why: Literal["", "refused", "failed", "paused", "cancelled"] = ""


_ARGUMENTS = msgspec.json.Decoder(dict[str, Any], float_hook=float)
"""Takes at most 30 ns a byte. msgspec before 0.23 takes ten times as long for numbers near the limits of a float."""


def decode_arguments(text: msgspec.Raw) -> dict[str, Any] | None:
    """Return the arguments of a request; None if they are nonsense."""
    try:
        return _ARGUMENTS.decode(text)
    except _DECODING_ERRORS:
        return None


def receive(connection: socket.socket) -> bytes:
    """Return the next packet of a connection; empty if the other end hung up.

    Raises:
        BlockingIOError: there is none yet.
    """
    for _ in range(2):  # after an error, what the other end sent before it hung up still waits
        try:
            return connection.recv(MAX_PACKET)
        except BlockingIOError:
            raise
        except OSError:
            pass
    return b""


def decode(packet: bytes, message: type[MessageT]) -> MessageT | None:
    """Return the message in a packet; None if it is empty or nonsense."""
    try:
        return msgspec.json.decode(packet, type=message) if packet else None
    except _DECODING_ERRORS:
        return None
