"""Serves the buses of a driver, each in its own task; they join, leave, or return with other options meanwhile."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import select
from collections.abc import Callable, Mapping, Sequence

from skinware.errors import BusError, ConfigurationError, DriverError, StructureError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.bus_names import BusName
from skinware_drivers.description import join_types
from skinware_drivers.polling import Poll, check_polls
from skinware_drivers.running.building import Builder
from skinware_drivers.running.bus_line import BusLine, are_patches
from skinware_drivers.running.guard import Backoff, Ending, hook
from skinware_drivers.running.patch_care import PatchCare
from skinware_drivers.running.poller import Poller

log: logging.Logger = logging.getLogger("skinware.driver")

_SILENCE_S = 0.5
"""How long a patch may be silent, before there is a structure that says it."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
"""How long a bus stays set aside."""


class Serving:
    """Serves buses one by one; ``be_ready`` is called whenever one delivers for the first time."""

    def __init__(
        self,
        lines: Sequence[BusLine],
        listen_only: bool,
        builder: Builder,
        be_ready: Callable[[], None],
        ending: Ending,
    ) -> None:
        self._lines, self._listen_only, self._builder = lines, listen_only, builder
        self._be_ready, self._ending = be_ready, ending
        self._tasks: dict[BusLine, asyncio.Task[None]] = {}
        self._join_requested = asyncio.Event()
        self._pauses: dict[BusLine, Backoff] = {}
        self._aside: set[BusLine] = set()  # the driver's own code failed on them, and has not succeeded since

    def begin(self, line: BusLine) -> None:
        task = asyncio.get_running_loop().create_task(self._serve(line))
        task.add_done_callback(self._ending.watch)
        self._tasks[line] = task

    async def end(self, *lines: BusLine) -> None:
        """Stop serving these buses; default: all."""
        tasks = [self._tasks.pop(line) for line in lines or tuple(self._tasks)]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def join(self) -> None:
        """Add what has appeared on the buses since the start."""
        self._join_requested.set()

    async def _serve(self, line: BusLine) -> None:
        """Serve one bus; if the driver's own code fails on it, set it aside and begin again."""
        pauses = self._pauses[line] = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)
        while True:
            try:
                await self._serve_once(line)
            except (DriverError, ConfigurationError) as error:
                task = asyncio.current_task()
                if task is not None and task.cancelling():
                    log.warning("%s", str(error))
                    return
                concerns_all = isinstance(error, DriverError) and error.bus != line.name
                others = [one for one in self._lines if not (one is line or one.is_removed or one in self._aside)]
                if concerns_all or not others:
                    raise
                self._aside.add(line)
                await line.set_aside(error)
            await self._builder.build()
            await asyncio.sleep(pauses.next_s())

    async def _serve_once(self, line: BusLine) -> None:
        """Serve one bus from its discovery on."""
        await line.describe(self._builder.build)
        try:
            async with asyncio.TaskGroup() as beside:
                care = PatchCare(
                    line, lambda: self._builder.generation, self._listen_only, self.join, beside.create_task
                )
                beside.create_task(self._join_on_request(line))
                beside.create_task(care.attend(lambda: self._silence_s))
                if not self._listen_only:
                    await line.set_up()
                    if type(line.adapter).polls is not Adapter.polls:
                        beside.create_task(self._poll(line))
                async with self._builder.built:  # other buses may still be asked what is attached to them
                    await self._builder.built.wait_for(lambda: self._builder.generation is not None)
                await care.check_data()
                self._be_ready()
                await self._look_after(line, care)
        except BaseExceptionGroup as failures:
            first = failures.exceptions[0]
            raise first from first.__cause__

    async def _look_after(self, line: BusLine, care: PatchCare) -> None:
        begun_ns = now_ns()
        try:
            while True:
                line.needs_care.clear()
                if line.connection.lost.is_set():
                    await line.reopen()
                await care.recover_silent()
                with contextlib.suppress(TimeoutError):
                    # not wait_for: that of Python 3.11 forgets a cancellation that comes in the moment of a loss
                    async with asyncio.timeout(self._silence_s):
                        await line.connection.lost.wait()
                self._aside.discard(line)
                await line.needs_care.wait()
        finally:
            self._pauses[line].begin_again_after(now_ns() - begun_ns)

    async def _poll(self, line: BusLine) -> None:
        logged = {""}

        def check(polls: Sequence[Poll]) -> None:
            doubt = check_polls(polls, line.adapter.wire_s)
            if doubt not in logged:
                logged.add(doubt)
                log.warning("%s: %s", line.name, doubt)

        with hook("polls", line.name):
            await Poller(line.link, line.bus.counters, check).run(
                lambda: line.adapter.polls, line.connection.lost.is_set
            )

    async def _join_on_request(self, line: BusLine) -> None:
        while True:
            await self._join_requested.wait()
            self._join_requested.clear()
            try:
                with hook("join", line.name):
                    patches = are_patches(await line.adapter.join(line.link, line.patches or ()))
            except BusError as error:
                log.warning("%s: nothing joined: %s", line.name, str(error))
                continue
            if patches:  # also the same ones: what is known of their types and frames may have changed
                line.patches = patches
                await self._builder.build()

    @property
    def _silence_s(self) -> float:
        generation = self._builder.generation
        return _SILENCE_S if generation is None else generation.publisher.pace.silence_ns / NS_PER_S


class BusChanges:
    """Changes the buses of a running driver, one change at a time. Programs see a new generation after each.

    A bus keeps its place, and with it the uids of its sensors: the place of a removed bus stays empty until a bus of
    the same name is added.
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
            staying = [line for line in self._present if line not in leaving]
            if leaving and not new and not any(line.patches for line in staying):
                names = ", ".join(line.name for line in leaving)
                raise ConfigurationError(f"bus {names}: the last one with sensors; stop the driver instead")
            for line in replaced.values():
                await self._take_out(line)
            for line in new:
                async with self._builder.built:
                    line.begin_lost()
                    self._lines[line.ordinal : line.ordinal + 1] = [line]
                    self._builder.rebuild(forced=True)  # before anything of it arrives
                self._serving.begin(line)
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

    async def _take_out(self, line: BusLine) -> None:
        """Stop the devices of a bus, and close it. Its sensors stay in the structure until the next build."""
        await self._serving.end(line)
        try:
            await line.stop()
        except DriverError as error:
            log.warning("%s", str(error))  # the bus is removed all the same
        async with self._builder.built:
            line.remove()
