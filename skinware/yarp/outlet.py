"""Drivers of a namespace as ports of YARP: one vector a frame, the newest to each reader, and a name that is known.

The rings are read in the thread that calls ``run``; ports live in an event loop of another one, to which only the
newest vector of each is handed. So neither a reader of a port nor a name server can hold up anything here, and nothing
here a driver.
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
from skinware.structure import Structure
from skinware.tactile.regions import Region
from skinware.transfer.collecting import Collector
from skinware.transfer.generation import Generation
from skinware.yarp.carriers import Carrier, Message
from skinware.yarp.names import Contact, NameServer, is_port_name
from skinware.yarp.port import OutputPort
from skinware.yarp.vectors import Vector, vectors_of

log: logging.Logger = logging.getLogger("skinware.yarp")

_LOOK_S = 2.0
"""Between two looks whether the name server still knows a port."""
_END_S = 15.0
_NOT_OF_A_NAME = re.compile(r"[^A-Za-z0-9_.:-]")
_NEWEST_YARP = 4
ANYWHERE = ("0.0.0.0", "::", "")


@dataclass(frozen=True)
class Wanted:
    """What is served, and how.

    Attributes:
        names: of drivers; empty: all there are and come.
        prefix: with which the names of ports begin.
        type_name: of sensors.
        full_scale: physical value that becomes 255; None: the type's greatest.
        regions: body parts that have a port each.
        host: where ports listen.
        yarp: major version of the YARP whose programs read in binary, 3 or 4; None: not known, and they are refused.
    """

    names: Collection[str] = ()
    prefix: str = "/skinware"
    type_name: str = "pressure"
    full_scale: float | None = None
    regions: Sequence[Region] = ()
    host: str = "127.0.0.1"
    yarp: int | None = None


class _Served:
    """One port, in the event loop; ``offer`` and what is told of it are for any thread."""

    def __init__(
        self, name: str, driver: str, names: NameServer, wanted: Wanted, loop: asyncio.AbstractEventLoop
    ) -> None:
        self.driver = driver
        self.port = OutputPort(name, names, wanted.yarp)
        self._yarp = wanted.yarp or _NEWEST_YARP
        self.messages = 0
        self.values = 0
        self.registered: Contact | None = None
        self.trouble = ""
        self._names, self._host, self._loop = names, wanted.host, loop
        self._lock = threading.Lock()
        self._newest: Message | None = None
        self._over = asyncio.Event()

    def offer(self, values: npt.NDArray[np.float64], acquired_ns: int) -> None:
        """The newest vector; one that was not sent yet is passed over."""
        self.messages += 1
        self.values = len(values)
        if not self.port.receivers:
            return
        since_s = (now_ns() - acquired_ns) / NS_PER_S
        message = Message(values, self.messages, time.time() - since_s, self._yarp)
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
        host = "..." if self._host in ANYWHERE else self._host
        try:
            while not self._over.is_set():
                await asyncio.to_thread(self._be_known, host, number)
                try:
                    async with asyncio.timeout(_LOOK_S):
                        await self._over.wait()
                except TimeoutError:
                    pass
        finally:
            await self.port.close()
            await asyncio.to_thread(self._be_unknown)

    def end(self) -> None:
        self._over.set()

    def _be_known(self, host: str, number: int) -> None:
        """Register, unless it is known; a name that another program has taken meanwhile is left to it."""
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

    def _be_unknown(self) -> None:
        try:
            if self.registered is not None and self._names.query(self.port.name) == self.registered:
                self._names.unregister(self.port.name)
        except OSError as error:
            log.warning("%s could not be unregistered: %s", self.port.name, error)
        self.registered = None


class Outlet:
    """Serves drivers as ports until it is stopped.

    Args:
        namespace: whose drivers.
        wanted: what is served.
        names: where ports are registered.
        tell: gets what happens (``port``, ``trouble``), as JSON has it.

    Raises:
        ConfigurationError: no port can have such a name.
    """

    def __init__(
        self,
        namespace: Namespace,
        wanted: Wanted,
        names: NameServer,
        tell: Callable[[dict[str, Any]], object] = lambda _: None,
    ) -> None:
        if not is_port_name(f"{wanted.prefix}/x"):
            raise ConfigurationError(f"prefix {wanted.prefix!r}: write /name, or /name/name, without spaces")
        self._wanted, self._names, self._tell = wanted, names, tell
        self._ports: dict[str, _Served] = {}
        self._lives: list[Future[None]] = []
        self._vectors: dict[str, list[tuple[_Served, Vector]]] = {}
        self._told: dict[str, str] = {}
        self._collector = Collector(namespace, set(wanted.names) or None, self)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="skinware yarp")
        self._thread.start()

    @property
    def lost(self) -> int:
        return self._collector.lost

    def run(self, tell: Callable[[], object] = lambda: None) -> None:
        """Until ``stop``; ``tell`` is called once a second."""

        def each_second() -> None:
            self._tell_trouble()
            tell()

        self._collector.run(each_second)

    def stop(self) -> None:
        """End it; from any thread, and from a signal handler."""
        self._collector.stop()

    def close(self) -> None:
        """Unregister all ports, and hang up. Idempotent."""
        self._collector.stop()
        if self._loop.is_closed():
            return
        for served in self._ports.values():
            self._loop.call_soon_threadsafe(served.end)
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
        """How each port is: its driver, whether it is registered, messages so far, values, and who reads."""
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
            for name, served in self._ports.items()
        }

    # -- what the collector tells ----------------------------------------------------------------------------------

    def began(self, service: str, head: bytes) -> None:
        """See :class:`skinware.transfer.collecting.Listener`."""
        self._vectors[service] = []
        try:
            generation = Generation(head, service)
        except BadRecording as error:
            self._tell_once(service, str(error))
            return
        if not isinstance(generation.context, Structure):
            return  # a service, of which YARP knows nothing
        wanted = self._wanted
        driver_type = bytes(generation.static()["driver_type"][0]).decode()
        try:
            vectors = vectors_of(
                service,
                generation.context,
                driver_type,
                type_name=wanted.type_name,
                full_scale=wanted.full_scale,
                regions=wanted.regions,
            )
        except ConfigurationError as error:
            self._tell_once(service, str(error))
            return
        for part, vector in vectors.items():
            served = self._port(part, service)
            if served.driver == service:
                self._vectors[service].append((served, vector))
            else:
                self._tell_once(service, f"driver {served.driver} has the port {served.port.name} already")

    def took(self, service: str, frame: Sample) -> None:
        for served, vector in self._vectors.get(service, ()):
            served.offer(vector.of(frame.column("values"), frame.column("status")), frame.acquired_ns)

    def happened(self, event: dict[str, Any]) -> None:
        """Likewise."""

    def _port(self, part: str, driver: str) -> _Served:
        name = f"{self._wanted.prefix}/{_NOT_OF_A_NAME.sub('_', part)}"
        if name not in self._ports:
            served = _Served(name, driver, self._names, self._wanted, self._loop)
            self._ports[name] = served
            self._tell({"event": "port", "port": name, "driver": driver})
            self._lives.append(asyncio.run_coroutine_threadsafe(served.live(), self._loop))
        return self._ports[name]

    def _tell_trouble(self) -> None:
        for name, served in self._ports.items():
            self._tell_once(name, served.trouble)
        for life in self._lives:
            if life.done() and not life.cancelled() and (error := life.exception()) is not None:
                raise error

    def _tell_once(self, about: str, why: str) -> None:
        if self._told.get(about, "") != why:
            self._told[about] = why
            if why:
                self._tell({"event": "trouble", "about": about, "why": why})
