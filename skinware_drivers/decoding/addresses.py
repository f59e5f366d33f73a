"""Find the patch and module of each frame, and the kernel filters that let these frames through."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware_drivers.bus import EXTENDED_FLAG, REMOTE_FLAG, Filter
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import Bits, Byte, Identifier
from skinware_drivers.layout import Frame, Layout

_FLAGS = EXTENDED_FLAG | REMOTE_FLAG


def filters_of(layout: Layout) -> list[Filter]:
    """Return the fewest filters that let all frames of a layout through, but no remote frames."""
    found = []
    for frame in layout.frames:
        value, mask = (EXTENDED_FLAG if frame.extended else 0), _FLAGS
        conditions = [condition for condition in frame.when if isinstance(condition, Identifier)]
        for condition in conditions:
            value |= condition.value
            mask |= condition.mask
        if all(value & condition.mask == condition.value for condition in conditions):  # else nothing fulfils them all
            found.append(Filter(value, mask))
    return fewest(found)


def fewest(filters: Iterable[Filter]) -> list[Filter]:
    """Return filters that let the same frames through as these, without redundant ones."""
    left = {Filter(value & mask, mask) for value, mask in filters}
    while True:
        joined = set()
        for one in left:
            for other in left:
                differ = one.value ^ other.value
                if one.mask == other.mask and differ.bit_count() == 1:
                    joined.add(Filter(one.value & ~differ, one.mask & ~differ))
        every = left | joined
        fewer = {
            one
            for one in every
            # another one is wider, and lets it through
            if not any(
                other != one and other.mask & one.mask == other.mask and one.value & other.mask == other.value
                for other in every
            )
        }
        if fewer == left:
            return sorted(left)
        left = fewer


STANDARD_IDENTIFIERS = 1 << 11
FIELD_BITS = 29  # of the key of a patch or module

Indices = npt.NDArray[np.int64]


class Addresses:
    """The address book of all buses of a driver.

    A *slot* stands for all identifiers of a bus with the same meaning; ``foreign`` is the slot of all others.

    Args:
        kinds_of_bus: for each bus, the numbers of the kinds that it carries.

    Attributes:
        entry: (n_slots,) int64: 0 to n_modules - 1: a module; then n_patches entries for "some module of this patch";
            then one for foreign frames.
        candidates: (n_slots,) uint16, row of ``sets``.
        sets: (n_sets, n_kinds) bool: kinds that a frame can be of.
    """

    def __init__(self, frames: Sequence[Frame], kinds_of_bus: Sequence[Sequence[int]], tables: SkinTables) -> None:
        self._tables = tables
        self._n_modules = tables.structure.n_modules
        self.foreign: int = len(kinds_of_bus) * STANDARD_IDENTIFIERS
        entries = [self._n_modules + tables.structure.n_patches] * (self.foreign + 1)
        possible: list[tuple[int, ...]] = [()] * (self.foreign + 1)
        self.forms: list[Form] = []
        for bus, kinds in enumerate(kinds_of_bus):
            for number in kinds:
                frame = frames[number]
                if frame.extended:
                    continue
                everything = np.arange(STANDARD_IDENTIFIERS)
                match = np.ones(STANDARD_IDENTIFIERS, bool)
                for condition in frame.when:
                    if isinstance(condition, Identifier):
                        match &= everything & condition.mask == condition.value
                for identifier in np.flatnonzero(match).tolist():
                    entry = self._find(bus, frame, identifier)
                    if entry is not None:
                        slot = bus * STANDARD_IDENTIFIERS + identifier
                        entries[slot] = entry
                        possible[slot] = (*possible[slot], number)
            # kinds of frame of 29 bits, grouped by the conditions and keys of their identifiers
            alike: dict[tuple[object, ...], list[int]] = {}
            for number in kinds:
                frame = frames[number]
                if frame.extended:
                    conditions = frozenset(c for c in frame.when if isinstance(c, Identifier))
                    alike.setdefault((conditions, frame.patch, frame.module), []).append(number)
            for same in alike.values():
                self.forms.append(Form(bus, frames[same[0]], tables, len(entries)))
                entries += self.forms[-1].entries
                possible += [tuple(same)] * len(self.forms[-1].entries)
        self.entry: npt.NDArray[np.int64] = np.array(entries, np.int64)
        sets = {kinds: row for row, kinds in enumerate(dict.fromkeys(possible))}
        self.candidates: npt.NDArray[np.uint16] = np.array([sets[kinds] for kinds in possible], np.uint16)
        self.sets: npt.NDArray[np.bool_] = np.zeros((len(sets), len(frames)), bool)
        for kinds, row in sets.items():
            self.sets[row, list(kinds)] = True

    def modules_of(self, kind: int, frame: Frame) -> list[int]:
        found = set(self.entry[self.sets[self.candidates, kind]].tolist())
        byte = frame.module_byte
        if byte is None:
            return sorted(entry for entry in found if entry < self._n_modules)
        same_byte = [c for c in frame.when if isinstance(c, Byte) and c.offset == byte.byte]
        field = (1 << byte.width) - 1 << byte.shift
        keys = [
            key
            for key in range(1 << byte.width)
            if not any((key << byte.shift ^ condition.value) & condition.mask & field for condition in same_byte)
        ]
        return sorted(
            module
            for (patch, key), module in self._tables.module_key.items()
            if key in keys and self._n_modules + patch in found
        )

    def _find(self, bus: int, frame: Frame, identifier: int) -> int | None:
        patch = self._tables.patch_key.get((bus, bits_of(identifier, frame.patch)))
        if patch is None:
            return None
        anyone = self._n_modules + patch
        if frame.module_byte is not None:
            return anyone
        return self._tables.module_key.get((patch, bits_of(identifier, frame.module)), anyone)


@dataclass(frozen=True)
class KeyField:
    shift: int
    mask: int
    constant: int = 0

    @staticmethod
    def of(bits: Bits | int | None) -> KeyField:
        if isinstance(bits, int):
            return KeyField(0, 0, bits)
        return KeyField(0, 0) if bits is None or bits.byte is not None else KeyField(bits.shift, (1 << bits.width) - 1)


class Form:
    """29-bit identifiers of one bus with the same conditions and keys."""

    def __init__(self, bus: int, frame: Frame, tables: SkinTables, first_slot: int) -> None:
        self.bus = bus
        self.conditions = [c for c in frame.when if isinstance(c, Identifier)]
        self.patch, self.module = KeyField.of(frame.patch), KeyField.of(frame.module)
        by_byte = frame.module_byte is not None
        known: dict[int, int] = {}
        self._anyone: dict[int, int] = {}  # patch key -> slot of "some module of this patch"
        self.entries: list[int] = []
        for (of_bus, patch_key), patch in tables.patch_key.items():
            if of_bus != bus:
                continue
            self._anyone[patch_key] = first_slot + len(self.entries)
            self.entries.append(tables.structure.n_modules + patch)
            for (of_patch, module_key), module in tables.module_key.items():
                if of_patch == patch and not by_byte:
                    known[patch_key << FIELD_BITS | module_key] = first_slot + len(self.entries)
                    self.entries.append(module)
        self.codes, self.slots = _sorted(known)
        self.patch_codes, self.patch_slots = _sorted(self._anyone)


def bits_of(identifier: int, bits: Bits | int | None) -> int:
    """Return a bit field of an identifier, 0 without one; or the constant in its place."""
    if isinstance(bits, int):
        return bits
    return 0 if bits is None else identifier >> bits.shift & ((1 << bits.width) - 1)


def _sorted(slots: dict[int, int]) -> tuple[Indices, Indices]:
    codes = np.array(sorted(slots), np.int64)
    return codes, np.array([slots[code] for code in codes.tolist()], np.int64)
