"""Update groups: which sensors of a module arrive together, and so share one time, one age and one period.

A module that one kind of frame or one cycle fills is one group. Where several kinds fill it, one of them can fall
silent while the others go on. Sensors that the same kinds carry are then a group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.realtime import NS_PER_S
from skinware_drivers.description import SkinTables

Indices = npt.NDArray[np.int64]


class Carrier(NamedTuple):
    """A kind of frame by itself, or a cycle: it makes one update.

    Attributes:
        modules: that it can fill.
        channels: for which it has values.
        period_s: nominal time between two of them; None: the driver's.
    """

    modules: Sequence[int]
    channels: frozenset[int]
    period_s: float | None


class Groups:
    """The update groups of a skin.

    Args:
        tables: the skin; its groups are replaced.
        carriers: all kinds and cycles that make updates.

    Attributes:
        tables: the same skin with the groups.
        of_carrier: for each carrier (n_modules + 1, most) int64, groups that an update of a module belongs to;
            ``n_groups``: none.
    """

    def __init__(self, tables: SkinTables, carriers: Sequence[Carrier]) -> None:
        structure = tables.structure
        self._tables = tables
        self._carriers_of: list[list[int]] = [[] for _ in range(structure.n_modules)]
        for number, carrier in enumerate(carriers):
            for module in carrier.modules:
                self._carriers_of[module].append(number)
        sensor_group = np.zeros(structure.n_sensors, np.int64)
        group_module: list[int] = []
        period_ns: list[int] = []
        updated: list[list[list[int]]] = [[[] for _ in range(structure.n_modules)] for _ in carriers]
        for module in range(structure.n_modules):
            for carried_by, sensors in self._divide(module, carriers):
                for number in carried_by:
                    updated[number][module].append(len(group_module))
                sensor_group[sensors] = len(group_module)
                declared_s = [carriers[number].period_s or 0.0 for number in carried_by]
                own_ns = int(tables.module_period_ns[module])
                period_ns.append(own_ns or round(min(declared_s, default=0.0) * NS_PER_S))
                group_module.append(module)
        self.tables: SkinTables = replace(
            tables,
            structure=structure.replace(
                sensor_group=sensor_group, group_module=group_module, group_period_ns=period_ns
            ),
        )
        most = max((len(groups) for rows in updated for groups in rows), default=1)
        self.of_carrier: list[Indices] = []
        for rows in updated:
            table = np.full((structure.n_modules + 1, most), len(group_module), np.int64)
            for module, groups in enumerate(rows):
                table[module, : len(groups)] = groups
            self.of_carrier.append(table)

    def _divide(self, module: int, carriers: Sequence[Carrier]) -> list[tuple[tuple[int, ...], Indices]]:
        """Return the groups of a module: the carriers that update each, and its sensors."""
        mine = self._carriers_of[module]
        sensors = np.arange(self._tables.structure.n_sensors)[self._tables.structure.module_index(module)]
        if len(mine) < 2:
            return [(tuple(mine), sensors)]
        channel_of = {sensor: channel for channel, sensor in enumerate(self._tables.channel_to_sensor[module].tolist())}
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
