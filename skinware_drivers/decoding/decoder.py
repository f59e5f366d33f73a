"""The state of a decoder, on arrays that C changes; the specification of what C does is in ``tests/specification``."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.samples import Unused
from skinware_drivers.counters import Samples
from skinware_drivers.decoding.addresses import STANDARD_IDENTIFIERS
from skinware_drivers.decoding.compiled import CompiledLayouts
from skinware_drivers.decoding.device_numbers import DeviceStamps
from skinware_drivers.decoding.skin_state import SkinState
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Layout

log: logging.Logger = logging.getLogger("skinware.driver")

NONE_YET = -1
_MUCH_HASTE, _NEVER_AGAIN = 200, -(1 << 62)
"""Frames that come too soon, with no whole cycle between, before a warning is logged; and their number afterwards."""

Indices = npt.NDArray[np.int64]


class Decoder:
    """The compiled layouts of a driver's buses, and the state of its skin.

    Nothing on the wire raises. Frames that cannot be used are counted.

    Attributes:
        samples: for each bus, some of the frames that could not be used.
        last_sequence: (n_modules,) int64, the last sequence number of each; -1: none yet.
        haste: (n_patches,) int64, frames that came too soon, since a whole cycle came.
        unknown_identifiers: (n_buses, 2048) int64, frames of each identifier of 11 bits that are of no module.

    Raises:
        ConfigurationError: the buses have more kinds of frame than a driver can have.
    """

    def __init__(
        self, layouts: Sequence[Layout | None], tables: SkinTables, periods_s: Sequence[float] | None = None
    ) -> None:
        self.compiled = CompiledLayouts(layouts, tables, periods_s)
        self.tables: SkinTables = self.compiled.tables
        structure = self.tables.structure
        self._module_patch = structure.module_patch.astype(np.intp)
        self.state: SkinState = SkinState(self.tables)
        self.samples: list[Samples] = [Samples() for _ in layouts]
        self.last_sequence = np.full(structure.n_modules, NONE_YET, np.int64)
        self.haste = np.zeros(structure.n_patches, np.int64)
        self.device_stamps: DeviceStamps = DeviceStamps(self.compiled.frames, structure)
        shape = len(structure.buses), STANDARD_IDENTIFIERS
        self.unknown_identifiers: npt.NDArray[np.int64] = np.zeros(shape, np.int64)

    def forget(self, patch: int) -> None:
        """Forget the sequence numbers, the rhythm and the clock of a patch that has restarted."""
        self.device_stamps.forget(patch)
        modules = np.flatnonzero(self._module_patch == patch)
        self.last_sequence[modules] = NONE_YET
        for cycle in self.compiled.cycles:
            cycle.forget(modules)

    def keep_samples(self, why: Unused, bus: npt.NDArray[np.uint16], wire: npt.NDArray[np.void], rows: Indices) -> None:
        """Keep some of these rows of a batch, which cannot be used."""
        if len(rows):
            for ordinal, samples in enumerate(self.samples):
                if samples.wants(why):
                    samples.take(why, wire[rows[bus[rows] == ordinal]])

    def warn_of_haste(self) -> None:
        for patch in np.flatnonzero(self.haste > _MUCH_HASTE).tolist():
            self.haste[patch] = _NEVER_AGAIN
            log.warning(
                "%s sends its cycles so fast that several fit into the layout's maximum_age_s: they cannot be"
                " distinguished and are not shown; give the driver the right period (period_ms, period_s); logged once",
                self.tables.structure.patch_name[patch].decode(),
            )
