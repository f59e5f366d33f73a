"""Serves the buses of a driver, each in its own task: ask what is attached, set it up, look after it, to the end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence

from skinware.errors import BusError, ConfigurationError, DriverError
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.adapter import Adapter
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
    """Serves buses one by one.

    Args:
        be_ready: called whenever a bus delivers for the first time.
    """

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
                if not self._can_do_without(line, error):
                    raise
                self._aside.add(line)
                await line.set_aside(error)
            await self._builder.build()
            await asyncio.sleep(pauses.next_s())

    def _can_do_without(self, line: BusLine, error: Exception) -> bool:
        """Return whether an error concerns this bus only, and another one is served meanwhile."""
        if isinstance(error, DriverError) and error.bus != line.name:
            return False
        return any(not (other is line or other.is_removed or other in self._aside) for other in self._lines)

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
            if now_ns() - begun_ns > self._pauses[line].longest_s * NS_PER_S:
                self._pauses[line].begin_again()

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
