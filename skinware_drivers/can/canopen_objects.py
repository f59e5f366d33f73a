"""Read and write object dictionaries of CANopen devices (CiA 301), and make layouts of their TPDOs."""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes
from canopen.sdo import constants as sdo
from canopen.sdo.exceptions import SdoAbortedError

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.sensor_types import CATALOGUE, SensorType
from skinware_drivers import EXTENDED_FLAG, Link, Match, Module, Patch, Sensor
from skinware_drivers.fields import Bits, Identifier, Packed
from skinware_drivers.layout import Frame, Layout, Values

log: logging.Logger = logging.getLogger("skinware.driver")

REPLY_S = 0.2
_COMMAND, _SEGMENT_BYTES, _FRAME_BYTES = 0xE0, 7, 8
_MOST_BYTES = 1 << 16
_NOT_IN_USE, _IS_EXTENDED = 1 << 31, 1 << 29
"""Bits of a COB-ID (CiA 301): the TPDO is not in use; its identifier has 29 bits."""


class SdoAborted(BusError):
    """The device refused to read or write an object; ``code``: CiA 301 abort code."""

    def __init__(self, what: str, code: int) -> None:
        super().__init__(f"{what}: {SdoAbortedError.CODES.get(code, 'refused')} (abort code 0x{code:08X})")
        self.code = code


class SdoClient:
    """Access to one device's object dictionary; one transfer at a time. ``node``: node id, 1 to 127."""

    def __init__(self, link: Link, node: int) -> None:
        self.node = node
        self._link = link
        self._busy = asyncio.Lock()

    async def read(self, index: int, subindex: int = 0) -> bytes:
        target = struct.pack("<HB", index, subindex)
        async with self._busy:
            answer = await self._ask(target, bytes([sdo.REQUEST_UPLOAD]) + target + bytes(4), sdo.RESPONSE_UPLOAD)
            if answer[0] & sdo.EXPEDITED:
                unused = answer[0] >> 2 & 3 if answer[0] & sdo.SIZE_SPECIFIED else 0
                return answer[4 : _FRAME_BYTES - unused]
            data, toggle = b"", 0
            while len(data) < _MOST_BYTES:
                request = bytes([sdo.REQUEST_SEGMENT_UPLOAD | toggle]).ljust(_FRAME_BYTES, b"\0")
                answer = await self._ask(target, request, sdo.RESPONSE_SEGMENT_UPLOAD, toggle)
                data += answer[1 : _FRAME_BYTES - (answer[0] >> 1 & 7)]
                if answer[0] & sdo.NO_MORE_DATA:
                    return data
                toggle ^= sdo.TOGGLE_BIT
        raise SdoAborted(f"{self._name(target)} has more than {_MOST_BYTES} bytes", sdo.ABORT_OUT_OF_MEMORY)

    async def read_number(self, index: int, subindex: int = 0) -> int:
        """Return an object as an unsigned number; raises what ``read`` does."""
        return int.from_bytes(await self.read(index, subindex), "little")

    async def write(self, index: int, subindex: int, data: bytes) -> None:
        """Set the bytes of an object; raises what ``read`` does."""
        target = struct.pack("<HB", index, subindex)
        async with self._busy:
            if 1 <= len(data) <= 4:
                command = sdo.REQUEST_DOWNLOAD | sdo.EXPEDITED | sdo.SIZE_SPECIFIED | (4 - len(data)) << 2
                await self._ask(target, bytes([command]) + target + data.ljust(4, b"\0"), sdo.RESPONSE_DOWNLOAD)
                return
            head = bytes([sdo.REQUEST_DOWNLOAD | sdo.SIZE_SPECIFIED]) + target
            await self._ask(target, head + struct.pack("<I", len(data)), sdo.RESPONSE_DOWNLOAD)
            toggle = 0
            for at in range(0, max(1, len(data)), _SEGMENT_BYTES):
                part = data[at : at + _SEGMENT_BYTES]
                last = sdo.NO_MORE_DATA if at + _SEGMENT_BYTES >= len(data) else 0
                command = sdo.REQUEST_SEGMENT_DOWNLOAD | toggle | (_SEGMENT_BYTES - len(part)) << 1 | last
                request = bytes([command]) + part.ljust(_SEGMENT_BYTES, b"\0")
                await self._ask(target, request, sdo.RESPONSE_SEGMENT_DOWNLOAD, toggle)
                toggle ^= sdo.TOGGLE_BIT

    async def _ask(self, target: bytes, request: bytes, response: int, toggle: int | None = None) -> bytes:
        """Send a request for an object and return the answer to it; other frames of the device's server are skipped."""
        with self._link.follow(Match(0x580 + self.node)) as frames:
            await self._link.send(0x600 + self.node, request)
            try:
                async with asyncio.timeout(REPLY_S):
                    while True:
                        payload = (await frames.get()).payload
                        if len(payload) != _FRAME_BYTES:
                            continue
                        if payload[0] == sdo.RESPONSE_ABORTED and payload[1:4] == target:
                            raise SdoAborted(self._name(target), int.from_bytes(payload[4:], "little"))
                        is_ours = payload[1:4] == target if toggle is None else payload[0] & sdo.TOGGLE_BIT == toggle
                        if payload[0] & _COMMAND == response and is_ours:
                            return payload
            except TimeoutError:
                why = f"no answer from {self._name(target)} within {REPLY_S:g} s"
                raise HandshakeTimeout(f"{self._link.bus_name}: {why}") from None

    def _name(self, target: bytes) -> str:
        index, subindex = struct.unpack("<HB", target)
        return f"object {index:04X}:{subindex} of node {self.node}"


@dataclass(frozen=True)
class Entry:
    """One mapped object: its place in the object dictionary, and its length in bits."""

    index: int
    subindex: int
    bits: int


@dataclass(frozen=True)
class Tpdo:
    """One TPDO, with its mapped objects in order.

    Attributes:
        identifier: of its frames, with ``EXTENDED_FLAG`` if it has 29 bits.
        transmission: transmission type: 0 to 240 upon SYNC, 254 and 255 by event or event timer.
    """

    number: int
    identifier: int
    transmission: int
    entries: tuple[Entry, ...]

    @staticmethod
    def make(number: int, cob_id: int, transmission: int, entries: Iterable[int]) -> Tpdo | None:
        """Return the TPDO of numbers in the object dictionary; None if it is not in use.

        ``cob_id`` and ``transmission`` are in 0x1800 + number - 1, subindices 1 and 2; ``entries`` (index << 16 |
        subindex << 8 | bits) in 0x1A00 + number - 1.
        """
        mapped = tuple(Entry(entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in entries)
        if cob_id & _NOT_IN_USE or not mapped:
            return None
        extended = bool(cob_id & _IS_EXTENDED)
        identifier = cob_id & 0x1FFF_FFFF | EXTENDED_FLAG if extended else cob_id & 0x7FF
        return Tpdo(number, identifier, transmission, mapped)


def default_tpdos(dictionary: ObjectDictionary) -> list[Tpdo]:
    """Return the TPDOs of a device in its original state, by its EDS."""

    def number(index: int, subindex: int) -> int:
        variable = dictionary.get_variable(index, subindex)
        value = None if variable is None else variable.value if variable.value is not None else variable.default
        return value if isinstance(value, int) else 0

    found = []
    for tpdo in tpdo_numbers(dictionary):
        mapping = 0x1A00 + tpdo - 1
        entries = [number(mapping, sub) for sub in range(1, number(mapping, 0) + 1)]
        found.append(Tpdo.make(tpdo, number(mapping - 0x200, 1), number(mapping - 0x200, 2), entries))
    return [tpdo for tpdo in found if tpdo is not None]


def tpdo_numbers(dictionary: ObjectDictionary) -> list[int]:
    """Return the numbers of the TPDOs that a device can have, from 1."""
    return [i + 1 for i in range(512) if 0x1800 + i in dictionary and 0x1A00 + i in dictionary]


class PdoMap:
    """The frames, types and patches of all nodes of a bus; objects whose name contains no type are of a default."""

    def __init__(self, dictionary: ObjectDictionary, nodes: Mapping[int, Sequence[Tpdo]], default_type: str) -> None:
        self._dictionary = dictionary
        self._default_type = default_type
        every = (entry for tpdos in nodes.values() for tpdo in tpdos for entry in tpdo.entries)
        self._sensors = {entry: self._variable(entry) for entry in dict.fromkeys(every)}
        known = [variable for variable in self._sensors.values() if variable is not None]
        if not known:
            raise ConfigurationError("none of the objects that are mapped into TPDOs is a number that the EDS knows")
        self.dtype: np.dtype[Any] = _common_dtype(known)
        self.types: list[SensorType] = self._types(known)
        self.layout = Layout(tuple(self._frames(nodes)))
        patches = []
        for node, tpdos in nodes.items():
            modules = []
            for tpdo in tpdos:
                channels: list[Sensor | None] = []
                for entry in tpdo.entries:
                    variable, uid = self._sensors[entry], node << 24 | entry.index << 8 | entry.subindex
                    channels.append(None if variable is None else Sensor(self._type_name(variable), uid))
                modules.append(Module(channels, key=tpdo.number, kind="tpdo"))
            patches.append(Patch(f"node {node}", modules, key=node))
        self.patches: Sequence[Patch] = patches

    def _variable(self, entry: Entry) -> ODVariable | None:
        """Return the sensor behind a mapped object; None if it is no sensor."""
        variable = self._dictionary.get_variable(entry.index, entry.subindex)
        if variable is not None and entry.bits <= 32 and variable.data_type in datatypes.NUMBER_TYPES:
            return variable
        if entry.index >= 0x20:  # below: gaps
            log.warning("object %04X:%d is mapped, but no number of at most 32 bits", entry.index, entry.subindex)
        return None

    def _type_name(self, variable: ODVariable) -> str:
        name = variable.qualname.lower().replace(" ", "_")
        return next((known for known in CATALOGUE if known in name), self._default_type)

    def _types(self, variables: Sequence[ODVariable]) -> list[SensorType]:
        types = []
        by_name = sorted(variables, key=self._type_name)
        for name, group in groupby(by_name, key=self._type_name):
            same = list(group)
            if len({(variable.factor, variable.unit) for variable in same}) > 1:
                raise ConfigurationError(f"the EDS gives sensors of type {name} different factors or units")
            limits = [_limits(variable) for variable in same]
            ends = [same[0].factor * limit for low, high in limits for limit in (low, high)]
            unit = same[0].unit or "counts"
            types.append(
                CATALOGUE[name].measured(unit=unit, scale=same[0].factor, minimum=min(ends), maximum=max(ends))
            )
        return types

    def _frames(self, nodes: Mapping[int, Sequence[Tpdo]]) -> Iterable[Frame]:
        """Yield one kind of frame for all nodes with one TPDO at predefined identifiers, else one for each node."""
        alike: dict[tuple[Any, ...], list[int]] = {}
        bases: dict[int, set[tuple[Any, ...]]] = {}
        for node, tpdos in nodes.items():
            for tpdo in tpdos:
                base = tpdo.identifier - node
                key = (base, tpdo.number, tpdo.entries)
                alike.setdefault(key, []).append(node)
                bases.setdefault(base, set()).add(key)
        for (base, number, entries), of_nodes in alike.items():
            length, values = -(-sum(entry.bits for entry in entries) // 8), tuple(self._runs(number, entries))
            if base & 0x7F == 0 and base < EXTENDED_FLAG and len(bases[base]) == 1:
                when = (Identifier(base, 0x780),)
                yield Frame(f"TPDO {number}", when, (length,), values, patch=Bits(0, 7), module=number)
                continue
            for node in of_nodes:
                name, when = f"TPDO {number} of node {node}", (Identifier(base + node),)
                yield Frame(name, when, (length,), values, patch=node, module=number)

    def _runs(self, number: int, entries: Sequence[Entry]) -> Iterable[Values]:
        """Yield runs of entries of one format; little-endian, as CiA 301 packs them."""
        bit, channel = 0, 0
        for (bits, kind), group in groupby(entries, key=lambda entry: (entry.bits, self._kind(entry))):
            count = len(list(group))
            if kind:
                to = tuple(range(channel, channel + count))
                if kind == "f" and (bit % 8 or bits != 32):
                    raise ConfigurationError(f"TPDO {number}: a REAL32 must begin with a byte")
                if bit % 8 == 0 and bits in (8, 16, 32):
                    yield Values(bit // 8, f"<{kind}{bits // 8}", count, to)
                else:
                    yield Values(bit // 8, Packed(bits, "little", kind == "i", skip=bit % 8), count, to)
            bit, channel = bit + bits * count, channel + count

    def _kind(self, entry: Entry) -> str:
        """Return the kind of numpy dtype; empty if the object is no sensor."""
        variable = self._sensors[entry]
        if variable is None:
            return ""
        if variable.data_type in datatypes.FLOAT_TYPES:
            return "f"
        return "i" if variable.data_type in datatypes.SIGNED_TYPES else "u"


def _capacity(variable: ODVariable) -> tuple[float, float]:
    if variable.data_type in datatypes.FLOAT_TYPES:
        return -np.inf, np.inf
    bits = len(variable)
    if variable.data_type in datatypes.SIGNED_TYPES:
        return -(1 << bits - 1), (1 << bits - 1) - 1
    return 0, (1 << bits) - 1


def _limits(variable: ODVariable) -> tuple[float, float]:
    """Return the least and greatest raw value: the limits in the EDS, else of the data type."""
    low, high = _capacity(variable)
    return low if variable.min is None else variable.min, high if variable.max is None else variable.max


def _common_dtype(variables: Sequence[ODVariable]) -> np.dtype[Any]:
    """Return the smallest dtype of a service for all values that these can send, within the limits of the EDS or not.

    Only for UNSIGNED32, which a service does not have, do the limits count; without any it becomes float32, which is
    exact to 24 bits.
    """
    ranges = [_limits(v) if v.data_type == datatypes.UNSIGNED32 else _capacity(v) for v in variables]
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    for dtype in (np.uint8, np.int16, np.uint16, np.int32):
        info = np.iinfo(dtype)
        if info.min <= low and high <= info.max:
            return np.dtype(dtype)
    return np.dtype(np.float32)
