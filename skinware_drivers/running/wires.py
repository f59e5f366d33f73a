"""Publish what goes over the wires of a driver while a program records it: ``skin-record --wire``."""

from __future__ import annotations

import asyncio
import logging
import platform
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version

import msgspec
import numpy as np
import numpy.typing as npt

from skinware import wire
from skinware.errors import SkinwareError
from skinware.memory.announcement import is_wished, living_readers
from skinware.realtime import NS_PER_S, now_ns
from skinware.service import ServiceWriter
from skinware_drivers.running.building import Identity
from skinware_drivers.running.bus_line import BusLine

log: logging.Logger = logging.getLogger("skinware.driver")

_BEGINNING_S = 0.3
"""How long the first frames are kept, in case that a program records them."""
_LOOK_S = 0.5
"""Time between two looks whether a program does."""
_TURN_S = 0.05
_SLOTS = 64
_MOST_S = 1.5
"""Least life of the service, unless it was found before: the driver may end at once."""
_FINDING_S = 0.02


class Wires:
    """The service with the wires of a driver. A sample has what went over one bus since the sample before."""

    def __init__(self, identity: Identity, lines: Sequence[BusLine]) -> None:
        self._identity, self._lines, self._namespace = identity, lines, identity.namespace
        self._writer: ServiceWriter | None = None
        self._until_ns = 0
        self._published: dict[str, npt.NDArray[np.bytes_]] = {}
        self._task: asyncio.Task[None] | None = None

    def begin(self) -> None:
        """Begin to keep what goes over the wires; in the running loop."""
        self._open_taps()
        self._task = asyncio.get_running_loop().create_task(self._serve())

    async def end(self) -> None:
        """Publish the rest, if a program records it, and withdraw the service. Idempotent."""
        if self._task is None:
            return
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        self._task = None
        try:
            if self._writer is not None or is_wished(self._namespace, wire.WISH):
                self._publish()
                name = wire.service_name(self._identity.name)
                for _ in range(round(_MOST_S / _FINDING_S)):
                    # a program that has found the service can read all of it, also after its end
                    is_read = any(record.service == name for record in living_readers(self._namespace))
                    if now_ns() > self._until_ns or is_read or not is_wished(self._namespace, wire.WISH):
                        break
                    await asyncio.sleep(_FINDING_S)
        except (SkinwareError, OSError) as error:
            self._log_trouble(error)
        self._withdraw()

    async def _serve(self) -> None:
        try:
            for _ in range(round(_BEGINNING_S / _TURN_S)):
                if is_wished(self._namespace, wire.WISH):
                    break
                await asyncio.sleep(_TURN_S)
            while True:
                if is_wished(self._namespace, wire.WISH):
                    self._open_taps()
                    for _ in range(round(_LOOK_S / _TURN_S)):
                        self._publish()
                        await asyncio.sleep(_TURN_S)
                else:
                    self._withdraw()
                    await asyncio.sleep(_LOOK_S)
        except (SkinwareError, OSError) as error:  # the driver goes on
            self._log_trouble(error)
            self._withdraw()

    def _publish(self) -> None:
        is_new = self._writer is None
        writer = self._writer_for()
        for line in self._lines:
            # an empty sample first, so that a silent bus is known, too
            for batch in line.bus.tap.fetch() if not is_new else (memoryview(b""), *line.bus.tap.fetch()):
                columns = writer.begin()
                columns["bus"][()], columns["used"][()] = line.ordinal, len(batch)
                columns["missed"][()] = line.bus.tap.missed
                columns["pieces"][: len(batch)] = np.frombuffer(batch, np.uint8)
                writer.commit(now_ns())

    def _writer_for(self) -> ServiceWriter:
        about = {
            "driver_type": self._identity.driver_type,
            "listen_only": self._identity.listen_only,
            "versions": _versions(),
            "buses": [
                {"medium": line.adapter.medium, "options": msgspec.to_builtins(line.adapter.options)}
                for line in self._lines
            ],
        }
        static = {
            "driver": np.array([self._identity.name.encode()]),
            "bus_name": np.array([line.name.encode() for line in self._lines]),
            "about": np.array([msgspec.json.encode(about)]),
        }
        rate_hz = len(self._lines) / _TURN_S
        if self._writer is None:
            self._writer = ServiceWriter(
                wire.service_name(self._identity.name),
                wire.COLUMNS,
                static,
                namespace=self._namespace,
                kind=wire.KIND,
                slots=_SLOTS,
                rate_hz=rate_hz,
                group=self._identity.group,
                description=f"what goes over the wires of {self._identity.name}",
            )
            self._until_ns = now_ns() + round(_MOST_S * NS_PER_S)
        elif any(static[name].tolist() != self._published[name].tolist() for name in static):
            self._writer.restructure(wire.COLUMNS, static, rate_hz=rate_hz)
        self._published = static
        return self._writer

    def _open_taps(self) -> None:
        for line in self._lines:
            line.bus.tap.open()

    def _withdraw(self) -> None:
        for line in self._lines:
            line.bus.tap.close()
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def _log_trouble(self, error: Exception) -> None:
        log.warning("what goes over the wires of %s is not published: %s", self._identity.name, error)


@cache
def _versions() -> dict[str, str]:
    return {
        "skinware": version("skinware"),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "linux": platform.release(),
    }
