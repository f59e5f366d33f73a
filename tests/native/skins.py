"""Skins of all kinds, for hypothesis: what a layout can say, each of it in as few choices as it takes.

Only what a driver may declare comes out: what ``check_layout`` refuses is thrown away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from hypothesis import assume
from hypothesis import strategies as st

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE, SensorType
from skinware.status import Status
from skinware_drivers.adapter import check_layout
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.description import Module, Patch, SkinTables, assemble, taxels
from skinware_drivers.fields import (
    Above,
    AnyFlag,
    Bits,
    Byte,
    Condition,
    DeviceTime,
    Flag,
    Identifier,
    Packed,
    Sentinel,
    SequenceNumber,
    StatusBytes,
)
from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values

_EXTENDED_BASE = EXTENDED_FLAG | 0x18DA_0000
_SLOT_SHIFT, _PATCH_SHIFT, _KEY_BITS = 8, 4, 4
DTYPES = ("u1", "<i2", "<u2", "<i4", "<f4")
_WHOLE = ["u1", "i1", "<u2", ">u2", "<i2", ">i2", "<u4", ">u4", "<i4", ">i4", "<u8", ">i8"]
_REAL = ["<f4", ">f4"]
_UNSIGNED = ["u1", "<u2", ">u2", "<u4", ">u4", "<u8", ">u8"]
_STATUS = [Status.OUT_OF_RANGE, Status.NO_ACK, Status.NOT_CONNECTED, Status.MASKED, Status.SUSPECT]

Bytes = npt.NDArray[np.uint8]
Expanded = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]


@dataclass(frozen=True)
class BusDesign:
    """What is on a bus, and what its frames mean; ``layout`` None: nobody knows yet."""

    layout: Layout | None
    patches: Sequence[Patch]
    period_s: float


@dataclass(frozen=True)
class SkinDesign:
    """A driver's buses, the dtype of its values, and the types of its sensors."""

    buses: Sequence[BusDesign]
    dtype: str
    types: Sequence[SensorType] = (PRESSURE.measured(unit="counts"),)

    @property
    def layouts(self) -> list[Layout | None]:
        return [bus.layout for bus in self.buses]

    @property
    def periods_s(self) -> list[float]:
        return [bus.period_s for bus in self.buses]

    def tables(self) -> SkinTables:
        return assemble([(f"bus{n}", bus.patches) for n, bus in enumerate(self.buses)], self.types, self.dtype)


# -- functions of a driver's author -------------------------------------------------------------------------------


def nibbles(payload: Bytes, length: Bytes) -> Expanded:
    """Two channels in a byte, those behind the length left out."""
    row, channel = np.divmod(np.arange(2 * payload.size), 2 * payload.shape[1])
    value = payload[row, channel // 2] >> 4 * (channel % 2) & 15
    there = channel // 2 < length[row]
    return row[there], channel[there], value[there].astype(np.int64)


def run_lengths(payload: Bytes, length: Bytes) -> Expanded:
    """(channel, value) pairs; raises for an odd first byte."""
    if (payload[:, 0] % 2).any():
        raise ValueError("an odd first byte")
    row = np.repeat(np.arange(len(payload)), 2)
    column = np.tile([0, 2], len(payload))
    return row, payload[row, column].astype(np.int64) % 8 - 1, payload[row, column + 1].astype(np.int64)


def greedy(payload: Bytes, length: Bytes) -> Expanded:
    """Cannot do with nothing; some values are more than any dtype but the widest holds."""
    longest = int(length.max())
    row = np.arange(len(payload))
    return row, row * 0, (payload[:, longest - 1].astype(np.int64) - 8) << 9


_EXPANDS = [Expand(nibbles), Expand(run_lengths), Expand(greedy)]


# -- parts of a frame ---------------------------------------------------------------------------------------------


@st.composite
def _runs(draw: st.DrawFn, dtype: str, shortest: int, channels: Sequence[int]) -> Sequence[Values]:
    """Runs of values, none of which ends behind the shortest payload; each channel comes as often as it likes."""
    limits = np.iinfo(dtype) if dtype != "<f4" else None
    plain = _WHOLE + _REAL
    if limits is not None:
        plain = [n for n in _WHOLE if limits.min <= np.iinfo(n).min and np.iinfo(n).max <= limits.max]
    most_bits = 32 if limits is None else int(limits.max).bit_length()
    runs = []
    for _ in range(draw(st.sampled_from([1, 1, 2, 3]))):
        kind: str | Packed = draw(st.sampled_from(plain))
        if draw(st.integers(0, 3)) == 3:
            is_signed = bool(limits is None or limits.min < 0) and draw(st.booleans())
            bits = draw(st.integers(1, most_bits + is_signed if most_bits < 32 else 32))
            kind = Packed(bits, draw(st.sampled_from(["big", "little"])), is_signed, draw(st.integers(0, 7)))
        first = Values(0, kind, 1).end
        if first > shortest:
            kind, first = plain[0], Values(0, plain[0], 1).end
        if first > shortest:
            continue
        offset = draw(st.integers(0, shortest - first))
        count = 1
        while count < 5 and Values(offset, kind, count + 1).end <= shortest and draw(st.booleans()):
            count += 1
        to = [draw(st.sampled_from([*channels, None])) for _ in range(count)]
        runs.append(Values(offset, kind, count, to))
    assume(runs)
    return runs


@st.composite
def _number(draw: st.DrawFn, shortest: int, fewest: int) -> SequenceNumber | None:
    """A sequence number of at least so many counts, in every payload of that length."""
    dtype = draw(st.sampled_from([d for d in _UNSIGNED if np.dtype(d).itemsize <= shortest]))
    bits = 8 * np.dtype(dtype).itemsize
    mask = None
    if draw(st.booleans()):
        width = draw(st.integers(2, bits))
        mask = ((1 << width) - 1) << draw(st.integers(0, bits - width))
    offset = draw(st.integers(0, shortest - np.dtype(dtype).itemsize))
    if bits > 32 and (mask is None or mask.bit_count() > 32):
        mask = 0xFFFF_FFFF << draw(st.integers(0, bits - 32))
    whole = SequenceNumber(offset, dtype, None, mask)
    modulo = draw(st.sampled_from([None, None, fewest, fewest + 1, max(fewest, whole.turn - 1)]))
    return SequenceNumber(offset, dtype, modulo if modulo is None or modulo <= whole.turn else None, mask)


@st.composite
def _flags(draw: st.DrawFn, longest: int, n_channels: int) -> Sequence[AnyFlag]:
    found: list[AnyFlag] = []
    for _ in range(draw(st.sampled_from([0, 1, 2, 3]))):
        status = draw(st.sampled_from(_STATUS))
        what = draw(st.sampled_from(["word", "sentinel", "above", "bytes"]))
        if what == "word":
            dtype = draw(st.sampled_from(_UNSIGNED))
            bits = 8 * np.dtype(dtype).itemsize
            each = draw(st.lists(st.tuples(st.integers(0, n_channels - 1), st.integers(0, bits - 1)), max_size=3))
            mask = draw(st.sampled_from([0, 1, 0x80, 1 << bits - 1, (1 << bits) - 1]))
            normal = draw(st.sampled_from([0, 0, 1, (1 << bits) - 1]))
            found.append(Flag(status, draw(st.integers(0, longest)), dtype, mask, each, normal))
        elif what in ("sentinel", "above"):
            value = draw(st.sampled_from([0, 1, -1, 255, 65535, -32768, 1 << 40, 0.0, 1.5, float("nan"), float("inf")]))
            found.append(Sentinel(status, value) if what == "sentinel" else Above(status, value))
        else:
            mask_of_bytes = draw(st.sampled_from([Status.OUT_OF_RANGE, Status.NO_ACK | Status.MASKED]))
            found.append(StatusBytes(draw(st.integers(0, longest)), mask_of_bytes))
    return found


@st.composite
def _flag_of_modules(draw: st.DrawFn, status: Status, longest: int) -> Flag:
    """A flag of other modules, one of which may not exist."""
    dtype = draw(st.sampled_from(_UNSIGNED))
    bits = 8 * np.dtype(dtype).itemsize
    keys = draw(st.lists(st.integers(0, 3), min_size=1, max_size=4, unique=True))
    each = [(key, draw(st.integers(0, bits - 1))) for key in keys]
    normal = draw(st.sampled_from([0, (1 << bits) - 1]))
    return Flag(status, draw(st.integers(0, longest)), dtype, normal=normal, each_module=each)


# -- layouts ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Naming:
    """How frames of a bus are told apart, and how they name patches and modules."""

    extended: bool
    kinds_by: str
    patch_by: str
    module_by: str
    kind_byte: int
    module_byte: Bits

    def conditions(self, number: int) -> list[Condition]:
        slot, byte = number, None
        if self.kinds_by == "byte alone":
            return [Byte(self.kind_byte, 0x10 + number)]
        if self.kinds_by == "byte":
            slot, byte = 0, Byte(self.kind_byte, 0x10 + number)
        elif self.kinds_by == "both":
            slot, byte = number // 2, Byte(self.kind_byte, number % 2, mask=0x0F)
        if self.extended:
            value, mask = _EXTENDED_BASE | slot << _SLOT_SHIFT, 0x1FFF_FF00
        else:
            value, mask = slot + 1 << _SLOT_SHIFT, 0x700
        if self.patch_by == "bits" and self.module_by != "bits":
            mask |= 0x00F
        return [Identifier(value, mask), *([byte] if byte is not None else [])]

    @property
    def patch(self) -> Bits | int | None:
        return Bits(_PATCH_SHIFT, _KEY_BITS) if self.patch_by == "bits" else 0 if self.patch_by == "key" else None

    @property
    def module(self) -> Bits | int | None:
        if self.module_by == "bits":
            return Bits(0, _KEY_BITS)
        if self.module_by == "byte":
            return self.module_byte
        return 0 if self.module_by == "key" else None


@st.composite
def _naming(draw: st.DrawFn, shortest: int) -> _Naming:
    shift = draw(st.integers(0, 5))
    return _Naming(
        draw(st.booleans()),
        draw(st.sampled_from(["identifier", "byte", "both", "byte alone"])),
        draw(st.sampled_from(["bits", "key", "none"])),
        draw(st.sampled_from(["bits", "byte", "key", "none"])),
        draw(st.integers(0, shortest - 1)),
        Bits(shift, draw(st.integers(1, 8 - shift)), draw(st.integers(0, shortest - 1))),
    )


@st.composite
def bus_designs(
    draw: st.DrawFn, dtype: str, members: Sequence[int] = (0, 0, 2, 2, 3, 5), most_alone: int = 2
) -> BusDesign:
    """A bus with one to three patches.

    Args:
        dtype: of the driver's values.
        members: how many frames the cycle may have; 0: none.
        most_alone: frames beside the cycle, at the most (one if there is none).
    """
    first_uid = 0
    shortest = draw(st.sampled_from([4, 6, 8, 8, 8, 20, 70, 257]))
    naming = draw(_naming(shortest))
    n_members = draw(st.sampled_from(members))
    n_frames = n_members + draw(st.integers(0 if n_members else 1, max(most_alone, not n_members)))
    of_member = draw(st.integers(1, 3))
    n_channels = max(1, of_member * max(1, n_members))
    has_counter = bool(n_members) and draw(st.booleans())
    time = None
    if draw(st.integers(0, 4)) == 4:
        time = DeviceTime(draw(st.integers(0, shortest - 4)), draw(st.sampled_from(["<u2", ">u4"])), 1e-4)
    order = draw(st.permutations(range(n_frames)))
    frames = []
    for number in range(n_frames):
        is_member = number < n_members
        own = range(number * of_member, (number + 1) * of_member) if is_member else range(n_channels)
        longest = draw(st.sampled_from([shortest, shortest, shortest + 2]))
        values: Sequence[Values] | Expand
        if draw(st.integers(0, 5)) == 5:
            values = draw(st.sampled_from(_EXPANDS))
        else:
            values = draw(_runs(dtype, shortest, own))
        flags = [*draw(_flags(longest, n_channels))]
        if not is_member and draw(st.booleans()):
            flags.append(draw(_flag_of_modules(_STATUS[number - n_members], longest)))
            values = draw(st.sampled_from([values, ()]))
        frames.append(
            Frame(
                f"frame {number}",
                naming.conditions(order[number]),
                sorted({shortest, longest}),
                values,
                naming.patch,
                naming.module,
                flags,
                None if is_member and has_counter else draw(st.none() | _number(shortest, 2)),
                time,
            )
        )
    period_s = draw(st.sampled_from([0.005, 0.02, 0.1]))
    cycle = None
    if n_members:
        counter = draw(_number(shortest, 4)) if has_counter else None
        assume(counter is None or counter.turn >= 4)
        cycle = Cycle(
            [frames[number].name for number in draw(st.permutations(range(n_members)))],
            draw(st.sampled_from([0.1, 0.4, 0.9])) * period_s,
            draw(st.sampled_from(["module", "patch"])),
            draw(st.sampled_from(["given", "any", "ends_with"])),
            counter,
            draw(st.sampled_from([None, None, 0.8 * period_s])),
        )
    patches = []
    for patch in range(draw(st.integers(1, 3)) if naming.patch_by == "bits" else 1):
        modules = []
        for key in range(draw(st.integers(1, 3)) if naming.module_by in ("bits", "byte") else 1):
            channels = [
                None if draw(st.integers(0, 7)) == 7 else sensor for sensor in taxels(n_channels, first_uid=first_uid)
            ]
            first_uid += n_channels
            modules.append(Module(channels, key=key))
        patches.append(Patch(f"patch {patch}", modules, key=patch))
    assume(any(sensor is not None for patch in patches for module in patch.modules for sensor in module.channels))
    try:
        layout = Layout(frames, cycle)
        check_layout(layout, patches, SkinDesign([BusDesign(None, patches, period_s)], dtype).tables(), period_s)
    except ConfigurationError:
        assume(False)
    return BusDesign(layout, patches, period_s)


@st.composite
def skins(draw: st.DrawFn) -> SkinDesign:
    """One to three buses; one of them may be like the one before, or have no layout yet."""
    dtype = draw(st.sampled_from(DTYPES))
    buses = [draw(bus_designs(dtype))]
    for _ in range(draw(st.sampled_from([0, 0, 1, 2]))):
        what = draw(st.sampled_from(["another", "alike", "unknown"]))
        if what == "another":
            buses.append(draw(bus_designs(dtype)))
        elif what == "alike":
            buses.append(BusDesign(buses[-1].layout, buses[-1].patches, buses[-1].period_s))
        else:
            buses.append(BusDesign(None, [], buses[0].period_s))
    return SkinDesign(buses, dtype)


@st.composite
def plain_skins(draw: st.DrawFn) -> SkinDesign:
    """One to four patches of modules with one value, on one bus or two: what matters is when they send."""
    frame = Frame("data", [Identifier(0x100, 0x700)], [8], Values(0, "u1", 1), Bits(4, 4), Bits(0, 4))
    period_s = draw(st.sampled_from([0.02, 0.005]))
    buses = []
    for _ in range(draw(st.integers(1, 2))):
        patches = []
        for key in range(draw(st.integers(1, 3))):
            modules = [
                Module(taxels(1, first_uid=16 * key + module), module) for module in range(draw(st.integers(1, 6)))
            ]
            patches.append(Patch(f"patch {key}", modules, key))
        buses.append(BusDesign(Layout([frame]), patches, period_s))
    return SkinDesign(buses, "u1")


@st.composite
def cycled_skins(draw: st.DrawFn) -> SkinDesign:
    """One bus of patches that send cycles, and hardly anything else."""
    dtype = draw(st.sampled_from(DTYPES))
    return SkinDesign([draw(bus_designs(dtype, members=(2, 2, 3, 4, 5), most_alone=1))], dtype)


@st.composite
def skins_of_frames(draw: st.DrawFn) -> SkinDesign:
    """One bus without cycles: what matters is what is in the frames."""
    dtype = draw(st.sampled_from(DTYPES))
    return SkinDesign([draw(bus_designs(dtype, members=(0,), most_alone=3))], dtype)
