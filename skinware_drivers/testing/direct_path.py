"""Feed frames to a driver's data path, without a bus and a loop around it."""

from __future__ import annotations

import os
import secrets
import shutil

from skinware.driver_service import DriverWriter
from skinware.memory.namespace import Namespace
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import Decoder
from skinware_drivers.description import SkinTables
from skinware_drivers.layout import Layout
from skinware_drivers.polling import Watch
from skinware_drivers.running.native_path import NativePath
from skinware_drivers.running.publisher import ALL_BUS_COUNTERS, ALL_PATCH_COUNTERS, Publisher


class DirectPath:
    """A data path that shows every update at once, with a namespace of its own.

    Args:
        layout: of the only bus.
        tables: the skin.
        payload_size: longest payload, bytes.

    Attributes:
        decoder: its ``state`` has what the frames so far have shown and counted.
    """

    def __init__(self, layout: Layout, tables: SkinTables, payload_size: int) -> None:
        self.decoder = Decoder([layout], tables)
        self._namespace = Namespace(f"direct-{os.getpid()}-{secrets.token_hex(4)}")
        self._writer = DriverWriter(
            "direct",
            self.decoder.tables.structure,
            bus_counters=ALL_BUS_COUNTERS,
            patch_counters=ALL_PATCH_COUNTERS,
            namespace=self._namespace,
        )
        publisher = Publisher(self._writer, self.decoder, Watch(tables), 1.0, by_cycle=False)
        self._batch = FrameBatch(1, payload_size, self.decoder.compiled.headroom)
        self._path = NativePath(self.decoder, publisher, self._batch)

    @property
    def waiting(self) -> int:
        """Number of frames that wait for the others of their cycle."""
        self._path.empty()
        return len(self._batch)

    def feed(self, time_ns: int, identifier: int, payload: bytes) -> None:
        """Decode one frame."""
        self._path.empty()
        self._batch.append(0, time_ns, identifier, payload)
        self._path.digest()

    def close(self) -> None:
        self._writer.close()
        shutil.rmtree(self._namespace.path, ignore_errors=True)
