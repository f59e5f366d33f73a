"""An emulated ROBOSKIN: MTB3 and MTB4 patch controllers on one CAN wire, which obey the real commands.

The boards are silent until a host starts them, or the option ``streaming`` does as if one had. Their commands are in
:mod:`.mtb`, their arithmetic in :mod:`.converters`, their touch in :mod:`.touch`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, cast

import numpy as np

from skinware.geometry import Geometry
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.virtual.device import DATA as BURSTS
from skinware_drivers.virtual.device import Device
from skinware_drivers.virtual.hardware import Event, EventLog, Point, Pressing
from skinware_drivers.virtual.roboskin.boards import DATA, INERTIAL, EmulatedBoard
from skinware_drivers.virtual.roboskin.converters import TriangleState
from skinware_drivers.virtual.roboskin.mtb import Mtb3, Mtb4
from skinware_drivers.virtual.roboskin.touch import (
    CHANNELS,
    TRIANGLES,
    EmulatedRoboskinOptions,
    PressedSkin,
    WireSource,
    cycle_pattern,
)
from skinware_drivers.virtual.stage import Stage

_CONFIGURED = (bytes.fromhex("4D0032F0"), bytes.fromhex("50000F02010022"), bytes.fromhex("0700"))
"""Set-up by a host: type 0, 50 ms, no load 240; all triangles, shift 2, offset 0x2200; start."""


class EmulatedRoboskin(Stage[EmulatedRoboskinOptions]):
    """Emulated boards on one bus.

    Args:
        source: called for every triangle of every burst as ``source(board, triangle, cycle, time_ns)``; its 12 values
            0-255 go on the wire instead of felt ones. Flags stay true.
    """

    numbered_by = "boards"
    longest_queue: ClassVar[int] = 48
    """icub-firmware:emBODY/eBcode/arch-arm/board/mtb4/application/src/main-appcan.cpp"""
    counted: ClassVar[Sequence[str]] = (*Stage.counted, "recalibrations")

    def __init__(
        self, options: EmulatedRoboskinOptions, *, log: EventLog | None = None, source: WireSource | None = None
    ) -> None:
        super().__init__(options, log=log)
        self._source = cycle_pattern if source is None and options.pattern == "cycle" else source
        self.skin = PressedSkin(options, self.world)
        if self.world is not None:
            self.world.fit(options.boards, TRIANGLES * CHANNELS)
        n_boards = len(options.boards)
        self._phases = np.random.default_rng([options.seed, n_boards]).uniform(0.02, 1, n_boards).tolist()

    def geometry(self) -> Geometry:
        return self.skin.geometry()

    def pressing(self, now_ns: int) -> list[tuple[Point, float]]:
        return self.skin.pressing(self.run_to(now_ns))

    def press(self, press: Pressing, now_ns: int) -> dict[str, object]:
        """Press from now on, besides the wandering fingers of the option ``pattern``; see :class:`.PressedSkin`."""
        return self.skin.press(press, self.run_to(now_ns))

    def kind_of(self, identifier: int, payload: bytes) -> str:
        """Name the halves of a triangle by identifier and half: ``0x470-head``; other frames by identifier."""
        name = super().kind_of(identifier, payload)
        if identifier >> 8 == DATA and payload:
            return f"{name}-{'tail' if payload[0] & 0x80 else 'head'}"
        return name

    def kinds(self) -> Sequence[str]:
        found = []
        for board in self.options.boards:
            for triangle in range(TRIANGLES):
                found += [self.kind_of(DATA << 8 | board << 4 | triangle, half) for half in (b"\x40", b"\xc0")]
            found += [self.kind_of(INERTIAL << 8 | board << 4 | sensor, b"") for sensor in (0, 1, 3)]
        return found

    # Faults at a moment of the caller's choice

    def set_triangle(self, address: int, triangle: int, fault: TriangleState, now_ns: int) -> None:
        """Break or mend a triangle; an unplugged one reads full pressure from its next burst on, and is flagged."""
        now_ns = self.run_to(now_ns)
        _board(self.device(address)).set_triangle(triangle, fault, now_ns)

    # The stage's hooks

    def make_device(self, number: int, now_ns: int) -> EmulatedBoard:
        kind = Mtb3 if number in self.options.mtb3 else Mtb4
        phase = self._phases[self.options.boards.index(number)]
        return kind(number, self, self.wire.attach(), now_ns, phase=phase, skin=self.skin, source=self._source)

    def power_up(self, now_ns: int) -> None:
        options = self.options
        self.skin.origin_ns = now_ns
        super().power_up(now_ns)
        for address, triangle, taxel in options.places("out_of_range", 3):
            self.log.append(Event("taxel_out_of_range", now_ns, board=address, triangle=triangle, taxel=taxel))
        if options.streaming:
            for device in self.devices.values():
                for command in _CONFIGURED:
                    self.obey(device, 0x200 | device.number, command, now_ns)

    def boot(self, device: Device, now_ns: int) -> None:
        _board(device).begin(now_ns)

    def obey(self, device: Device, identifier: int, payload: bytes, now_ns: int) -> bool:
        return bool(payload) and _board(device).receive(identifier, payload, now_ns)

    def on_timer(self, device: Device, name: str, time_ns: int) -> None:
        _board(device).on_timer(name, time_ns)

    def skipped(self, device: Device, name: str, times: int) -> int:
        frames = _board(device).frames_of(name, times)
        if name == BURSTS and frames:
            super().skipped(device, name, times)
        return frames

    def part_of(self, identifier: int, payload: bytes, position: int) -> Mapping[str, Any]:
        is_tail = payload[0] & 0x80 if payload else position % 2
        return {"triangle": identifier & 0xF, "half": "tail" if is_tail else "head"}

    def foreign_identifiers(self, random: np.random.Generator) -> Sequence[int]:  # noqa: ARG002
        """Return identifiers of other devices on the bus, none of them from the address of an emulated board.

        Motor boards (class 1), strain gauges (class 3, which is also the old class of skin data), a skin board that no
        host configured (class 4), inertial sensors (class 5), and 29-bit frames that end in the bits of a skin frame
        (classes: icub-firmware-shared:can/canProtocolLib/iCubCanProto_classes.h).
        """
        boards = self.options.boards
        return [
            message_class << 8 | address << 4 | low
            for message_class, low in ((1, 0), (1, 3), (3, 10), (3, 11), (4, 2), (5, 3))
            for address in range(1, 15)
            if address not in boards
        ] + [EXTENDED_FLAG | 0x1234_0000 | 0x400 | address << 4 | 3 for address in boards]


def _board(device: Device) -> EmulatedBoard:
    return cast("EmulatedBoard", device)
