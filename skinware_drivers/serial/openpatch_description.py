"""The greeting, the reports and the description of an open patch, read and checked.

The protocol is docs/protocols/patch-serial.md. Everything here comes from a wire: the outcome is a description that can
be trusted, or a :class:`BadDescription` with the fault.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skinware.errors import BusError, StructureError
from skinware.sensor_types import CATALOGUE, MAX_NAME_BYTES, MAX_UNIT_BYTES, SensorType
from skinware.status import Status
from skinware_drivers import Module, Patch, Sensor
from skinware_drivers.fields import AnyFlag, Bits, DeviceTime, Flag, Identifier, Sentinel, SequenceNumber, StatusBytes
from skinware_drivers.layout import Frame, Layout, Values

MAJOR, MINOR = 1, 0
MOST_PAYLOAD = 1024
MOST_ITEMS = 256
ALL_MODULES = 0xFF

_DATA = 0x80
_DATA_HEADER = 8  # bytes of a data message's payload before the values
_MOST_KINDS, _MOST_TYPES, _MOST_MODULES, _MOST_AXES = 32, 64, 255, 9
_MOST_VALUES = 16384  # of all modules together
_MOST_VALUE_BYTES = MOST_PAYLOAD - _DATA_HEADER  # of one module
_PATCH, _TYPE, _KIND, _MODULES = 1, 2, 3, 4  # tags of items
_PADDING = 0xFF
_DTYPES = ("u1", "<i2", "<u2", "<i4", "<f4")
_MAX_KIND_BYTES = 16
_STATUS = Status.STALE | Status.OUT_OF_RANGE | Status.NO_ACK | Status.NOT_CONNECTED | Status.MASKED | Status.SUSPECT
_CATALOGUE_NAMES = {known.id: known.name for known in CATALOGUE.values()}
_RESETS = ("unknown", "power-up", "reset pin", "watchdog", "brown-out", "software", "fault")


class BadDescription(BusError):
    """A patch has sent an impossible description."""


@dataclass(frozen=True)
class Greeting:
    """The answer to a greeting, and the announcement after a reset.

    It has the version of the protocol, the reason of the last reset in words and the time since then, whether the patch
    was started, and the checksum and number of items of its description.
    """

    major: int
    minor: int
    reset: str
    streaming: bool
    uptime_s: float
    crc: int
    n_items: int

    @classmethod
    def read(cls, data: bytes) -> Greeting:
        if data[:1] != bytes((MAJOR,)):
            speaks = f"version {data[0]}.{data[1]}" if len(data) > 1 else "no version"
            raise BadDescription(f"the patch speaks {speaks} of the protocol, this driver version {MAJOR}: update it")
        reader = _Reader(data, "greeting")
        major, minor, reset, streaming, uptime_ms, crc, n_items = reader.take("<BBBBIIH")
        if not 1 <= n_items <= MOST_ITEMS:
            raise BadDescription(f"a description of {n_items} items; 1 to {MOST_ITEMS} can be")
        word = _RESETS[reset] if reset < len(_RESETS) else f"reason {reset}"
        return cls(major, minor, word, bool(streaming), uptime_ms / 1000, crc, n_items)


@dataclass(frozen=True)
class Report:
    """The counters of a patch since its last reset: data messages sent and dropped, and damaged frames received."""

    uptime_s: float
    sent: int
    dropped: int
    bad_requests: int

    @classmethod
    def read(cls, data: bytes) -> Report:
        uptime_ms, sent, dropped, bad = _Reader(data, "report").take("<IIII")
        return cls(uptime_ms / 1000, sent, dropped, bad)


@dataclass(frozen=True)
class ModuleKind:
    """A kind of module; ``taxels`` has the sensor type of each value of each taxel, None for one without meaning."""

    name: str
    dtype: str
    taxels: Sequence[Sequence[str | None]]

    @property
    def n_values(self) -> int:
        return sum(map(len, self.taxels))


@dataclass(frozen=True)
class Description:
    """The description of a patch: the period of a cycle unless another is set, and the kind of each module."""

    product: str
    serial_number: str
    firmware: str
    period_us: int
    shortest_us: int
    longest_us: int
    types: Sequence[SensorType]
    kinds: Sequence[ModuleKind]
    modules: Sequence[int]

    @property
    def name(self) -> str:
        both = f"{self.product} {self.serial_number}".strip()
        return both if len(both.encode()) <= MAX_NAME_BYTES else self.serial_number

    @property
    def dtype(self) -> np.dtype[np.generic]:
        """The smallest dtype that holds the values of all kinds."""
        return np.result_type(*(self.kinds[kind].dtype for kind in self.modules))

    @property
    def patch(self) -> Patch:
        """The patch as it is published; uids number the taxels of all modules, in order."""
        uid, modules = 0, []
        for number, kind in enumerate(self.kinds[k] for k in self.modules):
            channels: list[Sensor | None] = []
            for taxel in kind.taxels:
                channels += [None if name is None else Sensor(name, uid) for name in taxel]
                uid += any(name is not None for name in taxel)
            modules.append(Module(channels, number, kind.name))
        return Patch(self.name, modules)

    @property
    def layout(self) -> Layout:
        return Layout([_frame(number, kind) for number, kind in enumerate(self.kinds)])


def read_description(items: Sequence[bytes], crc: int) -> Description:
    if zlib.crc32(b"".join(items)) != crc:
        raise BadDescription("the description changed while it was being read")
    found: Description | None = None
    types: list[SensorType] = []
    kinds: list[ModuleKind] = []
    modules: list[int] = []
    for number, item in enumerate(items):
        reader = _Reader(item, f"item {number} of the description")
        (tag,) = reader.take("B")
        if tag == _PATCH:
            found = _patch(reader, types, kinds, modules)
        elif tag == _TYPE:
            types.append(_type(reader))
        elif tag == _KIND:
            kinds.append(_kind(reader, types))
        elif tag == _MODULES:
            modules += _modules(reader, len(kinds))
            if len(modules) > _MOST_MODULES:
                break  # it is refused below
        # other tags are of later versions
    if found is None:
        raise BadDescription("the description does not say what the patch is")
    _check(found)
    return found


def _patch(reader: _Reader, types: list[SensorType], kinds: list[ModuleKind], modules: list[int]) -> Description:
    """Read the first item; the lists are filled by the items behind it."""
    period_us, shortest_us, longest_us = reader.take("<III")
    product, serial_number, firmware = (reader.text(MAX_NAME_BYTES) for _ in range(3))
    if not 0 < shortest_us <= period_us <= longest_us:
        raise reader.bad(f"a period of {period_us} us, between {shortest_us} and {longest_us}")
    if not serial_number and not product:
        raise reader.bad("neither a product nor a serial number")
    return Description(product, serial_number, firmware, period_us, shortest_us, longest_us, types, kinds, modules)


def _type(reader: _Reader) -> SensorType:
    (number,) = reader.take("<I")
    scale, offset, minimum, maximum = (reader.real() for _ in range(4))
    name, unit = reader.text(MAX_NAME_BYTES), reader.text(MAX_UNIT_BYTES)
    if _CATALOGUE_NAMES.get(number) != (name if name in CATALOGUE else None):
        raise reader.bad(f"type {number} is called {name!r}; in the shared catalogue it is not")
    if minimum == maximum:
        minimum, maximum = -math.inf, math.inf
    if not minimum < maximum:
        raise reader.bad(f"type {name!r} ranges from {minimum} to {maximum}")
    try:
        return SensorType(name, number, unit, scale, offset, minimum, maximum)
    except StructureError as error:
        raise reader.bad(str(error)) from None


def _kind(reader: _Reader, types: Sequence[SensorType]) -> ModuleKind:
    name = reader.text(_MAX_KIND_BYTES)
    dtype, n_runs = reader.take("BB")
    if dtype >= len(_DTYPES):
        raise reader.bad(f"kind {name!r} has values of dtype {dtype}; known are 0 to {len(_DTYPES) - 1}")
    size, taxels = 0, []
    for _ in range(n_runs):
        count, n_axes = reader.take("<HB")
        axes = reader.take(f"{n_axes}B")
        if not 1 <= n_axes <= _MOST_AXES or not count:
            raise reader.bad(f"kind {name!r} has a run of {count} taxels with {n_axes} axes")
        sensors = [axis for axis in axes if axis != _PADDING]
        if any(axis >= len(types) for axis in sensors):
            raise reader.bad(f"kind {name!r} has values of type {max(sensors)}, but there are only {len(types)} types")
        if len(set(sensors)) < len(sensors):
            raise reader.bad(f"kind {name!r} has taxels with two values of one type")
        size += count * n_axes * int(_DTYPES[dtype][-1])
        if size <= _MOST_VALUE_BYTES:
            taxels += [[None if axis == _PADDING else types[axis].name for axis in axes]] * count
    if not 1 <= size <= _MOST_VALUE_BYTES:
        raise reader.bad(f"kind {name!r} has {size} bytes of values; 1 to {_MOST_VALUE_BYTES} fit into a message")
    return ModuleKind(name, _DTYPES[dtype], taxels)


def _modules(reader: _Reader, n_kinds: int) -> list[int]:
    modules: list[int] = []
    (n_entries,) = reader.take("B")
    for _ in range(n_entries):
        kind, count = reader.take("BB")
        if kind >= n_kinds:
            raise reader.bad(f"modules of kind {kind}, but there are only {n_kinds} kinds")
        modules += [kind] * count
    return modules


def _check(found: Description) -> None:
    used = [found.kinds[kind] for kind in found.modules]
    for what, count, most in (
        ("types", len(found.types), _MOST_TYPES),
        ("kinds of module", len(found.kinds), _MOST_KINDS),
        ("modules", len(found.modules), _MOST_MODULES),
        ("values", sum(kind.n_values for kind in used), _MOST_VALUES),
    ):
        if not 1 <= count <= most:
            raise BadDescription(f"the patch has {count} {what}; 1 to {most} can be")
    if len({t.id for t in found.types}) < len(found.types) or len({t.name for t in found.types}) < len(found.types):
        raise BadDescription("two types of the patch share a name or an id")
    if not any(name is not None for kind in used for taxel in kind.taxels for name in taxel):
        raise BadDescription("the patch has no sensors")
    if {"<i4", "<f4"} <= {kind.dtype for kind in used}:
        raise BadDescription("the patch has 32-bit whole numbers beside floating point: no common dtype holds both")


def _frame(number: int, kind: ModuleKind) -> Frame:
    values = Values(_DATA_HEADER, kind.dtype, kind.n_values)
    flags: list[AnyFlag] = [Flag(bit, 7, "u1", mask=int(bit)) for bit in _STATUS]
    lengths = [values.end]
    if values.end + kind.n_values <= MOST_PAYLOAD:
        lengths.append(values.end + kind.n_values)
        flags.append(StatusBytes(values.end, _STATUS))
    if kind.dtype == "<f4":
        flags.append(Sentinel(Status.NOT_CONNECTED, math.nan))
    return Frame(
        f"kind {number}",
        [Identifier(_DATA + number)],
        lengths,
        values,
        module=Bits(0, 8, byte=0),
        flags=flags,
        sequence=SequenceNumber(1, "<u2"),
        time=DeviceTime(3, "<u4", 1e-6),
    )


class _Reader:
    def __init__(self, data: bytes, what: str) -> None:
        self._data = data
        self._what = what
        self._at = 0

    def bad(self, why: str) -> BadDescription:
        return BadDescription(f"{self._what}: {why}")

    def take(self, form: str) -> tuple[int, ...]:
        try:
            values = struct.unpack_from(form, self._data, self._at)
        except struct.error:
            raise self.bad(f"ends too early ({len(self._data)} bytes)") from None
        self._at += struct.calcsize(form)
        return values

    def real(self) -> float:
        """Return a float of 32 bits as the shortest decimal number that rounds to it."""
        (bits,) = self.take("<I")
        return float(str(np.uint32(bits).view(np.float32)))

    def text(self, most: int) -> str:
        end = self._data.find(0, self._at)
        raw = self._data[self._at : end]
        if end < 0 or len(raw) > most:
            raise self.bad(f"a text that does not end within {most} bytes")
        self._at = end + 1
        text = raw.decode("utf-8", "replace")
        if not text.isprintable() or "\ufffd" in text:
            raise self.bad(f"{raw!r} is no text")
        return text
