"""ROBOSKIN / iCub skin: MTB3 and MTB4 boards on CAN, sixteen modules of twelve channels each.

Wire format: robotology/icub-firmware embot_prot_can_skin_periodic.{h,cpp} and embot_app_application_theSkin.cpp;
robotology/icub-main CanBusSkin.cpp and SkinDiagnostics.h; robotology/icub-firmware-shared iCubCanProto_classes.h.

Data: class 4, identifier ``0x400 | board << 4 | triangle``, two frames a period. HEAD: ``40``, channels 0 to 6. TAIL:
``C0``, channels 7 to 11, two bytes of diagnostics (big-endian; bit 4 + k: channel k out of range, bit 0: a channel
did not acknowledge, bit 1: not connected; MTB3 sets one of the two, MTB4 may set both; old firmware sends none).
Values: uint8, lower = more pressure.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Annotated, ClassVar

import msgspec
import numpy as np

from skinware.errors import ConfigurationError, HandshakeTimeout
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.status import Status
from skinware_drivers.adapter import Watch
from skinware_drivers.can.adapter import CanAdapter
from skinware_drivers.description import Module, Patch, Sensor, SkinTables
from skinware_drivers.layout import Bits, Byte, Cycle, Flag, Frame, Identifier, Layout, Values
from skinware_drivers.link import Heard, Link, Match
from skinware_drivers.operations import operation
from skinware_drivers.skin_state import Updates

FIRST_BOARD, LAST_BOARD = 1, 14
TRIANGLES = 16
CHANNELS = 12
_NON_TACTILE = {"triangle": (6, 10), "fingertip": (), "palm": (11,)}
_TRIANGLE_SKIN_TYPES = (0, 2, 8)

_DISCOVERY_S = 0.3
_REPLY_S = 0.2
_AFTER_CONFIGURATION_S = 0.5
_RECALIBRATION_CYCLES = 5
"""A board re-calibrates all its triangles after this many cycles with a channel that does not acknowledge though it
is connected (embot_app_application_theSkin.cpp)."""

_BOARD = Bits(shift=4, width=4)
_MODULE = Bits(shift=0, width=4)
HEAD = Frame(
    "head",
    when=(Identifier(0x400, mask=0x700), Byte(0, 0x40)),
    length=(8,),
    patch=_BOARD,
    module=_MODULE,
    values=Values(offset=1, dtype="u1", count=7, to=range(7)),
)
TAIL = Frame(
    "tail",
    when=(Identifier(0x400, mask=0x700), Byte(0, 0xC0)),
    length=(6, 8),
    patch=_BOARD,
    module=_MODULE,
    values=Values(offset=1, dtype="u1", count=5, to=range(7, 12)),
    flags=(
        Flag(Status.OUT_OF_RANGE, offset=6, dtype=">u2", each=[(k, 4 + k) for k in range(CHANNELS)]),
        Flag(Status.NO_ACK, offset=6, dtype=">u2", mask=0x1),
        Flag(Status.NOT_CONNECTED, offset=6, dtype=">u2", mask=0x2),
    ),
)


class Kind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a range of triangles of a board is.

    Attributes:
        board: address.
        triangles: which of its triangles.
        kind: ``triangle``, ``fingertip`` or ``palm``.
        thermal: channels that are not tactile, if others than the kind's own.
        enabled: False: switched off in the board.
        shift: resolution of the board's arithmetic (SET_TRIANG_CFG).
        cdc_offset: offset register of the capacitance converter (SET_TRIANG_CFG).
    """

    board: int
    triangles: tuple[int, ...]
    kind: str = "triangle"
    thermal: tuple[int, ...] | None = None
    enabled: bool = True
    shift: int | None = None
    cdc_offset: int | None = None


class RoboskinOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver, for every board of a bus."""

    boards: Annotated[
        tuple[int, ...], msgspec.Meta(description="addresses of the boards, 1-14; default: whoever answers")
    ] = ()
    period_ms: Annotated[int, msgspec.Meta(description="time between two updates, 1-255 ms", ge=1, le=255)] = 50
    skin_type: Annotated[
        int, msgspec.Meta(description="type of skin that the boards are told: 0, 1, 2, 3, 7 or 8", ge=0, le=15)
    ] = 0
    no_load: Annotated[int, msgspec.Meta(description="value of an idle taxel", ge=0, le=255)] = 0xF0
    shift: Annotated[int, msgspec.Meta(description="resolution shift of the boards", ge=0, le=255)] = 2
    cdc_offset: Annotated[int, msgspec.Meta(description="converter offset register", ge=0, le=0xFFFF)] = 0x2200
    kind: Annotated[
        str, msgspec.Meta(description="what all modules are: triangle, fingertip or palm; default: by skin type")
    ] = ""
    learn_s: Annotated[float, msgspec.Meta(description="how long a listener learns what is there, s", gt=0)] = 1.0
    modules: Annotated[
        tuple[Kind, ...], msgspec.Meta(description="ranges of triangles that differ (configuration file only)")
    ] = ()

    def __post_init__(self) -> None:
        for board in (*self.boards, *(m.board for m in self.modules)):
            if not FIRST_BOARD <= board <= LAST_BOARD:
                raise ConfigurationError(
                    f"board address {board}: boards have {FIRST_BOARD} to {LAST_BOARD} (0 is the host, 15 everybody)"
                )
        if len(set(self.boards)) < len(self.boards):
            raise ConfigurationError(f"boards {self.boards}: one address is there twice")
        for kind in (self.kind, *(m.kind for m in self.modules)):
            if kind and kind not in _NON_TACTILE:
                raise ConfigurationError(f"kind {kind!r}: choose one of {', '.join(_NON_TACTILE)}")
        for module in self.modules:
            if any(not 0 <= t < TRIANGLES for t in module.triangles):
                raise ConfigurationError(f"board {module.board}: triangles {module.triangles} are not all 0 to 15")


class BaselineWatch(Watch):
    """Marks boards that will have moved their baseline without a word.

    After five cycles with a channel that does not acknowledge though it is connected (several such triangles count
    together), the firmware re-calibrates every triangle of the board, and the flag goes away. What the board sends
    from then on is measured from an unknown baseline, until it is set up again.
    """

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self._not_acknowledged = np.zeros(tables.structure.n_patches, np.int64)

    def look(self, updates: Updates) -> None:
        """Count what was not acknowledged, per board; see :class:`skinware_drivers.adapter.Watch`."""
        status = updates.status[:, 0]  # these flags are of all sensors of a triangle
        silent = (status & (Status.NO_ACK | Status.NOT_CONNECTED)) == Status.NO_ACK
        if not silent.any():
            return
        module_patch = self.tables.structure.module_patch
        np.add.at(self._not_acknowledged, module_patch[updates.module[silent]], 1)
        moved = self._not_acknowledged >= _RECALIBRATION_CYCLES
        self.module_status[moved[module_patch]] |= np.uint8(Status.SUSPECT)

    def forget(self, patch: int) -> None:
        """The board was set up anew, so its baseline is known again."""
        super().forget(patch)
        self._not_acknowledged[patch] = 0


class RoboskinDriver(CanAdapter[RoboskinOptions]):
    """MTB3 and MTB4 boards. See this module's docstring for the wire, and ``RoboskinOptions`` for the options.

    Sensor uid = board << 16 | triangle << 8 | channel. Non-tactile channels (thermal pads) are of type temperature.
    """

    Options: ClassVar[type[msgspec.Struct]] = RoboskinOptions
    types = (
        PRESSURE.measured(unit="counts", scale=-1.0, offset=255.0, minimum=0.0, maximum=255.0),
        TEMPERATURE.measured(unit="counts", minimum=0.0, maximum=255.0),
    )
    dtype = np.uint8

    def __init__(self, options: RoboskinOptions) -> None:
        super().__init__(options)
        self._boards: tuple[int, ...] = options.boards
        self._disabled: set[int] = set()
        self.layout = self._layout()

    @property
    def period_s(self) -> float:
        """The boards' period."""
        return self.options.period_ms / 1e3

    async def describe(self, link: Link) -> Sequence[Patch]:
        """The boards that were named, or else those that answer; a listener learns them from their data.

        Discovery (identifier 70F) silences an MTB3 that is sending, so it is only used before anything was started.
        """
        if link.listen_only:
            return self._patches_heard(await link.listen(self.options.learn_s), ())
        if self.options.boards:
            await self._name_missing(link)
        else:
            answers = await link.collect(0x70F, b"\xff", Match(0x700, 0x70F, b"\xff"), duration_s=_DISCOVERY_S)
            # five bytes: the application answers; four: the boot loader, which has no skin
            found = {a.identifier >> 4 & 0xF for a in answers if len(a.payload) >= 5}
            self._boards = tuple(sorted(found & set(range(FIRST_BOARD, LAST_BOARD + 1))))
        return [self._patch(board, range(TRIANGLES)) for board in sorted(self._boards)]

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        """A listener adds what it hears now; a driver that sends must be started again to find new boards."""
        if not link.listen_only:
            return known
        return self._patches_heard(await link.listen(self.options.learn_s), known)

    async def configure(self, link: Link) -> None:
        """Set all boards up, in the order and with the waits of CanBusSkin.cpp."""
        await self._configure(link, self._boards)

    async def start(self, link: Link) -> None:
        """SET_TXMODE 00 to every board: start (the polarity is as odd as it looks)."""
        for board in self._boards:
            await link.send(0x200 | board, b"\x07\x00")

    async def stop(self, link: Link) -> None:
        """SET_TXMODE 01 to every board: stop."""
        for board in self._boards:
            await link.send(0x200 | board, b"\x07\x01")

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Ask for the version by unicast: a silent board that answers has restarted, if it should not be silent."""
        if patch.key in self._disabled:
            return False
        try:
            await self._version(link, patch.key)
        except HandshakeTimeout:
            return False
        return True

    async def revive(self, link: Link, patch: Patch) -> None:
        """Set up and start one board (command 50 re-baselines every triangle that it reaches)."""
        await self._configure(link, (patch.key,))
        await link.send(0x200 | patch.key, b"\x07\x00")

    @operation(sets_up=True)
    async def rebaseline(self, link: Link, patches: Sequence[Patch]) -> None:
        """Make the boards take the present load as no load; nobody may touch the skin for about a second."""
        await self._configure(link, [patch.key for patch in patches])
        await self.enable(link, [patch for patch in patches if patch.key not in self._disabled])

    @operation(sets_up=True)
    async def rate(self, link: Link, patches: Sequence[Patch], hz: float) -> float:
        """Change how often all boards of the bus send, 4 to 1000 times a second; the baseline moves with it."""
        period_ms = round(1e3 / hz) if hz > 0 else 0
        if not 1 <= period_ms <= 255:
            raise ConfigurationError(f"{hz:g} Hz: boards send every 1 to 255 ms, so give 3.93 to 1000 Hz")
        if len(patches) < len(self._boards):
            raise ConfigurationError("all boards of a bus have one rate: do not name a patch")
        self.options = msgspec.structs.replace(self.options, period_ms=period_ms)
        self.layout = self._layout()
        await self.rebaseline(link, patches)
        return 1e3 / period_ms

    @operation()
    async def enable(self, link: Link, patches: Sequence[Patch], on: bool = True) -> None:
        """Make boards send (on=true) or be silent (on=false)."""
        for patch in patches:
            await link.send(0x200 | patch.key, b"\x07\x00" if on else b"\x07\x01")
            (self._disabled.discard if on else self._disabled.add)(patch.key)

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Marks silent re-calibration."""
        return BaselineWatch(tables)

    def _layout(self) -> Layout:
        """A tail belongs to the very frame before it from the same board, within half a period, or to none."""
        pair = Cycle(("head", "tail"), within="patch", maximum_age_s=self.period_s / 2)
        return Layout(frames=(HEAD, TAIL), cycle=pair)

    async def _configure(self, link: Link, boards: Iterable[int]) -> None:
        options = self.options
        boards = tuple(boards)
        for board in boards:
            head = bytes((0x4D, options.skin_type & 0x0F, options.period_ms, options.no_load))
            await link.send(0x200 | board, head)
        for board in boards:
            await link.send(0x200 | board, _triangles(0, TRIANGLES - 1, options.shift, True, options.cdc_offset))
        await link.sleep(_AFTER_CONFIGURATION_S)
        for module in options.modules:
            if module.board not in boards:
                continue
            shift = options.shift if module.shift is None else module.shift
            offset = options.cdc_offset if module.cdc_offset is None else module.cdc_offset
            for first, last in _runs(module.triangles):
                await link.send(0x200 | module.board, _triangles(first, last, shift, module.enabled, offset))
        await link.sleep(0.01)

    async def _name_missing(self, link: Link) -> None:
        answers = await asyncio.gather(*(self._version(link, board) for board in self._boards), return_exceptions=True)
        missing = []
        for board, answer in zip(self._boards, answers, strict=True):
            if isinstance(answer, HandshakeTimeout):
                missing.append(board)
            elif isinstance(answer, BaseException):
                raise answer
        if len(missing) == len(self._boards):
            raise HandshakeTimeout(f"none of the boards {', '.join(map(str, self._boards))} answers")

    async def _version(self, link: Link, board: int) -> bytes:
        """GET_FW_VERSION by unicast (an MTB3 ignores the broadcast); eight bytes: 1C type major minor build ..."""
        reply = Match(0x200 | board << 4, 0x7FF, b"\x1c")
        return (await link.request(0x200 | board, b"\x1c\x02\x00", reply, timeout_s=_REPLY_S)).payload

    def _patches_heard(self, heard: Counter[Heard], known: Sequence[Patch]) -> list[Patch]:
        triangles: dict[int, set[int]] = {p.key: {m.key for m in p.modules} for p in known}
        for frame in heard:
            if frame.identifier & ~0xFF == 0x400 and frame.first_byte in (0x40, 0xC0) and frame.length in (6, 8):
                triangles.setdefault(frame.identifier >> 4 & 0xF, set()).add(frame.identifier & 0xF)
        boards = sorted(board for board in triangles if FIRST_BOARD <= board <= LAST_BOARD)
        return [self._patch(board, sorted(triangles[board])) for board in boards]

    def _patch(self, board: int, triangles: Iterable[int]) -> Patch:
        modules = [self._module(board, t) for t in triangles]
        return Patch(f"board {board}", [m for m in modules if m is not None], key=board)

    def _module(self, board: int, triangle: int) -> Module | None:
        options = self.options
        kind = options.kind or ("triangle" if options.skin_type in _TRIANGLE_SKIN_TYPES else "fingertip")
        thermal: Sequence[int] = _NON_TACTILE[kind]
        for special in options.modules:
            if special.board == board and triangle in special.triangles:
                if not special.enabled:
                    return None
                kind = special.kind
                thermal = _NON_TACTILE[kind] if special.thermal is None else special.thermal
        uid = board << 16 | triangle << 8
        return Module(
            [Sensor("temperature" if k in thermal else "pressure", uid | k) for k in range(CHANNELS)],
            key=triangle,
            kind=kind,
        )


def _triangles(first: int, last: int, shift: int, enabled: bool, cdc_offset: int) -> bytes:
    """SET_TRIANG_CFG: 50, first, last, shift, enable, converter offset (little-endian)."""
    return bytes((0x50, first, last, shift, enabled, cdc_offset & 0xFF, cdc_offset >> 8))


def _runs(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """First and last of every run of consecutive numbers."""
    runs: list[tuple[int, int]] = []
    for number in sorted(set(numbers)):
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return runs
