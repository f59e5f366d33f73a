"""A layout's cycle, compiled: what its frames share, and how they are found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware_drivers.decoding.frame_kind import Assembly
from skinware_drivers.decoding.pairing import Pairing, Pairs
from skinware_drivers.decoding.punctuality import Punctuality
from skinware_drivers.decoding.sequences import read_numbers
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Cycle, Frame
from skinware_drivers.numbering import SequenceNumber

Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Flags = npt.NDArray[np.bool_]

_COUNTER_BITS = 32
_COUNTER_MASK = (1 << _COUNTER_BITS) - 1


class CompiledCycle:
    """Finds the cycles of one layout.

    Args:
        cycle: what makes one.
        frames: all kinds of frame.
        members: the numbers of its members among them, in order.
        assembly: reads them.
        tables: the skin.
        period_s: nominal time from one cycle to the next; None: not known.

    Attributes:
        members: as given.
        assembly: as given.
        sequence: of which member the sequence numbers are compared, and where they are; None: none has one.
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
        self.counters = cycle.counters
        sequences: Sequence[SequenceNumber | None] = self.counters or [frames[n].sequence for n in members]
        self.sequence: tuple[int, SequenceNumber] | None = next(
            ((member, each) for member, each in enumerate(sequences) if each is not None), None
        )
        structure = tables.structure
        places = np.full(256, len(members), np.uint8)
        places[members] = np.arange(len(members))
        if cycle.within == "patch":
            patches = np.arange(structure.n_patches + 1)
            groups = np.concatenate([structure.module_patch, patches])
        else:
            groups = np.minimum(np.arange(structure.n_modules + structure.n_patches + 1), 0xFFFF)
        self.group_of_entry = groups.astype(np.uint16)
        self.punctuality: Punctuality | None = None
        if period_s is not None and not self.counters:
            self.punctuality = Punctuality(cycle, cycle.period_s or period_s, structure.n_modules)
        self.pairing = Pairing(cycle, places, self.punctuality)

    def find(
        self, entry: Indices, kind: Bytes, payload: Bytes, time_ns: Indices, is_module: Flags, severed: Flags
    ) -> Pairs:
        """Find the cycles in a batch.

        Args:
            entry: (m,) module of each frame, where ``is_module``.
            kind: (m,) kind of each.
            payload: (m, size) uint8.
            time_ns: (m,) stamps.
            is_module: (m,) bool: the frame is one of a known module.
            severed: (m,) bool: the frame has waited for partners, and it is known that frames were lost since.
        """
        shared = entry
        if self.counters:
            shared = entry << _COUNTER_BITS
            for number, counter in zip(self.members, self.counters, strict=True):
                rows = np.flatnonzero((kind == number) & is_module)
                shared[rows] |= read_numbers(payload[rows], counter) & _COUNTER_MASK
        return self.pairing.find(shared, self.group_of_entry[entry], kind, time_ns, is_module, severed)

    def forget(self, modules: Indices) -> None:
        """These modules have restarted: their rhythm begins anew."""
        if self.punctuality is not None:
            self.punctuality.forget(modules)
