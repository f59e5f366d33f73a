"""Serves the buses of a driver, each in a task of its own: ask what is there, set it up, look after it, to the end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager

from skinware.errors import BusError, ConfigurationError, DriverError
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusReason
from skinware_drivers.adapter import Adapter
from skinware_drivers.polling import Poll, check_polls
from skinware_drivers.running.bus_line import BusLine, are_patches
from skinware_drivers.running.generation import Generation
from skinware_drivers.running.guard import hook
from skinware_drivers.running.patch_care import PatchCare
from skinware_drivers.running.poller import Poller

log: logging.Logger = logging.getLogger("skinware.driver")

_SILENCE_S = 0.5
"""Before there is a structure that says how long a patch may be silent."""


class Serving:
    """Serves buses one by one.

    Args:
        lines: all buses of the driver; the list may change.
        listen_only: send nothing.
        generation: what is in service now, None before anything is.
        built: notified when something is.
        build: makes a structure of what is there.
        tell_ready: called whenever a bus delivers for the first time.
        fail: called with what ends the driver.
    """

    def __init__(
        self,
        lines: Sequence[BusLine],
        listen_only: bool,
        generation: Callable[[], Generation | None],
        built: asyncio.Condition,
        build: Callable[[], Awaitable[None]],
        tell_ready: Callable[[], None],
        fail: Callable[[BaseException], None],
    ) -> None:
        self._lines = lines
        self._listen_only = listen_only
        self._generation = generation
        self._built = built
        self._build = build
        self._tell_ready = tell_ready
        self._fail = fail
        self._tasks: dict[BusLine, asyncio.Task[None]] = {}
        self._join_requested = asyncio.Event()

    def begin(self, line: BusLine) -> None:
        task = asyncio.get_running_loop().create_task(self._serve(line))
        task.add_done_callback(self._done)
        self._tasks[line] = task

    async def end(self, *lines: BusLine) -> None:
        """Serve these buses no more; default: none at all."""
        tasks = [self._tasks.pop(line) for line in lines or tuple(self._tasks)]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def join(self) -> None:
        """Take in what has appeared on the buses since the start."""
        self._join_requested.set()

    def _done(self, task: asyncio.Task[None]) -> None:
        error = None if task.cancelled() else task.exception()
        if error is not None:
            self._fail(error)

    async def _serve(self, line: BusLine) -> None:
        """One bus to the end; set aside and begun anew when the driver's own code fails on it."""
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
                await line.set_aside(error)
            await self._build()
            await asyncio.sleep(line.aside.next_s())

    def _can_do_without(self, line: BusLine, error: Exception) -> bool:
        """Whether an error concerns this bus only, and another one is served meanwhile."""
        if isinstance(error, DriverError) and error.bus != line.name:
            return False
        others = [other for other in self._lines if other is not line and other.reason != BusReason.REMOVED]
        return not all(other.is_aside for other in others)

    async def _serve_once(self, line: BusLine) -> None:
        """One bus from discovery on: describe, set up, then look after it."""
        await line.describe(self._build)
        with _first_failure():
            async with asyncio.TaskGroup() as beside:
                care = PatchCare(line, self._generation, self._listen_only, self.join, beside.create_task)
                beside.create_task(self._join_on_request(line))
                beside.create_task(care.attend(lambda: self._silence_s))
                if not self._listen_only:
                    await line.set_up()
                    if type(line.adapter).polls is not Adapter.polls:
                        beside.create_task(self._poll(line))
                async with self._built:  # others may still be asked what is there
                    await self._built.wait_for(lambda: self._generation() is not None)
                await care.check_data()
                self._tell_ready()
                await self._look_after(line, care)

    async def _look_after(self, line: BusLine, care: PatchCare) -> None:
        begun_ns = now_ns()
        try:
            while True:
                line.needs_care.clear()
                if line.lost.is_set():
                    await line.reopen()
                await care.recover_silent()
                with contextlib.suppress(TimeoutError):
                    # not wait_for: that of Python 3.11 forgets a cancellation that comes in the moment of a loss
                    async with asyncio.timeout(self._silence_s):
                        await line.lost.wait()
                line.is_aside = False
                await line.needs_care.wait()
        finally:
            if now_ns() - begun_ns > line.aside.longest_s * NS_PER_S:
                line.aside.begin_again()

    async def _poll(self, line: BusLine) -> None:
        told = {""}

        def check(polls: Sequence[Poll]) -> None:
            doubt = check_polls(polls, line.adapter.wire_s)
            if doubt not in told:
                told.add(doubt)
                log.warning("%s: %s", line.name, doubt)

        with hook("polls", line.name):
            await Poller(line.link, line.bus.counters, check).run(lambda: line.adapter.polls, line.lost.is_set)

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
                await self._build()

    @property
    def _silence_s(self) -> float:
        generation = self._generation()
        return _SILENCE_S if generation is None else generation.publisher.pace.silence_ns / NS_PER_S


@contextmanager
def _first_failure() -> Iterator[None]:
    try:
        yield
    except BaseExceptionGroup as failures:
        first = failures.exceptions[0]
        raise first from first.__cause__
