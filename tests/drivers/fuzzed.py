"""Drivers that random frames are fed to."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.can.allegro_v5 import AllegroV5Driver, AllegroV5Options, AllegroV5UdpDriver
from skinware_drivers.can.linkerhand import LinkerHandDriver, LinkerHandOptions
from skinware_drivers.link import Link
from skinware_drivers.virtual.bus import VirtualCanBus


def allegro(model: str, **options: object) -> AllegroV5Driver:
    """An Allegro hand on CAN that nothing was heard of."""
    adapter = AllegroV5Driver(AllegroV5Options(model=model, learn_s=0.001, **options))  # type: ignore[arg-type]
    asyncio.run(adapter.describe(Link(VirtualCanBus("allegro_v5"))))
    return adapter


FUZZED: Mapping[str, Callable[[], AnyAdapter]] = {
    "linkerhand-12x6": lambda: LinkerHandDriver(LinkerHandOptions(touch="12x6")),
    "linkerhand-10x4": lambda: LinkerHandDriver(LinkerHandOptions(touch="10x4")),
    "linkerhand-fingers": lambda: LinkerHandDriver(LinkerHandOptions(touch="fingers")),
    "linkerhand-hand_23x9": lambda: LinkerHandDriver(LinkerHandOptions(touch="hand_23x9")),
    "allegro_v5-tips": lambda: allegro("tips"),
    "allegro_v5-sense": lambda: allegro("sense"),
    "allegro_v5-udp": lambda: AllegroV5UdpDriver(AllegroV5Options()),
}
