"""What a driver makes of literal bytes: of a datasheet, of a recording, or written by hand.

::

    shown = decode_frames(MyDriver(MyOptions()), [(0x310, "01 00 02 00 03 00 04 00")])
    assert shown.values[:4].tolist() == [1, 2, 3, 4]
    assert shown.never_seen.sum() == 12

An identifier of 29 bits is written as everywhere: ``EXTENDED_FLAG | 0x18DA00F1``.

The data path in C is given the same, and has to do the same as that of numpy.

A test fails if something of what it decodes is not shown, and says what and why. Where that is what is tested, say
``strict=False`` and look at ``problems``. Bytes that a program computed, say the driver's emulator, prove only that two
programs agree.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import BusError
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware.structure import Structure
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import FrameBatch, check_identifier, identifier_text
from skinware_drivers.counters import BusCounters, FramerCounters
from skinware_drivers.decoding.skin_state import BUS_COUNTERS
from skinware_drivers.description import Patch, assemble
from skinware_drivers.link import Link
from skinware_drivers.modbus.adapter import ModbusAdapter
from skinware_drivers.modbus.master import Listener
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.testing.clock import run_in_its_time
from skinware_drivers.testing.defect import defect, require
from skinware_drivers.testing.direct_path import DirectPath
from skinware_drivers.testing.wire import make_bus
from skinware_drivers.virtual.hand_clock import HandClock
from skinware_drivers.virtual.hardware import EmulatedHardware, WireFrame

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
    """What users would see after some frames."""

    structure: Structure
    values: npt.NDArray[Any]
    """(n_sensors,) of the driver's dtype, raw."""
    status: npt.NDArray[np.uint8]
    """(n_sensors,) bits of :class:`skinware.status.Status`."""
    unknown: int
    """Frames that belong to no module."""
    problems: tuple[str, ...]
    """What was not shown, and why, a line each."""

    @property
    def never_seen(self) -> npt.NDArray[np.bool_]:
        """(n_sensors,) bool: sensors of which no value came."""
        never_seen: npt.NDArray[np.bool_] = (self.status & Status.NEVER_SEEN) != 0
        return never_seen


def decode_frames(
    adapter: AnyAdapter,
    frames: Sequence[tuple[int, str | bytes]],
    *,
    strict: bool = True,
    devices: EmulatedHardware | None = None,
    apart_s: float = 0.001,
) -> Shown:
    """What a driver makes of frames that arrive one after the other.

    Args:
        adapter: the driver. Its ``layout`` is used, and its ``patches`` or what its ``describe`` finds.
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
    """What a driver makes of bytes on a serial line.

    Args:
        adapter: the driver. Its ``framing`` and ``layout`` are used (of Modbus, its ``registers`` and byte order), and
            its ``patches``, or what ``describe`` finds.
        stream: the bytes, or their hexadecimal digits. Of Modbus: questions and their replies, as on a serial line.
        strict: fail the test if some of them are not shown.
        devices: emulated ones, for a ``describe`` that asks.
    """
    find = _overheard if isinstance(adapter, ModbusAdapter) else _framed
    frames, counters, pending = find(adapter, _bytes(stream))
    problems = [
        text
        for count, text in (
            (counters.checksum_errors, f"{counters.checksum_errors} x the checksum is wrong"),
            (counters.refused, f"{counters.refused} x what begins like a packet has a form that cannot be"),
            (counters.skipped_bytes, f"{counters.skipped_bytes} bytes belong to no good packet"),
            (pending, f"the last {pending} bytes are no whole packet: more would have to follow"),
            (not frames, "nothing of it is data of this driver"),
        )
        if count
    ]
    return _decode(adapter, frames, problems, strict, devices)


def _framed(adapter: Any, stream: bytes) -> tuple[list[tuple[int, bytes]], FramerCounters, int]:
    """The frames in the bytes of a serial line, what was counted, and how many bytes are no whole frame yet."""
    framer = adapter.framing.framer()
    frames = [(frame.identifier, frame.body) for frame in framer.feed(stream)]
    return frames, framer.counters, framer.pending


def _overheard(adapter: Any, stream: bytes) -> tuple[list[tuple[int, bytes]], FramerCounters, int]:
    counters = BusCounters()
    listener = Listener(adapter.wanted, counters)
    listener.heard(stream, NS_PER_S)
    return [(row.identifier, row.payload) for row in listener.rows], counters.framing, listener.pending


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
    """Feed frames one by one; yield what is wrong with each."""
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


class _Nobody:
    """Devices that are not there."""

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        pass

    def next_due_ns(self) -> int | None:
        return None

    def emit(self, now_ns: int) -> list[WireFrame]:  # noqa: ARG002
        return []

    def skip(self, now_ns: int) -> int:  # noqa: ARG002
        return 0

    def totals(self) -> dict[str, int]:
        return {}


def _patches(adapter: AnyAdapter, devices: EmulatedHardware | None) -> Sequence[Patch]:
    if type(adapter).describe is Adapter.describe:
        return adapter.patches
    clock = HandClock()

    async def describe() -> Sequence[Patch]:
        bus = make_bus(adapter, devices or _Nobody(), clock, listen_only=False)
        adapter.fit(bus)
        link = Link(bus)

        def hear() -> None:
            batch = FrameBatch(4096, bus.payload_size)
            bus.receive(batch, 0)
            link.offer(batch, np.arange(batch.start, batch.stop))

        bus.open()
        asyncio.get_running_loop().add_reader(bus.fileno(), hear)
        try:
            return await adapter.describe(link)
        except BusError as error:
            return defect(f"`describe` asks its devices, and none answers: give emulated ones as `devices=` ({error})")
        finally:
            asyncio.get_running_loop().remove_reader(bus.fileno())
            bus.close()

    patches = run_in_its_time(clock, describe)
    require(patches, "`describe` finds no patch: if it asks its devices, give emulated ones as `devices=`")
    return patches


def _bytes(data: str | bytes) -> bytes:
    """Spaces between hexadecimal digits may be anywhere, or nowhere."""
    return bytes.fromhex("".join(data.split())) if isinstance(data, str) else data
