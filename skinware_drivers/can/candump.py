"""Write the CAN frames of a batch as text (:func:`skinware.wire.candump_line`)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from skinware.wire import candump_line
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch

_FD_BYTES = 8
_FD_FLAG = 0x04  # CANFD_FDF of linux/can.h; newer kernels set it
_FD_FLAGS = 0x03


@dataclass(frozen=True)
class TextFrame:
    """One CAN frame.

    Attributes:
        time_us: time of receipt, microseconds since 1970.
        identifier: 11 or 29 bits.
        extended: whether the identifier has 29 bits.
        fd: flags of a CAN FD frame; None: a classic frame.
    """

    time_us: int
    identifier: int
    extended: bool
    fd: int | None
    payload: bytes

    def line(self, channel: str) -> str:
        """Return the line of the frame, without its end.

        Args:
            channel: name of the interface; see :func:`skinware.wire.channel_name`.
        """
        identifier = self.identifier | (EXTENDED_FLAG if self.extended else 0)
        return candump_line(self.time_us, channel, identifier, self.fd, self.payload)


def text_frames(batch: FrameBatch, epoch_offset_ns: int) -> Iterator[TextFrame]:
    """Yield the frames of a batch.

    Args:
        epoch_offset_ns: time since 1970 minus CLOCK_MONOTONIC, ns.
    """
    rows = slice(batch.start, batch.stop)
    wire = batch.wire[rows]
    columns = (wire[name].tolist() for name in ("identifier", "length", "flags"))
    for identifier, length, flags, payload, time_ns in zip(
        *columns, wire["payload"], batch.time_ns[rows].tolist(), strict=True
    ):
        is_fd = length > _FD_BYTES or bool(flags & _FD_FLAG)
        yield TextFrame(
            time_us=(time_ns + epoch_offset_ns) // 1000,
            identifier=identifier & ~EXTENDED_FLAG,
            extended=bool(identifier & EXTENDED_FLAG),
            fd=flags & _FD_FLAGS if is_fd else None,
            payload=payload[:length].tobytes(),
        )
