"""Find ROBOSKIN boards, whatever skin is on them, read their firmware, and change their addresses.

Sources: robotology/icub-firmware embot_app_application_theCANparserBasic.cpp (the answers of applications; a new
address is stored and holds at once, without a reply), embot_prot_can_bootloader.cpp and embot_prot_can.cpp (the
bytes), embot_prot_can.h and robotology/icub-firmware-shared iCubCanProto_types.h (board types).
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware_drivers import Link, Match, Patch, operation
from skinware_drivers.can.roboskin_layout import board_of
from skinware_drivers.can.roboskin_options import FIRST_BOARD, LAST_BOARD

ADDRESSES = range(FIRST_BOARD, LAST_BOARD + 1)
MTB3_TYPE = 5
BOARD_TYPES = {MTB3_TYPE: "mtb", 11: "mtb4", 16: "mtb4w", 20: "mtb4c"}
"""Types of boards that carry skin."""

_DISCOVERY = b"\xff"
_GET_FW_VERSION = 0x1C
_SET_BOARD_ADX = 0x32
_REPLY_S = 0.2
_DISCOVERY_S = 0.3
_ADDRESS_CHECKS, _BETWEEN_CHECKS_S = 10, 0.1


@dataclass(frozen=True)
class Board:
    """A board, by its answers.

    Attributes:
        address: 1 to 14.
        firmware: ``1.25.0``; without the third number from a boot loader.
        protocol: version of the CAN protocol, ``2.0``; empty if it was not asked.
        is_loader: its boot loader answered, which has no skin, not its application.
    """

    address: int
    board_type: int
    firmware: str
    protocol: str = ""
    is_loader: bool = False

    @property
    def type_name(self) -> str:
        """``mtb4``; ``type 12`` if it is none that carries skin."""
        return BOARD_TYPES.get(self.board_type, f"type {self.board_type}")

    def as_data(self) -> dict[str, Any]:
        """Return the board for JSON, without its address."""
        return {
            "type": self.type_name,
            "runs": "boot loader" if self.is_loader else "application",
            "firmware": self.firmware,
            "protocol": self.protocol,
        }

    def __str__(self) -> str:
        what = f"board {self.address} ({self.type_name} {self.firmware}"
        return f"{what}, in its boot loader)" if self.is_loader else f"{what})"


async def discover(link: Link) -> list[Board]:
    """Return the boards that answer a discovery, boot loaders too. It silences every MTB3 that is sending.

    An answer is FF type major minor from a boot loader; the application adds its build.
    """
    answers = await link.collect(0x70F, _DISCOVERY, Match(0x700, 0x70F, _DISCOVERY), duration_s=_DISCOVERY_S)
    found = {}
    for answer in answers:
        address, payload = answer.identifier >> 4 & 0xF, answer.payload
        if len(payload) >= 4:
            firmware = ".".join(map(str, payload[2:5]))
            found[address] = Board(address, payload[1], firmware, is_loader=len(payload) == 4)
    return [found[address] for address in sorted(found)]


async def read_version(link: Link, address: int) -> bytes:
    """Return the answer of an application to GET_FW_VERSION: 1C type major minor build ..., usually eight bytes.

    It is asked by unicast, as an MTB3 ignores the broadcast, and does no harm to a board that sends.
    """
    reply = Match(0x200 | address << 4, 0x7FF, bytes((_GET_FW_VERSION,)))
    request = bytes((_GET_FW_VERSION, 2, 0))
    return (await link.request(0x200 | address, request, reply, timeout_s=_REPLY_S)).payload


async def ask_versions(link: Link, addresses: Iterable[int] = ADDRESSES) -> list[Board]:
    """Return the boards whose applications answer; see :func:`read_version`."""
    answers = await asyncio.gather(*(_ask_version(link, address) for address in addresses))
    return [board for board in answers if board is not None]


async def move_board(link: Link, old: int, new: int) -> Board:
    """Give a board another address, which it stores, and check that it took it."""
    if new not in ADDRESSES:
        raise ConfigurationError(f"address {new}: boards have 1 to 14 (0 is the host, 15 everybody)")
    if new == old:
        raise ConfigurationError(f"board {old} has that address already")
    before = await _ask_version(link, old)
    if before is None:
        raise HandshakeTimeout(f"{link.bus_name}: board {old} does not answer; nothing was changed")
    if before.board_type not in BOARD_TYPES:
        raise ConfigurationError(f"{before} carries no skin; nothing was changed")
    other = await _ask_version(link, new)
    if other is not None:
        raise ConfigurationError(f"address {new} is taken by {other}; nothing was changed")
    await link.send(0x200 | old, bytes((_SET_BOARD_ADX, new)))
    for _ in range(_ADDRESS_CHECKS):
        after = await _ask_version(link, new)
        if after is not None:
            break
        await link.sleep(_BETWEEN_CHECKS_S)
    else:
        raise HandshakeTimeout(
            f"{link.bus_name}: board {old} got the address {new}, but no board answers there; to see which"
            " it has now: skin-find --probe"
        )
    if after.board_type != before.board_type or after.firmware != before.firmware:
        raise BusError(f"{link.bus_name}: {after} answers, which is not what board {old} was ({before})")
    if await _ask_version(link, old) is not None:
        raise BusError(
            f"{link.bus_name}: board {old} and board {new} both answer: {old} was not the only one of its kind"
        )
    return after


class BoardOperations:
    """The operations of ``skin-config`` on boards; a part of the driver."""

    @operation(looks=True)
    async def versions(self, link: Link, patches: Sequence[Patch]) -> dict[str, Any]:
        """Return type, firmware and protocol of the boards, by address; null for a board that does not answer."""
        asked = sorted({board_of(patch) for patch in patches}) or list(ADDRESSES)
        found: dict[str, Any] = {str(address): None for address in asked} if patches else {}
        for board in await ask_versions(link, asked):
            found[str(board.address)] = board.as_data()
        return found

    @operation(alone=True)
    async def set_address(self, link: Link, patches: Sequence[Patch], address: int) -> dict[str, Any]:
        """Give one board (name it as patch="board 7") another address, 1 to 14, for good."""
        boards = sorted({board_of(patch) for patch in patches})
        if len(boards) != 1:
            raise ConfigurationError(
                f"there are boards {', '.join(map(str, boards))}: say which one, as patch='board 7'"
            )
        moved = await move_board(link, boards[0], address)
        return {"was": boards[0], "is": moved.address, **moved.as_data()}

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:
        """Find boards by discovery on an idle bus, else by asking each address for its version."""
        boards = await (discover(link) if idle else ask_versions(link))
        return f"ROBOSKIN: {', '.join(map(str, boards))}" if boards else None


async def _ask_version(link: Link, address: int) -> Board | None:
    try:
        answer = await read_version(link, address)
    except HandshakeTimeout:
        return None
    if len(answer) < 7:
        return None
    _, board_type, major, minor, build, protocol_major, protocol_minor = answer[:7]
    return Board(address, board_type, f"{major}.{minor}.{build}", f"{protocol_major}.{protocol_minor}")
