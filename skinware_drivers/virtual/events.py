"""What the emulated skin writes down: every fault it injected, exactly, and every command that it got.

An event is a small struct; as a JSON line it carries its kind under ``event``. ``time_ns`` is CLOCK_MONOTONIC ns
of the carrier. A ``board`` is its CAN address, a ``cycle`` the number of a board's burst since power-up, from 0.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import msgspec

from skinware.errors import ConfigurationError

Half = Literal["head", "tail"]
FrameDamage = Literal["lost", "truncated", "corrupted", "repeated", "unsent"]
"""``unsent``: the device lost its power, or its queue was full; nobody heard it either."""


def _snake(name: str) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name).lstrip("_")


class Event(msgspec.Struct, frozen=True, kw_only=True, tag_field="event", tag=_snake):
    """Base of all events."""

    time_ns: int


class LostHalf(Event, frozen=True):
    """One of the two frames of a triangle was sent by nobody, or heard by nobody."""

    board: int
    triangle: int
    cycle: int
    half: Half
    reason: Literal["random", "overflow", "died", "restarted"]
    """``overflow``: the board's transmit queue was full, because the bus or the period was too short."""


class FrameFault(Event, frozen=True):
    """Something was wrong with one data frame of a small device."""

    board: int
    cycle: int
    position: int
    """Of the frame in its burst, from 0 (of ``unsent`` ones, in what the burst had become)."""
    identifier: int
    fault: FrameDamage
    payload: str
    """What went out (of lost ones: what would have gone), in hexadecimal digits."""


class WrongLength(Event, frozen=True):
    """A data frame went out with ``length`` payload bytes instead of its own number."""

    board: int
    triangle: int
    cycle: int
    half: Half
    length: int


class BurstDelayed(Event, frozen=True):
    """A burst began ``delay_ns`` later than its period says; the one after it is on time again."""

    board: int
    cycle: int
    delay_ns: int


class BoardDied(Event, frozen=True):
    """From here on the board sends and hears nothing."""

    board: int


class BoardRestarted(Event, frozen=True):
    """The board lost power for a moment: configuration gone, silent; deaf until ``ready_ns``."""

    board: int
    ready_ns: int


class BoardSilenced(Event, frozen=True):
    """A discovery made a streaming MTB3 fall silent, as it does to real ones."""

    board: int


class ErrorReported(Event, frozen=True):
    """A device reported an error (CANopen EMCY), or with code 0 that it has none."""

    board: int
    code: int


class Recalibrated(Event, frozen=True):
    """A board took new baselines for all of its triangles: values jump without notice."""

    board: int
    cycle: int
    """The first burst with the new baselines."""
    reason: Literal["power_up", "command", "no_ack"]


class TriangleFault(Event, frozen=True):
    """A triangle was unplugged or plugged in, or stopped or began again to acknowledge on its I2C line."""

    board: int
    triangle: int
    cycle: int
    """The first burst that shows it."""
    fault: Literal["unplugged", "plugged_in", "no_ack", "ack"]


class TaxelOutOfRange(Event, frozen=True):
    """A taxel of the board is broken from power-up on: far out of range, whatever the baseline."""

    board: int
    triangle: int
    taxel: int


class ForeignFrame(Event, frozen=True):
    """Some other device on the bus sent a frame."""

    identifier: int
    """With ``EXTENDED_FLAG`` for 29-bit identifiers."""
    length: int


class CommandReceived(Event, frozen=True):
    """A frame from the host that at least one board obeyed or answered."""

    identifier: int
    payload: str
    """In hexadecimal digits."""
    boards: list[int]
    """The boards that did, by the address they had before."""


def spoilt_bursts(events: Iterable[msgspec.Struct]) -> set[tuple[int, int]]:
    """The (board, cycle) of small devices of which a host cannot have got every frame intact."""
    spoilt = {"lost", "truncated", "corrupted", "unsent"}
    return {(e.board, e.cycle) for e in events if isinstance(e, FrameFault) and e.fault in spoilt}


def damaged_cycles(events: Iterable[msgspec.Struct]) -> set[tuple[int, int, int]]:
    """The (board, triangle, cycle) of which a host cannot have got both halves intact."""
    return {(event.board, event.triangle, event.cycle) for event in events if isinstance(event, LostHalf | WrongLength)}


class JsonLinesLog:
    """Writes events to a file, one JSON object a line, each as soon as it happens.

    Args:
        path: the file; an existing one is replaced.

    Raises:
        ConfigurationError: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self._encoder = msgspec.json.Encoder()
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise ConfigurationError(f"cannot write the log {path}: {error.strerror}") from error

    def append(self, event: msgspec.Struct) -> None:
        """Write one event."""
        self._file.write(self._encoder.encode(event) + b"\n")

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()
