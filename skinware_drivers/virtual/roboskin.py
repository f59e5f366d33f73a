"""An emulated ROBOSKIN: MTB3 and MTB4 patch controllers on one CAN wire, obeying the real commands.

The boards are silent until a host starts them (or the option ``streaming`` says that one did). What each kind of
board does is in :mod:`.mtb3` and :mod:`.mtb4`, what it computes in :mod:`.firmware`, what it feels in
:mod:`.touch`, what goes wrong in :mod:`.faults`, and what is written down about it in :mod:`.events`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import msgspec

from skinware.errors import ConfigurationError
from skinware_drivers.virtual import events
from skinware_drivers.virtual.hardware import EventLog, WireFrame
from skinware_drivers.virtual.roboskin_options import RoboskinOptions
from skinware_drivers.virtual.wire import Wire

if TYPE_CHECKING:  # what needs numpy is imported when the boards are made: commands show these options fast
    from skinware_drivers.virtual.boards import Board
    from skinware_drivers.virtual.faults import TriangleState
    from skinware_drivers.virtual.foreign import ForeignTraffic
    from skinware_drivers.virtual.touch import WireSource

_CONFIGURED = (bytes.fromhex("4D0032F0"), bytes.fromhex("50000F02010022"), bytes.fromhex("0700"))
"""What a host sends to a board: type 0, 50 ms, no load 240; all triangles, shift 2, offset 0x2200; start."""
_LONGEST_CATCH_UP_NS = 1_000_000_000
"""What ``skip`` still emulates frame by frame; the time before it is jumped over."""


class _Scheduled(NamedTuple):
    time_ns: int
    action: Callable[[int], None]


class EmulatedRoboskin:
    """Emulated boards on one bus; see :class:`skinware_drivers.virtual.hardware.EmulatedHardware`.

    Args:
        options: which boards, and what is wrong with them.
        log: takes the :mod:`.events`; a list will do.
        source: called for every triangle of every burst as ``source(board, triangle, cycle, time_ns)``; the 12
            values 0-255 that it returns go on the wire instead of what the pattern feels. Flags stay true.
    """

    Options: ClassVar[type[RoboskinOptions]] = RoboskinOptions

    def __init__(
        self, options: RoboskinOptions, *, log: EventLog | None = None, source: WireSource | None = None
    ) -> None:
        self._options = options
        self._log: EventLog = _Unlogged() if log is None else log
        self._source = source
        self._wire = Wire()
        self._boards: list[Board] = []
        self._devices: list[Board | ForeignTraffic] = []
        self._scheduled: list[_Scheduled] = []
        self._now_ns: int | None = None
        self._event_ns: int | None = None
        self._counts = dict.fromkeys(
            ("frames", "bursts", "commands", "lost_halves", "wrong_lengths", "foreign", "recalibrations"), 0
        )
        self._counts["unheard"] = 0

    # EmulatedHardware

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        """Take one frame from the bus. Frames that mean nothing to the boards are ignored."""
        now_ns = self._run(now_ns)
        if not payload:
            return
        addresses = [board.address for board in self._boards]
        obeyed = [board.receive(identifier, payload, now_ns) for board in self._boards]
        self._find_next_event()
        if any(obeyed):
            self._counts["commands"] += 1
            self._log.append(
                events.CommandReceived(
                    time_ns=now_ns,
                    identifier=identifier,
                    payload=payload.hex(),
                    boards=[address for address, did in zip(addresses, obeyed, strict=True) if did],
                )
            )

    def next_due_ns(self) -> int | None:
        """When ``emit`` is worth calling again; None while all boards are silent."""
        if self._wire.heard:
            return self._wire.heard[0].time_ns
        event_ns, start_ns = self._event_ns, self._wire.next_start_ns()
        if event_ns is None or start_ns is None:
            return start_ns if event_ns is None else event_ns
        return min(event_ns, start_ns)

    def emit(self, now_ns: int) -> list[WireFrame]:
        """The frames that began by ``now_ns`` and were not given before, oldest first."""
        self._run(now_ns)
        frames, self._wire.heard = self._wire.heard, []
        self._counts["frames"] += len(frames)
        return frames

    def skip(self, now_ns: int) -> int:
        """Let the boards run on with nobody listening; returns the number of frames that went unheard."""
        unheard = 0
        if self._now_ns is not None and now_ns - self._now_ns > _LONGEST_CATCH_UP_NS:
            self._wire.run(now_ns - _LONGEST_CATCH_UP_NS)
            unheard += sum(device.skip_to(now_ns - _LONGEST_CATCH_UP_NS) for device in self._devices)
            self._find_next_event()
        self._run(now_ns)
        unheard += len(self._wire.heard)
        self._wire.heard = []
        self._counts["unheard"] += unheard
        return unheard

    def totals(self) -> dict[str, int]:
        """Exact counts since power-up.

        ``frames`` given by ``emit``; ``unheard`` frames of ``skip``; ``bursts`` of a board; ``commands`` that some
        board obeyed or answered; ``lost_halves``, ``wrong_lengths``, ``foreign`` as in the log; and
        ``recalibrations``.
        """
        return dict(self._counts)

    # Faults at a moment of the caller's choice

    def kill(self, address: int, now_ns: int) -> None:
        """Make a board fall silent for good; what it had waiting for the wire is lost."""
        now_ns = self._run(now_ns)
        self._board(address).die(now_ns)
        self._find_next_event()

    def restart(self, address: int, now_ns: int) -> None:
        """Cut a board's power for a moment (a dead one lives again): silent, configuration lost, deaf for a while."""
        now_ns = self._run(now_ns)
        self._board(address).restart(now_ns, round(self._options.boot_s * 1e9))
        self._find_next_event()

    def unplug(self, address: int, triangle: int, now_ns: int) -> None:
        """Pull a triangle's plug: from its next burst on it reads full pressure and is flagged."""
        self._set_triangle(address, triangle, "unplugged", now_ns)

    def plug_in(self, address: int, triangle: int, now_ns: int) -> None:
        """Put the plug back."""
        self._set_triangle(address, triangle, "plugged_in", now_ns)

    def acknowledge(self, address: int, triangle: int, now_ns: int, *, on: bool) -> None:
        """Let a triangle's converter stop (``on=False``) or begin again to acknowledge on its I2C line."""
        self._set_triangle(address, triangle, "ack" if on else "no_ack", now_ns)

    # Within

    def _set_triangle(self, address: int, triangle: int, fault: TriangleState, now_ns: int) -> None:
        now_ns = self._run(now_ns)
        self._board(address).set_triangle(triangle, fault, now_ns)

    def _board(self, address: int) -> Board:
        for board in self._boards:
            if board.address == address:
                return board
        raise ConfigurationError(f"there is no emulated board {address}")

    def _run(self, now_ns: int) -> int:
        """Bring everything to ``now_ns``, in order of time; returns the time that holds."""
        if self._now_ns is None:
            self._now_ns = now_ns
            self._power_up(now_ns)
            self._find_next_event()
        self._now_ns = now_ns = max(now_ns, self._now_ns)
        while True:
            event_ns = self._event_ns
            if event_ns is None or event_ns > now_ns:
                self._wire.run(now_ns + 1)
                return now_ns
            self._wire.run(event_ns)
            while self._scheduled and self._scheduled[0].time_ns <= event_ns:
                self._scheduled.pop(0).action(event_ns)
            for device in self._devices:
                device.run(event_ns)
            self._find_next_event()

    def _find_next_event(self) -> None:
        """To be called whenever a device may have changed its mind about when it has something to do."""
        times_ns = [time_ns for device in self._devices if (time_ns := device.next_event_ns()) is not None]
        if self._scheduled:
            times_ns.append(self._scheduled[0].time_ns)
        self._event_ns = min(times_ns, default=None)

    def _schedule(self, time_ns: int, action: Callable[[int], None]) -> None:
        self._scheduled.append(_Scheduled(time_ns, action))
        self._scheduled.sort(key=lambda scheduled: scheduled.time_ns)

    def _power_up(self, now_ns: int) -> None:
        from skinware_drivers.virtual.patch import make_boards, make_foreign_traffic

        options = self._options
        self._boards = make_boards(options, self._wire, self._log, self._counts, self._source, now_ns)
        self._devices = [*self._boards, *make_foreign_traffic(options, self._wire, self._log, self._counts, now_ns)]
        for address, triangle, taxel in options.places("out_of_range", 3):
            self._log.append(events.TaxelOutOfRange(time_ns=now_ns, board=address, triangle=triangle, taxel=taxel))
        for board in self._boards:
            if options.streaming:
                for command in _CONFIGURED:
                    board.receive(0x200 | board.address, command, now_ns)
            if board.address in options.dead and options.dead_after_cycles is None:
                self._schedule(now_ns + round(options.dead_after_s * 1e9), board.die)
            if board.address in options.restart:
                restart = partial(board.restart, boot_ns=round(options.boot_s * 1e9))
                self._schedule(now_ns + round(options.restart_after_s * 1e9), restart)


class _Unlogged:
    """The log of those who want none."""

    def append(self, event: msgspec.Struct) -> None:
        """Forget the event."""


__all__ = ["EmulatedRoboskin"]
