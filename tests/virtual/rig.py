"""An emulated patch whose time the test owns."""

from __future__ import annotations

from typing import Any

from skinware_drivers.virtual.hardware import Event, EventName, WireFrame
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions, WireSource

MS = 1_000_000
START_NS = 5_000_000_000_000
ENABLE_ALL = "50 00 0F 02 01 00 22"


def constant_source(value: int) -> WireSource:
    return lambda board, triangle, cycle, time_ns: [value] * 12


def damaged_cycles(events: list[Event]) -> set[tuple[int, int, int]]:
    """Return (board, triangle, cycle) of the triangles of which a host cannot have received both halves intact."""
    return {(e.board, e.triangle, e.cycle) for e in events if e.half is not None and e.fault != "repeated"}


class Rig:
    def __init__(self, *, source: WireSource | None = None, **options: Any) -> None:
        self.log: list[Event] = []
        options.setdefault("boards", (7,))
        self.hardware = EmulatedRoboskin(EmulatedRoboskinOptions(**options), log=self.log, source=source)
        self.now_ns = START_NS
        self.hardware.skip(START_NS)

    def send(self, identifier: int, payload: str) -> None:
        self.hardware.receive(identifier, bytes.fromhex(payload), self.now_ns)

    def run_ms(self, duration_ms: float) -> list[WireFrame]:
        self.now_ns += round(duration_ms * MS)
        return self.hardware.emit(self.now_ns)

    def configure(self, board: int = 7, *, skin_type: int = 0, period_ms: int = 50, start: bool = True) -> None:
        """What a host sends, with the idle value 240, shift 2 and offset 0x2200."""
        self.send(0x200 | board, f"4D {skin_type:02X} {period_ms:02X} F0")
        self.send(0x200 | board, ENABLE_ALL)
        if start:
            self.send(0x200 | board, "07 00")

    def events(self, kind: EventName) -> list[Event]:
        return [event for event in self.log if event.event == kind]

    def lost(self) -> list[Event]:
        return [event for event in self.events("frame_fault") if event.fault in ("lost", "unsent")]

    def streams(self, board: int = 7, period_ms: int = 50) -> bool:
        """Whether skin data of the board comes within four periods."""
        return any(is_data(frame, board) for frame in self.run_ms(4 * period_ms + 5))


def is_data(frame: WireFrame, board: int) -> bool:
    return frame.identifier >> 8 in (3, 4) and frame.identifier >> 4 & 0xF == board


def cycles(frames: list[WireFrame]) -> list[list[WireFrame]]:
    """Frames of one board, split into bursts at gaps of more than 5 ms."""
    bursts: list[list[WireFrame]] = []
    for frame in frames:
        if not bursts or frame.time_ns - bursts[-1][-1].time_ns > 5 * MS:
            bursts.append([])
        bursts[-1].append(frame)
    return bursts
