"""Drivers that random frames are fed to."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Literal

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.can.allegro_v5 import AllegroV5Driver, AllegroV5Options, AllegroV5UdpDriver
from skinware_drivers.can.linkerhand import LinkerHandDriver, LinkerHandOptions
from skinware_drivers.hand import Hand
from skinware_drivers.link import Link
from skinware_drivers.serial.paxini import PaxiniDriver, PaxiniOptions
from skinware_drivers.serial.paxini_converter import ConverterBoard
from skinware_drivers.serial.paxini_high_speed import HighSpeedBoard
from skinware_drivers.serial.paxini_modules import Slot
from skinware_drivers.virtual.bus import VirtualCanBus


def allegro(model: str, **options: object) -> AllegroV5Driver:
    """An Allegro hand on CAN that nothing was heard of."""
    adapter = AllegroV5Driver(AllegroV5Options(model=model, learn_s=0.001, **options))  # type: ignore[arg-type]
    asyncio.run(adapter.describe(Link(VirtualCanBus("allegro_v5"))))
    return adapter


def paxini(board: Literal["converter", "high_speed"], points: Mapping[int, int]) -> PaxiniDriver:
    """A board of Paxini's with sensors of these ids, or modules in these slots, of so many taxels."""
    adapter = PaxiniDriver(PaxiniOptions(board=board))
    known: ConverterBoard | HighSpeedBoard
    if board == "converter":
        known = ConverterBoard((), 0, lambda: False, period_s=0.01, report=adapter.tell)
        adapter.patches = known.know(points)
    else:
        known = HighSpeedBoard(Hand(), use=adapter.change_framing, report=adapter.tell)
        adapter.patches = known.know([Slot(*each) for each in points.items()])
    adapter.layout, adapter.period_s = known.layout, known.period_s
    return adapter


FUZZED: Mapping[str, Callable[[], AnyAdapter]] = {
    "linkerhand-12x6": lambda: LinkerHandDriver(LinkerHandOptions(touch="12x6")),
    "linkerhand-10x4": lambda: LinkerHandDriver(LinkerHandOptions(touch="10x4")),
    "linkerhand-fingers": lambda: LinkerHandDriver(LinkerHandOptions(touch="fingers")),
    "linkerhand-hand_23x9": lambda: LinkerHandDriver(LinkerHandOptions(touch="hand_23x9")),
    "allegro_v5-tips": lambda: allegro("tips"),
    "allegro_v5-sense": lambda: allegro("sense"),
    "allegro_v5-palm": lambda: allegro("sense", palm="tenfold"),
    "allegro_v5-udp": lambda: AllegroV5UdpDriver(AllegroV5Options()),
    "paxini-converter": lambda: paxini("converter", {1: 31, 8: 9}),
    "paxini-high_speed": lambda: paxini("high_speed", {2: 31, 19: 0, 27: 9}),
}
