"""Buses that join a running driver, leave it, or return with other options, while the others continue."""

from __future__ import annotations

import asyncio
import itertools
import logging
import select
from collections.abc import Callable, Mapping, Sequence

from skinware.errors import ConfigurationError, DriverError, StructureError
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.bus_names import BusName
from skinware_drivers.description import join_types
from skinware_drivers.running.building import Builder
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.serving import Serving

log: logging.Logger = logging.getLogger("skinware.driver")


class BusChanges:
    """Changes the buses of a running driver, one change at a time. Programs see a new generation after each.

    A bus keeps its place, and with it the uids of its sensors: the place of a removed bus stays empty until a bus of
    the same name is added.

    Args:
        lines: the driver's buses, by place; changed.
    """

    def __init__(self, lines: list[BusLine], epoll: select.epoll, builder: Builder, serving: Serving) -> None:
        self._lines, self._epoll, self._builder, self._serving = lines, epoll, builder, serving
        self._changing = asyncio.Lock()

    async def change_to(self, wanted: Mapping[str, AnyAdapter], make_bus: Callable[[str, AnyAdapter], Bus]) -> None:
        """Change to these buses: add the new ones, reopen those with other options, remove the rest.

        All is checked before anything is changed.

        Args:
            wanted: the driver's object for every bus, by the name of the bus.
            make_bus: makes a bus of a name, for the driver's object.

        Raises:
            ConfigurationError: two buses contradict each other, or none with sensors would be left.
        """
        async with self._changing:
            leaving = [line for line in self._present if line.name not in wanted]
            replaced: dict[str, BusLine] = {}
            coming = []
            for name, adapter in wanted.items():
                same = next((line for line in self._present if line.name == name), None)
                if same is not None:
                    if same.adapter.options != adapter.options:
                        replaced[name] = same
                    continue
                old = next((line for line in leaving if BusName.of(line.name).place == BusName.of(name).place), None)
                if old is None:
                    coming.append(name)
                else:
                    leaving.remove(old)
                    replaced[name] = old
            places = [line.ordinal for line in replaced.values()]
            new = [
                BusLine(name, place, wanted[name], make_bus(name, wanted[name]), self._epoll)
                for name, place in zip([*replaced, *coming], [*places, *self._places(coming)], strict=True)
            ]
            adapters = {line.ordinal: line.adapter for line in (*self._present, *new)}
            try:
                join_types([adapter.types for adapter in adapters.values()])
            except StructureError as error:
                raise ConfigurationError(str(error)) from None
            if not new:
                self._check_rest(leaving)
            for line in replaced.values():
                await self._take_out(line)
            for line in new:
                await self._put_in(line)
            for line in leaving:
                await self._take_out(line)
                await self._builder.build()

    @property
    def _present(self) -> list[BusLine]:
        return [line for line in self._lines if not line.is_removed]

    def _places(self, names: Sequence[str]) -> list[int]:
        """Return places for buses that join: their old ones if they had some, else behind all others."""
        free = {line.name: line.ordinal for line in self._lines if line.is_removed}
        behind_all = itertools.count(len(self._lines))
        return [free[name] if name in free else next(behind_all) for name in names]

    def _check_rest(self, leaving: Sequence[BusLine]) -> None:
        if leaving and not any(line.patches for line in self._present if line not in leaving):
            names = ", ".join(line.name for line in leaving)
            raise ConfigurationError(f"bus {names}: the last one with sensors; stop the driver instead")

    async def _put_in(self, line: BusLine) -> None:
        async with self._builder.built:
            line.begin_lost()
            self._lines[line.ordinal : line.ordinal + 1] = [line]
            self._builder.rebuild(forced=True)  # before anything of it arrives
        self._serving.begin(line)

    async def _take_out(self, line: BusLine) -> None:
        """Stop the devices of a bus, and close it. Its sensors stay in the structure until the next build."""
        await self._serving.end(line)
        try:
            await line.stop()
        except DriverError as error:
            log.warning("%s", str(error))  # the bus is removed all the same
        async with self._builder.built:
            line.remove()
