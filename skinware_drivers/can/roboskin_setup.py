"""Find ROBOSKIN boards, whatever skin is on them, read their firmware, change their addresses, and set them up.

Sources: robotology/icub-firmware embot_app_application_theCANparserBasic.cpp (the answers of applications; a new
address is stored and holds at once, without a reply), embot_prot_can_bootloader.cpp and embot_prot_can.cpp (the
bytes), embot_prot_can.h and robotology/icub-firmware-shared iCubCanProto_types.h (board types).
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware_drivers import Link, Match, Patch, operation
from skinware_drivers.can.roboskin_layout import (
    ERGO_HAND,
    FIRST_BOARD,
    LAST_BOARD,
    TRIANGLES,
    Inertial,
    Kind,
    RoboskinOptions,
    SpecialBoards,
    board_of,
    runs,
)

log: logging.Logger = logging.getLogger("skinware.driver")

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


OLD_MTB4_PERIOD_MS = 40
START, STOP = b"\x07\x00", b"\x07\x01"
"""SET_TXMODE: 0 starts, 1 stops."""

_TICKS_PER_MS = 312.5
_FRAMES_OF_A_TRIANGLE, _FRAME_MS = 2, 0.13
"""Per period; a frame of 8 bytes and an 11-bit identifier, at 1 Mbit/s with an ordinary number of stuff bits."""
_OWN_TIMER = 3
_COMPENSATED = 0x08
_NOT_COMPENSATED_TYPE = 2
_INERTIAL_BITS = {"accelerometer": 0x02, "gyroscope": 0x04, "external_accelerometer": 0x08}
_IMU_BITS = {"imu_accelerometer": 0x01, "imu_magnetometer": 0x02, "imu_gyroscope": 0x04}
_FUSION = 1
_AREA_SHIFTS, _LAST_OF_4E = 0x22, 0x0A
"""As CanBusSkin.cpp always sends them; the areas that boards can average over are not used here."""


class BoardSetUp:
    """The set-up of one board, and the state it leaves the board in; ``is_mtb4`` matters for the old way only.

    Attributes:
        first: messages for every board, in order; each goes to all boards before the next.
        special_board: messages after the first wait.
        special_triangles: messages after the second wait.
        enabled: triangles that are switched on in the end.
        wiped: triangles that a special board configuration switched off, though no option does.
        is_uneven: its triangles have different shifts or converter offsets.
    """

    def __init__(self, options: RoboskinOptions, board: int, *, is_mtb4: bool = True) -> None:
        self.board = board
        self.first: list[bytes] = []
        self.special_board: list[bytes] = []
        self.special_triangles: list[bytes] = []
        self.period_ms: int = options.period_ms
        self.skin_type: int = options.skin_type
        self.inertial: Inertial = options.inertial
        self._no_load = options.no_load
        self._inertial_period_ms = options.inertial_period_ms
        self._on: set[int] = set()
        self._shift = [options.shift] * TRIANGLES
        self._cdc_offset = [options.cdc_offset] * TRIANGLES
        modules = [module for module in options.modules if module.board == board]
        if options.old_style:
            self._set_up_old(options, modules, is_mtb4)
            wanted = set(self._on)
        else:
            wanted = self._set_up_new(options, modules)
        self.enabled: frozenset[int] = frozenset(self._on)
        named_off = {t for module in modules if module.enabled is False for t in module.triangles}
        self.wiped: frozenset[int] = frozenset(wanted - self._on - named_off)
        self.is_uneven: bool = len({*zip(self._shift, self._cdc_offset, strict=True)}) > 1

    def inertial_set_up(self) -> list[bytes]:
        mask = self._imu_mask
        return [bytes((0x33, mask, 0, _FUSION, 0, 0, 0, 0))] if mask else []

    def inertial_start(self) -> list[bytes]:
        """Return the messages that start inertial data: ACC_GYRO_SETUP or IMU_TRANSMIT."""
        if self._imu_mask:
            return [bytes((0x35, self._inertial_period_ms))]
        mask = sum(_INERTIAL_BITS[sensor] for sensor in self.inertial)
        return [bytes((0x4F, mask, self._inertial_period_ms))] if mask else []

    def inertial_stop(self) -> list[bytes]:
        if self._imu_mask:
            return [b"\x35\x00"]
        return [b"\x4f\x00\x00"] if self.inertial else []

    @property
    def _imu_mask(self) -> int:
        return sum(_IMU_BITS.get(sensor, 0) for sensor in self.inertial)

    def _set_board(self, special: SpecialBoards) -> None:
        self.period_ms = self.period_ms if special.period_ms is None else special.period_ms
        self.skin_type = self.skin_type if special.skin_type is None else special.skin_type
        self._no_load = self._no_load if special.no_load is None else special.no_load

    def _set_up_new(self, options: RoboskinOptions, modules: Iterable[Kind]) -> set[int]:
        """Return the triangles that were switched on at some time."""
        self.first.append(self._board_configuration())
        self.first.append(self._triangles(0, TRIANGLES - 1, options.enabled))
        wanted = set(self._on)
        for special in options.special_boards:
            if self.board not in special.boards:
                continue
            if special.inertial is not None:
                self.inertial = special.inertial
            if special.sets_board:
                self._set_board(special)
                self.special_board.append(self._board_configuration())
        for module in modules:
            if not (module.enabled is None and module.shift is None and module.cdc_offset is None):
                self._set_triangles(module)
                wanted |= self._on
        return wanted

    def _board_configuration(self) -> bytes:
        """Return SET_BRD_CFG: 4D, type of skin, period, no load."""
        self._on.clear()
        return bytes((0x4D, self.skin_type & 0x0F, self.period_ms, self._no_load))

    def _set_triangles(self, module: Kind) -> None:
        for triangle in module.triangles:
            if module.shift is not None:
                self._shift[triangle] = module.shift
            if module.cdc_offset is not None:
                self._cdc_offset[triangle] = module.cdc_offset
        on = {t for t in module.triangles if (t in self._on if module.enabled is None else module.enabled)}
        for enabled, triangles in ((True, on), (False, set(module.triangles) - on)):
            alike: dict[tuple[int, int], list[int]] = {}
            for triangle in triangles:
                alike.setdefault((self._shift[triangle], self._cdc_offset[triangle]), []).append(triangle)
            for first, last in sorted(run for same in alike.values() for run in runs(same)):
                self.special_triangles.append(self._triangles(first, last, enabled))

    def _triangles(self, first: int, last: int, enabled: bool) -> bytes:
        """Return SET_TRIANG_CFG: 50, first, last, shift, enable, converter offset (little-endian)."""
        touched = range(first, last + 1)
        (self._on.update if enabled else self._on.difference_update)(touched)
        offset = self._cdc_offset[first]
        return bytes((0x50, first, last, self._shift[first], enabled, offset & 0xFF, offset >> 8))

    def _set_up_old(self, options: RoboskinOptions, modules: Iterable[Kind], is_mtb4: bool) -> None:
        for special in options.special_boards:
            if self.board in special.boards:
                self._set_board(special)
        self._on.update(range(TRIANGLES) if options.enabled else ())
        for module in modules:
            if module.enabled is not None:
                (self._on.update if module.enabled else self._on.difference_update)(module.triangles)
        ticks = min(round(self.period_ms * _TICKS_PER_MS), 0xFFFF)
        offset = options.cdc_offset
        timer = (ticks & 0xFF, ticks >> 8)
        self.first.append(bytes((0x4C, 0x01, 0x01, _OWN_TIMER, offset & 0xFF, offset >> 8, *timer)))
        compensated = self.skin_type != _NOT_COMPENSATED_TYPE
        parameter = _COMPENSATED | self.skin_type if compensated else 0
        mask = sum(1 << triangle for triangle in self._on)
        shift = options.shift & 0x0F
        self.first.append(
            bytes((0x4E, shift, _AREA_SHIFTS, self._no_load, parameter, mask & 0xFF, mask >> 8, _LAST_OF_4E))
        )
        if is_mtb4:
            self._on.update(range(TRIANGLES))
            self.period_ms = OLD_MTB4_PERIOD_MS


def warn_of_uneven_triangles(bus_name: str, set_ups: Sequence[BoardSetUp]) -> None:
    """Warn if a second set-up can reach other triangles than the first.

    With the type of the ergoCub's hand, the firmware stores shifts and offsets by triangle at first, and by chip after
    its first data: in a second set-up without a power cycle, the settings of triangles 1 to 15 go to others
    (trianglesOrder in embot_app_application_theSkin.cpp, robotology/icub-firmware b42992119, 2026-06-17).
    """
    uneven = [str(board.board) for board in set_ups if board.skin_type == ERGO_HAND and board.is_uneven]
    if uneven:
        log.warning(
            "%s: triangles of board %s have different shifts or offsets: a hand of skin type 3 takes them as meant at"
            " its first set-up only; cut its power before each further one, or give all triangles the same",
            bus_name,
            ", ".join(uneven),
        )


def warn_of_full_bus(bus_name: str, set_ups: Sequence[BoardSetUp]) -> None:
    """Warn if the boards send more than their wire can carry: the lowest address wins, the highest starves."""
    shares = [_FRAMES_OF_A_TRIANGLE * len(board.enabled) * _FRAME_MS / board.period_ms for board in set_ups]
    needed = sum(shares)
    if needed <= 1:
        return
    fitting = sum(share <= 1 for share in accumulate(shares))
    period_ms = max(board.period_ms for board in set_ups)
    log.warning(
        "%s: %d boards every %d ms need %.0f %% of a CAN bus of 1 Mbit/s: those of the highest addresses will be silent"
        " now and then, or always; the first %d fit, or all of them with period_ms = %d",
        bus_name,
        len(shares),
        period_ms,
        100 * needed,
        fitting,
        math.ceil(period_ms * needed),
    )
