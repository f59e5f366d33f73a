"""Values that physics made, through the wire and the driver of a device, equal the transfer of MuJoCo's own data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="needs the extra mujoco")

from skinware import DriverReader, Namespace
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.testing.driving import carried_on, driving_lines
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.physics.binding import find_binding
from tests.ros2.alone import own_domain
from tests.streams.peers import LOCAL, free_port

from .scenes import expected_counts, hardware_in, on_the_pad

BUSES = {
    "embedded": ("", ""),
    "pty": ("pty:{folder}/port", "serial:{folder}/port"),
    "modbus": ("modbus:tcp://{local}:{port}", "modbus:tcp://{local}:{port}"),
    "tcp": ("tcp://{local}:{port}", "tcp://{local}:{port}"),
    "dds": ("dds://{domain}", "dds://{domain}"),
}
AXES = "xyz"


@dataclass(frozen=True)
class Case:
    """A device on a bus.

    Attributes:
        modules: text of the binding, for each module.
        counts: per newton.
        together: sensors that arrive together; 0: all of a device.
    """

    driver: str
    bus: str
    modules: tuple[str, ...]
    counts: float
    together: int = 0
    options: dict[str, Any] = field(default_factory=dict)
    of_driver: dict[str, Any] = field(default_factory=dict)


PRESSES_S, TIMES_PRESSED = 0.4, 60
CASES = [
    Case("xela", "embedded", ('rows = 4\ncolumns = 4\naxes = "xyz"',), 3000, together=3),
    Case("anyskin", "pty", ('rows = 1\ncolumns = 5\naxes = "-xyz"',), 2000),
    Case("inspire", "modbus", ("rows = 12\ncolumns = 8\nfirst = 9\npitch_m = [0.0025, 0.0025]",), 3000),
    Case("tesollo", "tcp", ("rows = 3\ncolumns = 5\nfirst = 30\npitch_m = [0.004, 0.004]",), 150),
    Case(
        "dex3",
        "dds",
        ("rows = 3\ncolumns = 4\nfirst = 24\ndevice = 0", "rows = 4\ncolumns = 3\nfirst = 0\ndevice = 1"),
        100_000,
        options={"period_ms": 10},
    ),
]


def sent(hardware: Any, bound: Any, counts: dict[int, npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
    """(n_values,) what a device sends for the counts of its modules, as its protocol clips and rounds it."""
    n = len(hardware.places())
    values = np.zeros(n) + hardware.rest
    for number, module in enumerate(bound.binding.module):
        if number in counts:
            first, width = module.first or 0, len(module.axes)
            for place, axis in enumerate(module.axes):
                if axis in AXES:
                    rows = slice(first + place, first + width * len(counts[number]), width)
                    values[rows] += np.rint(counts[number][:, AXES.index(axis)])
    clipped: npt.NDArray[np.float64] = np.clip(values, hardware.lowest, hardware.full_scale)
    return clipped


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=pytest.mark.thorough if case.bus != "embedded" else [], id=case.driver)
        for case in CASES
    ],
)
def test_values_through_wire_and_driver_are_the_transfer_of_the_physics(
    case: Case, tmp_path: Path, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = on_the_pad(tmp_path, *case.modules, counts=case.counts)
    hardware, sampled = hardware_in(world, case.driver, **case.options)
    where = {"folder": tmp_path, "local": LOCAL, "port": free_port()}
    if case.bus == "dds":
        where["domain"] = own_domain(namespace, monkeypatch)
    devices, host = (name.format(**where) for name in BUSES[case.bus])
    driver = load_driver(case.driver)
    adapter = driver(driver.Options(**case.of_driver))
    with ExitStack() as stack:
        if devices:
            there = make_bus(devices, payload_size=4096, for_devices=True)
            if hasattr(there, "topics"):
                there.topics = getattr(adapter, "topics", ())
            stack.enter_context(carried_on(there, hardware))
            bus = make_bus(host, payload_size=adapter.payload_size)
        else:
            bus = VirtualCanBus("", hardware=hardware, payload_size=adapter.payload_size)
        stack.enter_context(driving_lines([(adapter, bus)], "skin", publish="cycle"))
        reader = stack.enter_context(DriverReader("skin", timeout_s=15))
        frames = [np.array(frame.values) for frame in until_pressed(reader, hardware)]
        times = list(sampled)
    bound = find_binding(world, case.driver)
    counts = expected_counts(bound, times)
    found = require_each_is_one_of(frames, hardware, bound, times, counts, case.together)
    assert len(found) > 20, "different samples were read"


def until_pressed(reader: DriverReader, hardware: Any) -> Iterator[Any]:
    """Yield snapshots until the ball has pressed in many of them."""
    pressed = 0
    for frame in reader.in_order(timeout_s=15):
        if not frame.status.any():
            pressed += hardware.world.scene.time_s > PRESSES_S
            yield frame
        if pressed > TIMES_PRESSED:
            return


def require_each_is_one_of(
    frames: list[npt.NDArray[Any]],
    hardware: Any,
    bound: Any,
    times: list[tuple[int, float]],
    counts: list[dict[int, npt.NDArray[np.float64]]],
    together: int,
) -> set[int]:
    """Fail unless everything that arrived together is one sample, and samples come in their order; return which."""
    n = len(hardware.places())
    found: set[int] = set()
    for place, number in enumerate(hardware.numbers):
        samples = [at for at, (device, _) in enumerate(times) if device == number]
        known = np.array([sent(hardware, bound, counts[at]) for at in samples])
        for first in range(0, n, together or n):
            columns = slice(first, first + (together or n))
            last = 0
            for frame in frames:
                arrived = frame[place * n : (place + 1) * n][columns]
                rows = np.flatnonzero((known[:, columns] == arrived).all(axis=1))
                assert len(rows), f"device {number}: {arrived} was never sampled"
                assert rows[-1] >= last, "samples come in their order"
                last = int(rows[rows >= last][0])
                found.add(samples[last])
    return found
