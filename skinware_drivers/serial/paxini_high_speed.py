"""Paxini's high-speed board PXSR-STDOTO4B: up to 28 modules of a hand, all of them in every frame.

All numbers are little-endian; LRC is minus the sum of all bytes before it.

* Request: ``55 AA | 00 | function | register u16 | count u16 | data | LRC``. Functions: 03 reads 1 to 512 bytes, 10
  writes 1 to 10, 17 calibrates. Reply: ``AA 55`` and the same; a function with bit 7 has the number of an error in the
  other bits. The data of a reply to a write is a status, 0 if all is well.
* Stream: ``AA 56 | 00 | bytes u16 | error u8 | data | LRC``; the bytes count error and data. Data: for each connected
  slot, in order, the resultant (three u16, whose low byte counts) and its taxels; nine taxels at most for a module on
  the palm. The length of a frame follows from the slots and their numbers of taxels, which must be read first.
* Registers: 0000 version, 15 characters; 0010 to 0013 connected slots, one bit each, the lowest first; 0016 kinds of
  data (1 resultants, 2 taxels); 0017 stream on and off; 0030 numbers of taxels, u16, of the slots; those of the palm
  are at 0066 in the maker's Hand_UI.py, behind the others in its text and in paxini-sdk 0.1.0: both are tried.

A program that ends without switching the stream off leaves the board sending. So the driver switches the stream off
before its first question, drops the bytes received, and repeats questions that are not answered.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate

from skinware.errors import BusError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.realtime import NS_PER_S
from skinware.status import Status
from skinware_drivers import Flag, Frame, Identifier, Layout, Link, Match, Notice, Patch
from skinware_drivers.fields import Reply
from skinware_drivers.hand import Hand
from skinware_drivers.serial import LRC, Field, Length, LengthTable, Packet, Refused, Split
from skinware_drivers.serial.framing import Framing
from skinware_drivers.serial.paxini_modules import MOST_POINTS, SATURATED, TAXEL, Slot, module, nominal_places, values

VERSION_BYTES = 15
STRANGE = 0x57
"""Identifier of streamed frames of another length; the identifiers of slots are their numbers."""

_REPLY, _STREAM = 0x55, 0x56
_READ, _WRITE, _CALIBRATE, _IS_ERROR = 0x03, 0x10, 0x17, 0x80
_VERSION, _CONNECTED, _SWITCH, _CALIBRATION = 0x0000, 0x0010, 0x0017, 0x0002
_KINDS, _BOTH, _POINTS, _POINTS_ON_PALM = 0x0016, 0x03, 0x0030, 0x0066
_FINGER_SLOTS, _SLOTS, _BYTES_OF_MASK = 20, 28, 4
_MOST_ON_PALM = 9
_LENGTH_AND_ERROR, _RESULTANT, _RESULTANT_STEP = 3, 6, 2
_LONGEST = 7 + _SLOTS * (_RESULTANT + TAXEL * MOST_POINTS)
_ENOUGH = 64
"""Bytes of a strange frame that are kept."""
_TIMEOUT_S, _TRIES, _SWITCHES = 0.2, 3, 2
_TIMEOUT_OF_CALIBRATION_S = 10.0
_USUAL_HZ = 91.0
_STRANGE_IN_A_ROW, _WITHIN_NS = 3, NS_PER_S


def request(function: int, register: int, count: int, data: bytes = b"") -> bytes:
    sent = b"\x55\xaa\0" + struct.pack("<BHH", function, register, count) + data
    return sent + LRC.to_bytes(sent)


def version_request() -> bytes:
    return request(_READ, _VERSION, VERSION_BYTES)


_WHOLE = Packet(
    sync=(0xAA, (_REPLY, _STREAM), 0x00),
    length=LengthTable(1, {_REPLY: Length(Field(6, 2), more=9), _STREAM: Length(Field(3, 2), more=6)}),
    maximum=_LONGEST,
    checksum=LRC,
    identifier=Field(1),
    header=3,
)


def framing_of(slots: Sequence[Slot]) -> Framing:
    """Return a framing of replies, and of streamed frames split by slot: its data behind length and error."""
    sizes = [_RESULTANT + TAXEL * slot.points for slot in slots]
    *starts, end = accumulate(sizes, initial=_LENGTH_AND_ERROR)
    parts = [(slot.number, start, start + size) for slot, start, size in zip(slots, starts, sizes, strict=True)]

    def split(identifier: int, body: bytes) -> Iterable[tuple[int, bytes]]:
        if identifier != _STREAM:
            return [(identifier, body)]
        if not parts or len(body) != end:  # its beginning is too short for the first slot, which is counted
            return [*((slot, body[:_LENGTH_AND_ERROR]) for slot, _, _ in parts[:1]), (STRANGE, body[:_ENOUGH])]
        return [(slot, body[:_LENGTH_AND_ERROR] + body[start:stop]) for slot, start, stop in parts]

    return Split(_WHOLE, split)


UNKNOWN_SLOTS: Framing = framing_of(())
"""All streamed frames are strange as long as the slots are unknown."""


class HighSpeedBoard:
    """One board: a patch with a module for each connected slot; ``use`` sets the framing of the line."""

    layout: Layout  # once it was described
    geometry: Geometry | None = None
    period_s = 1 / _USUAL_HZ

    def __init__(self, hand: Hand, *, use: Callable[[Framing], None], report: Callable[[Patch, Notice], None]) -> None:
        self.use, self.report = use, report
        self._hand = hand
        self.framing: Framing = UNKNOWN_SLOTS
        self._slots: list[Slot] = []
        self._patch: Patch | None = None
        self._streams = False

    async def is_streaming(self, link: Link, duration_s: float) -> bool:
        """Listen, and return whether frames come that only this board sends."""
        self._streams = False
        self.use(UNKNOWN_SLOTS)
        return any(heard.identifier == STRANGE for heard in await link.listen(duration_s))

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the board for its modules; it may still be sending for an earlier program."""
        self.framing = UNKNOWN_SLOTS
        self.use(self.framing)
        await self.stop(link)
        self.use(self.framing)
        version = (await self._read(link, _VERSION, VERSION_BYTES)).rstrip(b"\0 ").decode("ascii", "replace")
        kinds = (await self._read(link, _KINDS, 1))[0] & _BOTH
        if kinds in (1, 2):
            raise BusError(f"the board {version} streams resultants or taxels alone: write 3 into its register 0016")
        slots = await self._ask_slots(link)
        if not slots:
            raise BusError(f"the board {version} says that no module is connected to it")
        link.log.info("board %s with %s", version, ", ".join(f"{s.name} ({s.points})" for s in slots))
        patches = self.know(slots)
        self.use(self.framing)
        return patches

    def know(self, slots: Sequence[Slot]) -> Sequence[Patch]:
        self._slots = list(slots)
        self.framing, self.geometry = framing_of(slots), nominal_places(slots, self._hand)
        has_error = Flag(Status.SUSPECT, _LENGTH_AND_ERROR - 1, "u1", mask=0xFF)
        taxels_at, frames = _LENGTH_AND_ERROR + _RESULTANT, []
        for slot in slots:
            where = values(slot.points, taxels_at, _LENGTH_AND_ERROR, _RESULTANT_STEP)
            when, length = [Identifier(slot.number)], [taxels_at + TAXEL * slot.points]
            frames.append(Frame(slot.name, when, length, where, module=slot.number, flags=[has_error, *SATURATED]))
        self.layout = Layout(frames)
        modules = [module(slot.number, slot.points, key=slot.number, name=slot.name) for slot in slots]
        self._patch = Patch("hand", modules)
        return [self._patch]

    async def start(self, link: Link) -> None:
        """Switch the stream on; not every version of the board acknowledges it."""
        self._streams = True
        if not await self._switch(link, on=True):
            link.log.debug("the board does not acknowledge that it streams")

    async def stop(self, link: Link) -> None:
        """Switch the stream off, and wait for the acknowledgement."""
        self._streams = False
        if not await self._switch(link, on=False):
            link.log.debug("the board does not acknowledge that it is silent")

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Return whether a board with the same modules answers: then it was reset, and no longer sends."""
        if await self._ask_slots(link, tries=1) == self._slots:
            return True
        self.report(patch, Notice.CHANGED)
        return False

    async def attend(self, link: Link) -> None:
        """Notice streamed frames of another length: modules were connected or came off."""
        times_ns: list[int] = []
        with link.follow(Match(STRANGE)) as heard:
            while True:
                reply = await heard.get()
                times_ns = [*times_ns, reply.time_ns][-_STRANGE_IN_A_ROW:] if self._streams else []
                enough = len(times_ns) == _STRANGE_IN_A_ROW and times_ns[-1] - times_ns[0] < _WITHIN_NS
                if enough and self._patch is not None:
                    link.log.warning("the board streams other modules than before; asking which")
                    times_ns, self._streams = [], False
                    self.report(self._patch, Notice.CHANGED)

    async def tare(self, link: Link, patches: Sequence[Patch]) -> None:  # noqa: ARG002
        """Calibrate the board, which does not send meanwhile."""
        await self.stop(link)
        try:
            status = await self._exchange(
                link,
                request(_CALIBRATE, _CALIBRATION, 1, b"\1"),
                lambda frame: _data_of(frame, _CALIBRATE, _CALIBRATION, 1),
                _TIMEOUT_OF_CALIBRATION_S,
                tries=1,
            )
            if status is None:
                raise HandshakeTimeout(
                    f"the board does not say that it has calibrated, for {_TIMEOUT_OF_CALIBRATION_S:g} s"
                )
            _check_status("calibrate", status)
        finally:
            await self.start(link)

    async def _ask_slots(self, link: Link, tries: int = _TRIES) -> list[Slot]:
        mask = b"".join([await self._read(link, _CONNECTED + at, 1, tries) for at in range(_BYTES_OF_MASK)])
        connected = int.from_bytes(mask, "little")
        slots = []
        for number in (number for number in range(_SLOTS) if connected >> number & 1):
            points = await self._ask_points(link, number, tries)
            slot = Slot(number, points if number < _FINGER_SLOTS else min(points, _MOST_ON_PALM))
            if points > MOST_POINTS:
                raise BusError(f"the board says that {slot.name} has {points} taxels: that cannot be")
            slots.append(slot)
        return slots

    async def _ask_points(self, link: Link, number: int, tries: int) -> int:
        """Ask for the number of taxels in a slot; on the palm at both registers."""
        if number >= _FINGER_SLOTS:
            with contextlib.suppress(Refused):
                at = _POINTS_ON_PALM + 2 * (number - _FINGER_SLOTS)
                if points := int.from_bytes(await self._read(link, at, 2, tries), "little"):
                    return points
        return int.from_bytes(await self._read(link, _POINTS + 2 * number, 2, tries), "little")

    async def _switch(self, link: Link, *, on: bool) -> bool:
        """Switch the stream on or off; return whether a reply or an empty streamed frame acknowledged it."""
        sent = request(_WRITE, _SWITCH, 1, bytes([on]))

        def take(frame: Reply) -> bytes | None:
            is_empty = frame.identifier == STRANGE and len(frame.payload) == _LENGTH_AND_ERROR  # but for an error byte
            status = frame.payload[2:] if is_empty else _data_of(frame, _WRITE, _SWITCH, 1)
            _check_status("stream", status or b"")
            return status

        return await self._exchange(link, sent, take, _TIMEOUT_S, _SWITCHES) is not None

    async def _read(self, link: Link, register: int, count: int, tries: int = _TRIES) -> bytes:
        sent = request(_READ, register, count)
        data = await self._exchange(
            link, sent, lambda frame: _data_of(frame, _READ, register, count), _TIMEOUT_S, tries
        )
        if data is None:
            raise HandshakeTimeout(f"{link.bus_name}: no answer to [{sent.hex(' ').upper()}], {tries} times")
        return data

    async def _exchange(
        self, link: Link, sent: bytes, take: Callable[[Reply], bytes | None], timeout_s: float, tries: int
    ) -> bytes | None:
        """Send a request until ``take`` accepts a frame as its answer; return the result, None if no answer comes.

        Half a frame is dropped before the request is repeated: it may be a false beginning that would swallow the
        answer.
        """
        with link.follow(Match(_REPLY), Match(STRANGE)) as heard:
            for _ in range(tries):
                await link.send(0, sent)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(timeout_s):
                        while (taken := take(await heard.get())) is None:
                            pass
                        return taken
                self.use(self.framing)
        return None


def _data_of(frame: Reply, function: int, register: int, count: int) -> bytes | None:
    """Return the data of the reply to such a request; None if the frame is no such reply."""
    if frame.identifier != _REPLY:
        return None
    said, at, size = struct.unpack_from("<BHH", frame.payload)
    if at == register and said & _IS_ERROR:
        error = said & ~_IS_ERROR
        raise Refused(f"the board answers with error {error} at register {register:#06x}", error)
    return frame.payload[5:] if (said, at, size) == (function, register, count) else None


def _check_status(what: str, data: bytes) -> None:
    if data[:1] not in (b"", b"\0"):
        raise Refused(f"the board refuses to {what} with status {data[0]}", data[0])
