"""CAN frames as text, one a line, as ``candump -L`` writes them and ``canplayer`` and python-can read them.

::

    (1700000000.123456) vcan0 473#40F0F0F0F0F0F0F0      11-bit identifier: three digits
    (1700000000.123456) vcan0 12345678#0102             29-bit identifier: eight digits
    (1700000000.123456) vcan0 473##1112233              CAN FD: a second # and the flags (1 bit-rate switch, 2 error)

Source: can-utils lib.h and the manual of candump.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch

_LONGEST_INTERFACE = 15  # IFNAMSIZ without its end
_FD_BYTES = 8
_FD_FLAG = 0x04  # CANFD_FDF of linux/can.h; newer kernels set it
_FD_FLAGS = 0x03


@dataclass(frozen=True)
class TextFrame:
    """One frame.

    Attributes:
        time_us: when it was heard, microseconds since 1970.
        identifier: 11 or 29 bits.
        extended: 29 bits.
        fd: flags of a CAN FD frame, None for a classic one.
        payload: its data.
    """

    time_us: int
    identifier: int
    extended: bool
    fd: int | None
    payload: bytes

    def line(self, channel: str) -> str:
        """The line of it, without an end.

        Args:
            channel: name of the interface; see :func:`channel_name`.
        """
        seconds, microseconds = divmod(self.time_us, 1_000_000)
        identifier = f"{self.identifier:08X}" if self.extended else f"{self.identifier:03X}"
        flags = "" if self.fd is None else f"#{self.fd:X}"
        return f"({seconds}.{microseconds:06d}) {channel} {identifier}#{flags}{self.payload.hex().upper()}"


def text_frames(batch: FrameBatch, epoch_offset_ns: int) -> Iterator[TextFrame]:
    """The frames of a batch.

    Args:
        batch: of CAN frames.
        epoch_offset_ns: what must be added to CLOCK_MONOTONIC for the time since 1970.
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


def channel_name(interface: str, channel: str) -> str:
    """A name without blanks that can stand for an interface: ``can0``, ``ttyACM0``, ``virtual``."""
    name = channel.rpartition("/")[2] or interface
    return "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)[:_LONGEST_INTERFACE]
