"""Emulated patches for skintalk: silent until '1', then a record for every cell, until '0'.

An OctoCan3 takes 'X' and 'S'. Sources: ``skintalk.c`` of github.com/t173/skinvis, ``main.c`` of
github.com/t173/octocan3.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Literal

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid


class EmulatedSkintalkOptions(SerialEmulatorOptions, frozen=True):
    patches: Annotated[tuple[int, ...], Meta(description="numbers of the patches")] = (1, 2, 3, 4, 5, 6, 7, 8)
    cells: Annotated[int, Meta(ge=1, le=16, description="cells of each patch")] = 16
    firmware: Annotated[Literal["octocan", "octocan3"], Meta(description="whose commands are obeyed")] = "octocan"
    period_ms: Annotated[float, Meta(ge=0.1, description="time between two records of a cell, ms")] = 20


class EmulatedSkintalk(SerialEmulator[EmulatedSkintalkOptions]):
    """Patches on one line.

    Values: one for each cell.
    """

    full_scale = 0x7F_FFFF
    lowest = -0x80_0000
    rest = 50_000
    swing = 2_000_000
    numbered_by = "patches"

    @property
    def _commands(self) -> dict[bytes, bytes]:
        """Answer to each command."""
        if self.options.firmware == "octocan":
            return {b"1": b"", b"0": b""}
        return {b"X": b"Logging\r\n", b"S": b"STOPPING\r\n", b"C": b"Calibrating\r\n"}

    def places(self) -> Places:
        return on_a_grid(self.options.cells, 4)

    def cut(self, heard: bytes) -> tuple[list[bytes], bytes]:
        """Cut commands of one byte; other bytes mean nothing."""
        return [bytes([byte]) for byte in heard if bytes([byte]) in self._commands], b""

    def answer(self, device: Device, command: bytes, now_ns: int) -> bytes:
        text = self._commands[command]
        if command in b"1X":
            self.start(device, now_ns)
        elif command in b"0S":
            self.stop(device)
        return text

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name cells by the byte for patch and cell: ``0x13``."""
        return f"0x{payload[1]:02x}"

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:
        return [
            bytes((0x55, device.number << 4 | cell)) + struct.pack(">i", value)[1:] for cell, value in enumerate(values)
        ]
