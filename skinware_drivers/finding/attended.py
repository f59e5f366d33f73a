"""A bus that is open and read in the running event loop, without a driver: for tools that look or ask."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import numpy as np

from skinware.errors import BusNotAvailable
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.link import Link


@asynccontextmanager
async def attended(bus: Bus, take: Callable[[FrameBatch], object] = lambda _batch: None) -> AsyncIterator[Link]:
    """Open a bus, read it until the end of the block, and close it.

    A bus that goes away meanwhile is read no more: what is asked on it then gets no answer.

    Args:
        bus: not open yet.
        take: called with everything that was read at once; the batch is used again afterwards.

    Raises:
        BusNotAvailable: it cannot be opened.
    """
    loop = asyncio.get_running_loop()
    link = Link(bus)
    batch = FrameBatch.for_buses(1, bus.payload_size)

    def read() -> None:
        batch.clear()
        try:
            bus.receive(batch, 0)
        except BusNotAvailable:
            loop.remove_reader(descriptor)
        if len(batch):
            link.offer(batch, np.arange(batch.start, batch.stop))
            take(batch)

    bus.open()
    try:
        descriptor = bus.fileno()
        loop.add_reader(descriptor, read)
        try:
            yield link
        finally:
            loop.remove_reader(descriptor)
    finally:
        bus.close()
