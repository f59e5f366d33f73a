"""Run a driver on emulated devices in the time of a test, and keep what it publishes."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverReader
from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.samples import sample_report, sample_text
from skinware.status import BusState, PatchState, Status
from skinware.structure import Structure
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import FrameBatch, identifier_text
from skinware_drivers.link import Link
from skinware_drivers.proving.captures import snapshots_after
from skinware_drivers.running.patch_care import why_unused
from skinware_drivers.running.runner import Runner
from skinware_drivers.testing.clock import run_in_its_time
from skinware_drivers.testing.waiting import defect, require
from skinware_drivers.testing.wire import (
    EmulatedBus,
    Interference,
    Pattern,
    Truth,
    make_bus,
)
from skinware_drivers.virtual.hand_clock import HandClock

T = TypeVar("T")
NAME = "driver_under_test"
_BUS = "bus"
_SLOTS = 64
LONGEST_START_S = 12.0
_UNUSED = (
    *("unknown", "bad_length", "bad_content", "refused", "orphans", "checksum_errors", "bad_form"),
    "polls_unanswered",
)
SHOWN_ANYWAY = int(Status.SUSPECT | Status.OUT_OF_RANGE)
"""Status bits of values that are shown as they were sent."""


@dataclass(frozen=True)
class Case:
    """A driver and its devices; see :class:`skinware_drivers.testing.conformance.DriverConformance`."""

    driver: type[AnyAdapter]
    emulator: Any
    driver_options: Mapping[str, Any]
    emulator_options: Mapping[str, Any]
    shown: Callable[[Sequence[int]], Sequence[int]]

    def adapter(self) -> AnyAdapter:
        adapter = self.driver(msgspec.convert(dict(self.driver_options), self.driver.Options, strict=False))
        try:
            adapter.check()
        except ConfigurationError as error:
            defect(str(error))
        return adapter

    def options(self, **more: Any) -> Any:
        """Return the options of the devices, with those of ``more`` that they have."""
        known = self.emulator.Options.__struct_fields__
        given = {**self.emulator_options, **{name: value for name, value in more.items() if name in known}}
        return msgspec.convert(given, self.emulator.Options, strict=False)


class SnapshotLog:
    """Read every snapshot that a driver publishes, in order, as a user's program does.

    Attributes:
        keep: keep all snapshots; False: only the newest.
    """

    def __init__(self, clock: HandClock) -> None:
        self.frames: list[DriverSnapshot] = []
        self.times_ns: list[int] = []
        self.keep = True
        self.count: int = 0
        self.reader: DriverReader | None = None
        self._clock = clock

    def look(self, runner: Runner) -> None:
        if self.reader is None:
            if runner.builder.writer is None or runner.builder.writer.closed:
                return
            self.reader = DriverReader(runner.identity.name)
        for frame in snapshots_after(self.reader, self.frames[-1].position if self.frames else None):
            if not self.keep:
                self.frames.clear()
                self.times_ns.clear()
            self.count += 1
            self.frames.append(frame)
            self.times_ns.append(self._clock.now_ns)

    def close(self) -> None:
        if self.reader is not None:
            self.reader.close()


class Rig:
    """One driver on one bus of emulated devices, in the time of ``clock``."""

    def __init__(
        self, case: Case, clock: HandClock, pattern: Pattern, *, listen_only: bool = False, **emulated: Any
    ) -> None:
        self.case = case
        self.clock = clock
        self.adapter: AnyAdapter = case.adapter()
        options = case.options(**emulated)
        n_felt = len(case.emulator(options).places())
        self.truth: Truth = Truth(clock, n_felt, pattern, case.shown)
        self.devices: Any = case.emulator(options, log=None, source=self.truth)
        self.numbers: list[int] = list(self.devices.numbers)
        self.wire: Interference = Interference(self.devices)
        self.bus: EmulatedBus = make_bus(self.adapter, self.wire, clock, listen_only=listen_only)

    @property
    def period_ns(self) -> int:
        return round(self.adapter.period_s * 1e9)

    @property
    def n_values(self) -> int:
        return self.truth.n_values * len(self.numbers)


class Handshakes(Rig):
    """A rig without a runner, for a test that calls the adapter's methods itself."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.link: Link = Link(self.bus)

    async def __aenter__(self) -> Self:
        self.adapter.fit(self.bus)
        self.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def open(self) -> None:
        self.bus.open()
        asyncio.get_running_loop().add_reader(self.bus.fileno(), self._hear)

    def close(self) -> None:
        if self.bus.fileno() >= 0:
            asyncio.get_running_loop().remove_reader(self.bus.fileno())
        self.bus.close()

    def _hear(self) -> None:
        batch = FrameBatch(4096, self.bus.payload_size)
        self.bus.receive(batch, 0)
        self.link.offer(batch, np.arange(batch.start, batch.stop))


class Running(Rig):
    """A rig whose driver runs as in ``skin-driver``, while the ``async with`` block runs.

    Attributes:
        answers: number of frames that its handshakes took, or that came before it had a structure.
    """

    def __init__(self, case: Case, clock: HandClock, pattern: Pattern, *, listen_only: bool = False, **more: Any):
        super().__init__(case, clock, pattern, listen_only=listen_only, **more)
        self.record: SnapshotLog = SnapshotLog(clock)
        self.answers = 0
        self.runner: Runner | None = None
        self._listen_only = listen_only
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self.runner = Runner(
            NAME, [(_BUS, self.adapter, self.bus)], name=NAME, listen_only=self._listen_only, slots=_SLOTS
        )
        self._task = asyncio.create_task(self.runner.run())
        self.clock.before_passing.append(self._look)
        self._count_answers(self.runner)
        return self

    def _count_answers(self, runner: Runner) -> None:
        link = runner.lines[0].link
        offer = link.offer

        def offer_and_count(batch: FrameBatch, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
            unwanted = offer(batch, rows)
            self.answers += len(rows) if runner.builder.generation is None else len(rows) - len(unwanted)
            return unwanted

        link.offer = offer_and_count  # type: ignore[method-assign]

    async def __aexit__(self, *raised: object) -> None:
        await self.stop()

    async def stop(self) -> None:
        """Stop the driver as ``skin-driver`` does; raise the exception that ended it."""
        if self.runner is None or self._task is None:
            return
        runner, task, self._task = self.runner, self._task, None
        runner.stop()
        try:
            await task
        finally:
            self.clock.before_passing.remove(self._look)
            self.record.close()
            self.runner = None

    def _look(self) -> None:
        if self.runner is not None:
            self.record.look(self.runner)

    async def sleep(self, duration_s: float) -> None:
        """Let time pass; fail if the driver ends meanwhile."""
        await asyncio.sleep(duration_s)
        if self._task is not None and self._task.done():
            error = self._task.exception()
            defect(f"the driver ended by itself: {type(error).__name__}: {error}" if error else "the driver ended")

    async def until(
        self, condition: Callable[[DriverSnapshot], object], why_not: str, within_s: float = LONGEST_START_S
    ) -> DriverSnapshot:
        """Let time pass until a snapshot fulfils a condition; fail with ``why_not`` if none does."""
        record, end_ns = self.record, self.clock.now_ns + round(within_s * 1e9)
        seen = record.count
        while True:
            for frame in record.frames[len(record.frames) - (record.count - seen) :]:
                if condition(frame):
                    return frame
            seen = record.count
            require(self.clock.now_ns < end_ns, why_not)
            await self.sleep(min(self.adapter.period_s / 2, 0.05))

    def unused_in_words(self) -> str:
        """Return counters of unused frames, samples, and their reasons in the layout; empty if all were used."""
        counters = {name: count for name, count in self.counters().items() if count and name in (*_UNUSED, "orphans")}
        lone = counters.pop("orphans", 0)  # perhaps a consequence of the others
        if counters:
            reasons = "".join(
                f"{reason[0].upper()}{reason[1:]}.\n" for reason in why_unused(self.adapter.layout, self.bus)
            )
            return f"Frames that were not used: {counters}{self.samples_in_words()}.\n{reasons}"
        if lone:
            return (
                f"{lone} frames found no partners: do all frames of a cycle come, in the order of its `members`, within"
                " `maximum_age_s`, and with the same number, if it has a `counter`?\n"
            )
        return ""

    def counters(self) -> dict[str, int]:
        """Return the counters of the bus and of all patches together; empty before the driver runs."""
        if self.runner is None:
            return {}
        status = self.runner.status()
        counters: dict[str, int] = {}
        for part in (*status["buses"], *status.get("patches", ())):
            for name, count in part.items():
                if isinstance(count, int):
                    counters[name] = counters.get(name, 0) + count
        return counters

    def samples_in_words(self) -> str:
        """Return some frames that were not used: identifier, length, first bytes."""
        samples = [
            f"{sample['why']} {sample_text(sample)}"
            for line in (self.runner.lines if self.runner is not None else ())
            for sample in sample_report(line.bus.samples.rows)
        ]
        return f"; for example {', '.join(samples)}" if samples else ""

    def sent_in_words(self) -> str:
        """Return the first and the last frames that the driver sent."""
        sent = [f"{identifier_text(identifier)} [{payload.hex(' ')}]" for identifier, payload in self.wire.sent]
        return ", ".join(sent if len(sent) <= 6 else [*sent[:3], "...", *sent[-3:]]) or "nothing"

    def first_patch_of(self, number: int) -> int:
        """Return the patch that shows the first value of a device."""
        structure = self.record.frames[-1].structure
        return int(structure.sensor_patch[self.numbers.index(number) * self.truth.n_values])


def is_fresh(frame: DriverSnapshot) -> bool:
    """Return whether every sensor is good, or at least shown."""
    return not (frame.status & ~np.uint8(SHOWN_ANYWAY)).any()


def is_live(frame: DriverSnapshot) -> bool:
    return bool((frame.patch_state == PatchState.LIVE).all() and (frame.bus_state == BusState.LIVE).all())


def sensor_name(structure: Structure, sensor: int) -> str:
    type_name = next(t.name for t in structure.types if t.id == structure.sensor_type[sensor])
    return f"{structure.sensor_name(sensor)} ({type_name}, uid {int(structure.sensor_uid[sensor]):#x})"


def play(scenario: Callable[[HandClock], Coroutine[Any, Any, T]]) -> T:
    clock = HandClock()
    return run_in_its_time(clock, lambda: scenario(clock))


def in_its_time(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Make a test of a coroutine method with the argument ``clock``, which runs in the time of this clock."""

    @functools.wraps(test)
    def run(suite: Any, *arguments: Any, **named: Any) -> None:
        play(lambda clock: test(suite, clock, *arguments, **named))

    signature = inspect.signature(test)  # without the clock, which pytest would take for a fixture
    parameters = [parameter for name, parameter in signature.parameters.items() if name != "clock"]
    run.__dict__["__signature__"] = signature.replace(parameters=parameters, return_annotation=None)
    return run
