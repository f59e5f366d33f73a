"""An emulated ROBOSKIN: MTB3 and MTB4 patch controllers on one CAN wire, obeying the real commands.

The boards are silent until a host starts them (or the option ``streaming`` says that one did). What each kind of
board does is in :mod:`.mtb3` and :mod:`.mtb4`, what it computes in :mod:`.firmware`, what it feels in
:mod:`.touch` and :mod:`.pressed`, what goes wrong in :mod:`.faults`, and what is written down about it in
:mod:`skinware_drivers.virtual.events`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from skinware.errors import ConfigurationError
from skinware_drivers.virtual import events
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.roboskin.options import RoboskinOptions
from skinware_drivers.virtual.stage import Actor, Stage

if TYPE_CHECKING:  # what needs numpy is imported when the boards are made: commands show these options fast
    from skinware.geometry import Geometry
    from skinware_drivers.virtual.hardware import Point, Pressing
    from skinware_drivers.virtual.roboskin.boards import Board
    from skinware_drivers.virtual.roboskin.faults import TriangleState
    from skinware_drivers.virtual.roboskin.touch import WireSource

_CONFIGURED = (bytes.fromhex("4D0032F0"), bytes.fromhex("50000F02010022"), bytes.fromhex("0700"))
"""What a host sends to a board: type 0, 50 ms, no load 240; all triangles, shift 2, offset 0x2200; start."""
_COUNTED = ("lost_halves", "wrong_lengths", "foreign", "recalibrations")


class EmulatedRoboskin(Stage):
    """Emulated boards on one bus; see :class:`skinware_drivers.virtual.hardware.EmulatedHardware`.

    Args:
        options: which boards, and what is wrong with them.
        log: takes the :mod:`skinware_drivers.virtual.events`; a list will do.
        source: called for every triangle of every burst as ``source(board, triangle, cycle, time_ns)``; the 12
            values 0-255 that it returns go on the wire instead of what the pattern feels. Flags stay true.
    """

    Options: ClassVar[type[RoboskinOptions]] = RoboskinOptions

    def __init__(
        self, options: RoboskinOptions, *, log: EventLog | None = None, source: WireSource | None = None
    ) -> None:
        from skinware_drivers.virtual.roboskin.pressed import PressedSkin

        super().__init__(log, _COUNTED)
        self._options = options
        self._source = source
        self._boards: list[Board] = []
        self._skin = PressedSkin(options)

    def geometry(self) -> Geometry:
        """Where the sensors are: the boards cover a forearm and a hand."""
        return self._skin.geometry()

    def pressing(self, now_ns: int) -> list[tuple[Point, float]]:
        """What presses the boards: where, m, and with how many newtons."""
        return self._skin.pressing(self.run_to(now_ns))

    def press(self, press: Pressing, now_ns: int) -> dict[str, object]:
        """Press somewhere from now on, beside the wandering fingers of the option ``pattern``.

        Raises:
            ValueError: nothing of the skin would feel it, or too many presses have not ended yet.
        """
        return self._skin.press(press, self.run_to(now_ns))

    def kind_of(self, identifier: int, payload: bytes) -> str:
        """Name the halves of a triangle by identifier and half: ``0x470-head``; other frames by identifier."""
        from skinware_drivers.virtual.roboskin.boards import DATA, INERTIAL

        name = super().kind_of(identifier, payload)
        if identifier >> 8 == INERTIAL:
            return name
        if identifier >> 8 in (DATA, self._options.tail_class) and payload:
            return f"{name}-{'tail' if payload[0] & 0x80 else 'head'}"
        return name

    def kinds(self) -> Sequence[str]:
        from skinware_drivers.virtual.roboskin.boards import DATA, INERTIAL
        from skinware_drivers.virtual.roboskin.firmware import TRIANGLES

        found = []
        for board in self._options.boards:
            for triangle in range(TRIANGLES):
                low = board << 4 | triangle
                found.append(self.kind_of(DATA << 8 | low, b"\x40"))
                found.append(self.kind_of(self._options.tail_class << 8 | low, b"\xc0"))
            found += [self.kind_of(INERTIAL << 8 | board << 4 | sensor, b"") for sensor in (0, 1, 3)]
        return found

    def hear(self, identifier: int, payload: bytes, now_ns: int) -> list[int]:
        """Let all boards hear a command; those that obeyed or answered, by the address they had before."""
        if not payload:
            return []
        addresses = [board.address for board in self._boards]
        obeyed = [board.receive(identifier, payload, now_ns) for board in self._boards]
        return [address for address, did in zip(addresses, obeyed, strict=True) if did]

    # Faults at a moment of the caller's choice

    def kill(self, address: int, now_ns: int) -> None:
        """Make a board fall silent for good; what it had waiting for the wire is lost."""
        now_ns = self.run_to(now_ns)
        self._board(address).die(now_ns)
        self.find_next_event()

    def restart(self, address: int, now_ns: int) -> None:
        """Cut a board's power for a moment (a dead one lives again): silent, configuration lost, deaf for a while."""
        now_ns = self.run_to(now_ns)
        self._board(address).restart(now_ns, round(self._options.boot_s * 1e9))
        self.find_next_event()

    def unplug(self, address: int, triangle: int, now_ns: int) -> None:
        """Pull a triangle's plug: from its next burst on it reads full pressure and is flagged."""
        self._set_triangle(address, triangle, "unplugged", now_ns)

    def plug_in(self, address: int, triangle: int, now_ns: int) -> None:
        self._set_triangle(address, triangle, "plugged_in", now_ns)

    def acknowledge(self, address: int, triangle: int, now_ns: int, *, on: bool) -> None:
        """Let a triangle's converter stop (``on=False``) or begin again to acknowledge on its I2C line."""
        self._set_triangle(address, triangle, "ack" if on else "no_ack", now_ns)

    # Within

    def _set_triangle(self, address: int, triangle: int, fault: TriangleState, now_ns: int) -> None:
        now_ns = self.run_to(now_ns)
        self._board(address).set_triangle(triangle, fault, now_ns)

    def _board(self, address: int) -> Board:
        for board in self._boards:
            if board.address == address:
                return board
        raise ConfigurationError(f"there is no emulated board {address}")

    def power_up(self, now_ns: int) -> Sequence[Actor]:
        """Make the boards and whatever else is on the bus."""
        from skinware_drivers.virtual.roboskin.patch import make_boards, make_foreign_traffic

        options = self._options
        self._skin.begin(now_ns)
        self._boards = make_boards(options, self.wire, self.log, self.counts, self._source, self._skin, now_ns)
        for address, triangle, taxel in options.places("out_of_range", 3):
            self.log.append(events.TaxelOutOfRange(time_ns=now_ns, board=address, triangle=triangle, taxel=taxel))
        for board in self._boards:
            if options.streaming:
                for command in _CONFIGURED:
                    board.receive(0x200 | board.address, command, now_ns)
            if board.address in options.dead and options.dead_after_cycles is None:
                self.schedule(now_ns + round(options.dead_after_s * 1e9), board.die)
            if board.address in options.restart:
                restart = partial(board.restart, boot_ns=round(options.boot_s * 1e9))
                self.schedule(now_ns + round(options.restart_after_s * 1e9), restart)
        self.plan_silence(options.silence, self.kinds(), options.silence_after_s, now_ns)
        return [*self._boards, *make_foreign_traffic(options, self.wire, self.log, self.counts, now_ns)]
