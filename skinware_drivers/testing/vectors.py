"""What a driver makes of literal bytes: of a datasheet, of a recording, or written by hand.

::

    shown = decode_frames(MyDriver(MyOptions()), [(0x310, "01 00 02 00 03 00 04 00")])
    assert shown.values[:4].tolist() == [1, 2, 3, 4]
    assert shown.never_seen.sum() == 12

Bytes that a program computed, say the driver's emulator, prove only that two programs agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware.structure import Structure
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import assemble
from skinware_drivers.serial.adapter import SerialAdapter

_MS = 1_000_000


class Shown(NamedTuple):
    """What users would see after some frames."""

    structure: Structure
    values: npt.NDArray[Any]
    """(n_sensors,) of the driver's dtype, raw."""
    status: npt.NDArray[np.uint8]
    """(n_sensors,) bits of :class:`skinware.status.Status`."""
    unknown: int
    """Frames that belong to no module."""

    @property
    def never_seen(self) -> npt.NDArray[np.bool_]:
        """(n_sensors,) bool: sensors of which no value came."""
        never_seen: npt.NDArray[np.bool_] = (self.status & Status.NEVER_SEEN) != 0
        return never_seen


def decode_frames(adapter: AnyAdapter, frames: Sequence[tuple[int, str | bytes]]) -> Shown:
    """What a driver makes of frames that arrive a millisecond apart.

    Args:
        adapter: the driver. Its ``layout`` and ``patches`` are used, nothing is sent.
        frames: identifier and payload (bytes, or hexadecimal digits) of each.
    """
    decoder = Decoder([adapter.layout], assemble([("bus", adapter.patches)], adapter.types, adapter.dtype))
    batch = FrameBatch(len(frames), adapter.payload_size, decoder.headroom)
    for number, (identifier, payload) in enumerate(frames):
        batch.append(0, (number + 1) * _MS, identifier, _bytes(payload))
    updates, foreign = decoder.decode(batch)
    decoder.state.show(updates)
    state = decoder.state
    return Shown(decoder.tables.structure, state.values.copy(), state.status.copy(), len(foreign))


def decode_stream(adapter: SerialAdapter[Any], stream: str | bytes) -> Shown:
    """What a driver makes of bytes on a serial line.

    Args:
        adapter: the driver. Its ``framing``, ``layout`` and ``patches`` are used, nothing is sent.
        stream: the bytes, or their hexadecimal digits.
    """
    framed = adapter.framing.framer().feed(_bytes(stream))
    return decode_frames(adapter, [(frame.identifier, frame.body) for frame in framed])


def _bytes(data: str | bytes) -> bytes:
    """Spaces between hexadecimal digits may be anywhere, or nowhere."""
    return bytes.fromhex("".join(data.split())) if isinstance(data, str) else data


__all__ = ["Shown", "decode_frames", "decode_stream"]
