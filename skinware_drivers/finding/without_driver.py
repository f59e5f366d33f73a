"""Read and ask a bus without a running driver, and leave its devices as they were."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from skinware.errors import BusError, BusNotAvailable, BusSendError, ConfigurationError, HandshakeTimeout
from skinware.text import nearest_name, plural
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.description import Patch
from skinware_drivers.finding.guess import Traffic, patches_heard
from skinware_drivers.link import Link
from skinware_drivers.operations import check_arguments, operations_of


@asynccontextmanager
async def attended(bus: Bus, take: Callable[[FrameBatch], object] = lambda _batch: None) -> AsyncIterator[Link]:
    """Open a bus, read it until the end of the block, and close it.

    If the bus goes away meanwhile, requests on it get no answer.

    Args:
        bus: not opened yet.
        take: called with each batch of frames, which is used again afterwards.

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


_LISTEN_S = 0.5

Agree = Callable[[Sequence[Patch]], object]


async def carry_out(
    bus: Bus,
    bus_name: str,
    adapter: AnyAdapter,
    operation: str,
    arguments: dict[str, Any],
    *,
    agree: Agree = lambda _patches: None,
    force: bool = False,
) -> Any:
    """Carry out an operation of an adapter, without a running driver.

    If frames are heard, another program is at work: then only operations that change nothing are carried out, and no
    device is asked to describe itself; the operation gets the named patch if it was heard. Devices that were silent are
    silent again afterwards.

    Args:
        bus: not opened yet.
        arguments: of the operation; ``patch``: name of the only patch.
        agree: called with the patches before anything is changed; may raise.

    Returns:
        The result of the operation.

    Raises:
        ConfigurationError: there is no such operation, patch or argument; the bus is in use, or of another kind.
        BusError: the bus cannot be opened, no device answers, or the operation raises it.
    """
    declared = operations_of(type(adapter), alone=True)
    if operation not in declared:
        raise ConfigurationError(f"no operation {operation!r}{nearest_name(operation, sorted(declared))}")
    wanted = declared[operation]
    arguments = dict(arguments)
    patch_name = arguments.pop("patch", None)
    try:
        check_arguments(wanted.method, arguments)
    except TypeError as error:
        raise ConfigurationError(f"{operation}: {error}") from None
    adapter.fit(bus)
    traffic = Traffic()
    async with attended(bus, traffic.take) as link:
        await asyncio.sleep(_LISTEN_S)
        is_live = traffic.frames > 0
        if is_live and not wanted.looks and not force:
            raise ConfigurationError(
                f"{bus_name}: {plural(traffic.frames, 'frame')} heard in {_LISTEN_S:g} s, so another program may be"
                " using the bus: end it, or say --force"
            )
        if is_live and not force:
            patches: Sequence[Patch] = await patches_heard(traffic, bus, adapter) if patch_name else ()
        else:
            patches = await _describe(adapter, link, bus_name, required=not wanted.looks)
        if patch_name is not None:
            names = [patch.name for patch in patches]
            patches = [patch for patch in patches if patch.name == patch_name]
            if not patches:
                raise ConfigurationError(f"no patch {patch_name!r}{nearest_name(str(patch_name), names)}")
        if not wanted.looks:
            agree(patches)
        try:
            return await wanted.method(adapter, link, patches, **arguments)
        except (TypeError, ValueError) as error:  # an argument of another type
            raise ConfigurationError(f"{operation}: {error}") from error
        finally:
            if wanted.sets_up and not is_live:
                try:
                    await adapter.stop(link)
                except BusSendError as error:
                    raise BusError(f"{error}; devices may be sending now") from None


async def _describe(adapter: AnyAdapter, link: Link, bus_name: str, *, required: bool) -> Sequence[Patch]:
    try:
        patches = await adapter.describe(link)
    except HandshakeTimeout:
        if required:
            raise
        return ()
    if not patches and required:
        raise HandshakeTimeout(f"{bus_name}: no device of this driver answers; check power and bit rate")
    return patches
