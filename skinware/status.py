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
    """The interface exists but is down, its controller is off the bus, or the driver set it aside; it is waited for."""
    GONE = 4
    """The interface vanished; it is opened again as soon as it is back."""


class BusReason(enum.IntEnum):
    """Why a bus is in its state; of a live one, what is nevertheless wrong with it."""

    NONE = 0
    """Nothing is wrong, or nothing more is known."""
    NOTHING_HEARD = 1
    """Open and in order, but no frame came for longer than the driver's silence limit."""
    INTERFACE_DOWN = 2
    """The interface was set down."""
    INTERFACE_GONE = 3
    """There is no such interface (any more)."""
    REFUSED = 4
    """This user may not use it."""
    FAILED = 5
    """The interface or its library failed in another way, say because the adapter was unplugged."""
    BUS_OFF = 6
    """The controller met so many errors in sending that it took itself off the wire."""
    ERROR_PASSIVE = 7
    """The controller met many errors and may only whisper: nobody acknowledges, or the wire is bad."""
    ERROR_WARNING = 8
    """The controller meets errors more often than it should."""
    OVERFLOW = 9
    """The controller lost frames, as the machine did not fetch them in time."""
    NO_ACKNOWLEDGEMENT = 10
    """Nobody on the wire acknowledges what is sent."""
    BUS_ERRORS = 11
    """The controller hears broken frames: another bit rate, missing termination, bad wires."""
    REMOVED = 12
    """The driver was told to do without this bus."""
    SET_ASIDE = 13
    """The driver's own code failed on this bus: it was closed, and is tried again later. The driver's log says why."""


LOAD_UNKNOWN, LOAD_FILTERED = 0, 0xFFFF
"""In place of a bus' load: its bit rate is not known; or its filters leave frames out, which nobody counts."""


def load_report(load: int) -> dict[str, float | str | None]:
    """A bus' load as programs are told: ``load``, 0 to 1, and if that is not known, in ``load_unknown`` why."""
    if load in (LOAD_UNKNOWN, LOAD_FILTERED):
        return {"load": None, "load_unknown": "filter" if load == LOAD_FILTERED else "bit_rate"}
    return {"load": load / 1000, "load_unknown": None}
