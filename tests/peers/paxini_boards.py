"""Paxini's boards that need no questions: their modules are given."""

from __future__ import annotations

import numpy as np

from skinware_drivers.hand import Hand
from skinware_drivers.options import NoOptions
from skinware_drivers.serial import SerialAdapter
from skinware_drivers.serial.paxini_converter import ConverterBoard
from skinware_drivers.serial.paxini_high_speed import HighSpeedBoard
from skinware_drivers.serial.paxini_modules import TYPES, Slot

SENSOR, SLOTS, POINTS = 3, (0, 6, 18), 52


def known(name: str) -> SerialAdapter[NoOptions]:
    """Return a driver of ``converter`` or ``high_speed``."""
    board: ConverterBoard | HighSpeedBoard
    if name == "converter":
        board = ConverterBoard((SENSOR,), POINTS, lambda: False, period_s=0.01, report=lambda _patch, _notice: None)
        found = board.know({SENSOR: POINTS})
    else:
        board = HighSpeedBoard(Hand("right"), use=lambda _framing: None, report=lambda _patch, _notice: None)
        found = board.know([Slot(number, POINTS) for number in SLOTS])

    class Known(SerialAdapter[NoOptions]):
        framing, layout, patches = board.framing, board.layout, found
        types, dtype = TYPES, np.int16
        payload_size = 256

    return Known(NoOptions())


def messages(stream: bytes) -> list[bytes]:
    """Cut what a board sent into its messages, by their lengths."""
    found = []
    while len(stream) > 8:
        at, more = (2, 5) if stream[2] else (3, 6) if stream[1] == 0x56 else (6, 9)
        size = more + int.from_bytes(stream[at : at + 2], "little")
        found.append(stream[:size])
        stream = stream[size:]
    return found
