"""One fuzzer's input, run through both data paths: what ``tools/fuzzing/data_path.py`` does.

An input is a script: which skin it is, and then frames, good ones and arbitrary bytes, with any stamp, ends of batches,
time that passes, and what happens beside the wire. Nothing of it may raise anything, and both paths do the same.
Some inputs go through C alone: there, lengths are any that the row of a batch can hold. Others begin in the kernel, at
sockets and lines that C reads (flow_fuzzing.py).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Literal

import numpy as np

from skinware.errors import SkinwareError
from skinware.status import Status
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import EXTENDED_FLAG, wire_dtype
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import (
    Bits,
    Byte,
    DeviceTime,
    Flag,
    Identifier,
    Packed,
    Sentinel,
    SequenceNumber,
    StatusBytes,
)
from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values
from skinware_drivers.registry import DRIVERS, load_driver
from skinware_drivers.virtual.hand_clock import HandClock
from tests.native import flow_fuzzing
from tests.native.skins import BusDesign, SkinDesign, nibbles, run_lengths
from tests.native.traffic import identifier_of
from tests.serial.framings import EXAMPLES, Example
from tests.serial.fuzzing import Script, examples_of_drivers
from tests.serial.fuzzing import run as run_on_line
from tests.specification.both_paths import Pair
from tests.specification.one_path import Publishing, Way

_PERIOD_S = 0.02
_MOST_ROWS = 256
_FAR_NS = 1 << 60
"""Stamps lie within 36 years of the boot: those of the kernel, of which a clock was set."""


def designs() -> Mapping[str, SkinDesign]:
    """Skins by name: some that say everything that can be said, and those of the installed drivers that know theirs."""
    return {**_made_up(), **_of_drivers()}


@functools.cache
def _of_drivers() -> dict[str, SkinDesign]:
    found = {}
    for entry in entry_points(group=DRIVERS):
        try:
            driver: type[AnyAdapter] = load_driver(entry.name)
            adapter = driver(driver.Options())
        except (SkinwareError, TypeError):
            continue
        if type(adapter).describe is Adapter.describe:
            bus = BusDesign(adapter.layout, adapter.patches, adapter.period_s)
            found[f"driver_{entry.name}"] = SkinDesign([bus], np.dtype(adapter.dtype).str, adapter.types)
    return found


@functools.cache
def _made_up() -> dict[str, SkinDesign]:
    return {
        "headers": SkinDesign([_bus(_headers())], "<u2"),
        "counted cycle": SkinDesign([_bus(_cycle("given", SequenceNumber(0, ">u2", mask=0x0FF0), "patch"))], "<i2"),
        "timed cycle": SkinDesign([_bus(_cycle("any", None, "module"))], "<i4"),
        "cycle with an end": SkinDesign([_bus(_cycle("ends_with", None, "patch"))], "<f4"),
        "floats": SkinDesign([_bus(_floats())], "<f4"),
        "long": SkinDesign([_bus(_long())], "u1"),
        "long cycles": SkinDesign([_bus(_long_cycles())], "u1"),
        "several": SkinDesign(
            [_bus(_headers()), BusDesign(None, [], 1.0), _bus(_cycle("given", None, "module"), 0.005)], "<u2"
        ),
    }


def _bus(layout: Layout, period_s: float = _PERIOD_S) -> BusDesign:
    patches = [
        Patch(f"patch {key}", [Module(taxels(6, first_uid=(3 * key + m) * 6), key=m) for m in range(3)], key=key)
        for key in range(2)
    ]
    return BusDesign(layout, patches, period_s)


def _headers() -> Layout:
    """Kinds by a byte, modules by another; flags, sequence numbers, the device's time."""
    frames = [
        Frame(
            f"kind {kind}",
            [Identifier(0x100, 0x70F), Byte(0, 0x10 + kind)],
            [8, 6 + kind],
            Values(2, dtype, 4 // np.dtype(dtype).itemsize),
            Bits(4, 4),
            Bits(2, 3, byte=1),
            [Flag(Status.NO_ACK, 6, "<u2", 0x8001, [(0, 3), (1, 15)], normal=0x8), Sentinel(Status.MASKED, 7)],
            SequenceNumber(5, "u1", 200),
            DeviceTime(4, "<u2", 1e-3, 60_000),
        )
        for kind, dtype in enumerate(["u1", "<u2", ">u2"])
    ]
    return Layout(frames)


def _cycle(
    order: Literal["given", "any", "ends_with"], counter: SequenceNumber | None, within: Literal["patch", "module"]
) -> Layout:
    """Three frames, one of them packed and one a function, beside one alone."""
    contents: list[str | Packed] = [Packed(5, "big", False, 3), Packed(7, "little", False, 1), "u1"]
    frames = [
        Frame(
            f"part {place}",
            [Identifier(0x100 + (place << 8), 0x700)],
            [8],
            Expand(run_lengths) if place == 2 else Values(3, dtype, 2, [2 * place, 2 * place + 1]),
            Bits(4, 4),
            Bits(0, 4),
            [StatusBytes(5, Status.OUT_OF_RANGE | Status.SUSPECT)],
        )
        for place, dtype in enumerate(contents)
    ]
    alone = Frame("alone", [Identifier(0x700, 0x700)], [2, 4], Values(0, "u1", 2, [5, None]), Bits(4, 4), Bits(0, 4))
    names = [frame.name for frame in frames]
    return Layout([*frames, alone], Cycle(names, 0.008, within, order, counter))


def _floats() -> Layout:
    """29-bit identifiers."""
    flags = [Sentinel(Status.NOT_CONNECTED, float("nan")), Sentinel(Status.OUT_OF_RANGE, float("inf"))]
    conditions = [Identifier(EXTENDED_FLAG | 0x18DA_0000, 0x1FFF_FF00)]
    values = [Values(0, "<f4", 2), Values(8, ">f4", 3, [2, None, 4])]
    mixed = [Values(1, ">i8", 1), Values(9, "<u4", 2, [1, 0]), Values(17, "i1", 3)]
    other = [Identifier(EXTENDED_FLAG | 0x18DB_0000, 0x1FFF_FF00)]
    return Layout(
        [
            Frame("floats", conditions, [20, 24], values, Bits(4, 4), Bits(0, 4), flags),
            Frame("mixed", other, [20], mixed, Bits(4, 4), Bits(0, 4), [Sentinel(Status.MASKED, -1)]),
        ]
    )


def _long() -> Layout:
    """Rows with long payloads, as serial lines have them."""
    return Layout(
        [
            Frame("values", [Identifier(1)], [300], Values(290, "u1", 6), 0, Bits(0, 2, byte=299)),
            Frame("function", [Identifier(2)], [1, 70, 257], Expand(nibbles), 1, 1, [StatusBytes(60, Status.MASKED)]),
        ]
    )


def _long_cycles() -> Layout:
    """Two cycles of one layout, one of more frames than a word has bits; what names no module is passed over."""

    def rows(count: int, module: int) -> list[Frame]:
        return [
            Frame(
                f"{module}, {row}",
                [Identifier(0x100, 0x70F), Byte(0, module), Byte(1, row)],
                [3, 4],
                Values(2, "u1", 1, [row if row < 6 else None]),
                Bits(4, 4),
                Bits(0, 8, byte=0),
            )
            for row in range(count)
        ]

    long, short = rows(34, 0), rows(2, 1)
    cycles = [Cycle([frame.name for frame in frames], 0.008) for frames in (long, short)]
    other = Frame("other", [Identifier(0x100, 0x70F)], range(9), Values(0, "u1", 0), Bits(4, 4), Bits(0, 8, byte=0))
    return Layout([other, *long, *short], cycles[0], cycles[1:])


@functools.cache
def _framings() -> dict[str, Example]:
    return {**EXAMPLES, **examples_of_drivers()}


def run(clock: HandClock, data: bytes) -> int:
    """Run one input, on a skin, on a serial line or through the kernel; how many frames it published.

    Raises:
        AssertionError: the paths differ, or something was not counted.
    """
    script = Script(data)
    where = script.number(4)
    if where == 1:
        return flow_fuzzing.run(clock, script)
    if where == 0:
        framings = _framings()
        run_on_line(framings[sorted(framings)[script.number(len(framings))]], data[2:])
        return 0
    known = designs()
    design = known[sorted(known)[script.number(len(known))]]
    is_alone = script.number(4) == 0
    publishing = Publishing(_PERIOD_S, script.number(4) > 0, script.number(4) == 0, 2 + script.number(8))
    longest = max(layout.payload_size for layout in design.layouts if layout is not None)
    size = longest + (0, 64, 512)[script.number(3)]
    skin = design.layouts, design.tables(), design.periods_s
    with Pair(clock, *skin, publishing, rows=_MOST_ROWS, payload_size=size) as pair:
        _Fuzz(design, pair, script, is_alone).run()
        return pair.frames


class _Fuzz:
    """Plays a script."""

    def __init__(self, design: SkinDesign, pair: Pair, script: Script, is_alone: bool) -> None:
        self._design, self._pair, self._script, self._is_alone = design, pair, script, is_alone
        size = pair.numpy.batch.payload_size
        self._size = size
        self._wire = np.zeros(_MOST_ROWS, wire_dtype(size))
        self._time_ns = np.zeros(_MOST_ROWS, np.int64)
        self._bus = np.zeros(_MOST_ROWS, np.uint16)
        self._n = 0
        self._read_ns = 0
        self._n_patches = pair.numpy.decoder.tables.structure.n_patches
        self._identifiers = [
            (number, frame, identifier_of(frame, patch.key, module.key))
            for number, bus in enumerate(design.buses)
            if bus.layout is not None
            for frame in bus.layout.frames
            for patch in bus.patches
            for module in patch.modules
        ]

    def run(self) -> None:
        while not self._script.is_over:
            what = self._script.number(16)
            if what < 11:
                self._add(is_good=what > 0)
            elif what < 14:
                self._digest()
            elif what == 14:
                self._digest()
                self._pair.clock.now_ns += (
                    self._script.number(1 << 16) * self._pair.numpy.publisher.pace.period_ns // 4096
                )
                self._read_ns = max(self._read_ns, self._pair.clock.now_ns - self._script.number(1 << 10) * 10_000)
                self._do(lambda way: way.publish_if_due(self._read_ns))
            else:
                self._happen()
            if self._n == _MOST_ROWS:
                self._digest()
        self._digest()

    def _do(self, action: Callable[[Way], object]) -> None:
        if self._is_alone:
            action(self._pair.native)
        else:
            self._pair.do(action)

    def _add(self, is_good: bool) -> None:
        script, row = self._script, self._wire[self._n]
        bus, frame, identifier = self._identifiers[script.number(len(self._identifiers))]
        lengths = sorted(frame.length)
        length = lengths[script.number(len(lengths))]
        payload = bytearray(script.bytes(min(length, 1 + script.number(24))).ljust(self._size, b"\xa5"))
        if is_good:
            for condition in frame.when:
                if isinstance(condition, Byte):
                    payload[condition.offset] = payload[condition.offset] & ~condition.mask & 0xFF | condition.value
        else:
            bus = script.number(len(self._design.buses))
            identifier ^= int.from_bytes(script.bytes(4), "little")
            length = self._any_length()
        row["identifier"], row["length"] = identifier, length
        row["payload"] = np.frombuffer(bytes(payload[: self._size]), np.uint8)
        self._bus[self._n] = bus
        self._time_ns[self._n] = self._stamp_ns()
        self._n += 1

    def _any_length(self) -> int:
        if self._is_alone:
            return int.from_bytes(self._script.bytes(self._wire.dtype["length"].itemsize), "little")
        return self._script.number(self._size + 1)

    def _stamp_ns(self) -> int:
        now_ns, what = self._pair.clock.now_ns, self._script.number(16)
        if what == 0:
            return int.from_bytes(self._script.bytes(8), "little", signed=True) % (2 * _FAR_NS) - _FAR_NS
        if what < 4:
            return now_ns - self._script.number(1 << 16) * 1000
        self._pair.clock.now_ns += 50_000
        return now_ns

    def _digest(self) -> None:
        n, interrupted = self._n, self._script.number(8)
        buses = [bus for bus in range(len(self._design.buses)) if interrupted >> bus & 1]

        def take(way: Way) -> None:
            way.empty()
            rows = slice(way.batch.stop, way.batch.stop + n)
            way.batch.wire[rows], way.batch.time_ns[rows] = self._wire[:n], self._time_ns[:n]
            way.batch.bus[rows] = self._bus[:n]
            way.batch.stop = rows.stop
            way.digest(buses)

        self._do(take)
        self._n = 0

    def _happen(self) -> None:
        patch, what, now_ns = self._script.number(self._n_patches), self._script.number(4), self._pair.clock.now_ns

        def act(way: Way) -> None:
            if what == 0:
                way.decoder.forget(patch)
            elif what == 1 and way.desk is not None:
                way.desk.waiting.append(now_ns)
            elif what == 2:
                way.watch.suspect(patch)
            else:
                way.watch.forget(patch)

        self._do(act)
