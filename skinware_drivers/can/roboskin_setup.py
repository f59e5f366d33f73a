"""The set-up of ROBOSKIN boards, and a watch for boards that may have moved their baseline."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from itertools import accumulate

import numpy as np
import numpy.typing as npt

from skinware.status import Status
from skinware_drivers.can.roboskin_options import (
    ERGO_HAND,
    TRIANGLES,
    Inertial,
    Kind,
    RoboskinOptions,
    SpecialBoards,
    runs,
)
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.polling import Watch

log: logging.Logger = logging.getLogger("skinware.driver")

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
