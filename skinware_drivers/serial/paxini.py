"""Paxini's PX-6AX GEN3: tactile modules of three axes, behind a serial converter board or behind a high-speed board.

Wire formats: the requests of Paxini's own programs, captured and published; three published programs that read the
sensors (github.com/riverfog7/paxini-utils, adnan-saood/paxini_ros2, yknxh/paxini-toolkit). The formats are described in
:mod:`.paxini_converter` and :mod:`.paxini_high_speed`. Both boards speak at 921600 baud, 8N1.

Not known: whether a question in the other board's protocol disturbs a board (it is assumed not to; with the option
``board`` none is asked), and the meaning of the error byte in the high-speed board's frames (if it is not 0, all values
of the frame are ``SUSPECT``).
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import BusError, HandshakeTimeout
from skinware_drivers import Link, Match, Notice, Options, Patch, Poll, operation
from skinware_drivers.hand import Hand
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.serial import (
    LRC,
    LengthTable,
    Packet,
    SerialAdapter,
    Unframed,
    paxini_converter,
    paxini_high_speed,
)
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.paxini_converter import IDENTIFIER, SENSORS, ConverterBoard, ask_version
from skinware_drivers.serial.paxini_high_speed import HighSpeedBoard
from skinware_drivers.serial.paxini_modules import MOST_POINTS, TAXEL, TYPES

_HEADERS = 48
"""At least the bytes around the taxels in any body."""
_LISTEN_S, _TIMEOUT_S, _TRIES = 0.1, 0.2, 2
_VERSIONS: Framing = Packet(
    sync=(0xAA, 0x55, (0, 110)),
    length=LengthTable(2, {0: 9 + paxini_high_speed.VERSION_BYTES, 110: 15 + paxini_converter.VERSION_BYTES}),
    checksum=LRC,
    identifier=IDENTIFIER,
    header=5,
)
"""Replies of either board to the question for its version, and no other frames."""
_HEADER_OF_HIGH_SPEED = paxini_high_speed.version_request()[:8]
"""Header of the reply of a high-speed board, except for the first two bytes."""
_VERSION_OF_HIGH_SPEED = Match(IDENTIFIER.of(_HEADER_OF_HIGH_SPEED), prefix=_HEADER_OF_HIGH_SPEED[5:])


class PaxiniOptions(Options, frozen=True):
    board: Annotated[
        Literal["auto", "converter", "high_speed"], Meta(description="the kind of board; auto: listen and ask")
    ] = "auto"
    sensors: Annotated[
        tuple[Annotated[int, Meta(ge=SENSORS[0], le=SENSORS[-1])], ...],
        Meta(description="converter board: ids of the sensors that must be there; none: all that answer"),
    ] = ()
    points: Annotated[
        int, Meta(ge=0, le=MOST_POINTS, description="converter board: taxels of each sensor; 0: by its part code")
    ] = 0
    period_ms: Annotated[
        float, Meta(ge=1, le=1000, description="converter board: time between two questions to a sensor, ms")
    ] = 10
    hand: Annotated[
        Literal["right", "left"], Meta(description="high-speed board: the hand with its modules, for their places")
    ] = "right"


class PaxiniDriver(SerialAdapter[PaxiniOptions]):
    """One board on a serial line, with all modules that are attached to it."""

    framing = _VERSIONS
    commands = Unframed(64)
    baudrate = 921_600
    payload_size = -(-(_HEADERS + TAXEL * MOST_POINTS) // 8) * 8  # of the largest module
    types = TYPES
    dtype = np.int16
    watch = ZeroWatch

    def __init__(self, options: PaxiniOptions) -> None:
        super().__init__(options)
        self._converter = ConverterBoard(
            options.sensors,
            options.points,
            lambda: self._line is not None and self._line.fileno() < 0,
            period_s=options.period_ms / 1e3,
            report=self.tell,
        )
        self._high_speed = HighSpeedBoard(Hand(options.hand), use=self.change_framing, report=self.tell)
        self._board: ConverterBoard | HighSpeedBoard | None = None
        self._is_asking = False

    @property
    def polls(self) -> Sequence[Poll]:
        """Questions to a converter board; a high-speed board sends by itself."""
        return self._board.polls if isinstance(self._board, ConverterBoard) else ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        if link.listen_only:
            raise BusError("Paxini's boards report their modules only on request: listening is not enough")
        self._board, self._is_asking = None, True  # no other question meanwhile
        try:
            board = await self._find(link)
            self.change_framing(board.framing)
            patches = await board.describe(link)
        finally:
            self._is_asking = False
        self.layout, self.geometry, self.period_s = board.layout, board.geometry, board.period_s
        self._board = board
        return patches

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask the sensors of a converter board, then a high-speed board, for a version; it does no harm at any time."""
        for sensor in SENSORS:
            try:
                return f"Paxini sensor {sensor}: {await ask_version(link, sensor)}"
            except HandshakeTimeout:
                continue
        return f"Paxini high-speed board {await _ask_high_speed(link)}"

    async def start(self, link: Link) -> None:
        if isinstance(self._described, HighSpeedBoard):  # a converter board only answers
            await self._described.start(link)

    async def stop(self, link: Link) -> None:
        if isinstance(self._board, HighSpeedBoard):
            await self._board.stop(link)

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Return whether a silent patch answers and is the same; if no board is known, ask which it is."""
        if self._board is not None:
            return await self._board.probe(link, patch)
        if not self._is_asking:
            self.tell(patch, Notice.CHANGED)
        return False

    async def attend(self, link: Link) -> None:
        """Follow the frames of either board that are no data."""
        async with asyncio.TaskGroup() as attending:
            for board in (self._converter, self._high_speed):
                attending.create_task(board.attend(link))

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:  # noqa: ARG002
        """Ask for the modules that are attached now, and start the data again."""
        patches = await self.describe(link)
        await self.start(link)
        return patches

    @operation(sets_up=True)
    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:
        """Take the present forces as zero; a high-speed board needs up to 10 s for it."""
        await self._described.tare(link, patches)

    @property
    def _described(self) -> ConverterBoard | HighSpeedBoard:
        if self._board is None:
            raise BusError("the board was not found yet")
        return self._board

    async def _find(self, link: Link) -> ConverterBoard | HighSpeedBoard:
        """Return the board of the options, or the one that streams or answers."""
        if self.options.board == "converter":
            return self._converter
        if self.options.board == "high_speed" or await self._high_speed.is_streaming(link, _LISTEN_S):
            return self._high_speed
        self.change_framing(_VERSIONS)
        if await self._converter.is_there(link):
            return self._converter
        await _ask_high_speed(link)
        return self._high_speed


async def _ask_high_speed(link: Link) -> str:
    question = paxini_high_speed.version_request()
    reply = await link.request(0, question, _VERSION_OF_HIGH_SPEED, timeout_s=_TIMEOUT_S, tries=_TRIES)
    return reply.payload[3:].rstrip(b"\0 ").decode("ascii", "replace")
