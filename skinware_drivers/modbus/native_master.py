"""Let C ask a master's questions, even while the event loop rests, as long as every reply is good and in time.

``asking.c`` does what :meth:`Master.say` and :meth:`Master.heard` do with a good reply, on the same image. C stops at a
timeout, an exception, a damaged reply or a question of the driver's own, and Python goes on from its state.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from skinware_drivers.modbus import wire
from skinware_drivers.modbus.master import Master
from skinware_drivers.modbus.registers import Read
from skinware_drivers.modbus.unanswered import SentQuestion
from skinware_drivers.modbus.wire import Message
from skinware_drivers.native import structs
from skinware_drivers.serial.checksums import CRC16_MODBUS

_MOST_BLOCKS = 32
"""Frames that end in one read: a batch has room for so many."""
_ROOM = 1024


class NativeMaster(Master):
    """A master that C can take over; see :class:`skinware_drivers.modbus.master.Master`."""

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._over_tcp = isinstance(self._line, wire.TcpMessages)
        self._arrays = structs.Arrays()
        self._buffer = np.zeros(_ROOM, np.uint8)
        rows = [self._compile(read) for read in self._schedule.reads]
        self._asker = structs.Asker(
            is_tcp=self._over_tcp,
            n_reads=len(rows),
            reads=self._arrays.structs(structs.AskedRead, rows)[1],
            most_blocks=max((row.n_blocks for row in rows), default=0),
            timeout_ns=self._timing.timeout_ns,
            turnaround_ns=self._timing.turnaround_ns,
            period_ns=self._timing.period_ns,
            buffer=self._arrays.at(self._buffer),
            crc_table=self._arrays.of(CRC16_MODBUS.table, np.uint32),
        )
        is_plain = self._image.is_plain and all(read.every == 1 for read in self._schedule.reads)
        self._can = is_plain and 0 < self._asker.most_blocks <= _MOST_BLOCKS
        self._is_stuck = False

    def say(self, time_ns: int) -> bytes:
        self._is_stuck = False
        return super().say(time_ns)

    def hand_over(self, fd: int, guests_fd: int) -> int | None:
        """Let C go on until ``take_back`` is called.

        Args:
            guests_fd: is readable when another program wants something; -1: no program can.

        Returns:
            The address of C's state; None: only Python can do what comes next.
        """
        schedule, asked = self._schedule, self.unanswered.open
        asks_otherwise = self._commands or self._again or schedule.retries or self._guests.are_waiting
        is_unusual = not self.unanswered.is_usual or (asked is not None and (asked.read < 0 or asked.tries > 1))
        if not self._can or self._is_stuck or asks_otherwise or is_unusual or self.rows or self.pending:
            return None
        asker, counters = self._asker, self._counters
        asker.fd, asker.guests_fd, asker.is_stuck, asker.size = fd, guests_fd, 0, 0
        asker.open, asker.next = -1, schedule.next
        if asked is not None:
            asker.open, asker.until_ns = asked.read, asked.until_ns
            if self._over_tcp:
                row = ctypes.cast(asker.reads, ctypes.POINTER(structs.AskedRead))[asked.read]
                ctypes.memmove(row.reply, self.unanswered.number.to_bytes(2, "big"), 2)
        asker.number, asker.cycle, asker.free_ns = self.unanswered.number, schedule.cycle, self._free_ns
        asker.cycle_ns, asker.deadline_ns = schedule.cycle_ns, schedule.deadline_ns
        asker.sent, asker.polls_missed, asker.frames = counters.sent, counters.polls_missed, counters.frames
        framing = counters.framing
        asker.bytes_in, asker.frame_bytes, asker.found = framing.bytes_in, framing.frame_bytes, framing.frames
        return ctypes.addressof(asker)

    def take_back(self) -> bytes:
        """Go on from C's state; return the bytes that it has read and not understood."""
        asker, counters, schedule = self._asker, self._counters, self._schedule
        self._is_stuck = bool(asker.is_stuck)
        self.unanswered.number, schedule.cycle, schedule.next = asker.number, asker.cycle, asker.next
        self._free_ns, schedule.cycle_ns, schedule.deadline_ns = asker.free_ns, asker.cycle_ns, asker.deadline_ns
        counters.sent, counters.polls_missed, counters.frames = asker.sent, asker.polls_missed, asker.frames
        framing = counters.framing
        framing.bytes_in, framing.frame_bytes, framing.frames = asker.bytes_in, asker.frame_bytes, asker.found
        self.unanswered.clear()
        if asker.open >= 0:
            message = schedule.questions[asker.open]._replace(number=self.unanswered.number if self._over_tcp else 0)
            asked_ns = asker.until_ns - self._timing.timeout_ns
            self.unanswered.ask(SentQuestion(message, asker.open, asked_ns, asker.until_ns, 1))
        return self._buffer[: asker.size].tobytes()

    def _compile(self, read: Read) -> structs.AskedRead:
        message = Message(read.unit, read.question)
        framed = wire.tcp_frame if self._over_tcp else wire.rtu_frame
        question = framed(message)
        reply = Message(read.unit, bytes([read.function, 2 * read.count]) + bytes(2 * read.count))
        whole = framed(reply)
        head = len(whole) - 2 * read.count - (0 if self._over_tcp else 2)
        area = self._image.areas[read.area]
        blocks = [
            structs.AskedBlock(
                registers=self._arrays.at(area.registers[begin:]),
                heard_ns=self._arrays.at(area.heard_ns[begin:]),
                told_ns=self._arrays.at(self._image.told_ns[number:]),
                count=block.count,
                identifier=number,
            )
            for number, begin, block in area.blocks
            if read.first < begin + block.count <= read.first + read.count
        ]
        n_blocks, address = self._arrays.structs(structs.AskedBlock, blocks)
        return structs.AskedRead(
            question=self._arrays.of(list(question), np.uint8),
            question_bytes=len(question),
            reply=self._arrays.of(list(whole[:head]), np.uint8),
            reply_head=head,
            reply_bytes=len(whole),
            registers=self._arrays.at(area.registers[read.first :]),
            heard_ns=self._arrays.at(area.heard_ns[read.first :]),
            count=read.count,
            n_blocks=n_blocks,
            blocks=address,
        )
