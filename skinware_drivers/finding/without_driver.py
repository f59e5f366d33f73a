"""Look at and ask a bus that no driver has, and leave it as it was found."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from typing import Any

import numpy as np

from skinware.errors import BusError, BusNotAvailable, BusSendError, ConfigurationError, HandshakeTimeout
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.description import Patch
from skinware_drivers.finding.guess import Traffic, patches_heard
from skinware_drivers.link import Link
from skinware_drivers.operations import check_arguments, operations_of
from skinware_drivers.options import nearest_name


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
    """Do what an adapter declares, without a running driver.

    Where something is sending, another program is at work: only operations that change nothing are then carried out.
    Nobody is asked to describe himself there: they get the patch that is meant if it was heard, else none. Devices
    that were silent are silent again afterwards.

    Args:
        bus: not open.
        bus_name: for messages.
        adapter: the driver's object for it.
        operation: name.
        arguments: of it; ``patch``: the only patch that is meant.
        agree: called with the patches that are meant before anything is changed; may raise.
        force: change things also where something is sending.

    Returns:
        What the operation returns.

    Raises:
        ConfigurationError: no such operation, patch or argument; the bus is in use, or another kind of bus.
        BusError: it cannot be opened, nobody answers, or what the operation raises.
    """
    declared = operations_of(type(adapter), alone=True)
    if operation not in declared:
        raise ConfigurationError(f"no operation {operation!r}{nearest_name(operation, declared)}")
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
                f"{bus_name}: {traffic.frames} frames were heard in {_LISTEN_S:g} s, so another program may be using"
                " the bus: end it, or say --force"
            )
        if is_live and not force:
            patches: Sequence[Patch] = await patches_heard(traffic, bus, adapter) if patch_name else ()
        else:
            patches = await _describe(adapter, link, bus_name, required=not wanted.looks)
        patches = _meant(patches, patch_name)
        if not wanted.looks:
            agree(patches)
        try:
            return await wanted.method(adapter, link, patches, **arguments)
        except (TypeError, ValueError) as error:  # an argument of another type than it wants
            raise ConfigurationError(f"{operation}: {error}") from error
        finally:
            if wanted.sets_up and not is_live:
                await _stop(adapter, link)


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


def _meant(patches: Sequence[Patch], name: object) -> Sequence[Patch]:
    if name is None:
        return patches
    meant = [patch for patch in patches if patch.name == name]
    if not meant:
        there_are = ", ".join(patch.name for patch in patches) or "none"
        raise ConfigurationError(f"no patch {name!r}; there are: {there_are}")
    return meant


async def _stop(adapter: AnyAdapter, link: Link) -> None:
    try:
        await adapter.stop(link)
    except BusSendError as error:
        raise BusError(f"{error}; devices may be sending now") from None
