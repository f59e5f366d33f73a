"""ROBOSKIN / iCub skin: MTB3 and MTB4 boards on CAN, sixteen modules of twelve channels each, and inertial sensors.

``roboskin_layout`` has the options and frames, ``roboskin_setup`` the messages to the boards, their addresses and
firmware. Further sources: robotology/icub-main CanBusSkin.cpp; robotology/icub-firmware
embot_app_application_theSkin.cpp.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError, HandshakeTimeout
from skinware.sensor_types import SensorType
from skinware.status import Status
from skinware_drivers import Link, Module, Patch, Watch, operation
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.roboskin_layout import (
    FIRST_BOARD,
    HEAD_BYTE,
    INERTIAL,
    LAST_BOARD,
    NON_TACTILE,
    OLD_SKIN,
    SKIN,
    SKIN_TYPES,
    TAIL_BYTE,
    TRIANGLES,
    RoboskinOptions,
    board_of,
    inertial_patch,
    is_inertial,
    make_layout,
    make_types,
    runs_text,
    skin_patch,
    triangle_module,
    usual_kind,
)
from skinware_drivers.can.roboskin_setup import (
    BOARD_TYPES,
    MTB3_TYPE,
    START,
    STOP,
    BoardOperations,
    BoardSetUp,
    discover,
    read_version,
    warn_of_full_bus,
    warn_of_uneven_triangles,
)
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.link import Heard

_AFTER_CONFIGURATION_S = 0.5
_BETWEEN_SPECIALS_S = 0.01
_OLD_CALIBRATION_PERIODS = 4
"""Periods after the old set-up in which an MTB3 sends nothing, at most."""


class RoboskinDriver(BoardOperations, CanAdapter[RoboskinOptions]):
    """MTB3 and MTB4 boards, a patch each; uid = board << 16 | triangle << 8 | channel.

    Channels that do not measure touch (thermal pads) are of type temperature. Triangles that the configuration leaves
    switched off are not part of the structure.
    """

    types: Sequence[SensorType] = SKIN_TYPES
    dtype: npt.DTypeLike = np.uint8

    def __init__(self, options: RoboskinOptions) -> None:
        super().__init__(options)
        self._boards: tuple[int, ...] = options.boards
        self._board_type: dict[int, int] = {}
        self._disabled: set[int] = set()  # patch keys
        self._has_warned = False
        self.types = make_types(options)
        if options.all_inertial:
            self.dtype = np.int16
        self._fit_boards()
        if options.boards and not any(self.patches_set_up(options.boards)):
            raise ConfigurationError(
                f"boards {', '.join(map(str, options.boards))}: the configuration leaves all triangles switched off"
            )

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        return BaselineWatch(tables)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Return the boards that were named, or all that answer; a listener learns them from their data.

        Discovery (identifier 70F) silences an MTB3 that is sending, so it is only used before any board is started.
        """
        if link.listen_only:
            return self.patches_heard(await link.listen(self.options.learn_s), ())
        if self.options.boards:
            await self._ask_named(link)
        else:
            known = self._board_type
            found = [b for b in await discover(link) if not b.is_loader and FIRST_BOARD <= b.address <= LAST_BOARD]
            self._board_type = {board.address: board.board_type for board in found}
            self._boards = tuple(board for board, its_type in self._board_type.items() if its_type in BOARD_TYPES)
            for board in sorted(self._board_type.keys() - set(self._boards) - known.keys()):
                link.log.warning(  # START makes a strain board send
                    "board %d is of type %d, which is not known to have skin: left alone; if it has, name it in boards",
                    board,
                    self._board_type[board],
                )
        if not self._has_warned:
            set_ups = self._set_ups(self._boards)
            for set_up in set_ups:
                self._warn(link, set_up)
            warn_of_full_bus(link.bus_name, set_ups)
            warn_of_uneven_triangles(link.bus_name, set_ups)
        self._has_warned = bool(self._boards)
        self._fit_boards()
        return self.patches_set_up(self._boards)

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        """Add the boards that a listener hears now; a driver that sends must be started again to find new boards."""
        if not link.listen_only:
            return known
        return self.patches_heard(await link.listen(self.options.learn_s), known)

    async def configure(self, link: Link) -> None:
        """Set all boards up, in the order and with the waits of CanBusSkin.cpp."""
        await self._configure(link, self._boards)

    async def start(self, link: Link) -> None:
        if not self.options.old_style:
            for board in self._boards:
                await link.send(0x200 | board, START)
        for set_up in self._set_ups(self._boards):
            await _send(link, set_up.board, set_up.inertial_start())

    async def stop(self, link: Link) -> None:
        for board in self._boards:
            await link.send(0x200 | board, STOP)
        for set_up in self._set_ups(self._boards):
            await _send(link, set_up.board, set_up.inertial_stop())

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Ask for the version: a silent board that answers has restarted, unless it was switched off."""
        if patch.key in self._disabled:
            return False
        await read_version(link, board_of(patch))
        return True

    async def revive(self, link: Link, patch: Patch) -> None:
        """Set up and start one board (command 50 re-baselines every triangle that it reaches)."""
        if not is_inertial(patch) and not self.options.old_style:
            await self._configure(link, (board_of(patch),), inertial=False)
        await self._switch(link, patch, True)

    @operation(sets_up=True)
    async def rebaseline(self, link: Link, patches: Sequence[Patch]) -> None:
        """Make the boards take the present load as no load; do not touch the skin for about a second."""
        skin = [patch for patch in patches if not is_inertial(patch)]
        await self._configure(link, [board_of(patch) for patch in skin], inertial=False)
        for patch in skin:
            is_on = patch.key not in self._disabled
            if is_on != self.options.old_style:  # the old set-up starts a board, the new one leaves it silent
                await self._switch(link, patch, is_on)

    @operation(sets_up=True)
    async def rate(self, link: Link, patches: Sequence[Patch], hz: float) -> float:
        """Change how often all boards of the bus send, 3.93 to 1000 times a second; the baseline moves with it."""
        period_ms = round(1e3 / hz) if hz > 0 else 0
        if not 1 <= period_ms <= 255:
            raise ConfigurationError(f"{hz:g} Hz: boards send every 1 to 255 ms, so give 3.93 to 1000 Hz")
        if {p.key for p in patches} != {p.key for p in self.patches_set_up(self._boards)}:
            raise ConfigurationError("all boards of a bus have one rate: do not name a patch")
        fixed = [board for board in self._boards if self.options.old_style and self._is_mtb4(board)]
        if fixed:
            raise ConfigurationError(f"board {fixed[0]} is an MTB4: configured the old way, it sends every 40 ms")
        special = tuple(
            s if s.period_ms is None else msgspec.structs.replace(s, period_ms=period_ms)
            for s in self.options.special_boards
        )
        self.options = msgspec.structs.replace(self.options, period_ms=period_ms, special_boards=special)
        self._fit_boards()
        await self.rebaseline(link, patches)
        return 1e3 / period_ms

    @operation()
    async def enable(self, link: Link, patches: Sequence[Patch], on: bool = True) -> None:
        """Make boards send (on=true) or be silent (on=false)."""
        for patch in patches:
            await self._switch(link, patch, on)
            (self._disabled.discard if on else self._disabled.add)(patch.key)

    def _set_ups(self, boards: Iterable[int]) -> list[BoardSetUp]:
        return [BoardSetUp(self.options, board, is_mtb4=self._is_mtb4(board)) for board in boards]

    def _is_mtb4(self, board: int) -> bool:
        return self._board_type.get(board, MTB3_TYPE if self.options.old_style else 0) != MTB3_TYPE

    def _fit_boards(self) -> None:
        boards = self._boards or range(FIRST_BOARD, LAST_BOARD + 1)
        periods_ms = [set_up.period_ms for set_up in self._set_ups(boards)]
        self.layout = make_layout(self.options, min(periods_ms) / 1e3)
        self.period_s = max(*periods_ms, self.options.inertial_period_ms if self.options.all_inertial else 0) / 1e3

    async def _configure(self, link: Link, boards: Iterable[int], *, inertial: bool = True) -> None:
        set_ups = self._set_ups(boards)
        for number in range(2):
            for set_up in set_ups:
                await _send(link, set_up.board, set_up.first[number : number + 1])
        if self.options.old_style:
            await link.sleep(_OLD_CALIBRATION_PERIODS * self.period_s)
        else:
            await link.sleep(_AFTER_CONFIGURATION_S)
            if any(set_up.special_board for set_up in set_ups):
                for set_up in set_ups:
                    await _send(link, set_up.board, set_up.special_board)
                await link.sleep(_BETWEEN_SPECIALS_S)
            for set_up in set_ups:
                await _send(link, set_up.board, set_up.special_triangles)
            await link.sleep(_BETWEEN_SPECIALS_S)
        if inertial:
            for set_up in set_ups:
                await _send(link, set_up.board, set_up.inertial_set_up())

    async def _switch(self, link: Link, patch: Patch, on: bool) -> None:
        (set_up,) = self._set_ups([board_of(patch)])
        if is_inertial(patch):
            await _send(link, set_up.board, set_up.inertial_set_up() if on else ())
            await _send(link, set_up.board, set_up.inertial_start() if on else set_up.inertial_stop())
        elif on and self.options.old_style:
            await self._configure(link, [set_up.board], inertial=False)
        else:
            await _send(link, set_up.board, [START if on else STOP])

    async def _ask_named(self, link: Link) -> None:
        """Learn the types of the named boards; at least one must answer."""
        answers = await asyncio.gather(*(read_version(link, board) for board in self._boards), return_exceptions=True)
        missing = []
        for board, answer in zip(self._boards, answers, strict=True):
            if isinstance(answer, HandshakeTimeout):
                missing.append(board)
            elif isinstance(answer, BaseException):
                raise answer
            elif len(answer) > 1:
                self._board_type[board] = answer[1]
        if len(missing) == len(self._boards):
            raise HandshakeTimeout(f"none of the boards {', '.join(map(str, self._boards))} answers")

    def _warn(self, link: Link, set_up: BoardSetUp) -> None:
        """Log triangles that are off, and inertial sensors of another kind than the options say."""
        off = set(range(TRIANGLES)) - set_up.enabled
        if set_up.wiped:
            link.log.warning(
                "board %d: triangles %s are off: its special configuration switched them off,"
                " and nothing switches them on again",
                set_up.board,
                runs_text(set_up.wiped),
            )
        if off - set_up.wiped:
            link.log.info("board %d: triangles %s are off, as configured", set_up.board, runs_text(off - set_up.wiped))
        known = self._board_type.get(set_up.board)
        kind = "mtb3" if known == MTB3_TYPE else "mtb4"
        if set_up.inertial and known is not None and kind != self.options.inertial_scale:
            link.log.warning(
                "board %d: is an %s, but its inertial data is scaled as that of an %s: set inertial_scale",
                set_up.board,
                kind.upper(),
                self.options.inertial_scale.upper(),
            )

    def patches_set_up(self, boards: Iterable[int]) -> list[Patch]:
        patches = []
        for set_up in self._set_ups(sorted(boards)):
            is_old = self.options.old_style and not self._is_mtb4(set_up.board)
            if set_up.enabled:
                modules = [self._module(set_up, triangle) for triangle in sorted(set_up.enabled)]
                patches.append(skin_patch(set_up.board, modules, OLD_SKIN if is_old else SKIN))
            if set_up.inertial:
                patches.append(inertial_patch(set_up.board, set_up.inertial))
        return patches

    def patches_heard(self, heard: Counter[Heard], known: Sequence[Patch]) -> list[Patch]:
        """Return the patches of known boards and of those whose frames were heard."""
        skin: dict[tuple[int, int], set[int]] = {
            (board_of(p), p.key >> 4): {m.key for m in p.modules} for p in known if not is_inertial(p)
        }
        inertial = {board_of(p) for p in known if is_inertial(p)}
        classes = (OLD_SKIN, SKIN) if self.options.old_style else (SKIN,)
        for frame in heard:
            message_class, board = frame.identifier >> 8, frame.identifier >> 4 & 0xF
            if not FIRST_BOARD <= board <= LAST_BOARD:
                continue
            if message_class in classes and frame.first_byte in (HEAD_BYTE, TAIL_BYTE) and frame.length in (6, 8):
                skin.setdefault((board, message_class), set()).add(frame.identifier & 0xF)
            elif message_class == INERTIAL:
                inertial.add(board)
        patches = []
        for set_up in self._set_ups(sorted({board for board, _ in skin} | inertial)):
            # a board sends one class; frames of strain boards can look like skin in the other
            message_class = SKIN if (set_up.board, SKIN) in skin else OLD_SKIN
            if triangles := skin.get((set_up.board, message_class)):
                modules = [self._module(set_up, triangle) for triangle in sorted(triangles)]
                patches.append(skin_patch(set_up.board, modules, message_class))
            if set_up.board in inertial and set_up.inertial:
                patches.append(inertial_patch(set_up.board, set_up.inertial))
        return patches

    def _module(self, set_up: BoardSetUp, triangle: int) -> Module:
        options = self.options
        kind = options.kind or usual_kind(set_up.skin_type, triangle)
        thermal = NON_TACTILE[kind]
        for special in options.modules:
            if special.board != set_up.board or triangle not in special.triangles:
                continue
            if special.kind or special.thermal is not None:
                kind = special.kind or kind
                thermal = NON_TACTILE[kind] if special.thermal is None else special.thermal
        return triangle_module(set_up.board, triangle, kind, thermal)


async def _send(link: Link, board: int, messages: Iterable[bytes]) -> None:
    for message in messages:
        await link.send(0x200 | board, message)


_RECALIBRATION_CYCLES = 5
_ZERO, _ALL = 1, (1 << _RECALIBRATION_CYCLES) - 1


class BaselineWatch(Watch):
    """Marks boards that may have moved their baseline.

    A board moves its baseline after five cycles in which a channel did not acknowledge, and the flag of the channel
    goes away. Until it is set up again, its values are measured from an unknown baseline.

    The count of a board is not always known: a board that was set up again does not say whether it had restarted. So
    all possible counts are followed, as bits, and a board that may have reached the fifth is marked.
    """

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self._counts: npt.NDArray[np.int64] = np.full(tables.structure.n_patches, _ZERO)  # bit k: it may be at k

    def look(self, updates: Updates) -> None:
        """Count the cycles without acknowledgement of each board; see :class:`skinware_drivers.polling.Watch`."""
        status = updates.status[:, 0]  # these flags are those of all sensors of a triangle
        silent = (status & (Status.NO_ACK | Status.NOT_CONNECTED)) == Status.NO_ACK
        if not silent.any():
            return
        module_patch = self.tables.structure.module_patch
        cycles = np.bincount(module_patch[updates.module[silent]], minlength=len(self._counts))
        moved = (self._counts << np.minimum(cycles, _RECALIBRATION_CYCLES)) > _ALL
        turned = self._counts << cycles % _RECALIBRATION_CYCLES
        self._counts = (turned | turned >> _RECALIBRATION_CYCLES | moved * _ZERO) & _ALL
        self.module_status[moved[module_patch]] |= np.uint8(Status.SUSPECT)

    def forget(self, patch: int) -> None:
        """Trust a board that was set up again: its baseline is known. It goes on counting, unless it had restarted."""
        super().forget(patch)
        self._counts[patch] |= _ZERO
