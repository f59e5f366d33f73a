"""An emulated patch controller: what both kinds of MTB have in common. The kinds differ in what commands do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from skinware_drivers.virtual import events
from skinware_drivers.virtual.hardware import EventLog
from skinware_drivers.virtual.roboskin.converters import Acquisition, Converters
from skinware_drivers.virtual.roboskin.faults import BoardFaults, Fate, TriangleState
from skinware_drivers.virtual.roboskin.firmware import TRIANGLES
from skinware_drivers.virtual.roboskin.inertial import InertialSensors, Units
from skinware_drivers.virtual.roboskin.touch import Touch, WireSource
from skinware_drivers.virtual.wire import Transmission, Transmitter

POLLING, OLD_DATA, DATA, INERTIAL, BOOTLOADER = 2, 3, 4, 5, 7
"""Message classes (icub-firmware-shared:can/canProtocolLib/iCubCanProto_classes.h)."""
EVERY_BOARD = 15
"""The destination that all boards hear (icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can.cpp)."""
LONGEST_QUEUE = 48
"""Frames a board can have waiting (icub-firmware:emBODY/eBcode/arch-arm/board/mtb4/application/src/main-appcan.cpp)."""

_REPLY_NS = 200_000
_NO_ACKS_TO_RECALIBRATE = 5


@dataclass
class BoardParts:
    """What a board is made of and connected to.

    Attributes:
        touch: what its skin feels.
        transmitter: its place on the wire.
        faults: what is wrong with it.
        log: takes its events.
        counts: totals that all boards of the patch share.
        phase: 0-1, where in its period a started board sends its first burst.
        source: values for the wire instead of what is felt.
        short_tail: the second frame has no diagnostics.
        tail_class: message class of the second frame.
    """

    touch: Touch
    transmitter: Transmitter
    faults: BoardFaults
    log: EventLog
    counts: dict[str, int]
    phase: float
    source: WireSource | None
    short_tail: bool
    tail_class: int


class Board(ABC):
    """One board, powered up at ``now_ns``.

    Defaults: icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theSkin.cpp, ``setdefault`` and
    ``TriangleCfg``. Silent until told to transmit.

    Attributes:
        address: on the bus; commands can change it.
        cycle: bursts sent since the first power-up; the number of the next one.
        next_burst_ns: None while the board does not stream.
        alive: False once it died.
    """

    is_mtb3: ClassVar[bool]
    board_type: ClassVar[int]
    firmware: ClassVar[tuple[int, int, int]]
    protocol: ClassVar[tuple[int, int]]
    units: ClassVar[Units]

    def __init__(self, address: int, parts: BoardParts, now_ns: int) -> None:
        self.address: int = address
        self.parts = parts
        self.alive: bool = True
        self.cycle: int = 0
        self._identifiers_for: tuple[object, list[int]] = None, []
        self._power_up(now_ns)

    def _power_up(self, ready_ns: int) -> None:
        self._ready_ns = ready_ns
        self.parts.touch.stream_from(None)
        self.next_burst_ns: int | None = None
        self.inertial: InertialSensors = InertialSensors(self.units)
        self._data_class = DATA
        self._no_acks = 0
        self._recalibration_due = False
        self._converters = Converters(
            self.parts.touch, self.parts.faults, mtb3=self.is_mtb3, short_tail=self.parts.short_tail
        )
        self._active = np.ones(TRIANGLES, np.bool_)
        self._period_ns = 50_000_000

    # What others do to the board

    @abstractmethod
    def receive(self, identifier: int, payload: bytes, now_ns: int) -> bool:
        """Take a frame from the bus.

        Returns:
            Whether the board obeyed or answered it. Nothing is ever acknowledged.
        """

    def hears(self, now_ns: int) -> bool:
        return self.alive and now_ns >= self._ready_ns

    def die(self, now_ns: int, reason: Literal["died", "restarted"] = "died") -> None:
        """Lose power: no reaction to anything, and what waits for the wire is gone."""
        self.alive = False
        self.parts.faults.last_cycle = None
        self.next_burst_ns = None
        self.inertial.stop()
        for transmission in self.parts.transmitter.queue:
            for triangle, half in transmission.unsent_halves():
                self._log_lost(now_ns, triangle, transmission.cycle, half, reason)
        self.parts.transmitter.queue.clear()
        if reason == "died":
            self.parts.log.append(events.BoardDied(time_ns=now_ns, board=self.address))

    def restart(self, now_ns: int, boot_ns: int) -> None:
        """Lose power for a moment: configuration gone, silent, deaf for ``boot_ns``."""
        self.die(now_ns, "restarted")
        self.alive = True
        ready_ns = now_ns + boot_ns
        self.parts.log.append(events.BoardRestarted(time_ns=now_ns, board=self.address, ready_ns=ready_ns))
        self._power_up(ready_ns)

    def set_triangle(self, triangle: int, fault: TriangleState, now_ns: int) -> None:
        """Break or mend a triangle, from the next burst on."""
        self.parts.faults.set_triangle(triangle, fault)
        self._log_triangle(now_ns, triangle, fault)

    def skip_to(self, now_ns: int) -> int:
        """Leave out what is due before ``now_ns``; cycles go on.

        Returns:
            The number of frames left out.
        """
        skipped = self.inertial.skip_to(now_ns)
        if self.next_burst_ns is not None and self.next_burst_ns < now_ns:
            bursts = -((self.next_burst_ns - now_ns) // self._period_ns)
            self.next_burst_ns += bursts * self._period_ns
            if self._active.any():
                self.cycle += bursts
                self.parts.counts["bursts"] += bursts
                skipped += bursts * 2 * int(self._active.sum())
        return skipped

    # What the board does by itself

    def next_event_ns(self) -> int | None:
        inertial_ns = self.inertial.next_ns
        if self.next_burst_ns is None or inertial_ns is None:
            return self.next_burst_ns if inertial_ns is None else inertial_ns
        return min(self.next_burst_ns, inertial_ns)

    def run(self, now_ns: int) -> None:
        inertial_ns = self.inertial.next_ns
        if inertial_ns is not None and inertial_ns <= now_ns:
            for low, payload in self.inertial.take():
                self._send(inertial_ns, INERTIAL, low, payload)
        if self.next_burst_ns is not None and self.next_burst_ns <= now_ns:
            time_ns = self.next_burst_ns
            self.next_burst_ns = time_ns + self._period_ns
            faults = self.parts.faults
            if faults.last_cycle is not None and self.cycle >= faults.last_cycle:
                self.die(time_ns)
            elif self._active.any():
                self._burst(time_ns)

    def _burst(self, time_ns: int) -> None:
        for trigger in self.parts.faults.triangles_breaking(self.cycle):
            self._log_triangle(time_ns, trigger.triangle, trigger.fault)
        if self._recalibration_due:
            self._recalibration_due = False
            if not self._recalibrate_by_itself(time_ns):
                return
        acquired = self._acquire(time_ns)
        no_acks = self._no_acks + int((acquired.no_ack & self._active).sum())
        self._recalibration_due = no_acks >= _NO_ACKS_TO_RECALIBRATE
        self._no_acks = no_acks % _NO_ACKS_TO_RECALIBRATE
        self._queue_burst(time_ns, acquired.payloads)
        self.cycle += 1
        self.parts.counts["bursts"] += 1

    @abstractmethod
    def _recalibrate_by_itself(self, time_ns: int) -> bool:
        """Take new baselines because converters did not acknowledge; tell whether this burst is sent at all."""

    def _calibrate(self, time_ns: int, reason: Literal["power_up", "command", "no_ack"]) -> None:
        """Take what is read at ``time_ns`` as the new baseline of all triangles."""
        self._converters.calibrate(time_ns, self.cycle)
        self.parts.counts["recalibrations"] += 1
        self.parts.log.append(events.Recalibrated(time_ns=time_ns, board=self.address, cycle=self.cycle, reason=reason))

    def _acquire(self, time_ns: int) -> Acquisition:
        source = self.parts.source
        if source is None:
            return self._converters.acquire(time_ns, self.cycle, self._period_ns)
        values = {
            triangle: source(self.address, triangle, self.cycle, time_ns)
            for triangle in np.flatnonzero(self._active).tolist()
        }
        return self._converters.acquire_values(time_ns, self.cycle, values)

    def _queue_burst(self, time_ns: int, payloads: list[bytes]) -> None:
        """Hand the frames of all active triangles to the wire, back to back; faults happen here."""
        parts = self.parts
        delay_ns = parts.faults.delay_ns()
        if delay_ns:
            parts.log.append(
                events.BurstDelayed(time_ns=time_ns, board=self.address, cycle=self.cycle, delay_ns=delay_ns)
            )
        identifiers = self._identifiers()
        if len(identifiers) < len(payloads):
            payloads = [payloads[2 * (identifier & 0xF) + at % 2] for at, identifier in enumerate(identifiers)]
        usual = not parts.short_tail
        burst = Transmission(time_ns + delay_ns, identifiers, payloads, usual=usual, cycle=self.cycle)
        fates = parts.faults.fates(len(identifiers))
        if fates:
            self._spoil(time_ns, burst, fates)
        room = max(0, LONGEST_QUEUE - len(parts.transmitter))
        if room < len(burst):
            rest = Transmission(burst.ready_ns, identifiers, payloads, burst.lost, cycle=self.cycle, sent=room)
            for triangle, half in rest.unsent_halves():
                self._log_lost(time_ns, triangle, self.cycle, half, "overflow")
            burst.identifiers, burst.payloads = burst.identifiers[:room], burst.payloads[:room]
        if burst:
            parts.transmitter.queue.append(burst)

    def _identifiers(self) -> list[int]:
        head = self._data_class << 8 | self.address << 4
        tail = head if self.parts.tail_class == DATA else self.parts.tail_class << 8 | self.address << 4
        key = (head, tail, self._active.tobytes())
        if self._identifiers_for[0] != key:
            active = np.flatnonzero(self._active).tolist()
            self._identifiers_for = key, [half | triangle for triangle in active for half in (head, tail)]
        return self._identifiers_for[1]

    def _spoil(self, time_ns: int, burst: Transmission, fates: dict[int, Fate]) -> None:
        """Lose and damage some of a burst's frames."""
        burst.lost = {position for position, fate in fates.items() if fate.length is None}
        burst.payloads = payloads = list(burst.payloads)
        for position, fate in sorted(fates.items()):
            triangle = burst.identifiers[position] & 0xF
            half: events.Half = "tail" if position % 2 else "head"
            if fate.length is None:
                self._log_lost(time_ns, triangle, self.cycle, half, "random")
                continue
            payloads[position] = payloads[position][: fate.length].ljust(fate.length, b"\0")
            burst.usual = False
            self.parts.counts["wrong_lengths"] += 1
            self.parts.log.append(
                events.WrongLength(
                    time_ns=time_ns,
                    board=self.address,
                    triangle=triangle,
                    cycle=self.cycle,
                    half=half,
                    length=fate.length,
                )
            )

    # What the kinds of boards share in obeying

    def _set_triangles(self, payload: bytes) -> bool:
        """SET_TRIANG_CFG (0x50): range, shift, enable, offset. False where it is to be ignored."""
        first, last, shift, enable = payload[1:5]
        if first > last or last >= TRIANGLES:
            return False
        self._active[first : last + 1] = bool(enable & 1)
        self._converters.set_triangles(first, last, shift, payload[5] | payload[6] << 8)
        return True

    def _set_address(self, address: int) -> bool:
        """SET_BOARD_ADX (0x32). Only the addresses 1-14 are taken; a random one (0xFF) is not emulated.

        Source: icub-firmware:emBODY/eBcode/arch-arm/embot/app/embot_app_application_theCANparserBasic.cpp
        """
        if not 0 < address < EVERY_BOARD:
            return False
        self.address = address
        return True

    def _begin_bursts(self, now_ns: int) -> None:
        """Stream from here on. A period of 0 is none."""
        phase_ns = max(1, round(self.parts.phase * self._period_ns))
        self.next_burst_ns = now_ns + phase_ns if self._period_ns else None
        if not self.parts.touch.streams:
            self.parts.touch.stream_from(self.next_burst_ns)

    def _send_version(self, host: int, payload: bytes, now_ns: int) -> None:
        """GET_FW_VERSION (0x1C): compatible means the same major protocol and no older minor one.

        Source: icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can.cpp, ``Message_GET_VERSION``
        """
        major, minor = self.protocol
        compatible = major == payload[1] and minor >= payload[2]
        version = bytes([0x1C, self.board_type, *self.firmware, major, minor, compatible])
        self._send(now_ns + _REPLY_NS, POLLING, host, version)

    def _send_discovery(self, host: int, now_ns: int) -> None:
        """The answer of a running application to BROADCAST (0xFF): five bytes, a bootloader's would be four.

        Source: icub-firmware:emBODY/eBcode/arch-arm/embot/prot/can/embot_prot_can_bootloader.cpp
        """
        self._send(now_ns + _REPLY_NS, BOOTLOADER, host, bytes([0xFF, self.board_type, *self.firmware]))

    def _send(self, ready_ns: int, message_class: int, low: int, payload: bytes) -> None:
        identifier = message_class << 8 | self.address << 4 | low
        self.parts.transmitter.queue.append(Transmission(ready_ns, [identifier], [payload]))

    # Records

    def _log_triangle(self, time_ns: int, triangle: int, fault: TriangleState) -> None:
        self.parts.log.append(
            events.TriangleFault(time_ns=time_ns, board=self.address, triangle=triangle, cycle=self.cycle, fault=fault)
        )

    def _log_lost(
        self,
        time_ns: int,
        triangle: int,
        cycle: int,
        half: events.Half,
        reason: Literal["random", "overflow", "died", "restarted"],
    ) -> None:
        self.parts.counts["lost_halves"] += 1
        self.parts.log.append(
            events.LostHalf(
                time_ns=time_ns, board=self.address, triangle=triangle, cycle=cycle, half=half, reason=reason
            )
        )
