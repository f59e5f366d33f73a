"""Export recorded wires as files of other programs: candump's text, and pcapng.

A file has the frames of all buses by time, each with the name of its interface (``can0``). If two drivers listened to
one bus, the second one's frames have the name ``can0_2``, and so on.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from typing import BinaryIO

from skinware.errors import BadRecording, ConfigurationError
from skinware.recording.reading import Recording
from skinware.recording.wire_tracks import WireTrack
from skinware.text import nearest_name
from skinware.wire import IS_CUT, IS_FD, SERIAL, SERIAL_HEADER, SOCKETCAN, WireItem, candump_line, channel_name

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_NAME, _DESCRIPTION, _RESOLUTION, _FLAGS = 2, 3, 9, 2
_INBOUND, _OUTBOUND = 1, 2
_ASKED_EACH = 1000

_Wires = list[tuple[WireTrack, str]]
"""(wire, name of its interface)."""


@dataclass(frozen=True)
class Chosen:
    """The part of the wires to export.

    Attributes:
        start_s: begin at this time, s since the recording began.
        end_s: end before this time; None: at the end of the recording.
        is_stopped: called now and then; True ends the export with :class:`KeyboardInterrupt`.
    """

    drivers: Collection[str] = ()
    start_s: float = 0.0
    end_s: float | None = None
    is_stopped: Callable[[], bool] = lambda: False


@dataclass
class Exported:
    """The result of an export.

    Attributes:
        counts: frames of each interface; reads and writes of serial lines.
        notes: a line for each thing that the format cannot hold.
    """

    counts: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)


def export_candump(recording: Recording, path: Path, chosen: Chosen | None = None) -> Exported:
    """Write the frames of all CAN buses as ``candump -L`` does; each line ends with R (received) or T (sent)."""
    part = chosen or Chosen()
    with _exporting(recording, path, part, with_serial=False) as (file, wires, exported):
        for number, item in _in_order(wires, part, exported):
            channel = wires[number][1]
            fd_flags = item.flags if item.flags & IS_FD else None
            direction = "T" if item.is_sent else "R"
            line = candump_line(item.epoch_ns // 1000, channel, item.identifier or 0, fd_flags, item.data, direction)
            file.write(line.encode() + b"\n")
            exported.counts[channel] += 1
    return exported


def export_pcapng(recording: Recording, path: Path, chosen: Chosen | None = None) -> Exported:
    """Write all wires for Wireshark, with times in ns and directions.

    An interface of a CAN bus has the link type :data:`SOCKETCAN`, one of a serial line :data:`SERIAL`.
    """
    part = chosen or Chosen()
    with _exporting(recording, path, part, with_serial=True) as (file, wires, exported):
        file.write(_block(_SECTION, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)))
        for wire, name in wires:
            options = _option(_NAME, name.encode()) + _option(_RESOLUTION, b"\x09")
            options += _option(_DESCRIPTION, f"bus {wire.bus} of {wire.driver}".encode()) + struct.pack("<HH", 0, 0)
            link_type = SERIAL if wire.is_serial else SOCKETCAN
            file.write(_block(_INTERFACE, struct.pack("<HHI", link_type, 0, 0) + options))
        for number, item in _in_order(wires, part, exported):
            file.write(_packet(number, item))
            exported.counts[wires[number][1]] += 1
    return exported


@contextmanager
def _exporting(
    recording: Recording, path: Path, chosen: Chosen, *, with_serial: bool
) -> Iterator[tuple[BinaryIO, _Wires, Exported]]:
    """Yield a new file, the wires to write into it, and the result to fill in; a file that fails is removed."""
    recorded = {wire.driver for wire in recording.wires}
    for driver in chosen.drivers:
        if recorded and driver not in recorded:
            others = nearest_name(driver, sorted(recorded))
            raise ConfigurationError(f"{recording.path}: no wire of {driver!r} in it{others}")
    exported = Exported()
    wires: _Wires = []
    for wire, name in _named(recording):
        if chosen.drivers and wire.driver not in chosen.drivers:
            continue
        if with_serial or not wire.is_serial:
            wires.append((wire, name))
        else:
            exported.notes.append(f"{wire.bus} of {wire.driver} left out: the format has no serial lines")
        if wire.missed:
            exported.notes.append(f"{wire.bus} of {wire.driver}: {wire.missed} missed while it was recorded")
    if not wires:
        what = "no frame of a CAN bus" if exported.notes else "no wire"
        raise BadRecording(f"{recording.path}: {what} was recorded: skin-record --wire records them")
    with path.open("xb") as file:
        try:
            yield file, wires, exported
        except BaseException:
            path.unlink()
            raise


def _named(recording: Recording) -> _Wires:
    named: _Wires = []
    used: Counter[str] = Counter()
    for wire in recording.wires:
        interface, _, channel = wire.bus.partition("?")[0].rpartition(":")
        name = channel_name(interface or "bus", channel)
        used[name] += 1
        named.append((wire, name if used[name] == 1 else f"{name}_{used[name]}"))
    return named


def _in_order(wires: _Wires, chosen: Chosen, exported: Exported) -> Iterator[tuple[int, WireItem]]:
    """Yield (number of its wire, item) of all wires by time; note how many frames were cut."""
    cut = 0
    streams = [
        zip(repeat(number), wire.items(start_s=chosen.start_s, end_s=chosen.end_s))
        for number, (wire, _) in enumerate(wires)
    ]
    for count, (number, item) in enumerate(heapq.merge(*streams, key=lambda one: one[1].epoch_ns)):
        if not count % _ASKED_EACH and chosen.is_stopped():
            raise KeyboardInterrupt
        cut += bool(item.flags & IS_CUT)
        yield number, item
    if cut:
        exported.notes.append(f"{cut} CAN FD frames without their end: their driver knows none that are so long")


def _block(kind: int, body: bytes) -> bytes:
    size = 12 + len(body)
    return struct.pack("<II", kind, size) + body + struct.pack("<I", size)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _filled_up(value)


def _filled_up(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _packet(number: int, item: WireItem) -> bytes:
    if item.identifier is None:
        data = SERIAL_HEADER.pack(1, item.is_sent, 0) + item.data
    else:
        data = struct.pack(">IBBH", item.identifier, len(item.data), item.flags & ~IS_CUT & 0xFF, 0) + item.data
    head = struct.pack("<IIIII", number, item.epoch_ns >> 32, item.epoch_ns & 0xFFFF_FFFF, len(data), len(data))
    options = _option(_FLAGS, struct.pack("<I", _OUTBOUND if item.is_sent else _INBOUND)) + struct.pack("<HH", 0, 0)
    return _block(_PACKET, head + _filled_up(data) + options)
