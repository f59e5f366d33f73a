"""Emulated pucks of Barrett's BH280, which answer questions about TACT with data.

Source: owd ``openwam/CANbus.cc``. It is assumed that a puck does not answer before a format was chosen, and that the
answer about a property other than TACT goes to group 6.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, Places, on_a_grid

_TACT = 106
_TOP_10, _FULL = 1, 2


class EmulatedBarrettOptions(EmulatorOptions, frozen=True):
    nodes: Annotated[tuple[int, ...], Meta(description="nodes of the pucks")] = (11, 12, 13, 14)


class EmulatedBarrett(Emulator[EmulatedBarrettOptions]):
    """Pucks on one bus. Values are in 1/256 N/cm2."""

    full_scale = 0xFFF
    swing = 3_000
    identifiers: Collection[int] = frozenset(range(0x800)) - {
        i for i in range(0x800) if i >> 5 & 31 not in range(11, 15) and i & 0x41F not in (0x405, 11, 12, 13, 14)
    }
    numbered_by = "nodes"

    def places(self) -> Places:
        return on_a_grid(24, 3)

    def boot(self, device: Device, now_ns: int) -> None:  # noqa: ARG002
        """Wait for questions; with ``streaming``, the format is chosen already."""
        if self.options.streaming:
            device.memory["format"] = _FULL

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        """Obey a command about TACT, or answer a question about another property."""
        if identifier not in (device.number, 0x405) or not payload:
            return False
        number, is_set = payload[0] & 0x7F, payload[0] >= 0x80
        if number != _TACT:
            if is_set:
                return False
            self.reply(device, (device.number << 5 | 0x406, bytes([0x80 + number, 0, 201, 0])), now_ns)
            return True
        if is_set:
            device.memory["format"] = payload[2]
        if device.memory.get("format") not in (_TOP_10, _FULL):
            return is_set
        self.burst(device, now_ns)
        return True

    def kind_of(self, identifier: int, payload: bytes) -> str:
        """Name the frames of all cells by identifier and part: ``0x569-0``."""
        part = f"-{payload[0] >> 4}" if identifier & 0x41F == 0x409 else ""
        return f"{super().kind_of(identifier, payload)}{part}"

    def kinds(self) -> Sequence[str]:
        """Name five frames of all cells, and one of the ten strongest, from each puck."""
        senders = [number << 5 | 0x400 for number in self.numbers]
        whole = [self.kind_of(sender | 9, bytes([part << 4])) for sender in senders for part in range(5)]
        return [*whole, *(self.kind_of(sender | 8, b"") for sender in senders)]

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        sender = device.number << 5 | 0x400
        if device.memory["format"] == _FULL:
            cells = "".join(f"{value:03x}" for value in [*values, 0])
            return [(sender | 9, bytes.fromhex(f"{i:x}{cells[15 * i : 15 * i + 15]}")) for i in range(5)]
        strongest = sorted(sorted(range(24), key=lambda cell: -values[cell])[:10])
        cells = sum(0x800000 >> cell for cell in strongest).to_bytes(3, "big").hex()
        levels = "".join(f"{min(values[cell] >> 8, 15):x}" for cell in strongest)
        return [(sender | 8, bytes.fromhex(cells + levels))]
