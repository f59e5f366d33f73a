"""The log of emulated hardware: every fault that it injected, exactly, and every command that it received."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import msgspec

from skinware.errors import ConfigurationError

Half = Literal["head", "tail"]
FrameDamage = Literal["lost", "truncated", "corrupted", "repeated", "wrong_length", "unsent"]
"""``unsent``: the device lost its power, or its queue was full; no program received it either."""
EventName = Literal[
    "lost_half",
    "frame_fault",
    "wrong_length",
    "burst_delayed",
    "board_died",
    "board_restarted",
    "board_silenced",
    "error_reported",
    "recalibrated",
    "triangle_fault",
    "taxel_out_of_range",
    "foreign_frame",
    "command_received",
]


class Event(msgspec.Struct, frozen=True, omit_defaults=True):
    """One event; as a JSON line it has the fields of its kind.

    ======================  ============================================================================================
    event                   meaning, and fields besides ``time_ns``
    ======================  ============================================================================================
    ``frame_fault``         a data frame was damaged: board, cycle, position, identifier, fault, payload; for a half of
                            a triangle also triangle, half
    ``lost_half``           no program received a half of a triangle: board, triangle, cycle, half, reason (``random``,
                            ``overflow`` of the board's queue, ``died``, ``restarted``)
    ``wrong_length``        a half of a triangle had a wrong ``length``: board, triangle, cycle, half, length
    ``burst_delayed``       a burst began ``delay_ns`` late, the next one on time: board, cycle, delay_ns
    ``board_died``          the board sends and hears nothing from now on: board
    ``board_restarted``     the board lost power for a moment and is deaf until ``ready_ns``: board, ready_ns
    ``board_silenced``      a discovery silenced a streaming MTB3, as it does to real ones: board
    ``error_reported``      a device reported an error (CANopen EMCY), or with code 0 its end: board, code
    ``recalibrated``        a board took new baselines, so that values jump: board, cycle (the first with them), reason
                            (``power_up``, ``command``, ``no_ack``)
    ``triangle_fault``      a triangle changed: board, triangle, cycle (the first that shows it), fault (``unplugged``,
                            ``plugged_in``, ``no_ack``, ``ack``)
    ``taxel_out_of_range``  a taxel is broken from power-up on: board, triangle, taxel
    ``foreign_frame``       another device on the bus sent a frame: identifier, length
    ``command_received``    boards obeyed or answered a frame of the host: identifier, payload, boards
    ======================  ============================================================================================

    Attributes:
        time_ns: CLOCK_MONOTONIC ns of the bus that carries the frames.
        board: number of the device; of ROBOSKIN boards, the CAN address.
        cycle: number of the device's burst since power-up, from 0.
        position: of the frame in its burst, from 0; of ``unsent`` ones, in the burst after its other faults.
        identifier: with ``EXTENDED_FLAG`` for 29-bit identifiers.
        payload: hexadecimal digits, as it was sent; of lost frames, as it would have been.
        boards: the devices that obeyed or answered, by their numbers before that.
    """

    event: EventName
    time_ns: int
    board: int = -1
    triangle: int = -1
    taxel: int = -1
    cycle: int = -1
    position: int = -1
    identifier: int = -1
    half: Half | None = None
    fault: str | None = None
    reason: str | None = None
    payload: str | None = None
    length: int = -1
    delay_ns: int = -1
    ready_ns: int = -1
    code: int = -1
    boards: Sequence[int] = ()


class JsonLinesLog:
    """Write events to a file, one JSON object a line, each as soon as it happens.

    Raises:
        ConfigurationError: the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self._encoder = msgspec.json.Encoder()
        try:
            self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close()
        except OSError as error:
            raise ConfigurationError(f"cannot write the log {path}: {error.strerror}") from error

    def append(self, event: Event) -> None:
        self._file.write(self._encoder.encode(event) + b"\n")

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()
