"""Decode a capture again with the present driver, and compare with the values that were decoded and recorded then.

The driver runs in the time of a test clock: minutes of a capture take seconds, and a busy machine makes no difference.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import shutil
from array import array
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

import skinware.recording
from skinware.errors import ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.recording import Recording
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, Bus
from skinware_drivers.options import options_of
from skinware_drivers.proving.updates import Collected, Comparison, Decoding, compare, load
from skinware_drivers.registry import load_driver
from skinware_drivers.running.runner import Runner
from skinware_drivers.virtual.hand_clock import HandClock, HandLoop, package_on
from skinware_drivers.virtual.logs import WireSource
from skinware_drivers.virtual.recorded import medium_of, replayed_bus, wire_of
from skinware_drivers.virtual.snapshot_log import SnapshotLog

_NAME = "captured"
_SLOTS = 64
_LOOK_S = 0.1
_SETTLED_NS = NS_PER_S
"""Time after the end within which everything is published."""
_LATEST_NS = 60 * NS_PER_S
"""Time that a driver which sends other requests than then may lose, beside twice the length of the recording."""


def expected_of(capture: Path) -> Path:
    """Return the file beside a capture with the expected values, if they are not those that were recorded."""
    return capture.with_suffix(".npz")


def check_capture(
    capture: Path, driver: type[AnyAdapter] | None = None, options: Mapping[str, Any] | None = None
) -> tuple[Comparison, Decoding]:
    """Compare the values that a driver decodes from a capture now with the expected ones.

    Expected are the values in the file beside it (:func:`expected_of`), or else those that were decoded and recorded
    then.

    Returns:
        The comparison, and the values that are decoded now.

    Raises:
        BadRecording: the file is not a recording.
        ConfigurationError: it has no wire, or wires of several drivers; or the options are wrong.
        DriverError: the driver failed.
        OSError: a file cannot be read.
    """
    now = decoded_now(capture, driver, options)
    beside = expected_of(capture)
    return compare(load(beside) if beside.exists() else decoded_then(capture), now), now


def decoded_then(capture: Path) -> Decoding:
    with skinware.recording.open(capture) as recording:
        wires = _wires(recording)
        found = Collected(_began_ns(recording, wires))
        if wires[0].driver in recording.drivers:
            for part in recording[wires[0].driver].parts:
                series = part.read(["values", "module_time_ns"])
                found.add(series.structure, series.column("values"), series.column("module_time_ns"))
        return found.decoding()


def decoded_now(
    capture: Path, driver: type[AnyAdapter] | None = None, options: Mapping[str, Any] | None = None
) -> Decoding:
    with skinware.recording.open(capture) as recording:
        wires = _wires(recording)
        about = recording.about(wires[0].driver)
        began_ns, listens = _began_ns(recording, wires), bool(about.get("listen_only"))
        clock = HandClock()
        driver = driver or load_driver(_driver_type(recording, about))
        replays = []
        for wire in wires:
            usual = about.get("buses", {}).get(wire.bus, {}).get("options", {})
            given = {**usual, **(options or {})}
            replays.append(_ReplayedWire(recording, wire, driver, given, listens, clock))
    log, namespace = SnapshotLog(clock), Namespace(f"captured-{os.getpid()}-{secrets.token_hex(4)}")
    try:
        with package_on(clock), asyncio.Runner(loop_factory=lambda: HandLoop(clock)) as loop:
            loop.run(_run(clock, replays, log, namespace, listens))
    finally:
        log.close()
        shutil.rmtree(namespace.path, ignore_errors=True)
    found = Collected(began_ns)
    for structure, frames in groupby(log.frames, lambda frame: frame.structure):
        snapshots = list(frames)
        times = np.array([frame.module_time_ns for frame in snapshots])
        bus = np.asarray(structure.patch_bus)[np.asarray(structure.module_patch)]
        for number, replay in enumerate(replays):
            times[:, bus == number] = replay.then_ns(times[:, bus == number])
        found.add(structure, np.array([frame.values for frame in snapshots]), times)
    return found.decoding()


def driver_type_of(capture: Path) -> str:
    """Return the recorded driver, for ``--driver``."""
    with skinware.recording.open(capture) as recording:
        return _driver_type(recording, recording.about(_wires(recording)[0].driver))


def _driver_type(recording: Recording, about: Mapping[str, Any]) -> str:
    if "driver_type" not in about:
        raise ConfigurationError(f"{recording.path}: it was recorded by an earlier version: name its driver")
    return str(about["driver_type"])


def _wires(recording: Recording) -> Sequence[WireSource]:
    if len({wire.driver for wire in recording.wires}) > 1:
        names = ", ".join(sorted({wire.driver for wire in recording.wires}))
        raise ConfigurationError(f"{recording.path}: wires of several drivers ({names}); a capture has one driver")
    return recording.wires or [wire_of(recording)]  # raises an error that names the reason


def _began_ns(recording: Recording, wires: Sequence[WireSource]) -> int:
    first = next((item for wire in wires for item in wire.items()), None)
    return 0 if first is None else first.time_ns - (first.epoch_ns - recording.start_ns)


class _ReplayedWire:
    """A recorded wire, and the adapter of the present driver on it."""

    def __init__(
        self,
        recording: Recording,
        wire: WireSource,
        driver: type[AnyAdapter],
        options: Mapping[str, Any],
        listens: bool,
        clock: HandClock,
    ) -> None:
        medium = medium_of(recording, wire)
        self._times = []  # of what the replayed bus gives the driver
        for item in wire.items():
            is_data = not item.is_sent and not (item.identifier or 0) & (ERROR_FLAG | REMOTE_FLAG)
            if is_data or (item.is_sent and medium == "modbus"):
                self._times.append(item.time_ns)
        self.duration_ns: int = self._times[-1] - self._times[0] if self._times else 0
        self._stamps_ns, self._then_ns = array("q"), array("q")
        kind = next((one for one in (driver, *driver.elsewhere) if one.medium == medium), driver)
        adapter = kind(options_of(kind, options))
        adapter.check()
        bus = replayed_bus(
            str(recording.path),
            {"bus": wire.bus, "driver": wire.driver},
            payload_size=adapter.payload_size,
            listen_only=listens,
            clock=clock,
            note=self._note,
        )
        self.line: tuple[str, AnyAdapter, Bus] = wire.bus, adapter, bus

    @property
    def is_over(self) -> bool:
        return not self._times or (len(self._then_ns) > 0 and self._then_ns[-1] >= self._times[-1])

    def _note(self, stamp_ns: int, then_ns: int) -> None:
        self._stamps_ns.append(stamp_ns)
        self._then_ns.append(then_ns)

    def then_ns(self, time_ns: np.ndarray[Any, np.dtype[np.int64]]) -> np.ndarray[Any, np.dtype[np.int64]]:
        """Return the recorded times of present times; 0 stays 0."""
        stamps_ns = np.frombuffer(self._stamps_ns, np.int64)
        if not len(stamps_ns):
            return time_ns
        at = np.maximum(np.searchsorted(stamps_ns, time_ns, side="right") - 1, 0)
        later_ns = stamps_ns[at] - np.frombuffer(self._then_ns, np.int64)[at]
        return np.where(time_ns == 0, 0, time_ns - later_ns)


async def _run(
    clock: HandClock, replays: Sequence[_ReplayedWire], log: SnapshotLog, namespace: Namespace, listens: bool
) -> None:
    """Run the driver until every frame is delivered, and the values are published."""
    lines = [replay.line for replay in replays]
    runner = Runner(_NAME, lines, name=_NAME, listen_only=listens, namespace=namespace, slots=_SLOTS, publish="cycle")
    running = asyncio.create_task(runner.run())
    latest_ns = clock.now_ns + _LATEST_NS + 2 * max(replay.duration_ns for replay in replays)
    clock.before_passing.append(lambda: log.look(runner))
    over_ns = latest_ns
    while clock.now_ns < over_ns and not running.done():
        await asyncio.sleep(_LOOK_S)
        if over_ns == latest_ns and all(replay.is_over for replay in replays):
            over_ns = clock.now_ns + _SETTLED_NS
    clock.before_passing.clear()
    log.look(runner)
    runner.stop()
    await running
