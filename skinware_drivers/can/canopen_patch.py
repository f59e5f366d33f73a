"""Any CANopen skin patch (CiA 301), by its EDS: configured over SDO, read from its TPDOs.

The package ``canopen`` parses the EDS. The TPDO mapping is read once from each node (0x1800 ff., 0x1A00 ff.) and
becomes a layout, so that no CANopen code runs per frame. Identifiers, states and commands: CiA 301, with the predefined
connection set: NMT 0x000, SYNC 0x080, EMCY 0x080 + node, SDO 0x600/0x580 + node, heartbeat 0x700 + node.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence
from importlib import resources
from typing import Annotated

import canopen
from canopen.emcy import EmcyError
from canopen.objectdictionary import ObjectDictionary
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.sensor_types import CATALOGUE
from skinware.text import nearest_name
from skinware_drivers import Link, Match, Notice, Options, Patch, Poll
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.canopen_objects import PdoMap, SdoAborted, SdoClient, Tpdo, default_tpdos, tpdo_numbers
from skinware_drivers.fields import Reply

log: logging.Logger = logging.getLogger("skinware.driver")

FIRST_NODE, LAST_NODE = 1, 127
_START, _ENTER_PRE_OPERATIONAL = 0x01, 0x80
_BOOT_UP, _OPERATIONAL = 0, 5
_LAST_SYNCHRONOUS = 240
_NODES_SEND = (0x700, 0x180, 0x280, 0x380, 0x480)
_MOST_ERRORS_LOGGED = 10
_LOST_HEARTBEATS, _LEAST_HEARTBEAT_LOSS_S = 3, 0.2


class CanopenOptions(Options, frozen=True):
    eds: Annotated[str, Meta(description="EDS or DCF file of the patches; default: the example's")] = ""
    nodes: Annotated[tuple[int, ...], Meta(description="node ids of the patches, 1-127; default: all that answer")] = ()
    period_ms: Annotated[int, Meta(description="time between two updates, ms", ge=1, le=60_000)] = 20
    heartbeat_ms: Annotated[
        int, Meta(description="time between two heartbeats of a patch, ms; 0: none", ge=0, le=60_000)
    ] = 100
    type: Annotated[str, Meta(description="type of sensors whose name in the EDS contains none")] = "pressure"
    learn_s: Annotated[float, Meta(description="time in which a listener learns the nodes, s", gt=0)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(set(self.nodes)) < len(self.nodes) or not set(self.nodes) <= set(range(FIRST_NODE, LAST_NODE + 1)):
            raise ConfigurationError(f"nodes {self.nodes}: give different ids of {FIRST_NODE} to {LAST_NODE}")
        if self.type not in CATALOGUE:
            raise ConfigurationError(f"type {self.type!r}{nearest_name(self.type, sorted(CATALOGUE))}")


class MappingChanged(BusError):
    """A node came back with other TPDOs than before: the driver must be started again."""


class CanopenDriver(CanAdapter[CanopenOptions]):
    """CANopen patches: a node is a patch, each of its TPDOs a module, each mapped number a sensor.

    uid = node << 24 | index << 8 | subindex. The type of a sensor is the type whose name its name in the EDS contains;
    Factor and Unit of the EDS, if it has them, are scale and unit.

    Attributes:
        expects_heartbeat_of: nodes that accepted the heartbeat period of the options; others are not missed.
    """

    payload_size = 8

    def __init__(self, options: CanopenOptions) -> None:
        super().__init__(options)
        self._dictionary = _read_eds(options.eds, 0)
        self._clients: dict[int, SdoClient] = {}
        self._tpdos: dict[int, list[Tpdo]] = {}
        self.expects_heartbeat_of: set[int] = set()

    @property
    def polls(self) -> Sequence[Poll]:
        """SYNC, if a TPDO waits for it: often enough for the slowest TPDO to be sent once a period."""
        types = (tpdo.transmission for tpdos in self._tpdos.values() for tpdo in tpdos)
        every = [max(1, type_) for type_ in types if type_ <= _LAST_SYNCHRONOUS]  # so many SYNCs
        return (Poll(0x080, b"", self.period_s / max(every)),) if every else ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Return the nodes of the options, or all that answer, with the TPDOs that they report.

        The TPDOs of the EDS are assumed by a listener, and for named nodes that do not answer while others do.
        """
        if link.listen_only:
            heard = set(self.options.nodes)
            if not heard:  # nodes with heartbeats, and with TPDOs of the predefined connection set
                identifiers = {frame.identifier for frame in await link.listen(self.options.learn_s)}
                heard = {i & 0x7F for i in identifiers if i < 0x800 and i & 0x780 in _NODES_SEND and i & 0x7F}
            self._tpdos = {node: self._default(node) for node in sorted(heard)}
        else:
            asked = self.options.nodes or range(FIRST_NODE, LAST_NODE + 1)
            self._clients = {node: SdoClient(link, node) for node in asked}
            answers = await asyncio.gather(*(self._is_there(node) for node in asked))
            there = {node for node, answer in zip(asked, answers, strict=True) if answer}
            if self.options.nodes and not there:
                raise HandshakeTimeout(f"none of the nodes {', '.join(map(str, asked))} answers")
            wanted = self.options.nodes or sorted(there)
            self._tpdos = {n: await self._read_tpdos(n) if n in there else self._default(n) for n in wanted}
        if not self._tpdos:
            return ()
        made = PdoMap(self._dictionary, self._tpdos, self.options.type)
        self.layout, self.types, self.dtype, self.patches = made.layout, made.types, made.dtype, made.patches
        return self.patches

    async def configure(self, link: Link) -> None:
        """Set heartbeat and event timers of all nodes; nodes that do not answer are left to ``probe``."""
        results = await asyncio.gather(*(self._configure(link, node) for node in self._tpdos), return_exceptions=True)
        failures = [result for result in results if isinstance(result, BaseException)]
        for failure in failures:
            if not isinstance(failure, HandshakeTimeout) or len(failures) == len(results):
                raise failure

    async def start(self, link: Link) -> None:
        for node in self._tpdos:
            await link.send(0x000, bytes((_START, node)))

    async def stop(self, link: Link) -> None:
        """Return every node to pre-operational, in which it sends no TPDO."""
        for node in self._tpdos:
            await link.send(0x000, bytes((_ENTER_PRE_OPERATIONAL, node)))

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Take a silent node out of ``stopped``, in which it answers no question, and ask for its device type."""
        await link.send(0x000, bytes((_ENTER_PRE_OPERATIONAL, patch.key)))
        return await self._is_there(patch.key)

    async def revive(self, link: Link, patch: Patch) -> None:
        if await self._read_tpdos(patch.key) != self._tpdos[patch.key]:
            link.log.error("the TPDOs of %s have changed: start the driver again", patch.name)
            raise MappingChanged(f"{patch.name}: other TPDOs than before")
        await self._configure(link, patch.key)
        await link.send(0x000, bytes((_START, patch.key)))

    async def attend(self, link: Link) -> None:
        nodes = {patch.key: _NodeState(patch, self.tell) for patch in self.patches}
        matches = [Match(base + node) for node in nodes for base in (0x700, 0x080)]
        loss_s = max(_LOST_HEARTBEATS * self.options.heartbeat_ms / 1e3, _LEAST_HEARTBEAT_LOSS_S)
        with link.follow(*matches) as frames:
            while True:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(loss_s / 2):
                        frame = await frames.get()
                    nodes[frame.identifier & 0x7F].hear(frame)
                if frames.empty():  # received heartbeats are judged before missing ones
                    for node in self.expects_heartbeat_of & nodes.keys():
                        nodes[node].look(asyncio.get_running_loop().time(), loss_s)

    def _default(self, node: int) -> list[Tpdo]:
        return default_tpdos(_read_eds(self.options.eds, node))

    async def _is_there(self, node: int) -> bool:
        try:
            await self._clients[node].read(0x1000)
        except HandshakeTimeout:
            return False
        except SdoAborted:
            return True
        return True

    async def _read_tpdos(self, node: int) -> list[Tpdo]:
        read = self._clients[node].read_number
        found = []
        for number in tpdo_numbers(self._dictionary):
            parameters, mapping = 0x1800 + number - 1, 0x1A00 + number - 1
            cob_id, transmission = await read(parameters, 1), await read(parameters, 2)
            entries = [await read(mapping, sub) for sub in range(1, await read(mapping, 0) + 1)]
            found.append(Tpdo.make(number, cob_id, transmission, entries))
        return [tpdo for tpdo in found if tpdo is not None]

    async def _configure(self, link: Link, node: int) -> None:
        await link.send(0x000, bytes((_ENTER_PRE_OPERATIONAL, node)))
        self.expects_heartbeat_of.discard(node)
        if await self._write(node, 0x1017, 0, self.options.heartbeat_ms) and self.options.heartbeat_ms:
            self.expects_heartbeat_of.add(node)
        for tpdo in self._tpdos[node]:
            if tpdo.transmission > _LAST_SYNCHRONOUS:
                await self._write(node, 0x1800 + tpdo.number - 1, 5, self.options.period_ms)

    async def _write(self, node: int, index: int, subindex: int, value: int) -> bool:
        """Set an UNSIGNED16; False if the device keeps its own."""
        try:
            await self._clients[node].write(index, subindex, value.to_bytes(2, "little"))
        except SdoAborted as error:
            log.warning("%s", str(error))
            return False
        return True


class _NodeState:
    """The state of a node, by its messages."""

    def __init__(self, patch: Patch, tell: Callable[[Patch, Notice], None]) -> None:
        self._patch = patch
        self._tell = tell
        self._heard_s: float | None = None
        self._is_operational = False
        self._errors: set[int] = set()

    def hear(self, frame: Reply) -> None:
        if frame.identifier < 0x700:
            self._hear_emergency(frame.payload)
            return
        if len(frame.payload) != 1:
            return
        state = frame.payload[0] & 0x7F
        if state == _BOOT_UP:
            self._heard_s = None
            self._errors.clear()
            self._tell(self._patch, Notice.RESTARTED)
        else:
            self._heard_s = asyncio.get_running_loop().time()
            if self._is_operational and state != _OPERATIONAL:
                self._tell(self._patch, Notice.LOST)
        self._is_operational = state == _OPERATIONAL

    def look(self, time_s: float, loss_s: float) -> None:
        """Report the node as lost if its heartbeat is overdue; a heartbeat must have been heard before."""
        if self._heard_s is not None and time_s - self._heard_s > loss_s:
            self._heard_s = None
            self._is_operational = False
            self._tell(self._patch, Notice.LOST)

    def _hear_emergency(self, payload: bytes) -> None:
        if len(payload) != 8:
            return
        code = int.from_bytes(payload[:2], "little")
        if code >> 8 == 0:  # error reset, or no error
            self._errors.clear()
            self._tell(self._patch, Notice.SOUND)
            return
        if code not in self._errors and len(self._errors) < _MOST_ERRORS_LOGGED:  # each once, until they are over
            self._errors.add(code)
            text = EmcyError(code, payload[2], payload[3:], 0).get_desc() or "unknown error"
            log.warning("%s reports an error: %s (code %04X)", self._patch.name, text, code)
        self._tell(self._patch, Notice.SUSPECT)


def _read_eds(path: str, node: int) -> ObjectDictionary:
    source = path or str(resources.files("skinware_drivers") / "eds" / "skin_patch.eds")
    try:
        return canopen.import_od(source, node)
    except OSError as error:
        raise ConfigurationError(f"EDS {source}: {error.strerror}") from None
    except Exception as error:  # noqa: BLE001 - the exceptions of the parser are not documented
        raise ConfigurationError(f"EDS {source} cannot be read: {error}") from None
