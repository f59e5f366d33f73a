"""Twenty cells on CAN, three frames of a 29-bit identifier each; with a right driver, and wrong ones."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware_drivers import (
    EXTENDED_FLAG,
    Bits,
    Cycle,
    Frame,
    Identifier,
    Layout,
    Module,
    NoOptions,
    Patch,
    Sensor,
    Values,
    taxels,
)
from skinware_drivers.can import CanAdapter
from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid

CELLS = range(1, 21)
DATA = EXTENDED_FLAG | 0x18D0_0000
KEY = Bits(0, 5)


def frames_of_a_cell(extended: int = EXTENDED_FLAG, lengths: Sequence[int] = (8, 8, 4)) -> list[Frame]:
    return [
        Frame(
            f"part {part}",
            [Identifier(extended | 0x18D0_0000 & (0x1FFF_FFFF if extended else 0x7FF) | part, mask=0x1FFF_00FF)],
            [length],
            Values(0, "<u2", length // 2, to=range(4 * part, 4 * part + length // 2)),
            module=Bits(8, 8),
        )
        for part, length in enumerate(lengths)
    ]


class Cells(CanAdapter[NoOptions]):
    """The right driver."""

    types = (PRESSURE.measured(unit="counts"), TEMPERATURE.measured(scale=0.01))
    dtype = np.uint16
    period_s = 0.02
    keys = CELLS
    layout = Layout(frames_of_a_cell(), Cycle(["part 0", "part 1", "part 2"], maximum_age_s=0.01))

    @property
    def patches(self) -> Sequence[Patch]:  # type: ignore[override]
        return [
            Patch(
                "skin", [Module([*taxels(9, first_uid=16 * n), Sensor("temperature", uid=n)], key=n) for n in self.keys]
            )
        ]


class ShiftedKeys(Cells):
    keys = range(2, 22)


class ElevenBits(Cells):
    """Its author took the identifiers for those of 11 bits."""

    layout = Layout(
        [
            Frame(
                f"part {p}",
                [Identifier(p << 5, 0x7E0)],
                [n],
                Values(0, "<u2", n // 2, range(4 * p, 4 * p + n // 2)),
                module=KEY,
            )
            for p, n in enumerate((8, 8, 4))
        ]
    )


class NoTemperatures(Cells):
    """The third frame has another length than the layout says."""

    layout = Layout(frames_of_a_cell(lengths=(8, 8, 2)), Cycle(["part 0", "part 1", "part 2"], maximum_age_s=0.01))


class EmulatedCells(Emulator[EmulatorOptions]):
    """They send by themselves. Pressures have 12 bits, temperatures 10."""

    full_scale: int | Sequence[int] = ([4095] * 9 + [1023]) * len(CELLS)
    lowest: int | Sequence[int] = ([0] * 9 + [100]) * len(CELLS)
    rest: int | Sequence[int] = ([200] * 9 + [512]) * len(CELLS)
    swing: int | Sequence[int] = ([3000] * 9 + [50]) * len(CELLS)
    period_s = 0.02
    numbers = (0,)

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(len(CELLS), 5, each=10)

    def boot(self, device: Device, now_ns: int) -> None:
        self.start(device, now_ns)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        sent = []
        for number, cell in enumerate(CELLS):
            own = values[10 * number : 10 * number + 10]
            parts = [struct.pack(f"<{len(part)}H", *part) for part in (own[:4], own[4:8], own[8:])]
            sent += [(DATA | cell << 8 | part, payload) for part, payload in enumerate(parts)]
        return sent
