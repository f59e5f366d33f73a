"""Encode requests and answers, and keep account of what each client may still ask."""

from __future__ import annotations

import os
import socket
import sys
import time
from typing import Any, Literal, TypeVar

import msgspec

from skinware.memory.announcement import Announcement, ReaderRecord
from skinware.memory.namespace import Namespace
from skinware.memory.ring_reader import Turns
from skinware.memory.take import Turn
from skinware.realtime import NS_PER_S, now_ns

MAX_PACKET = 1 << 16
_DECODING_ERRORS = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding somebody else's packet can raise: not JSON, not UTF-8, nested too deeply."""
ENCODING_ERRORS = (TypeError, ValueError, OverflowError, RecursionError)
"""What encoding can raise: no JSON type, half a surrogate pair, a number or a nesting without an end."""
ACQUIRE = "acquire"
"""Operation of every service: publish a frame whose acquisition begins after the request was received."""
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
        operation: what to do.
        arguments: by name; still JSON, as decoding them takes the time.
    """

    id: int
    operation: str
    arguments: msgspec.Raw = msgspec.Raw(b"{}")


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


_ARGUMENTS = msgspec.json.Decoder(dict[str, Any], float_hook=float)
"""Takes at most 30 ns a byte. msgspec's own way with numbers near the limits of a float takes ten times as long."""


def decode_arguments(text: msgspec.Raw) -> dict[str, Any] | None:
    """The arguments of a request; None if they are nonsense."""
    try:
        return _ARGUMENTS.decode(text)
    except _DECODING_ERRORS:
        return None


def receive(connection: socket.socket) -> bytes:
    """The next packet of a connection; empty if the other end hung up.

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
    """What a packet says; None if it is empty or nonsense."""
    try:
        return msgspec.json.decode(packet, type=message) if packet else None
    except _DECODING_ERRORS:
        return None


_ANNOUNCE_EVERY_NS = NS_PER_S // 4


class Accounts:
    """Counts at the moments at which a reader is in no hurry: it notes times before it sleeps, and adds them up later.

    With more readers than processors, what one does before it sleeps makes the next one's frame older.

    Args:
        namespace, service: what is read.
        announce: let others see it, from its first frame or wait on.
    """

    def __init__(self, namespace: Namespace, service: str, announce: bool) -> None:
        program = os.path.basename(sys.argv[0] or sys.executable)
        self._record = ReaderRecord(service, os.getpid(), program, "on demand")
        self._namespace, self._announce_it = namespace, announce
        self._announcement: Announcement | None = None
        self._announced_ns = self._announced_frames = 0
        self._in_loop = False
        self._turns: list[Turn] = []
        self._cpu_ns = 0

    @property
    def record(self) -> ReaderRecord:
        self._add_up()
        return self._record

    def begin_loop(self, kind: str) -> None:
        """The reader reads in a loop from now on, whose turns are timed."""
        self._record.kind = kind
        self._in_loop = True

    def taken(self, lost: int) -> None:
        self._record.frames += 1
        if lost:
            self._record.lost += lost

    @property
    def due_ns(self) -> int:
        return self._announced_ns + _ANNOUNCE_EVERY_NS

    def settle(self, turns: Turns) -> None:
        self._record.frames += turns.frames
        self._record.lost += turns.lost
        self._turns += turns.over if self._in_loop else [turn._replace(cpu_ns=0) for turn in turns.over]

    def end_turn(self, turn: tuple[int, int] | None) -> None:
        """Note the turn that ends now, if there is one; add up and tell everybody now and then."""
        time_ns = now_ns()
        if turn is not None:
            self._turns.append(Turn(*turn, time_ns, time.thread_time_ns() if self._in_loop else 0))
        if time_ns - self._announced_ns >= _ANNOUNCE_EVERY_NS:
            self._add_up()
            self._announce(time_ns)

    def _add_up(self) -> None:
        record = self._record
        turns, self._turns = self._turns, []
        for acquired_ns, taken_ns, ended_ns, cpu_ns in turns:
            age_ns = taken_ns - acquired_ns
            record.age.add(age_ns)
            record.age_ms = round(age_ns / 1e6, 3)
            if cpu_ns:
                record.wall.add(ended_ns - taken_ns)
                if 0 < self._cpu_ns <= cpu_ns:
                    record.cpu.add(cpu_ns - self._cpu_ns)
                self._cpu_ns = cpu_ns

    def _announce(self, time_ns: int) -> None:
        record = self._record
        if self._announced_ns:
            passed_ns = time_ns - self._announced_ns
            record.rate_hz = round((record.frames - self._announced_frames) * NS_PER_S / passed_ns, 2)
        if self._announce_it:
            if self._announcement is None:
                self._announcement = Announcement(self._namespace, record.service)
            self._announcement.write(record)
        self._announced_ns, self._announced_frames = time_ns, record.frames

    def close(self) -> None:
        self._announce_it = False
        if self._announcement is not None:
            self._announcement.close()
