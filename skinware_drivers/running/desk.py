"""Answer the requests of programs to a running driver."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from skinware.errors import BusError, ConfigurationError, DriverError
from skinware.realtime import now_ns
from skinware.service import Request, RequestServer
from skinware.service.messages import ACQUIRE
from skinware.text import nearest_name
from skinware_drivers.description import Patch
from skinware_drivers.operations import Operation, check_arguments, operations_of
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.guard import Ending, hook
from skinware_drivers.running.publisher import NEVER_NS

log: logging.Logger = logging.getLogger("skinware.driver")

_declared = cache(operations_of)


class RequestDesk:
    """Carries out operations on the buses, and answers requests for new snapshots.

    Args:
        changed: called after an operation with its bus, its patches, and whether it set them up again.
        ending: of the driver; errors outside of an operation end it.
    """

    def __init__(
        self,
        server: RequestServer,
        lines: Sequence[BusLine],
        listen_only: bool,
        changed: Callable[[BusLine, Sequence[Patch], bool], object],
        ending: Ending,
    ) -> None:
        self._server = server
        self._lines = lines
        self._listen_only = listen_only
        self._changed = changed
        self._ending = ending
        self._waiting: list[tuple[int, Request]] = []
        self._tasks: set[asyncio.Task[None]] = set()

    def take(self) -> None:
        """Take the requests that have arrived; safe as a callback of the loop."""
        self._waiting = [(time_ns, request) for time_ns, request in self._waiting if not request.cancelled]
        for request in self._server.take():
            if request.operation == ACQUIRE:
                self._waiting.append((now_ns(), request))
            else:
                task = asyncio.get_running_loop().create_task(self._carry_out(request))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
                task.add_done_callback(self._ending.watch)

    @property
    def wanted_ns(self) -> int:
        """The oldest data that is new enough for a waiting request, CLOCK_MONOTONIC ns; far ahead: none waits."""
        return min((time_ns for time_ns, request in self._waiting if not request.cancelled), default=NEVER_NS)

    def published(self, oldest_ns: int, position: tuple[int, int]) -> None:
        """Answer the requests that waited for a snapshot that was published, by the oldest stamp of its new data."""
        answered = [request for time_ns, request in self._waiting if time_ns <= oldest_ns]
        self._waiting = [(t, r) for t, r in self._waiting if t > oldest_ns and not r.cancelled]
        for request in answered:
            request.reply(position=position)

    async def close(self) -> None:
        """Cancel running operations; their callers see the driver hang up."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _carry_out(self, request: Request) -> None:
        arguments = dict(request.arguments)
        bus, patch = arguments.pop("bus", None), arguments.pop("patch", None)
        try:
            does: dict[BusLine, tuple[object, Operation]] = {}
            for line in self._lines:
                for doer in (line.bus, line.adapter):  # the adapter's own comes first
                    if request.operation in _declared(type(doer)):
                        does[line] = doer, _declared(type(doer))[request.operation]
            if self._listen_only and any(doer is line.adapter for line, (doer, _) in does.items()):
                raise ConfigurationError("this driver only listens (--listen-only)")
            meant = self._meant(list(does), bus, patch)
            for line, _ in meant:
                check_arguments(does[line][1].method, arguments)
        except (ConfigurationError, TypeError) as error:
            request.fail(f"{request.operation}: {error}", "refused")
            return
        results = await asyncio.gather(
            *(self._on_bus(line, patches, request, does[line], arguments) for line, patches in meant),
            return_exceptions=True,
        )
        failures = []
        for (line, _), result in zip(meant, results, strict=True):
            if isinstance(result, BaseException):
                is_known = isinstance(result, BusError | ConfigurationError | ValueError)
                failures.append(f"{line.name}: {result if is_known else f'{type(result).__name__}: {result}'}")
        if failures:
            request.fail(f"{request.operation}: {'; '.join(failures)}")
        else:
            request.reply({line.name: result for (line, _), result in zip(meant, results, strict=True)})

    async def _on_bus(
        self,
        line: BusLine,
        patches: Sequence[Patch],
        request: Request,
        job: tuple[object, Operation],
        arguments: dict[str, Any],
    ) -> object:
        doer, operation = job
        async with line.busy:
            if request.cancelled:
                return None
            if line.connection.lost.is_set():
                raise ConfigurationError("the bus is away")
            try:
                with hook(request.operation, line.name):
                    result = await operation.method(doer, line.link, patches, **arguments)
            except DriverError as error:
                if not isinstance(error.__cause__, ValueError):  # raised for arguments that make no sense
                    log.warning("%s", str(error))
                raise error.__cause__ if isinstance(error.__cause__, Exception) else error from None
        try:
            self._changed(line, patches, operation.sets_up)
        except Exception as error:
            self._ending.fail(error)
            raise
        return result

    def _meant(self, able: Sequence[BusLine], bus: object, patch: object) -> list[tuple[BusLine, Sequence[Patch]]]:
        lines = [line for line in able if bus in (None, line.name) and line.patches]
        if not lines:
            others = nearest_name(str(bus), [line.name for line in able if line.patches])
            raise ConfigurationError(f"no bus {bus!r} with patches{others}")
        if patch is None:
            return [(line, line.patches or ()) for line in lines]
        meant = [(line, [p for p in line.patches or () if p.name == patch]) for line in lines]
        if not any(patches for _, patches in meant):
            others = nearest_name(str(patch), [p.name for line in lines for p in line.patches or ()])
            raise ConfigurationError(f"no patch {patch!r}{others}")
        return [(line, patches) for line, patches in meant if patches]


def offered(lines: Sequence[BusLine]) -> dict[str, Callable[..., Any]]:
    declared: dict[str, Operation] = {}
    for line in lines:
        declared |= _declared(type(line.bus)) | _declared(type(line.adapter))
    return {name: operation.method for name, operation in sorted(declared.items())}
