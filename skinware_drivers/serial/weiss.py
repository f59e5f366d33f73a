"""What Weiss Robotics' sensors and controllers have in common: their packets, their answers, and what they are asked.

Frames: ``AA AA AA | command | length u16 LE | payload | CRC u16 LE``, with a CRC that is in no catalogue. A response
has the number of its command and begins with a status, u16 LE.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from skinware_drivers.description import Patch
from skinware_drivers.link import Link, Match
from skinware_drivers.options import OptionsT
from skinware_drivers.polling import Notice
from skinware_drivers.serial.adapter import Answers, SerialAdapter
from skinware_drivers.serial.checksums import CRC16_WEISS
from skinware_drivers.serial.framing import Field
from skinware_drivers.serial.packets import Length, Packet

_AROUND = 8
"""Bytes of a frame beside its payload."""


def weiss_packet(most_payload: int, **more: Any) -> Packet:
    """The frames of a device.

    Args:
        most_payload: bytes of the longest payload.
        more: what else is said of a :class:`Packet`.
    """
    return Packet(
        sync=(0xAA, 0xAA, 0xAA),
        length=Length(Field(4, 2), more=_AROUND),
        maximum=_AROUND + most_payload,
        checksum=CRC16_WEISS,
        identifier=Field(3),
        **more,
    )


def weiss_answers(device: str, reasons: Mapping[int, str]) -> Answers:
    """How a device answers.

    Args:
        device: what it is called.
        reasons: what its statuses mean.
    """
    return Answers(device, reasons, dtype="<u2")


class WeissAdapter(SerialAdapter[OptionsT]):
    """One device, which says itself which cells it has; :meth:`describe` keeps that in ``_cells``.

    Attributes:
        packet: its frames.
        answers: how it answers.
        timeout_s, tries: how long an answer is waited for, and how often it is asked.
    """

    packet: ClassVar[Packet]
    answers: ClassVar[Answers]
    timeout_s: ClassVar[float]
    tries: ClassVar[int]

    def __init__(self, options: OptionsT) -> None:
        super().__init__(options)
        self._cells: Any = ()

    @property
    def payload_size(self) -> int:
        """Of the most cells: how many there are is known only when it was asked."""
        return -(-self.packet.maximum_body // 8) * 8

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Whether it answers, and still is what it was: then it was reset, and does not send by itself any more."""
        if await self._ask_cells(link, tries=1) == self._cells:
            return True
        self.tell(patch, Notice.CHANGED)
        return False

    @classmethod
    @abstractmethod
    async def _ask_cells(cls, link: Link, *, tries: int | None = None) -> Any:
        """Which cells it has."""

    @classmethod
    async def _ask(
        cls, link: Link, command: int, arguments: bytes = b"", *, size: int = 0, tries: int | None = None
    ) -> bytes:
        """What it answers behind its status.

        Raises:
            Refused: it does not do it.
            BusError: it does not answer, or too little.
        """
        reply = await link.request(
            command, arguments, Match(command), timeout_s=cls.timeout_s, tries=cls.tries if tries is None else tries
        )
        return cls.answers.result(command, reply.payload, size)
