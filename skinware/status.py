"""What a driver says of each sensor, patch and bus in every frame: small integers, the same for C readers."""

from __future__ import annotations

import enum


class Status(enum.IntFlag):
    """Bits of a sensor's status; 0 means fresh and good."""

    NEVER_SEEN = 1
    """No value has arrived since the driver started; the value is meaningless."""
    STALE = 2
    """The value is older than the patch's last update, or the patch went silent."""
    OUT_OF_RANGE = 4
    """The hardware says that the true value lies beyond what it can express."""
    NO_ACK = 8
    """The transducer does not answer its patch's microcontroller."""
    NOT_CONNECTED = 16
    """The hardware says that no transducer is connected."""
    MASKED = 32
    """Switched off by configuration."""
    SUSPECT = 64
    """Something happened that makes the value doubtful (say, the hardware moved its own baseline)."""


class PatchState(enum.IntEnum):
    """What a patch (microcontroller) is doing."""

    EXPECTED = 0
    """Part of the structure, but not heard yet."""
    LIVE = 1
    """Its data arrives."""
    STALE = 2
    """It was live and fell silent."""
    RESTARTED = 3
    """It came back from a power cycle and is being set up again."""


class BusState(enum.IntEnum):
    """What a bus is doing."""

    CONNECTING = 0
    """Not open yet, or being opened again."""
    LIVE = 1
    """Open, and frames came lately."""
    SILENT = 2
    """Open, but nothing came for longer than the driver's silence limit."""
    DOWN = 3
    """The interface exists but is down; the driver waits for it."""
    GONE = 4
    """The interface vanished; it is opened again as soon as it is back."""
