"""A driver without hardware: moving touches published through the core alone, as the commands' tests need it.

As a program: ``python -m tests.cli.fake_skin NAME`` publishes 20 times a second until it is killed.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware import BusState, DriverReader, DriverWriter, Namespace, PatchState, Status, Structure
from skinware.errors import ServiceError
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.status import SAMPLE, SAMPLES
from skinware.tactile.calm_driver import SENSOR_COLUMNS
from skinware_drivers.testing.waiting import wait_until

BUS_COUNTERS = ("frames", "dropped", "errors", "unknown")
PATCH_COUNTERS = ("orphans", "updates")
TAXELS, THERMAL = 10, 2


def fake_structure(
    patches: int = 4, modules: int = 16, *, buses: int = 1, dtype: npt.DTypeLike = "u1", kind: str = "triangle"
) -> Structure:
    """Patches of modules of ten pressure and two temperature sensors, spread over buses."""
    n_modules = patches * modules
    per_module = [PRESSURE.id] * TAXELS + [TEMPERATURE.id] * THERMAL
    return Structure(
        types=[
            PRESSURE.measured(unit="counts", scale=-1.0, offset=255.0, minimum=0.0, maximum=255.0),
            TEMPERATURE.measured(unit="degC", scale=0.5),
        ],
        buses=[f"can{bus}" for bus in range(buses)],
        patch_name=[f"board {7 + patch}" for patch in range(patches)],
        patch_bus=[patch * buses // patches for patch in range(patches)],
        module_patch=np.repeat(np.arange(patches), modules),
        module_kind=[kind] * n_modules,
        sensor_uid=np.arange(n_modules * len(per_module)) + 1000,
        sensor_type=per_module * n_modules,
        sensor_module=np.repeat(np.arange(n_modules), len(per_module)),
        dtype=dtype,
    )


class FakeSkin:
    """A driver whose frames are made one by one, each with the touch a little further on.

    Args:
        name: of the driver.
        structure: default: four patches of sixteen modules.
        namespace: default: the one of the environment.
        slots: of its ring.
        driver_type: that it tells.
        why: (n_sensors,) reasons of its sensors, as a calmed driver has them; None: it is none.
    """

    def __init__(
        self,
        name: str = "fake",
        structure: Structure | None = None,
        namespace: Namespace | None = None,
        slots: int = 64,
        driver_type: str = "fake",
        why: npt.ArrayLike | None = None,
    ) -> None:
        self.why = why
        self.structure = structure or fake_structure()
        self.is_hung = False
        self.acquired_ns: int | None = None
        self.values: npt.NDArray[Any] | None = None
        self.status = np.zeros(self.structure.n_sensors, np.uint8)
        self.untouched: npt.NDArray[np.uint8] | None = None
        self.patch_state = np.full(self.structure.n_patches, int(PatchState.LIVE), np.uint8)
        self.bus_state = np.full(len(self.structure.buses), int(BusState.LIVE), np.uint8)
        self.bus_reason = np.zeros(len(self.structure.buses), np.uint8)
        self.bus_since_ns = np.zeros(len(self.structure.buses), np.int64)
        self.bus_load = np.zeros(len(self.structure.buses), np.uint16)
        self.data_path, self.bus_data_path = 0, np.zeros(len(self.structure.buses), np.uint8)
        self.bus_samples = np.zeros((len(self.structure.buses), SAMPLES), SAMPLE)
        self.interval_counts = np.zeros((self.structure.n_patches, 32), np.uint64)
        self.age_counts = np.zeros((self.structure.n_patches, 32), np.uint64)
        self.bus_counters = np.zeros((len(self.structure.buses), len(BUS_COUNTERS)), np.uint64)
        self.patch_counters = np.zeros((self.structure.n_patches, len(PATCH_COUNTERS)), np.uint64)
        self.writer = DriverWriter(
            name,
            self.structure,
            driver_type=driver_type,
            bus_counters=BUS_COUNTERS,
            patch_counters=PATCH_COUNTERS,
            sensor_columns={} if why is None else SENSOR_COLUMNS,
            namespace=namespace,
            slots=slots,
        )

    def publish(self, count: int = 1) -> None:
        """Publish frames of ``acquired_ns``; None: of now."""
        for _ in range(count):
            time_ns = time.monotonic_ns() if self.acquired_ns is None else self.acquired_ns
            columns = self.writer.begin()
            columns["values"][:] = self._touched() if self.values is None else self.values
            columns["status"][:] = self.status
            if self.why is not None:
                columns["why"][:] = self.why
            columns["module_time_ns"][:] = time_ns
            columns["module_untouched"][:] = 0 if self.untouched is None else self.untouched
            columns["patch_state"][:] = self.patch_state
            columns["bus_state"][:] = self.bus_state
            columns["bus_reason"][:] = self.bus_reason
            columns["bus_since_ns"][:] = self.bus_since_ns
            columns["bus_load"][:] = self.bus_load
            columns["data_path"][:] = self.data_path
            columns["bus_data_path"][:] = self.bus_data_path
            columns["bus_samples"][:] = self.bus_samples.view(np.uint8).ravel()
            columns["patch_interval_counts"][:] = self.interval_counts.ravel()
            columns["patch_age_counts"][:] = self.age_counts.ravel()
            columns["bus_counters"][:] = self.bus_counters.ravel()
            columns["patch_counters"][:] = self.patch_counters.ravel()
            self.writer.commit(time_ns)

    def break_some(self) -> None:
        """Make a few sensors, the last patch and some counters tell of trouble."""
        self.status[20:24] = Status.STALE
        self.status[30] = Status.NOT_CONNECTED
        self.status[31] = Status.NEVER_SEEN
        self.status[40] = Status.OUT_OF_RANGE
        self.patch_state[-1] = PatchState.STALE
        self.status[self.structure.patch_index(self.structure.n_patches - 1)] = Status.STALE
        self.bus_counters[0] = (5156, 2, 0, 7)
        self.patch_counters[0] = (3, 640)

    def close(self) -> None:
        """Withdraw the driver."""
        self.writer.close()

    def __enter__(self) -> FakeSkin:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _touched(self) -> npt.NDArray[np.float64]:
        """(n_sensors,): idle taxels at 240 (lower = more pressure), touched ones below; temperatures near 50."""
        count = self.structure.n_sensors
        centre = self.writer.sequence * 3 % count
        touch = 200 * np.exp(-(((np.arange(count) - centre) / 14.0) ** 2))
        noise = np.random.default_rng(self.writer.sequence).integers(0, 3, count)
        return np.where(self.structure.sensor_type == PRESSURE.id, 240 - touch - noise, 50 + noise)


@contextmanager
def publishing(skin: FakeSkin, rate_hz: float = 100.0) -> Iterator[FakeSkin]:
    """A skin that publishes from a thread of its own as long as the block lasts, and is withdrawn then."""
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(1 / rate_hz):
            if not skin.is_hung:
                skin.publish()

    skin.publish()
    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield skin
    finally:
        stop.set()
        thread.join()
        skin.close()


@contextmanager
def fake_process(name: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """A driver in a process of its own that has published; killed at the end, its file removed."""
    process = subprocess.Popen([sys.executable, "-m", "tests.cli.fake_skin", name, *options])
    try:
        wait_until(lambda: _has_published(name, process.pid))
        yield process
    finally:
        kill(process)
        Namespace().ring_path(name).unlink(missing_ok=True)


def kill(process: subprocess.Popen[bytes]) -> None:
    """End a process without giving it the time to tidy up."""
    if process.poll() is None:
        os.kill(process.pid, signal.SIGKILL)
    process.wait()


def _has_published(name: str, pid: int) -> bool:
    try:
        with DriverReader(name, announce=False) as reader:
            return reader.writer_pid == pid and reader.newest_position is not None
    except ServiceError:
        return False


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("--patches", type=int, default=4)
    parser.add_argument("--modules", type=int, default=16)
    parser.add_argument("--buses", type=int, default=1)
    parser.add_argument("--rate", type=float, default=20.0)
    parser.add_argument("--frames", type=int, default=0, help="then fall silent; 0 = never")
    parser.add_argument("--trouble", action="store_true")
    options = parser.parse_args()
    skin = FakeSkin(options.name, fake_structure(options.patches, options.modules, buses=options.buses))
    if options.trouble:
        skin.break_some()
    while not options.frames or skin.writer.sequence < options.frames:
        skin.publish()
        time.sleep(1 / options.rate)
    signal.pause()


if __name__ == "__main__":
    main()
