"""Define the states of sensors, patches and buses, and when a value is fresh: small integers, the same in C.

And samples of frames that a driver could not use, beside the counters that say how many there were.
"""

from __future__ import annotations

import enum
from typing import Any

import numpy as np
import numpy.typing as npt

_PERIODS = 3
_LEAST_NS = 200_000_000
_WITHOUT_PERIOD_NS = 1_000_000_000
AHEAD_NS = 200_000_000
"""How far ahead of the clock a stamp may be: clocks of two machines differ a little. Beyond it, no age is known."""
LONGEST_PERIOD_S = 86_400.0
"""That anything may have: a day."""


def age_limit_ns(period_ns: int) -> int:
    """Return how old data may be and still count as fresh: three periods, and at least 0.2 s.

    A driver marks sensors ``STALE`` after the same time. :meth:`skinware.Structure.age_limits_ns` has that of each
    sensor.

    Args:
        period_ns: nominal time between two updates of the data; 0 if it has none: then 1 s.
    """
    return max(_PERIODS * period_ns, _LEAST_NS) if period_ns > 0 else _WITHOUT_PERIOD_NS


def is_fresh(
    status: npt.NDArray[np.uint8],
    time_ns: npt.NDArray[np.int64],
    *,
    at_ns: int | npt.NDArray[np.int64],
    max_age_ns: int | npt.NDArray[np.int64],
    alive: bool = True,
) -> npt.NDArray[np.bool_]:
    """Return which of n sensors are fresh.

    Args:
        status: (..., n) bits of :class:`skinware.Status`.
        time_ns: (..., n) time of each sensor's data (that of its update group), 0: never seen.
        at_ns: the moment at which they are looked at, on the clock of ``time_ns``.
            Stamps of more than 0.2 s later are not fresh.
        max_age_ns: the age beyond which nothing is fresh, or (n,) that of each sensor; see ``age_limit_ns``.
        alive: the driver ran when the sample was taken.

    Returns:
        (..., n) bool.
    """
    if not alive:
        return np.zeros(status.shape, bool)
    is_recent = (time_ns >= at_ns - max_age_ns) & (time_ns <= at_ns + AHEAD_NS)
    fresh: npt.NDArray[np.bool_] = (status == 0) & (time_ns > 0) & is_recent
    return fresh


def are_young(time_ns: npt.NDArray[np.int64], at_ns: int) -> bool:
    """Return whether data of all (n,) times is so recent at a moment that it is fresh, whatever its period."""
    return bool(at_ns - _LEAST_NS <= time_ns.min(initial=at_ns) and time_ns.max(initial=0) <= at_ns + AHEAD_NS)


class Status(enum.IntFlag):
    """Bits of a sensor's status; 0: no problem was known when the sample was published."""

    NEVER_SEEN = 1
    """No value has arrived since the driver started; the value is meaningless."""
    STALE = 2
    """It was valid earlier, and is outdated: older than three periods and 0.2 s, or known to be missing."""
    OUT_OF_RANGE = 4
    """The hardware reports that the true value is beyond its range."""
    NO_ACK = 8
    """The transducer does not answer its patch's microcontroller."""
    NOT_CONNECTED = 16
    """The hardware reports that no transducer is connected."""
    MASKED = 32
    """Switched off by configuration."""
    SUSPECT = 64
    """Some event makes the value doubtful (for example, the hardware moved its own baseline)."""
    UNHEALTHY = 128
    """The sensor has had a fault for minutes (stuck, noisy, dead ...), so its value is doubtful; set by skin-calm."""


class Why(enum.IntEnum):
    """Why a taxel of a calmed driver is in its state."""

    REST = 0
    """It is at rest."""
    HELD = 1
    """It is touched; its offset is predicted, not measured."""
    RELEARNING = 2
    """Its offset is not known yet, or less well than its noise."""
    COVERED = 3
    """It is far from its offset, which was learned under a load or before a cover sank nearby."""
    DOUBTED = 4
    """It falls and returns again and again where nothing touches: its polarity may be wrong."""
    SATURATED = 5
    """It is at the end of its range: it may bear more than it shows."""
    NO_RESOLUTION = 6
    """It has too few levels to show how strong a touch is."""


class PatchState(enum.IntEnum):
    """State of a patch (microcontroller)."""

    EXPECTED = 0
    """Part of the structure, but has not sent yet."""
    LIVE = 1
    """Its data arrives."""
    STALE = 2
    """It was live and fell silent."""
    RESTARTED = 3
    """It came back from a power cycle and is being configured again."""


class BusState(enum.IntEnum):
    """State of a bus."""

    CONNECTING = 0
    """Not open yet, or being opened again."""
    LIVE = 1
    """Open, and frames arrived recently."""
    SILENT = 2
    """Open, but no frame arrived for longer than the driver's silence limit."""
    DOWN = 3
    """The interface exists but is down, its controller is bus-off, or the driver set it aside."""
    GONE = 4
    """The interface disappeared; it is opened again as soon as it is back."""


class BusReason(enum.IntEnum):
    """Why a bus is in its state; for a live bus, a problem that it has nevertheless."""

    NONE = 0
    """Nothing is wrong, or nothing more is known."""
    NOTHING_HEARD = 1
    """Open and in order, but no frame arrived for longer than the driver's silence limit."""
    INTERFACE_DOWN = 2
    """The interface was set down."""
    INTERFACE_GONE = 3
    """There is no such interface (any more)."""
    REFUSED = 4
    """The driver's account may not use it."""
    FAILED = 5
    """The interface or its library failed in another way, for example because the adapter was unplugged."""
    BUS_OFF = 6
    """The controller counted so many send errors that it took itself off the bus."""
    ERROR_PASSIVE = 7
    """The controller counted many errors and is error-passive: no acknowledgement, or bad wiring."""
    ERROR_WARNING = 8
    """The controller sees errors more often than it should."""
    OVERFLOW = 9
    """The controller lost frames because the machine did not fetch them in time."""
    NO_ACKNOWLEDGEMENT = 10
    """No other node acknowledges what is sent."""
    BUS_ERRORS = 11
    """The controller receives broken frames: another bit rate, missing termination, bad wiring."""
    REMOVED = 12
    """The bus was removed from the driver's configuration."""
    SET_ASIDE = 13
    """The driver's own code failed on this bus: it was closed, and is tried again later. The driver's log says why."""


class DataPath(enum.IntEnum):
    """The code that receives the frames of a bus. Compiled code decodes and publishes all of them."""

    NOT_TOLD = 0
    """The driver does not say."""
    PYTHON = 1
    """Python: an adapter of python-can, an emulated bus."""
    NATIVE = 2
    """Compiled code."""
    MIXED = 3
    """Compiled code on some buses of a driver, Python on others; never of a bus."""

    @classmethod
    def _missing_(cls, value: object) -> DataPath:
        del value
        return cls.NOT_TOLD


LOAD_UNKNOWN, LOAD_FILTERED = 0, 0xFFFF
"""In place of a bus' load: its bit rate is not known; or its filters drop frames without counting them."""


def load_report(load: int) -> dict[str, float | str | None]:
    """Return a bus' load as JSON has it: ``load``, 0 to 1; if it is not known, ``load_unknown`` says why."""
    if load in (LOAD_UNKNOWN, LOAD_FILTERED):
        return {"load": None, "load_unknown": "filter" if load == LOAD_FILTERED else "bit_rate"}
    return {"load": load / 1000, "load_unknown": None}


SAMPLES_OF_A_KIND = 3
"""Number of samples for each reason and bus."""
DATA_BYTES = 8
"""Bytes of a frame that are kept at most."""
_EXTENDED_FLAG = 0x8000_0000  # CAN_EFF_FLAG of linux/can.h

SAMPLE = np.dtype(
    [("identifier", "<u4"), ("length", "<u2"), ("why", "u1"), ("reserved", "u1"), ("data", "u1", DATA_BYTES)]
)
"""One sample. ``identifier`` has bit 31 set if it has 29 bits; ``data`` are the first bytes; ``why`` 0: none here."""


class Unused(enum.IntEnum):
    """Why a frame was not used; the counters have the same names."""

    UNKNOWN = 1
    """Its identifier is none of ours."""
    BAD_LENGTH = 2
    """It has a wrong length."""
    BAD_CONTENT = 3
    """Nothing that we know is in it."""
    REFUSED = 4
    """The bus did not take it: a remote frame, one too long for the layout; on a serial line, bytes without a frame."""


SAMPLES = SAMPLES_OF_A_KIND * len(Unused)
"""Places for samples, for each bus."""


def sample_report(samples: npt.NDArray[np.void]) -> list[dict[str, Any]]:
    """Return samples as JSON has them.

    Args:
        samples: (n,) :data:`SAMPLE`; empty places are left out.
    """
    known = {int(why) for why in Unused}
    return [
        {
            "why": Unused(int(sample["why"])).name.lower(),
            "identifier": int(sample["identifier"]) & ~_EXTENDED_FLAG,
            "extended": bool(int(sample["identifier"]) & _EXTENDED_FLAG),
            "length": int(sample["length"]),
            "data": sample["data"][: int(sample["length"])].tobytes().hex(),
        }
        for sample in samples
        if int(sample["why"]) in known
    ]


def sample_text(sample: dict[str, Any]) -> str:
    """One entry of such a report for people: identifier as candump writes it, length, and the first bytes."""
    identifier = f"{sample['identifier']:0{8 if sample['extended'] else 3}X}"
    more = " ..." if sample["length"] > DATA_BYTES else ""
    return f"{identifier} [{sample['length']}] {bytes.fromhex(sample['data']).hex(' ').upper()}{more}".rstrip()
