"""Run a driver on emulated devices in the time of a test, and keep what it publishes: the base of the suite."""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine, Mapping, Sequence
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import numpy.typing as npt

from skinware.driver_snapshot import DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.status import Status, sample_report, sample_text
from skinware.structure import Structure
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import FrameBatch, identifier_text
from skinware_drivers.link import Link
from skinware_drivers.options import options_of
from skinware_drivers.running.patch_care import why_unused
from skinware_drivers.running.runner import Runner
from skinware_drivers.testing.waiting import defect, require, run_in_its_time
from skinware_drivers.testing.wire import Interference, Pattern, Truth, make_bus
from skinware_drivers.virtual.emulator import each_value
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.snapshot_log import SnapshotLog

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


class Rig:
    """One driver on one bus of emulated devices, in the time of ``clock``."""

    def __init__(
        self, suite: Suite, clock: HandClock, pattern: Pattern, *, listen_only: bool = False, **emulated: Any
    ) -> None:
        self.clock = clock
        self.adapter: AnyAdapter = suite.make_adapter()
        options = suite.make_options(**emulated)
        n_felt = len(suite.emulator(options).places())
        self.truth: Truth = Truth(clock, n_felt, pattern, suite.shown)
        self.devices: Any = suite.emulator(options, log=None, source=self.truth)
        self.numbers: list[int] = list(self.devices.numbers)
        self.wire: Interference = Interference(self.devices)
        self.bus = make_bus(self.adapter, self.wire, clock, listen_only=listen_only)

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

    def __init__(self, suite: Suite, clock: HandClock, pattern: Pattern, *, listen_only: bool = False, **more: Any):
        super().__init__(suite, clock, pattern, listen_only=listen_only, **more)
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
        runner, link = self.runner, self.runner.lines[0].link
        offer = link.offer

        def offer_and_count(batch: FrameBatch, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
            unwanted = offer(batch, rows)
            self.answers += len(rows) if runner.builder.generation is None else len(rows) - len(unwanted)
            return unwanted

        link.offer = offer_and_count  # type: ignore[method-assign]
        return self

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


Values = npt.NDArray[np.int64]


def limits(emulator: Any, n_values: int) -> tuple[Values, Values]:
    """Return the least and the greatest value that each sensor of a device can send."""
    lowest = each_value("lowest", getattr(emulator, "lowest", 0), n_values)
    return lowest, each_value("full_scale", emulator.full_scale, n_values)


def lively(emulator: Any) -> Pattern:
    """Return a pattern with another random value for every sensor, device and burst, so that any mix-up shows."""

    def feel(number: int, cycle: int, n_values: int) -> Values:
        lowest, highest = limits(emulator, n_values)
        return np.random.default_rng([number, cycle, 7]).integers(lowest, highest, n_values, endpoint=True)

    return feel


def extreme(emulator: Any) -> Pattern:
    """Return a pattern of range ends and bit patterns by turns, with lively values between them."""
    between = lively(emulator)

    def feel(number: int, cycle: int, n_values: int) -> Values:
        lowest, highest = limits(emulator, n_values)
        odd = np.arange(n_values) % 2
        middle = lowest + (highest - lowest + 1) // 2
        moments = (
            lowest,
            highest,
            lowest | (highest & 0x5555_5555) if (lowest == 0).all() else 0x55,
            lowest | (highest & 0xAAAA_AAAA) if (lowest == 0).all() else -0x56,
            np.where(odd, lowest, highest),
            np.where(odd, highest, lowest),
            middle,
            middle - 1,
            -1,
            1,
        )
        which, is_between = divmod(cycle, 2)
        if is_between:
            return between(number, cycle, n_values)
        return np.clip(moments[which % len(moments)], lowest, highest)

    return feel


class Suite:
    """A driver and its emulator.

    Attributes:
        driver_options: options of the driver, as in a configuration file.
        emulator_options: options of the emulator, beside those that the tests set.
    """

    driver: ClassVar[type[AnyAdapter]]
    emulator: ClassVar[Any]
    driver_options: ClassVar[Mapping[str, Any]] = {}
    emulator_options: ClassVar[Mapping[str, Any]] = {}

    def shown(self, felt: Sequence[int]) -> Sequence[int]:
        """Return the values that a device can send for the values that it felt: override it if they are fewer."""
        return felt

    def make_adapter(self) -> AnyAdapter:
        adapter = self.driver(options_of(self.driver, self.driver_options))
        try:
            adapter.check()
        except ConfigurationError as error:
            defect(str(error))
        return adapter

    def make_options(self, **more: Any) -> Any:
        """Return the options of the devices, with those of ``more`` that they have."""
        known = self.emulator.Options.__struct_fields__
        given = {**self.emulator_options, **{name: value for name, value in more.items() if name in known}}
        return options_of(self.emulator, given)

    def running(self, clock: HandClock, **more: Any) -> Running:
        """Return the running driver on devices that feel new values in each burst."""
        return Running(self, clock, more.pop("pattern", lively)(self.emulator), **more)

    def handshakes(self, clock: HandClock, **more: Any) -> Handshakes:
        return Handshakes(self, clock, lively(self.emulator), **more)

    @staticmethod
    def require_all_counted(rig: Running) -> None:
        counters = rig.counters()
        came = counters["frames"] + counters["refused"] + counters["dropped"]
        if rig.adapter.medium == "can":
            require(came == rig.wire.frames, f"{rig.wire.frames} frames came, the bus counted {came}")
        layout = rig.adapter.layout
        if layout.cycle is not None and len(layout.cycle.members) < len(layout.frames):
            return  # updates may have had any number of frames
        used = counters["updates"] * layout.cycle_length + rig.answers
        used += sum(counters[name] for name in ("unknown", "bad_length", "bad_content", "orphans"))
        structure = rig.record.frames[-1].structure
        groups = structure.n_patches if layout.cycle and layout.cycle.within == "patch" else structure.n_modules
        require(
            0 <= counters["frames"] - used <= groups * (layout.cycle_length - 1),  # which may still wait for others
            f"{counters['frames']} frames came in, {used} were shown, counted, or answers to the driver: {counters}",
        )
