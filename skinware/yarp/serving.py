"""Publish the drivers of a namespace as ports of YARP: a vector for each frame, the newest one to each reader.

The thread that calls ``run`` reads the rings; ports live in an event loop of another thread, which gets only the newest
vector of each. So neither readers nor a name server can hold up this thread or a driver.
"""

from __future__ import annotations

import asyncio
import logging
import re
import threading
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from skinware.errors import BadRecording, ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.realtime import NS_PER_S, now_ns
from skinware.tactile.regions import Region
from skinware.transfer.collecting import Collector
from skinware.transfer.generation import Generation
from skinware.yarp.carriers import Carrier, VectorMessage
from skinware.yarp.names import NameServer, PortAddress, is_port_name
from skinware.yarp.port import OutputPort
from skinware.yarp.vectors import Vector, vectors_of

log: logging.Logger = logging.getLogger("skinware.yarp")

_LOOK_S = 2.0
"""Time between two looks whether the name server still knows a port."""
_END_S = 15.0
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9_.:-]")
_NEWEST_YARP = 4
_ANYWHERE = ("0.0.0.0", "::", "")


@dataclass(frozen=True)
class Settings:
    """Settings of the ports.

    Attributes:
        prefix: before the names of all ports.
        full_scale: physical value that becomes 255; None: the maximum of the type.
        yarp: major version of the YARP of binary readers, 3 or 4; None: they are refused.
    """

    names: Collection[str] = ()
    prefix: str = "/skinware"
    type_name: str = "pressure"
    full_scale: float | None = None
    regions: Sequence[Region] = ()
    host: str = "127.0.0.1"
    yarp: int | None = None


class _ServedPort:
    """A port in the event loop until ``over`` is set there; other threads call ``offer`` and read its attributes."""

    def __init__(
        self, name: str, driver: str, names: NameServer, settings: Settings, loop: asyncio.AbstractEventLoop
    ) -> None:
        self.driver = driver
        self.port = OutputPort(name, names, settings.yarp)
        self._yarp = settings.yarp or _NEWEST_YARP
        self.messages = 0
        self.values = 0
        self.registered: PortAddress | None = None
        self.trouble = ""
        self._names, self._host, self._loop = names, settings.host, loop
        self._lock = threading.Lock()
        self._newest: VectorMessage | None = None
        self.over = asyncio.Event()

    def offer(self, values: npt.NDArray[np.float64], acquired_ns: int) -> None:
        """Send a vector, in place of one that was not sent yet."""
        self.messages += 1
        self.values = len(values)
        if not self.port.receivers:
            return
        since_s = (now_ns() - acquired_ns) / NS_PER_S
        message = VectorMessage(values, self.messages, time.time() - since_s, self._yarp)
        with self._lock:
            waits, self._newest = self._newest is not None, message
        if not waits:
            self._loop.call_soon_threadsafe(self._send)

    def _send(self) -> None:
        with self._lock:
            message, self._newest = self._newest, None
        if message is not None:
            self.port.send(message)

    async def live(self) -> None:
        number = await self.port.open(self._host)
        host = "..." if self._host in _ANYWHERE else self._host
        try:
            while not self.over.is_set():
                await asyncio.to_thread(self._register, host, number)
                try:
                    async with asyncio.timeout(_LOOK_S):
                        await self.over.wait()
                except TimeoutError:
                    pass
        finally:
            await self.port.close()
            await asyncio.to_thread(self._unregister)

    def _register(self, host: str, number: int) -> None:
        """Register the port, unless its name is registered, perhaps by another program meanwhile."""
        try:
            known = self._names.query(self.port.name)
            if self.registered is not None and known is not None:
                self.trouble = "" if known == self.registered else "another program has this name now"
                return
            registered = self._names.register(self.port.name, host, number)
            self._names.describe(self.port.name, [carrier.title for carrier in Carrier])
            self.registered, self.trouble = registered, ""
        except OSError as error:
            self.trouble = str(error)

    def _unregister(self) -> None:
        try:
            if self.registered is not None and self._names.query(self.port.name) == self.registered:
                self._names.unregister(self.port.name)
        except OSError as error:
            log.warning("%s could not be unregistered: %s", self.port.name, error)
        self.registered = None


class YarpServer:
    """Publishes drivers as ports.

    Args:
        on_event: called with events (``port``, ``trouble``), as JSON has them.

    Raises:
        ConfigurationError: the prefix cannot begin the name of a port.
    """

    def __init__(
        self,
        namespace: Namespace,
        settings: Settings,
        names: NameServer,
        on_event: Callable[[dict[str, Any]], object] = lambda _: None,
    ) -> None:
        if not is_port_name(f"{settings.prefix}/x"):
            raise ConfigurationError(f"prefix {settings.prefix!r}: write /name, or /name/name, without spaces")
        self._settings, self._names, self._on_event = settings, names, on_event
        self._ports: dict[str, _ServedPort] = {}
        self._lives: list[Future[None]] = []
        self._vectors: dict[str, list[tuple[_ServedPort, Vector]]] = {}
        self._troubles: dict[str, str] = {}
        self._collector = Collector(namespace, set(settings.names) or None, self)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="skinware yarp")
        self._thread.start()

    @property
    def missed(self) -> int:
        """Frames that were missed in their rings."""
        return self._collector.missed

    def run(self, each_second: Callable[[], object] = lambda: None) -> None:
        """Run until ``stop``; call ``each_second`` once a second."""

        def second() -> None:
            for name, served in self._ports.items():
                self._report(name, served.trouble)
            for life in self._lives:
                if life.done() and not life.cancelled() and (error := life.exception()) is not None:
                    raise error
            each_second()

        self._collector.run(second)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._collector.stop()

    def close(self) -> None:
        """Unregister and close all ports. Idempotent."""
        self._collector.stop()
        if self._loop.is_closed():
            return
        for served in self._ports.values():
            self._loop.call_soon_threadsafe(served.over.set)
        for life in self._lives:
            try:
                life.result(_END_S)
            except (OSError, TimeoutError) as error:
                log.warning("a port did not end in order: %s", error)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.run_until_complete(self._loop.shutdown_default_executor())
        self._loop.close()
        self._collector.close()

    def ports(self) -> dict[str, dict[str, Any]]:
        """Return the state of each port: driver, whether it is registered, messages so far, values, and readers.

        It may be called from any thread.
        """
        return {
            name: {
                "driver": served.driver,
                "registered": served.registered is not None and not served.trouble,
                "messages": served.messages,
                "values": served.values,
                "readers": [
                    {"name": r.name, "carrier": r.carrier.title, "sent": r.sent, "passed_over": r.passed_over}
                    for r in tuple(served.port.receivers)
                ],
            }
            for name, served in self._ports.copy().items()
        }

    # -- a skinware.transfer.collecting.FrameListener -------------------------------------------------------------

    def began(self, service: str, head: bytes) -> None:
        self._vectors[service] = []
        settings = self._settings
        try:
            generation = Generation(head, service)
            if generation.structure is None:
                return  # not a driver
            vectors = vectors_of(
                service,
                generation.structure,
                bytes(generation.static()["driver_type"][0]).decode(),
                type_name=settings.type_name,
                full_scale=settings.full_scale,
                regions=settings.regions,
            )
        except (BadRecording, ConfigurationError) as error:
            self._report(service, str(error))
            return
        for part, vector in vectors.items():
            served = self._port(part, service)
            if served.driver == service:
                self._vectors[service].append((served, vector))
            else:
                self._report(service, f"driver {served.driver} has the port {served.port.name} already")

    def took(self, service: str, frame: Sample) -> None:
        for served, vector in self._vectors.get(service, ()):
            served.offer(vector.of(frame.column("values"), frame.column("status")), frame.acquired_ns)

    def happened(self, event: dict[str, Any]) -> None:
        """Ports stay when their drivers go."""

    def _port(self, part: str, driver: str) -> _ServedPort:
        name = f"{self._settings.prefix}/{_NOT_IN_A_NAME.sub('_', part)}"
        if name not in self._ports:
            served = self._ports[name] = _ServedPort(name, driver, self._names, self._settings, self._loop)
            self._on_event({"event": "port", "port": name, "driver": driver})
            self._lives.append(asyncio.run_coroutine_threadsafe(served.live(), self._loop))
        return self._ports[name]

    def _report(self, about: str, why: str) -> None:
        if self._troubles.get(about, "") != why:
            self._troubles[about] = why
            if why:
                self._on_event({"event": "trouble", "about": about, "why": why})
