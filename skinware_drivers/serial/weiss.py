"""The protocol of Weiss Robotics' sensors and controllers: their packets, their answers, and the check after a reset.

Frames: ``AA AA AA | command | length u16 LE | payload | CRC u16 LE``, with a CRC that is in no catalogue. A response
has the number of its command and begins with a status, u16 LE.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

from skinware_drivers import Link, Match, Notice, Patch
from skinware_drivers.options import OptionsT
from skinware_drivers.serial import CRC16_WEISS, Answers, Field, Length, Packet, SerialAdapter

_AROUND = 8
"""Bytes of a frame beside its payload."""


def weiss_packet(most_payload: int, **more: Any) -> Packet:
    """Return the framing of a device whose longest payload has so many bytes; ``more``: as of :class:`Packet`."""
    return Packet(
        sync=(0xAA, 0xAA, 0xAA),
        length=Length(Field(4, 2), more=_AROUND),
        maximum=_AROUND + most_payload,
        checksum=CRC16_WEISS,
        identifier=Field(3),
        **more,
    )


class WeissAdapter(SerialAdapter[OptionsT]):
    """One device, which reports its cells; :meth:`describe` keeps the report in ``_cells``."""

    packet: ClassVar[Packet]
    answers: ClassVar[Answers]
    timeout_s: ClassVar[float]
    tries: ClassVar[int]

    def __init__(self, options: OptionsT) -> None:
        super().__init__(options)
        self._cells: Any = ()

    @property
    def payload_size(self) -> int:
        """Bytes of the most cells; their number is known only after the device was asked."""
        return -(-self.packet.maximum_body // 8) * 8

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Return whether the same device answers: then it was reset, and no longer sends by itself."""
        if await self._ask_cells(link, tries=1) == self._cells:
            return True
        self.tell(patch, Notice.CHANGED)
        return False

    @classmethod
    @abstractmethod
    async def _ask_cells(cls, link: Link, *, tries: int | None = None) -> Any:
        """Ask for its cells."""

    @classmethod
    async def _ask(
        cls, link: Link, command: int, arguments: bytes = b"", *, size: int = 0, tries: int | None = None
    ) -> bytes:
        """Send a command and return the answer behind its status."""
        reply = await link.request(
            command, arguments, Match(command), timeout_s=cls.timeout_s, tries=cls.tries if tries is None else tries
        )
        return cls.answers.result(command, reply.payload, size)
