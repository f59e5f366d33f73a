"""Samples of frames that a driver could not use, beside the counters that say how many there were."""

from __future__ import annotations

import enum
from typing import Any

import numpy as np
import numpy.typing as npt

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
