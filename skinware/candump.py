"""CAN frames as text, one a line, as ``candump -L`` writes them and ``canplayer`` and python-can can read them."""

from __future__ import annotations

from skinware.wire import ERROR, EXTENDED, MASK, REMOTE

_TOLD = 0x03
"""Flags of a CAN FD frame that are told as text."""
_LONGEST_INTERFACE = 15  # IFNAMSIZ without its end


def candump_line(
    epoch_us: int, channel: str, identifier: int, fd_flags: int | None, payload: bytes, direction: str = ""
) -> str:
    """A frame as ``candump -L`` writes it, and ``canplayer`` and python-can read it.

    ::

        (1700000000.123456) vcan0 473#40F0F0F0F0F0F0F0      11-bit identifier: three digits
        (1700000000.123456) vcan0 12345678#0102             29-bit identifier: eight digits
        (1700000000.123456) vcan0 473##1112233              CAN FD: ## and the flags (1 bit-rate switch, 2 error)
        (1700000000.123456) vcan0 123#R                     remote frame
        (1700000000.123456) vcan0 20000004#0004000000000000 error frame: eight digits, with its flag

    Source: can-utils lib.h and the manual of candump.

    Args:
        epoch_us: when, microseconds since 1970.
        channel: name of the interface (:func:`channel_name`).
        identifier: with the flags of linux/can.h.
        fd_flags: of a CAN FD frame; None of a classic one.
        payload: its data.
        direction: ``R`` received, ``T`` sent, or not told.
    """
    seconds, microseconds = divmod(epoch_us, 1_000_000)
    if identifier & ERROR:
        name = f"{identifier & (MASK | ERROR):08X}"
    else:
        name = f"{identifier & MASK:08X}" if identifier & EXTENDED else f"{identifier & MASK:03X}"
    data = "R" if identifier & REMOTE and not identifier & ERROR else payload.hex().upper()
    flags = "" if fd_flags is None else f"#{fd_flags & _TOLD:X}"
    behind = f" {direction}" if direction else ""
    return f"({seconds}.{microseconds:06d}) {channel} {name}#{flags}{data}{behind}"


def channel_name(interface: str, channel: str) -> str:
    """A name without blanks that can stand for an interface: ``can0``, ``ttyACM0``, ``virtual``."""
    name = channel.rpartition("/")[2] or interface
    return "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)[:_LONGEST_INTERFACE]
