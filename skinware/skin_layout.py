"""Which sensors the whole skin has at a time, and where they are in its arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from skinware import text
from skinware._columns import Index, texts
from skinware.errors import StructureError
from skinware.geometry import Geometry
from skinware.matrices import Matrices, ModuleKey
from skinware.structure import Structure
from skinware.text import nearest_name


@dataclass(frozen=True, eq=False)
class SkinLayout:
    """Which drivers the skin consists of. It never changes; if a driver joins or leaves, there is a new one.

    Attributes:
        drivers: names, sorted; the order of everything below.
        structures: one per driver.
    """

    drivers: tuple[str, ...]
    structures: tuple[Structure, ...]
    _matrices: dict[str, Matrices[ModuleKey]] = field(default_factory=dict, init=False, repr=False)
    _by_uid: dict[str, dict[int, list[int]]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def types(self) -> tuple[str, ...]:
        """Names of all sensor types, in order of first appearance."""
        return tuple(dict.fromkeys(t.name for structure in self.structures for t in structure.types))

    @cached_property
    def _parts(self) -> dict[str, list[tuple[int, Index]]]:
        return {
            name: [
                (driver, structure.span(name))
                for driver, structure in enumerate(self.structures)
                if any(t.name == name for t in structure.types)
            ]
            for name in self.types
        }

    def parts(self, type_name: str) -> list[tuple[int, Index]]:
        """Return where the sensors of a type are: (driver, positions in that driver's snapshot), in order.

        Raises:
            StructureError: no driver has such sensors; the message lists the types there are.
        """
        try:
            return self._parts[type_name]
        except KeyError:
            others = nearest_name(type_name, self.types) if self.types else ": no driver runs"
            raise StructureError(f"no sensor type {type_name!r} in this skin{others}") from None

    @cached_property
    def patches(self) -> tuple[str, ...]:
        """Names of the patches of all drivers, driver by driver; of those that share one ``board 8 of torso``."""
        pairs = zip(self.drivers, self.structures, strict=True)
        named = [(name, driver) for driver, structure in pairs for name in structure.patch_names]
        return text.distinct([name for name, _ in named], [driver for _, driver in named], "of")

    @cached_property
    def modules(self) -> tuple[str, ...]:
        """Names of the modules of all drivers, driver by driver, each after that of its patch."""
        return text.module_names(
            [name for structure in self.structures for name in texts(structure.module_name)],
            [kind for structure in self.structures for kind in texts(structure.module_kind)],
            self._in_whole("module_patch", "n_patches").tolist(),
            self.patches,
        )

    def _in_whole(self, column: str, count: str) -> npt.NDArray[np.int64]:
        """Return a column of row numbers of all drivers, one after the other, counted through."""
        before = np.cumsum([0, *(getattr(structure, count) for structure in self.structures)])
        parts = [getattr(structure, column) + first for structure, first in zip(self.structures, before, strict=False)]
        return np.concatenate(parts, dtype=np.int64) if parts else np.zeros(0, np.int64)

    def unit(self, type_name: str) -> str:
        """Return unit of the physical values of a type.

        Raises:
            StructureError: no driver has such sensors, or several have them in different units; the message says how
                to choose.
        """
        parts = self.parts(type_name)
        units = {self.drivers[driver]: self.structures[driver].type(type_name).unit for driver, _ in parts}
        if len(set(units.values())) > 1:
            found = ", ".join(f"{unit} of {driver}" for driver, unit in units.items())
            raise StructureError(
                f"{type_name} comes in different units: {found}; read one driver with"
                f" snapshot.of({next(iter(units))!r}).physical({type_name!r}), or choose some with Skin(drivers=[...])"
            )
        return next(iter(units.values()))

    def _rows(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: row of every sensor of a type among all sensors, driver by driver."""
        before = np.cumsum([0, *(structure.n_sensors for structure in self.structures)])
        return np.concatenate(
            [np.arange(before[driver], before[driver + 1])[index] for driver, index in self.parts(type_name)]
        )

    def uids(self, type_name: str) -> npt.NDArray[np.uint64]:
        """Return (n,) uint64: uid of every sensor of a type, in the order of ``Snapshot.physical``."""
        parts = self.parts(type_name)
        return np.concatenate([self.structures[driver].sensor_uid[index] for driver, index in parts])

    def driver_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: index into ``drivers`` of every sensor of a type, in the same order."""
        return np.concatenate(
            [np.full(len(self.structures[driver].sensor_uid[index]), driver) for driver, index in self.parts(type_name)]
        )

    def module_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: index into ``modules`` of every sensor of a type, in the same order."""
        return self._in_whole("sensor_module", "n_modules")[self._rows(type_name)]

    def patch_of(self, type_name: str) -> npt.NDArray[np.int64]:
        """Return (n,) int64: index into ``patches`` of every sensor of a type, in the same order."""
        return self._in_whole("sensor_patch", "n_patches")[self._rows(type_name)]

    def sensor_name(self, type_name: str, position: int) -> str:
        """Return name of a sensor's place, as people know it: ``board 8, triangle 3, taxel 5``.

        Args:
            type_name: its type.
            position: in the order of ``Snapshot.physical``.
        """
        driver = int(self.driver_of(type_name)[position])
        first = sum(structure.n_sensors for structure in self.structures[:driver])
        row = int(self._rows(type_name)[position]) - first
        module = self.modules[self.module_of(type_name)[position]]
        return text.joined(module, self.structures[driver].name_in_module(row))

    def matrices(self, type_name: str) -> Matrices[ModuleKey]:
        """Return where the sensors of a type are in modules that are matrices: indices for arrays in the same order.

        ``snapshot.physical("pressure")[layout.matrices("pressure")["inspire", "right hand", "index top"]]`` is
        (rows, columns). The name that the module has in its driver, ``"right hand, index top"``, does as well while one
        driver has it.

        Returns:
            By driver, patch and module, (rows, columns) int64. Drivers that join or leave do not change these keys.

        Raises:
            StructureError: no driver has such sensors.
        """
        module_of = self.module_of(type_name)
        if type_name not in self._matrices:
            keys: list[ModuleKey] = []
            for driver, structure in zip(self.drivers, self.structures, strict=True):
                patches = structure.module_patch.tolist()
                own = text.names_in_patches(texts(structure.module_name), texts(structure.module_kind), patches)
                keys += [(driver, structure.patch_names[of], name) for of, name in zip(patches, own, strict=True)]
            kinds = [kind for structure in self.structures for kind in texts(structure.module_kind)]
            names = [name for structure in self.structures for name in structure.module_names]
            self._matrices[type_name] = Matrices(type_name, keys, kinds, module_of, names)
        return self._matrices[type_name]

    def geometry(self, type_name: str) -> Geometry:
        """Return where every sensor of a type is, in the same order; not known where its driver does not publish it.

        Raises:
            StructureError: no driver has such sensors.
        """
        parts = []
        for driver, index in self.parts(type_name):
            structure = self.structures[driver]
            uid = structure.sensor_uid[index]
            known = structure.geometry
            parts.append(Geometry.unknown([type_name] * len(uid), uid) if known is None else known[index])
        return Geometry.joined(parts)

    def position(self, type_name: str, uid: int, driver: str | None = None) -> int:
        """Return where a sensor is in the order of ``Snapshot.physical``.

        Args:
            type_name: its type.
            uid: its uid, unique among the sensors of that type of one driver.
            driver: which driver's, where several have it.

        Raises:
            StructureError: there is none, or several drivers have one.
        """
        if type_name not in self._by_uid:
            positions = self._by_uid[type_name] = {}
            for position, own in enumerate(self.uids(type_name).tolist()):
                positions.setdefault(own, []).append(position)
        found = self._by_uid[type_name].get(uid, [])
        if driver is not None:
            of = self.driver_of(type_name)
            found = [position for position in found if self.drivers[of[position]] == driver]
        if len(found) == 1:
            return found[0]
        whose = f" of driver {driver!r}" if driver is not None else ""
        if not found:
            raise StructureError(f"no {type_name!r} sensor with uid {uid:#x}{whose} in this skin")
        names = ", ".join(self.drivers[self.driver_of(type_name)[position]] for position in found)
        raise StructureError(f"several drivers have a {type_name!r} sensor with uid {uid:#x}: {names}; say which")

    def __repr__(self) -> str:
        sensors = sum(structure.n_sensors for structure in self.structures)
        return f"<SkinLayout {', '.join(self.drivers) or 'no driver'}: {sensors} sensors>"
