"""Reading and writing the object dictionary of a CANopen device (CiA 301, SDO), in coroutines over a ``Link``.

Expedited and segmented transfers with the default identifiers: requests 0x600 + node, answers 0x580 + node. The numbers
and the names of abort codes are those of the ``canopen`` package.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable

from canopen.sdo import constants as sdo
from canopen.sdo.exceptions import SdoAbortedError

from skinware.errors import BusError, HandshakeTimeout
from skinware_drivers.link import Link, Match

REPLY_S = 0.2
_COMMAND, _SEGMENT_BYTES, _FRAME_BYTES = 0xE0, 7, 8
_MOST_BYTES = 1 << 16


class SdoAborted(BusError):
    """The device refused to read or write an object.

    Attributes:
        code: CiA 301 abort code.
    """

    def __init__(self, what: str, code: int) -> None:
        super().__init__(f"{what}: {SdoAbortedError.CODES.get(code, 'refused')} (abort code 0x{code:08X})")
        self.code = code


class SdoClient:
    """One device's object dictionary. Only one transfer at a time goes on, the others wait.

    Args:
        link: the bus.
        node: node id, 1 to 127.
    """

    def __init__(self, link: Link, node: int) -> None:
        self.node = node
        self._link = link
        self._busy = asyncio.Lock()

    async def read(self, index: int, subindex: int = 0) -> bytes:
        """The bytes of an object.

        Raises:
            SdoAborted: the device does not give it.
            HandshakeTimeout: no answer.
            BusSendError: as ``Link.send``.
        """
        async with self._busy:
            return await self._read(_Object(self.node, index, subindex))

    async def read_number(self, index: int, subindex: int = 0) -> int:
        """An unsigned number; raises what ``read`` does."""
        return int.from_bytes(await self.read(index, subindex), "little")

    async def write(self, index: int, subindex: int, data: bytes) -> None:
        """Set the bytes of an object; raises what ``read`` does."""
        async with self._busy:
            await self._write(_Object(self.node, index, subindex), data)

    async def _read(self, target: _Object) -> bytes:
        answer = await self._ask(target, target.head(sdo.REQUEST_UPLOAD) + bytes(4), sdo.RESPONSE_UPLOAD)
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
        raise SdoAborted(f"{target} has more than {_MOST_BYTES} bytes", sdo.ABORT_OUT_OF_MEMORY)

    async def _write(self, target: _Object, data: bytes) -> None:
        if 1 <= len(data) <= 4:
            command = sdo.REQUEST_DOWNLOAD | sdo.EXPEDITED | sdo.SIZE_SPECIFIED | (4 - len(data)) << 2
            await self._ask(target, target.head(command) + data.ljust(4, b"\0"), sdo.RESPONSE_DOWNLOAD)
            return
        size = struct.pack("<I", len(data))
        await self._ask(target, target.head(sdo.REQUEST_DOWNLOAD | sdo.SIZE_SPECIFIED) + size, sdo.RESPONSE_DOWNLOAD)
        toggle = 0
        for at in range(0, max(1, len(data)), _SEGMENT_BYTES):
            part = data[at : at + _SEGMENT_BYTES]
            last = sdo.NO_MORE_DATA if at + _SEGMENT_BYTES >= len(data) else 0
            command = sdo.REQUEST_SEGMENT_DOWNLOAD | toggle | (_SEGMENT_BYTES - len(part)) << 1 | last
            request = bytes([command]) + part.ljust(_SEGMENT_BYTES, b"\0")
            await self._ask(target, request, sdo.RESPONSE_SEGMENT_DOWNLOAD, toggle)
            toggle ^= sdo.TOGGLE_BIT

    async def _ask(self, target: _Object, request: bytes, response: int, toggle: int | None = None) -> bytes:
        """Send a request; the answer to it. Other frames of the device's server are passed over."""

        def is_answer(payload: bytes) -> bool:
            if payload[0] & _COMMAND != response:
                return False
            return payload[0] & sdo.TOGGLE_BIT == toggle if toggle is not None else payload[1:4] == target.address

        payload = await self._exchange(target, request, is_answer)
        if payload[0] == sdo.RESPONSE_ABORTED:
            raise SdoAborted(str(target), int.from_bytes(payload[4:], "little"))
        return payload

    async def _exchange(self, target: _Object, request: bytes, is_answer: Callable[[bytes], bool]) -> bytes:
        with self._link.follow(Match(0x580 + self.node)) as frames:
            await self._link.send(0x600 + self.node, request)
            try:
                async with asyncio.timeout(REPLY_S):
                    while True:
                        payload = (await frames.get()).payload
                        if len(payload) != _FRAME_BYTES:
                            continue
                        is_abort = payload[0] == sdo.RESPONSE_ABORTED and payload[1:4] == target.address
                        if is_abort or is_answer(payload):
                            return payload
            except TimeoutError:
                raise HandshakeTimeout(f"{self._link.bus_name}: no answer from {target} within {REPLY_S:g} s") from None


class _Object:
    """Where an object is."""

    def __init__(self, node: int, index: int, subindex: int) -> None:
        self._name = f"object {index:04X}:{subindex} of node {node}"
        self.address = struct.pack("<HB", index, subindex)

    def head(self, command: int) -> bytes:
        return bytes([command]) + self.address

    def __str__(self) -> str:
        return self._name
