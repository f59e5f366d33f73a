"""Decode literal bytes with a driver: bytes of a datasheet, of a recording, or written by hand.

::

    shown = decode_frames(MyDriver(MyOptions()), [(0x310, "01 00 02 00 03 00 04 00")])
    assert shown.values[:4].tolist() == [1, 2, 3, 4]
    assert shown.never_seen.sum() == 12

An identifier of 29 bits is written ``EXTENDED_FLAG | 0x18DA00F1``.

A test fails, and says why, if something that it decodes is not shown. To test just that, say ``strict=False`` and look
at ``problems``. Bytes that a program computed, such as the driver's emulator, only prove that two programs agree.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.driver_service import DriverWriter
from skinware.errors import BusError
from skinware.memory.namespace import Namespace
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import FrameBatch, check_identifier, identifier_text
from skinware_drivers.counters import BusCounters
from skinware_drivers.decoding.decoder import BUS_COUNTERS, PATCH_COUNTERS, Decoder
from skinware_drivers.description import Patch, SkinTables, assemble
from skinware_drivers.finding.without_driver import attended
from skinware_drivers.layout import Layout
from skinware_drivers.modbus.adapter import ModbusAdapter
from skinware_drivers.modbus.master import Listener
from skinware_drivers.polling import Watch
from skinware_drivers.running.native_path import Named, NativePath
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, Publisher
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.testing.waiting import defect, require, run_in_its_time
from skinware_drivers.testing.wire import make_bus
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import EmulatedHardware
from skinware_drivers.virtual.recorded_wire import RecordedWire

_MS = 1_000_000
_WHY = dict(
    zip(
        BUS_COUNTERS,
        (
            "no frame of the layout has this identifier, or it names no patch or module",
            "the layout has no frame of this length",
            "its identifier and length are known, its content is that of no frame of the layout",
            "it is stamped before this machine booted",
        ),
        strict=True,
    )
)


class Shown(NamedTuple):
    """The values that users would read after some frames."""

    structure: Structure
    values: npt.NDArray[Any]
    """(n_sensors,) of the driver's dtype, raw."""
    status: npt.NDArray[np.uint8]
    """(n_sensors,) bits of :class:`skinware.status.Status`."""
    unknown: int
    """Frames that belong to no module."""
    problems: tuple[str, ...]
    """Data that was not shown, with the reason, a line each."""

    @property
    def never_seen(self) -> npt.NDArray[np.bool_]:
        """Return (n_sensors,) bool: sensors without a value."""
        never_seen: npt.NDArray[np.bool_] = (self.status & Status.NEVER_SEEN) != 0
        return never_seen


class DirectPath:
    """A driver's data path without a bus and a loop; it shows every update at once, in a namespace of its own.

    Args:
        layout: of the only bus.
        payload_size: longest payload, bytes.
        period_s: nominal time between two updates of a module; None: cycles are joined whenever their frames come.
        rows: the most frames that are fed at once.
        watch: looks at updates; None: none does.

    Attributes:
        decoder: its ``state`` holds the values and counters after the frames so far.
    """

    def __init__(
        self,
        layout: Layout,
        tables: SkinTables,
        payload_size: int,
        *,
        period_s: float | None = None,
        rows: int = 1,
        watch: Watch | None = None,
    ) -> None:
        self.decoder = Decoder([layout], tables, None if period_s is None else [period_s])
        self._namespace = Namespace(f"direct-{os.getpid()}-{secrets.token_hex(4)}")
        self._writer = DriverWriter(
            "direct",
            self.decoder.tables.structure,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=PATCH_COUNTERS,
            namespace=self._namespace,
        )
        publisher = Publisher(self._writer, self.decoder, watch or Watch(tables), 1.0, by_cycle=False)
        self._batch = FrameBatch(rows, payload_size, self.decoder.compiled.headroom)
        self._path = NativePath(self.decoder, publisher, self._batch)

    @property
    def waiting(self) -> int:
        """Return the number of frames that wait for the others of their cycle."""
        self._path.empty()
        return len(self._batch)

    def feed(self, time_ns: int, identifier: int, payload: bytes) -> None:
        """Decode one frame."""
        self._path.empty()
        self._batch.append(0, time_ns, identifier, payload)
        self._path.digest()

    def feed_rows(self, wire: npt.NDArray[np.void], time_ns: npt.NDArray[np.int64]) -> Named:
        """Decode frames as in a batch; return what they are."""
        self._path.empty()
        batch = self._batch
        rows = slice(batch.stop, batch.stop + len(wire))
        batch.wire[rows], batch.time_ns[rows], batch.bus[rows] = wire, time_ns, 0
        batch.stop = rows.stop
        self._path.digest()
        return self._path.named(rows)

    def close(self) -> None:
        self._writer.close()
        shutil.rmtree(self._namespace.path, ignore_errors=True)


def decode_frames(
    adapter: AnyAdapter,
    frames: Sequence[tuple[int, str | bytes]],
    *,
    strict: bool = True,
    devices: EmulatedHardware | None = None,
    apart_s: float = 0.001,
) -> Shown:
    """Decode frames that arrive one after the other.

    Args:
        adapter: the driver. Its ``layout`` is used, and its ``patches`` or the patches that its ``describe`` finds.
        frames: identifier and payload (bytes, or hexadecimal digits) of each.
        strict: fail the test if one of them is not shown.
        devices: emulated ones, for a ``describe`` that asks.
        apart_s: time from one frame to the next, s.
    """
    return _decode(adapter, frames, [], strict, devices, round(apart_s * NS_PER_S))


def decode_stream(
    adapter: SerialAdapter[Any] | ModbusAdapter[Any],
    stream: str | bytes,
    *,
    strict: bool = True,
    devices: EmulatedHardware | None = None,
) -> Shown:
    """Decode bytes on a serial line.

    Args:
        adapter: the driver. Its ``framing`` and ``layout`` are used (for Modbus, its ``registers`` and byte order), and
            its ``patches`` or the patches that its ``describe`` finds.
        stream: the bytes, or their hexadecimal digits; for Modbus, requests and replies as on a serial line.
        strict: fail the test if some of them are not shown.
        devices: emulated ones, for a ``describe`` that asks.
    """
    if isinstance(adapter, ModbusAdapter):
        counted = BusCounters()
        counters, listener = counted.framing, Listener(adapter.wanted, counted)
        listener.heard(_bytes(stream), NS_PER_S)
        frames, pending = [(row.identifier, row.payload) for row in listener.rows], listener.pending
    else:
        framer = adapter.framing.framer()
        frames = [(frame.identifier, frame.body) for frame in framer.feed(_bytes(stream))]
        counters, pending = framer.counters, framer.pending
    problems = [
        text
        for count, text in (
            (counters.checksum_errors, f"{counters.checksum_errors} x the checksum is wrong"),
            (counters.refused, f"{counters.refused} x a packet begins, and its form is impossible"),
            (counters.skipped_bytes, f"{counters.skipped_bytes} bytes belong to no good packet"),
            (pending, f"the last {pending} bytes are no whole packet: more would have to follow"),
            (not frames, "no part of it is data of this driver"),
        )
        if count
    ]
    return _decode(adapter, frames, problems, strict, devices)


def _decode(
    adapter: AnyAdapter,
    frames: Sequence[tuple[int, str | bytes]],
    problems: list[str],
    strict: bool,
    devices: EmulatedHardware | None,
    apart_ns: int = _MS,
) -> Shown:
    patches = _patches(adapter, devices)
    tables = assemble([("bus", patches)], adapter.types, adapter.dtype)
    with closing(DirectPath(adapter.layout, tables, adapter.payload_size)) as path:
        problems += _feed(path, adapter, frames, apart_ns)
        state = path.decoder.state
        orphans, waiting = int(state.patch_counters[:, 1].sum()), path.waiting
        if orphans:
            problems.append(f"{orphans} frames have no partners of their cycle")
        if waiting:
            problems.append(f"{waiting} frames wait for the others of their cycle")
        if strict and problems:
            defect("not everything was shown (if that is right, say strict=False):\n" + "\n".join(problems))
        unknown = int(state.bus_counters[0, 0])
        return Shown(path.decoder.tables.structure, state.values.copy(), state.status.copy(), unknown, tuple(problems))


def _feed(
    path: DirectPath, adapter: AnyAdapter, frames: Sequence[tuple[int, str | bytes]], apart_ns: int
) -> Iterator[str]:
    """Feed frames one by one, and yield the problems of each."""
    counters = path.decoder.state.bus_counters[0]
    for number, (identifier, digits) in enumerate(frames):
        payload = _bytes(digits)
        if adapter.medium == "can":
            check_identifier(identifier)
        name = f"frame {number}, {identifier_text(identifier)} [{len(payload)}] {payload[:8].hex(' ').upper()}"
        if len(payload) > adapter.payload_size:
            yield f"{name}: too long, the longest of the layout has {adapter.payload_size} bytes"
            continue
        before = counters.copy()
        path.feed((number + 1) * apart_ns, identifier, payload)
        yield from (f"{name}: {_WHY[BUS_COUNTERS[which]]}" for which in np.flatnonzero(counters - before))


def _patches(adapter: AnyAdapter, devices: EmulatedHardware | None) -> Sequence[Patch]:
    if type(adapter).describe is Adapter.describe:
        return adapter.patches
    clock = HandClock()

    async def describe() -> Sequence[Patch]:
        bus = make_bus(adapter, devices or RecordedWire(iter(()), 0), clock, listen_only=False)
        adapter.fit(bus)
        async with attended(bus) as link:
            try:
                return await adapter.describe(link)
            except BusError as error:
                return defect(
                    f"`describe` asks its devices, and none answers: give emulated ones as `devices=` ({error})"
                )

    patches = run_in_its_time(clock, describe)
    require(patches, "`describe` finds no patch: if it asks its devices, give emulated ones as `devices=`")
    return patches


def _bytes(data: str | bytes) -> bytes:
    return bytes.fromhex("".join(data.split())) if isinstance(data, str) else data
