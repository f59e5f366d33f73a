"""Buses that join a running driver, leave it, or come back with other options, while the others go on."""

from __future__ import annotations

import asyncio
import itertools
import select
from collections.abc import Awaitable, Callable, Mapping, Sequence

from skinware.errors import ConfigurationError, StructureError
from skinware.status import BusReason
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.bus_names import BusName
from skinware_drivers.description import join_types
from skinware_drivers.running.bus_line import BusLine


class BusChanges:
    """Changes the buses of a running driver, one change at a time. Users see a new generation after each.

    Buses keep their places permanently, and with them the uids of their sensors: the place of one that was removed
    stays empty, until a bus of the same name is added.

    Args:
        lines: the driver's buses, by place.
        epoll: for those that join.
        put_in: begins to serve a bus at its place.
        take_out: ends that.
        rebuild: makes a structure of what is there.
    """

    def __init__(
        self,
        lines: Sequence[BusLine],
        epoll: select.epoll,
        put_in: Callable[[BusLine], Awaitable[None]],
        take_out: Callable[[BusLine], Awaitable[None]],
        rebuild: Callable[[], Awaitable[None]],
    ) -> None:
        self._lines = lines
        self._epoll = epoll
        self._put_in = put_in
        self._take_out = take_out
        self._rebuild = rebuild
        self._changing = asyncio.Lock()

    async def change_to(self, wanted: Mapping[str, AnyAdapter], make_bus: Callable[[str, AnyAdapter], Bus]) -> None:
        """Have these buses from now on: add what is new, open anew what has other options, remove the rest.

        All is checked before anything is changed.

        Args:
            wanted: the driver's object for every bus, by the name of the bus.
            make_bus: makes a bus of a name, for the driver's object.

        Raises:
            ConfigurationError: a bus cannot be what it is wanted to be.
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
            self._check_types(new)
            if not new:
                self._check_rest(leaving)
            for line in replaced.values():
                await self._take_out(line)
            for line in new:
                await self._put_in(line)
            for line in leaving:
                await self._take_out(line)
                await self._rebuild()

    @property
    def _present(self) -> list[BusLine]:
        return [line for line in self._lines if line.reason != BusReason.REMOVED]

    def _places(self, names: Sequence[str]) -> list[int]:
        """Where buses go that join: to their old places if they had some, else behind all others."""
        free = {line.name: line.ordinal for line in self._lines if line.reason == BusReason.REMOVED}
        behind_all = itertools.count(len(self._lines))
        return [free[name] if name in free else next(behind_all) for name in names]

    def _check_rest(self, leaving: Sequence[BusLine]) -> None:
        if leaving and not any(line.patches for line in self._present if line not in leaving):
            names = ", ".join(line.name for line in leaving)
            raise ConfigurationError(f"bus {names}: the last one with sensors; stop the driver instead")

    def _check_types(self, new: Sequence[BusLine]) -> None:
        lines = {line.ordinal: line for line in (*self._present, *new)}
        try:
            join_types([line.adapter.types for line in lines.values()])
        except StructureError as error:
            raise ConfigurationError(str(error)) from None
