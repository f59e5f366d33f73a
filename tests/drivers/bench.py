"""A driver and an emulator that was made for it, on one bus whose time the test owns."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from skinware import Status
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import BUS_COUNTERS, PATCH_COUNTERS
from skinware_drivers.description import Patch, assemble
from skinware_drivers.link import Link
from skinware_drivers.polling import Notice
from skinware_drivers.virtual import Emulator
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hand_clock import MonotonicClock
from skinware_drivers.virtual.hardware import Event
from tests.specification.decoding import SpecifiedDecoder

MS = 1_000_000
EXAMPLE_EDS = Path(str(resources.files("skinware_drivers") / "eds" / "skin_patch.eds"))
T = TypeVar("T")


class BenchLoop(asyncio.SelectorEventLoop, MonotonicClock):
    """Its time is what its benches have let pass: no timeout runs out because the machine is busy."""

    now_ns = 5_000_000_000_000

    def __call__(self) -> int:
        return self.now_ns

    def time(self) -> float:
        """As the benches say, s."""
        return self.now_ns / 1e9


def play(scenario: Coroutine[Any, Any, None]) -> None:
    """Run a scenario to its end, a minute of the benches' time at the most."""
    with asyncio.Runner(loop_factory=BenchLoop) as runner:
        runner.run(asyncio.wait_for(scenario, 60))


def as_sent(values: Sequence[int]) -> Sequence[int]:
    return values


@dataclass(frozen=True)
class Case:
    """What the tests of every driver need to know of one.

    Attributes:
        driver: its adapter.
        emulator: its devices. Their n-th value is that of the n-th sensor of a patch; patches in the order of numbers.
        options, emulated: options of both, other than faults.
        shown: of the values that a device felt, those that its protocol can tell.
    """

    driver: type[AnyAdapter]
    emulator: type[Emulator[Any]]
    options: dict[str, Any] = field(default_factory=dict)
    emulated: dict[str, Any] = field(default_factory=dict)
    shown: Callable[[Sequence[int]], Sequence[int]] = as_sent

    @cached_property
    def n_values(self) -> int:
        """Of each device."""
        return len(self.emulator(self.emulator.Options(**self.emulated)).places())

    def adapter(self) -> AnyAdapter:
        return self.driver(self.driver.Options(**self.options))

    def devices(self, log: list[Event] | None = None, **faults: Any) -> Emulator[Any]:
        options = self.emulator.Options(**self.emulated, **faults)
        return self.emulator(options, log=log, source=self.felt)

    def felt(self, number: int, cycle: int) -> list[int]:
        """What a device feels: other values for each sensor, device and cycle."""
        modulo = int(np.max(self.emulator.full_scale)) + 1
        return [(cycle * 1117 + sensor * 2903 + number * 77) % modulo for sensor in range(self.n_values)]

    def expected(self, number: int, cycles: int) -> np.ndarray[Any, Any]:
        """(cycles, n) what a driver can know of them."""
        return np.array([self.shown(self.felt(number, cycle)) for cycle in range(cycles)])


class Bench:
    """Set up and started when it is entered; ``run`` lets time pass.

    Attributes:
        updates: (patch, module, values) of whole updates, in order.
    """

    def __init__(self, case: Case, **faults: Any) -> None:
        self.case = case
        self.log: list[Event] = []
        loop = asyncio.get_running_loop()
        assert isinstance(loop, BenchLoop)
        self._loop = loop
        self.hardware = case.devices(self.log, **faults)
        self.adapter = case.adapter()
        size = self.adapter.payload_size
        self.bus = VirtualCanBus("", hardware=self.hardware, payload_size=size, clock=loop)
        self.link = Link(self.bus)
        self.updates: list[tuple[int, int, list[int]]] = []
        self.notices: list[tuple[str, Notice]] = []
        self.patches: Sequence[Patch] = ()
        self._decoder: SpecifiedDecoder | None = None
        self._batch = FrameBatch(4096, self.adapter.payload_size)
        self._polled_ns: dict[int, int] = {}
        self._attending: asyncio.Task[None] | None = None

    @property
    def now_ns(self) -> int:
        """The time."""
        return self._loop.now_ns

    async def __aenter__(self) -> Self:
        self.bus.open()
        try:
            await self._set_up()
        except BaseException:
            self.bus.close()
            raise
        return self

    async def _set_up(self) -> None:
        self.patches = await self.during(self.adapter.describe(self.link))
        adapter = self.adapter
        tables = assemble([("bus", self.patches)], adapter.types, adapter.dtype)
        self._decoder = SpecifiedDecoder([adapter.layout], tables)
        self._batch = FrameBatch(4096, adapter.payload_size, self._decoder.compiled.headroom)
        adapter.heard_by = self._tell
        self._attending = asyncio.create_task(adapter.attend(self.link))
        await self.during(adapter.configure(self.link))
        await self.during(adapter.start(self.link))

    async def __aexit__(self, *raised: object) -> None:
        if self._attending is not None:
            self._attending.cancel()
            await asyncio.gather(self._attending, return_exceptions=True)
        self.bus.close()

    @property
    def decoder(self) -> SpecifiedDecoder:
        assert self._decoder is not None
        return self._decoder

    async def during(self, work: Awaitable[T]) -> T:
        """Let time pass until something is done."""
        task = asyncio.ensure_future(work)
        while not task.done():
            await self.run(1, poll=False)
        return await task

    async def run(self, duration_ms: int, *, poll: bool = True) -> None:
        """Let time pass, a millisecond at a time."""
        for _ in range(duration_ms):
            self._loop.now_ns += MS
            if poll:
                self._poll()
            self._take(lambda batch: self.bus.receive(batch, 0))
            await asyncio.sleep(0)

    async def stop(self) -> None:
        """Stop the devices, and hear what is on its way."""
        await self.during(self.adapter.stop(self.link))
        await self.run(50, poll=False)

    def count(self, name: str) -> int:
        """A counter, over all patches or of the bus."""
        state = self.decoder.state
        if name in BUS_COUNTERS:
            return int(state.bus_counters[0, BUS_COUNTERS.index(name)])
        return int(state.patch_counters[:, PATCH_COUNTERS.index(name)].sum())

    def faults(self, kind: str = "") -> list[Event]:
        return [e for e in self.log if e.event == "frame_fault" and kind in ("", e.fault)]

    @property
    def attends(self) -> bool:
        """Whether ``attend`` has not failed."""
        task = self._attending
        return task is not None and (not task.done() or task.exception() is None)

    @property
    def fresh(self) -> bool:
        """Whether every sensor was seen and is good."""
        return not self.decoder.state.status.any()

    @property
    def never_seen(self) -> bool:
        return bool((self.decoder.state.status == Status.NEVER_SEEN).all())

    def _tell(self, patch: Patch, notice: Notice) -> None:
        self.notices.append((patch.name, notice))

    def _poll(self) -> None:
        for number, poll in enumerate(self.adapter.polls):
            if self.now_ns >= self._polled_ns.get(number, 0):
                self._polled_ns[number] = self.now_ns + round(poll.period_s * 1e9)
                self.bus.send(poll.identifier, poll.payload)

    def _take(self, fill: Callable[[FrameBatch], object]) -> None:
        batch, decoder = self._batch, self._decoder
        if decoder is None:
            batch.clear()
        else:
            decoder.put_back(batch)
        fill(batch)
        if decoder is None:
            self.link.offer(batch, np.arange(batch.start, batch.stop))
            return
        updates, foreign = decoder.decode(batch)
        decoder.count_unknown(batch, self.link.offer(batch, foreign))
        decoder.state.show(updates)
        structure = decoder.tables.structure
        for module, values, whole, to in zip(
            updates.module.tolist(), updates.values, updates.whole, updates.sensors, strict=True
        ):
            if whole:
                inside = to < structure.n_sensors
                in_order = np.argsort(to[inside])
                patch = int(structure.module_patch[module])
                self.updates.append((patch, module, values[inside][in_order].tolist()))
