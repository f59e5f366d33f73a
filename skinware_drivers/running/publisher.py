"""Keep the columns of a snapshot that C publishes beside the values, and answer the requests of programs."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverWriter
from skinware.errors import BusError, ConfigurationError, DriverError
from skinware.memory.statistics import BUCKETS
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import Request, RequestServer
from skinware.service.messages import ACQUIRE
from skinware.status import LOAD_UNKNOWN, SAMPLE, SAMPLES, BusState, DataPath, PatchState, age_limit_ns
from skinware.structure import Structure
from skinware.text import nearest_name
from skinware_drivers.counters import OWN_BUS_COUNTERS, BusCounters, read_own
from skinware_drivers.decoding.decoder import BUS_COUNTERS, Decoder, SkinState, Updates
from skinware_drivers.description import Patch
from skinware_drivers.operations import Operation, check_arguments, operations_of
from skinware_drivers.polling import Watch
from skinware_drivers.running.bus_line import BusLine
from skinware_drivers.running.guard import Ending, hook

log: logging.Logger = logging.getLogger("skinware.driver")

ALL_BUS_COUNTERS = (*OWN_BUS_COUNTERS, *BUS_COUNTERS)
"""Counters of every bus, in the order of the column ``bus_counters``."""

_IDLE_NS = NS_PER_S // 4
NEVER_NS = (1 << 63) - 1
"""In place of the oldest data that is new enough for a request: none waits."""
_STANDS_OUT = 2.0  # shortest pause between bursts, in mean spacings of a patch's modules


class PublishPace(NamedTuple):
    """Times of the publisher, ns.

    Attributes:
        period_ns: nominal time between two updates of a module.
        patience_ns: from the first update of a cycle to publication without the others. It is longer than a period: a
            late frame must not be cut off from its burst, or bursts mix from then on.
        pause_ns: silence of a patch after which its burst is over.
        idle_ns: between two snapshots without new values.
        silence_ns: silence of a patch after which it is stale.
    """

    period_ns: int
    patience_ns: int
    pause_ns: int
    idle_ns: int
    silence_ns: int

    @classmethod
    def of(cls, period_s: float) -> PublishPace:
        period_ns = round(period_s * NS_PER_S)
        return cls(period_ns, period_ns * 3 // 2, period_ns // 2, max(_IDLE_NS, 2 * period_ns), age_limit_ns(period_ns))


class BusColumns:
    """The columns of the buses, and their counters; (n_buses,) each."""

    def __init__(self, n_buses: int) -> None:
        self.state: npt.NDArray[np.uint8] = np.full(n_buses, int(BusState.CONNECTING), np.uint8)
        self.reason: npt.NDArray[np.uint8] = np.zeros(n_buses, np.uint8)
        self.since_ns: npt.NDArray[np.int64] = np.zeros(n_buses, np.int64)
        self.load: npt.NDArray[np.uint16] = np.full(n_buses, LOAD_UNKNOWN, np.uint16)
        self.samples: npt.NDArray[np.void] = np.zeros((n_buses, SAMPLES), SAMPLE)
        self.data_path: npt.NDArray[np.uint8] = np.full(n_buses, int(DataPath.PYTHON), np.uint8)
        self.counters: Sequence[BusCounters] = [BusCounters() for _ in range(n_buses)]


class PatchLife:
    """The patches that send, and the pauses between their bursts, which ``bursts.c`` learns.

    (n_patches,) each, times CLOCK_MONOTONIC ns.

    Attributes:
        state: :class:`skinware.PatchState`.
        heard_ns: when the last update came.
        lives_until_ns: when it becomes silent, unless a whole update comes before.
        counts_from_ns: its silence does not count before: it was set up, or asked for something, until then.
        pause_ns: the pause that ends a burst.
        standing_out_ns: the shortest pause that is longer than the spacing of modules.
        group_heard_ns: (n_groups,), when the last update of each group came.
        age_limit_ns: (n_groups,), beyond which its values are stale.
        gap_ns: (n_groups,), the time before the last update of each group.
    """

    def __init__(self, structure: Structure, state: SkinState, pace: PublishPace) -> None:
        n_patches, n_groups = structure.n_patches, structure.n_groups
        self.state: npt.NDArray[np.uint8] = np.full(n_patches, int(PatchState.EXPECTED), np.uint8)
        self.heard_ns = np.zeros(n_patches, np.int64)
        self.lives_until_ns = np.zeros(n_patches, np.int64)
        self.counts_from_ns = np.zeros(n_patches, np.int64)
        self.pause_ns: npt.NDArray[np.int64] = np.full(n_patches, pace.pause_ns, np.int64)
        n_prompt = np.bincount(state.group_patch[state.is_prompt], minlength=n_patches)
        self.standing_out_ns: npt.NDArray[np.float64] = _STANDS_OUT * pace.period_ns / np.maximum(1, n_prompt)
        self.group_heard_ns = np.full(n_groups, now_ns(), np.int64)
        self.age_limit_ns = structure.group_age_limits_ns(pace.period_ns)
        self.gap_ns: npt.NDArray[np.int64] = np.zeros(n_groups, np.int64)


class PatchTiming:
    """How regularly patches deliver, and how old their data is: histograms, which C counts at publication.

    The buckets are those of :class:`skinware.memory.statistics.Histogram`.

    Attributes:
        intervals: (n_patches, BUCKETS) int64: time between two updates of a group that were shown in turn.
        ages: (n_patches, BUCKETS) int64: age of a group's update when it was published.
        both: (2, n_patches, BUCKETS) int64: one after the other.
        before_ns: (n_groups,) int64: stamps of what was shown before, 0: nothing.
    """

    def __init__(self, structure: Structure) -> None:
        self.both: npt.NDArray[np.int64] = np.zeros((2, structure.n_patches, BUCKETS), np.int64)
        self.intervals: npt.NDArray[np.int64] = self.both[0]
        self.ages: npt.NDArray[np.int64] = self.both[1]
        self.before_ns = np.zeros(structure.n_groups, np.int64)


class Publisher:
    """The end of the data path: the moments of publication, and the columns beside values.

    By cycle, a snapshot is published as soon as every live update group was heard (except groups that are slower than
    the driver), and always before a patch begins its next burst, so that no update is overwritten before publication
    and no snapshot holds two bursts of a patch (``native/bursts.c``); else half a period after the cycle is over. Where
    patches send together and then pause, snapshots end before the pause, whichever patch was heard first.

    Otherwise it is published at the driver's rate; without new values four times a second, so that readers see states.

    Args:
        on_request: publish only what a request waits for (beside the very first snapshot).
    """

    def __init__(
        self,
        writer: DriverWriter,
        decoder: Decoder,
        watch: Watch,
        period_s: float,
        by_cycle: bool,
        desk: RequestDesk | None = None,
        on_request: bool = False,
    ) -> None:
        structure = decoder.tables.structure
        self.writer, self.watch, self._desk = writer, watch, desk
        self.by_cycle, self.on_request = by_cycle, on_request and desk is not None
        self.pace = PublishPace.of(period_s)
        self.state: SkinState = decoder.state
        self.state.settle_pace(self.pace.period_ns)
        self.buses = BusColumns(len(structure.buses))
        self.patches, self.timing = PatchLife(structure, self.state, self.pace), PatchTiming(structure)
        self.latency_ns: npt.NDArray[np.int64] = np.zeros(1, np.int64)
        self.data_path: npt.NDArray[np.uint8] = np.full(1, int(DataPath.NATIVE), np.uint8)
        self._structure = structure
        self._counts = np.zeros((len(structure.buses), len(ALL_BUS_COUNTERS)), np.int64)

    @property
    def wanted_ns(self) -> int:
        """The oldest data that is new enough for a request that waits; far ahead if none does."""
        return NEVER_NS if self._desk is None else self._desk.wanted_ns

    def answer(self, oldest_ns: int) -> None:
        """Answer the requests that waited for a snapshot that was published, by the oldest stamp of its new data."""
        if self._desk is not None:
            self._desk.published(oldest_ns, self.writer.position)

    def lose(self, patch: int, state: PatchState) -> None:
        """Count a patch as silent until its next data."""
        self.patches.lives_until_ns[patch] = 0
        self.patches.state[patch] = state

    def excuse(self, since_ns: int, asleep_ns: int) -> None:
        """Count silence only while this process ran; from now on for patches that lived when it last ran.

        Args:
            asleep_ns: how long the machine was suspended: older data is older by that time.
        """
        lives_until_ns, counts_from_ns = self.patches.lives_until_ns, self.patches.counts_from_ns
        counts_from_ns[:] = np.maximum(lives_until_ns, counts_from_ns) + (now_ns() - since_ns)
        lived = lives_until_ns > since_ns
        until_ns = np.maximum(lives_until_ns, now_ns() + self.pace.silence_ns)
        lives_until_ns[lived] = until_ns[lived]
        times_ns = self.state.group_time_ns
        times_ns[:] = np.where(times_ns > 0, np.maximum(1, times_ns - asleep_ns), 0)

    def silent_ns(self, patch: int) -> int:
        """Return how long a patch has been silent beyond its age limit, while this process ran, ns."""
        return now_ns() - int(max(self.patches.lives_until_ns[patch], self.patches.counts_from_ns[patch]))

    def count_buses(self) -> npt.NDArray[np.int64]:
        """Return (n_buses, len(ALL_BUS_COUNTERS)) int64, as of now."""
        self._counts[:, : len(OWN_BUS_COUNTERS)] = [read_own(counters) for counters in self.buses.counters]
        self._counts[:, len(OWN_BUS_COUNTERS) :] = self.state.bus_counters
        return self._counts

    def look(self, updates: Updates) -> None:
        """Let the watch look at updates that were shown; raise ``DriverError`` if it fails."""
        try:
            self.watch.look(updates)
        except (Exception, SystemExit):
            buses = np.unique(self._structure.patch_bus[self.state.group_patch[updates.group]]).tolist()
            with hook("Watch.look", *(self._structure.buses[bus] for bus in buses), of_all=True):
                raise


_declared = cache(operations_of)


class RequestDesk:
    """Carries out operations on the buses, and answers requests for new snapshots.

    Args:
        changed: called after an operation with its bus and its patches.
        ending: of the driver; errors outside of an operation end it.
    """

    def __init__(
        self,
        server: RequestServer,
        lines: Sequence[BusLine],
        listen_only: bool,
        changed: Callable[[BusLine, Sequence[Patch], Operation], object],
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
            self._changed(line, patches, operation)
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
