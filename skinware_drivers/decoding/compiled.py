"""Compile the layouts of all buses to lookup tables, and find the update groups that follow from them."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, repeat
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware_drivers.decoding.addresses import Addresses
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import Byte, SequenceNumber
from skinware_drivers.layout import MOST_FRAMES, Cycle, Expand, Frame, Layout

log: logging.Logger = logging.getLogger("skinware.driver.expand")

Bytes = npt.NDArray[np.uint8]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


class FrameKind:
    """One kind of frame, compiled.

    Attributes:
        channels: (width,) int64, channel of each value; -1 = dropped.
        carries: the channels for which its frames can have values.
        module_by_byte: (n_patches, keys) module that a payload byte names; None: the identifier names it.
    """

    def __init__(self, frame: Frame, tables: SkinTables) -> None:
        self.frame = frame
        self._is_logged = False
        self._dtype = tables.structure.dtype
        n_channels = tables.channel_to_sensor.shape[1]
        self.module_by_byte: Indices | None = None
        if frame.module_byte is not None:
            self.module_by_byte = np.full((tables.structure.n_patches, 1 << frame.module_byte.width), -1, np.int64)
            for (patch, key), module in tables.module_key.items():
                if key < self.module_by_byte.shape[1]:
                    self.module_by_byte[patch, key] = module
        self.channels: Indices
        if isinstance(frame.values, Expand):
            self.channels = np.arange(n_channels)
        else:
            channels = [channel for run in frame.runs for channel in run.channels]
            self.channels = np.array([-1 if c is None else c for c in channels], np.int64)
            self.channels[self.channels >= n_channels] = -1
        to = frame.values.to if isinstance(frame.values, Expand) else None
        self.carries: frozenset[int] = frozenset(self.channels[self.channels >= 0].tolist() if to is None else to)

    def expand(self, expand: Expand, payload: Bytes, length: Bytes) -> tuple[npt.NDArray[Any], Flags, Indices]:
        """Read n frames, payloads (n, size) uint8, by a function of the driver's author.

        Returns:
            (n, width) values; (n, width) bool, which of them the frames have; and the frames for which it raised.
        """
        values = np.zeros((len(payload), len(self.channels)), self._dtype)
        found, failed = np.zeros(values.shape, bool), []
        if not len(payload):
            return values, found, np.zeros(0, np.int64)
        try:
            values, found = self._expand(expand, payload, length)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - it costs only the frame
            if not self._is_logged:
                self._is_logged = True
                log.error(
                    "frame %r: its Expand function raised %s: %s (%s:%d); frames for which it does are not shown, and"
                    " counted as bad content; logged once",
                    self.frame.name,
                    type(error).__name__,
                    str(error),  # so that a kept record refers to no frame of the traceback
                    *traceback.extract_tb(error.__traceback__)[-1][:2],
                )
        else:
            return values, found, np.zeros(0, np.int64)
        # the other frames are read one by one
        for row in range(len(payload)):
            one = slice(row, row + 1)
            try:
                values[one], found[one] = self._expand(expand, payload[one], length[one])
            except (Exception, SystemExit):  # noqa: BLE001
                failed.append(row)
        return values, found, np.array(failed, np.int64)

    def _expand(self, expand: Expand, payload: Bytes, length: Bytes) -> tuple[npt.NDArray[Any], Flags]:
        row, channel, value = expand.function(payload, length)
        if not len(row) == len(channel) == len(value) or value.dtype.kind not in "biuf":
            raise ValueError(f"it returned {len(row)} rows, {len(channel)} channels, {len(value)} {value.dtype} values")
        inside = (channel >= 0) & (channel < len(self.channels))
        row, channel, value = row[inside], channel[inside], value[inside]
        with np.errstate(invalid="ignore"):
            held = value.astype(self._dtype)
        if self._dtype.kind in "iu" and (held != value).any():
            raise ValueError(f"it returned {value[held != value][0]}: the driver's dtype {self._dtype} cannot hold it")
        values = np.zeros((len(payload), len(self.channels)), self._dtype)
        values[row, channel] = held
        found = np.zeros(values.shape, bool)
        found[row, channel] = True
        return values, found


class Assembly:
    """The frames that together make one update of a module, and the sensors of their values.

    Args:
        width: values of every update, whatever it is made of; at least the sum over ``kinds``.
        groups: (n_modules + 1, most) update groups that an update of each module belongs to.
    """

    def __init__(self, kinds: list[FrameKind], tables: SkinTables, width: int, groups: Indices) -> None:
        self.groups = groups
        self.kinds = kinds
        self.channels = np.full(width, -1, np.int64)
        self.columns: list[slice] = []
        end = 0
        for kind in kinds:
            columns = slice(end, end + len(kind.channels))
            self.columns.append(columns)
            self.channels[columns] = kind.channels
            end = columns.stop
        # one column more for what is dropped, one row more for updates that are not shown
        sensors = tables.channel_to_sensor
        table = np.full((len(sensors) + 1, sensors.shape[1] + 1), tables.structure.n_sensors)
        table[:-1, :-1] = sensors
        self.destination = np.ascontiguousarray(table[:, self.channels])


NO_KIND = 255
"""The number in place of the kind of a frame that is of no kind."""
NEVER_NS = -(1 << 62)
_MARGIN = 8
"""One part in so many of the time by which a frame may be early or late is left for the spacing inside a cycle."""


class Punctuality:
    """When each kind of frame of each module came last, and how long after the one before.

    A module may always be slower than its nominal period from cycle to cycle.
    """

    def __init__(self, cycle: Cycle, period_s: float, n_modules: int) -> None:
        self._n = len(cycle.members)
        self.all_as_they_should = cycle.order != "given"
        self.period_ns = round(period_s * NS_PER_S)
        self.reach_ns = round(cycle.reach_s * NS_PER_S)
        self.margin_ns = (self.period_ns - self.reach_ns) // _MARGIN
        self.soon_ns = round(cycle.maximum_age_s * NS_PER_S) + self.margin_ns
        self.last_ns = np.full(n_modules * self._n, NEVER_NS, np.int64)
        self.spacings_ns = np.full(n_modules * self._n, self.period_ns, np.int64)

    def forget(self, modules: Indices) -> None:
        kinds = (modules[:, None] * self._n + np.arange(self._n)).reshape(-1)
        self.last_ns[kinds] = NEVER_NS
        self.spacings_ns[kinds] = self.period_ns


class CompiledCycle:
    """A cycle of one layout, of the frames with the numbers ``members``.

    ``sequence`` is the member whose sequence numbers are compared, and their place; None: there are none.
    """

    def __init__(
        self,
        cycle: Cycle,
        frames: Sequence[Frame],
        members: list[int],
        assembly: Assembly,
        tables: SkinTables,
        period_s: float | None,
    ) -> None:
        self.members = members
        self.assembly = assembly
        self.order, self.counters = cycle.order, cycle.counters
        self.maximum_age_ns = round(cycle.maximum_age_s * NS_PER_S)
        sequences: Sequence[SequenceNumber | None] = self.counters or [frames[n].sequence for n in members]
        self.sequence: tuple[int, SequenceNumber] | None = next(
            ((member, each) for member, each in enumerate(sequences) if each is not None), None
        )
        structure = tables.structure
        if cycle.within == "patch":
            patches = np.arange(structure.n_patches + 1)
            groups = np.concatenate([structure.module_patch, patches])
        else:
            groups = np.minimum(np.arange(structure.n_modules + structure.n_patches + 1), 0xFFFF)
        self.group_of_entry = groups.astype(np.uint16)
        self.punctuality: Punctuality | None = None
        if period_s is not None and not self.counters:
            self.punctuality = Punctuality(cycle, cycle.period_s or period_s, structure.n_modules)

    def forget(self, modules: Indices) -> None:
        """Forget the rhythm of modules that have restarted."""
        if self.punctuality is not None:
            self.punctuality.forget(modules)


class UpdateMaker(NamedTuple):
    """A kind of frame by itself, or a cycle: it makes one update, in its own period or (None) the driver's."""

    modules: frozenset[int]
    channels: frozenset[int]
    period_s: float | None


def update_groups(tables: SkinTables, carriers: Sequence[UpdateMaker]) -> tuple[SkinTables, list[Indices]]:
    """Find the update groups of a skin: sensors of a module that arrive together, with one time, age and period.

    A module that one kind of frame or one cycle fills is one group. Where several kinds fill it, one of them can fall
    silent while the others continue. Sensors that the same kinds carry are then a group.

    Returns:
        The same skin with the groups; for each carrier (n_modules + 1, most) int64, groups that an update of a module
        belongs to; ``n_groups``: none.
    """
    structure = tables.structure
    sensor_group = np.zeros(structure.n_sensors, np.int64)
    group_module: list[int] = []
    period_ns: list[int] = []
    updated: list[list[list[int]]] = [[[] for _ in range(structure.n_modules)] for _ in carriers]
    for module in range(structure.n_modules):
        for carried_by, sensors in _divide(tables, module, carriers):
            for number in carried_by:
                updated[number][module].append(len(group_module))
            sensor_group[sensors] = len(group_module)
            declared_s = [carriers[number].period_s or 0.0 for number in carried_by]
            own_ns = int(tables.module_period_ns[module])
            period_ns.append(own_ns or round(min(declared_s, default=0.0) * NS_PER_S))
            group_module.append(module)
    grouped = structure.replace(sensor_group=sensor_group, group_module=group_module, group_period_ns=period_ns)
    most = max((len(groups) for rows in updated for groups in rows), default=1)
    of_carrier: list[Indices] = []
    for rows in updated:
        table = np.full((structure.n_modules + 1, most), len(group_module), np.int64)
        for module, groups in enumerate(rows):
            table[module, : len(groups)] = groups
        of_carrier.append(table)
    return replace(tables, structure=grouped), of_carrier


def _divide(tables: SkinTables, module: int, carriers: Sequence[UpdateMaker]) -> list[tuple[tuple[int, ...], Indices]]:
    """Return the groups of a module: the carriers that update each, and its sensors."""
    mine = [number for number, carrier in enumerate(carriers) if module in carrier.modules]
    sensors = tables.structure.module_index(module)
    if len(mine) < 2:
        return [(tuple(mine), sensors)]
    channel_of = {sensor: channel for channel, sensor in enumerate(tables.channel_to_sensor[module].tolist())}
    found: dict[tuple[int, ...], list[int]] = {}
    for sensor in sensors.tolist():
        carried_by = tuple(number for number in mine if channel_of[sensor] in carriers[number].channels)
        found.setdefault(carried_by, []).append(sensor)
    never = found.pop((), [])  # no frame has them: they stay "never seen" in any group
    for number in mine:
        if not any(number in carried_by for carried_by in found):
            found[(number,)] = []  # it has values of no sensor
    first, *others = found.items()
    groups = [(first[0], np.array(sorted([*first[1], *never]), np.int64))]
    return groups + [(carried_by, np.array(own, np.int64)) for carried_by, own in others]


class CompiledLayouts:
    """The layouts of all buses of a driver, compiled for one set of tables.

    Args:
        periods_s: nominal time from one cycle to the next, for each bus: without it, cycles that have no counter are
            joined whenever they come (as those of fixed bytes in a test).

    Attributes:
        tables: what is attached, with the update groups that follow from the layouts.
        payload_names: (n_sets,) bool, sets of kinds of which one is named by its payload.
        alone: by number of its kind, what reads a frame that is an update by itself.
        length_ok: (256, lengths) bool, by kind (the last row: any) and length (the last column: all longer ones).
        header: a payload byte and a table (256, lengths) of kinds; None if one byte does not determine the kind.
    """

    def __init__(
        self, layouts: Sequence[Layout | None], described: SkinTables, periods_s: Sequence[float] | None = None
    ) -> None:
        self.layouts: list[Layout | None] = list(layouts)
        self.described = described
        self.frames: list[Frame] = []
        # different layouts (and periods), and the number of the first kind of each
        first_of: list[tuple[Layout, float | None, int]] = []
        kinds_of_bus = []
        for layout, period_s in zip(layouts, periods_s or repeat(None), strict=False):
            if layout is None:
                kinds_of_bus.append(range(0))
                continue
            first = next((first for *known, first in first_of if known == [layout, period_s]), None)
            if first is None:
                first = len(self.frames)
                first_of.append((layout, period_s, first))
                self.frames += layout.frames
            kinds_of_bus.append(range(first, first + len(layout.frames)))
        if len(self.frames) > MOST_FRAMES:
            raise ConfigurationError(
                f"the buses have {len(self.frames)} kinds of frame, a driver takes {MOST_FRAMES}: run several drivers"
            )
        self.addresses = Addresses(self.frames, kinds_of_bus, described)
        self.kinds = [FrameKind(frame, described) for frame in self.frames]
        # if it is the identifier that names a module, and names none, the frame is just unknown
        by_payload = np.array([kind.module_by_byte is not None for kind in self.kinds], bool)
        self.payload_names: Flags = self.addresses.sets @ by_payload
        self._compile_assemblies(first_of)
        longest = max((max(frame.length) for frame in self.frames), default=0)
        self.length_ok = np.zeros((256, max(256, longest + 2)), bool)
        for kind, frame in enumerate(self.frames):
            self.length_ok[[kind, NO_KIND], np.array(frame.length)[:, None]] = True
        self.header = self._compile_header()

    def columns_of(self, kind: int) -> slice:
        """Return where the values of a kind of frame are among those of its update."""
        if kind in self.alone:
            return self.alone[kind].columns[0]
        return next(c.assembly.columns[c.members.index(kind)] for c in self.cycles if kind in c.members)

    @property
    def headroom(self) -> int:
        """Rows that a batch must keep free in front, for frames that wait for their partners."""
        longest = max((len(cycle.members) for cycle in self.cycles), default=1)
        structure = self.tables.structure
        return max(structure.n_modules, structure.n_patches) * (longest - 1)

    @property
    def most_groups(self) -> int:
        """The largest number of update groups that one update belongs to."""
        assemblies = [*self.alone.values(), *(cycle.assembly for cycle in self.cycles)]
        return assemblies[0].groups.shape[1] if assemblies else 1

    def _compile_assemblies(self, layouts: Sequence[tuple[Layout, float | None, int]]) -> None:
        cycles: list[tuple[Cycle, list[int], float | None]] = []
        for layout, period_s, first in layouts:
            number_of = {frame.name: first + number for number, frame in enumerate(layout.frames)}
            cycles += [(cycle, [number_of[name] for name in cycle.members], period_s) for cycle in layout.cycles]
        in_cycles = {number for _, members, _ in cycles for number in members}
        alone = [number for number in range(len(self.frames)) if number not in in_cycles]
        made_of = [[number] for number in alone] + [members for _, members, _ in cycles]
        width = max((sum(len(self.kinds[number].channels) for number in members) for members in made_of), default=0)
        period_of: list[float] = [0.0 for _ in alone]
        period_of += [own_s if (own_s := cycle.period_s or 0.0) > (bus_s or 0.0) else 0.0 for cycle, _, bus_s in cycles]
        carriers = []
        for members, period_s in zip(made_of, period_of, strict=True):
            modules = (self.addresses.modules_of(number, self.frames[number]) for number in members)
            declared_s = [each for number in members if (each := self.frames[number].period_s) is not None]
            longest_s = max([*declared_s, period_s])
            channels = frozenset[int]().union(*(self.kinds[number].carries for number in members))
            carriers.append(UpdateMaker(frozenset(chain.from_iterable(modules)), channels, longest_s or None))
        self.tables, groups = update_groups(self.described, carriers)
        made = [
            Assembly([self.kinds[n] for n in members], self.tables, width, own)
            for members, own in zip(made_of, groups, strict=True)
        ]
        self.alone = dict(zip(alone, made, strict=False))
        of_cycles = iter(made[len(alone) :])
        self.cycles = [
            CompiledCycle(cycle, self.frames, members, next(of_cycles), self.tables, period_s)
            for cycle, members, period_s in cycles
        ]
        self.width = width

    def _compile_header(self) -> tuple[int, Bytes] | None:
        """Return a payload byte and a table over it and the length, if they determine the kind (a fast case)."""
        conditions = [[c for c in frame.when if isinstance(c, Byte)] for frame in self.frames]
        if not conditions or not all(len(c) == 1 and c[0].mask == 0xFF for c in conditions):
            return None
        if len({(c[0].offset) for c in conditions}) > 1 or len({c[0].value for c in conditions}) < len(conditions):
            return None
        if not self.addresses.sets[1:].all():
            return None  # which kinds it can be depends on bus and identifier
        offset = conditions[0][0].offset
        table = np.full((256, self.length_ok.shape[1]), NO_KIND, np.uint8)
        for number, (frame, condition) in enumerate(zip(self.frames, conditions, strict=True)):
            table[condition[0].value, list(frame.length)] = number
        return offset, table
