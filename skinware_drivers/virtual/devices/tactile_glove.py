"""An emulated tactile glove of Bielefeld University, which sends from power-up on and hears nothing.

Source: the bytes that tactile-filters ``linux/libio/SerialInput.cpp`` reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid


class EmulatedTactileGloveOptions(SerialEmulatorOptions, frozen=True):
    taxels: Annotated[int, Meta(ge=1, le=64, description="taxels of the glove")] = 64
    period_ms: Annotated[float, Meta(ge=0.1, description="time between two packets of a taxel, ms")] = 30


class EmulatedTactileGlove(SerialEmulator[EmulatedTactileGloveOptions]):
    """One glove, device 1.

    Values: one for each taxel; pressure lowers it.
    """

    full_scale = 0xFFF
    rest = 4000
    swing = -3000
    streams = "always"

    def places(self) -> Places:
        return on_a_grid(self.options.taxels, 8)

    def kind_of(self, identifier: int, payload: bytes) -> str:  # noqa: ARG002
        """Name taxels by their first byte: ``0x3c``."""
        return f"0x{payload[0]:02x}"

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:  # noqa: ARG002
        return [bytes((0x3C + taxel, 1, value >> 8, value & 0xFF, 0)) for taxel, value in enumerate(values)]
