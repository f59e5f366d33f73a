"""An emulated pad of FlexiTac or 3D-ViTac, which sends from power-up on, and hears nothing.

Sources: ``32_16_fast.ino`` of FlexiTac/FlexiTac_Hardware_Repo, and for the text ``MatrixArray.ino`` of
binghao-huang/3D-ViTac_Tactile_Hardware. A real FlexiTac sends the next marker right after a frame; this one sends it a
period later, so that a frame is known to be whole only then.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from skinware_drivers.virtual import Device, Places, SerialEmulator, SerialEmulatorOptions, on_a_grid


class EmulatedFlexiTacOptions(SerialEmulatorOptions, frozen=True):
    rows: Annotated[int, Meta(ge=1, le=64, description="rows of the pad")] = 12
    columns: Annotated[int, Meta(ge=1, le=64, description="columns of the pad")] = 32
    firmware: Annotated[Literal["binary", "text"], Meta(description="firmware of the pad")] = "binary"
    broken_rows: Annotated[tuple[int, ...], Meta(description="rows whose cells all read 0")] = ()
    broken_columns: Annotated[tuple[int, ...], Meta(description="columns whose cells all read 0")] = ()


class EmulatedFlexiTac(SerialEmulator[EmulatedFlexiTacOptions]):
    """One pad, device 1.

    Values: one for each cell, row by row.
    """

    full_scale = 255
    rest = 20
    swing = 220
    speed_mbit_s: ClassVar[int] = 2
    streams = "always"

    def __init__(self, options: EmulatedFlexiTacOptions, **more: Any) -> None:
        super().__init__(options, **more)
        self._sound = np.ones((options.rows, options.columns), np.int64)
        self._sound[list(options.broken_rows)] = 0
        self._sound[:, list(options.broken_columns)] = 0

    def places(self) -> Places:
        return on_a_grid(self.options.rows * self.options.columns, self.options.columns)

    def messages(self, device: Device, values: Sequence[int]) -> Sequence[bytes]:  # noqa: ARG002
        cells = np.reshape(values, self._sound.shape) * self._sound
        if self.options.firmware == "binary":
            return [b"\xaa\x55" + cells.astype(np.uint8).tobytes()]
        lines = ["".join(f"{cell} " for cell in row) for row in cells.tolist()]
        return ["\r\n".join([*lines, "", ""]).encode()]
