"""Handshakes of a driver with the devices on one bus, in coroutines, while data keeps flowing."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from skinware.errors import BusSendError, HandshakeTimeout
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.bus import REMOTE_FLAG, Bus, Filter, FrameBatch, check_identifier, identifier_text
from skinware_drivers.decoding.addresses import fewest, filters_of
from skinware_drivers.fields import Match, Reply
from skinware_drivers.layout import Layout

_FIRST_RETRY_S, _LONGEST_RETRY_S = 0.002, 0.05
_SEND_TIMEOUT_S = 0.5
_LATE_NS = 5 * NS_PER_S
DEFAULT_PACE_PER_MS = 4.0
"""Half of the frames that a CAN bus of 1 Mbit/s can carry; the devices' own frames need the other half."""
AT_ONCE = 8
"""Frames that may be sent without a pause if none was sent for a while; reception waits for these at most."""


class _Overdue(NamedTuple):
    """A question in lock step whose timeout has passed.

    Attributes:
        due_ns: when the answer should have come.
        until_ns: until when the answer may still come.
        on_late: called with the delay of the answer, s.
    """

    answer: Match
    due_ns: int
    until_ns: int
    on_late: Callable[[float], None]


class Heard(NamedTuple):
    """The properties by which :meth:`Link.listen` distinguishes frames."""

    identifier: int
    first_byte: int
    length: int


class BusLog(logging.LoggerAdapter[logging.Logger]):
    """The log of drivers; messages begin with the name of a bus."""

    def __init__(self, bus_name: str) -> None:
        super().__init__(logging.getLogger("skinware.driver"))
        self._bus_name = bus_name

    def log(self, level: int, msg: object, *args: object, **more: Any) -> None:
        """Log a message with its arguments."""
        self.logger.log(level, f"%s: {msg}", self._bus_name, *args, **more)


class Link:
    """One bus for a driver's handshakes. Everything runs in the runner's event loop, without threads.

    Frames that are not data of the layout are offered to handshakes that wait for answers. Frames are sent at a limited
    pace, so that reception continues meanwhile.

    Args:
        bus: the bus.
        pace_per_ms: frames that may be sent within a millisecond on average.

    Attributes:
        log: the driver's log; its messages begin with the name of the bus.
    """

    def __init__(self, bus: Bus, pace_per_ms: float = DEFAULT_PACE_PER_MS) -> None:
        self._bus = bus
        self.log = BusLog(bus.name)
        self._gap_s = 1e-3 / pace_per_ms
        self._free_at_s = 0.0
        self._wanted: Sequence[Filter] | None = None
        self._waiters: list[tuple[tuple[Match, ...], asyncio.Queue[Reply]]] = []
        self._late: deque[tuple[int, tuple[Match, ...]]] = deque()  # until when their answers are no strangers
        self._questions = 0
        self._no_question = asyncio.Event()
        self._no_question.set()
        self._data_question = asyncio.Lock()  # held while one is open
        self._expected: tuple[Match, asyncio.Event] | None = None
        self._came_ns = 0
        self._overdue: list[_Overdue] = []
        self._heard: Counter[Heard] | None = None

    @property
    def bus_name(self) -> str:
        """Name of the bus, for messages."""
        return self._bus.name

    @property
    def listen_only(self) -> bool:
        """Whether sending is forbidden."""
        return self._bus.listen_only

    @property
    def is_awaiting(self) -> bool:
        """Whether a question is open; ``follow`` asks none."""
        return self._questions > 0 or self._expected is not None

    async def send(self, identifier: int, payload: bytes, *, timeout_s: float = _SEND_TIMEOUT_S) -> None:
        """Send one frame, once no question in lock step is open (:meth:`ask`) and the interface's queue has room.

        Raises:
            BusSendError: still full after ``timeout_s``, the bus is down, or it is opened to listen only.
            ConfigurationError: a CAN identifier of more than 11 bits lacks the ``EXTENDED_FLAG``.
            TypeError: the payload is no bytes.
        """
        if not isinstance(payload, bytes | bytearray | memoryview):
            raise TypeError(f"the payload {payload!r} is no bytes: write b'...', or bytes([...])")
        if self._data_question.locked():
            async with self._data_question:
                pass
        await self._send(identifier, payload, timeout_s)

    async def _send(self, identifier: int, payload: bytes, timeout_s: float) -> None:
        if self._bus.medium == "can":
            check_identifier(identifier & ~REMOTE_FLAG)
        loop = asyncio.get_running_loop()
        deadline_s, retry_s = loop.time() + timeout_s, _FIRST_RETRY_S
        while True:
            self._free_at_s = max(self._free_at_s, loop.time() - AT_ONCE * self._gap_s) + self._gap_s
            if (wait_s := self._free_at_s - loop.time()) > 0:  # keep the pace
                await asyncio.sleep(wait_s)
            try:
                self._bus.send(identifier, payload)
                return
            except BusSendError:
                left_s = deadline_s - loop.time()
                if self._bus.listen_only or left_s <= 0:
                    raise
            await asyncio.sleep(min(retry_s, left_s))
            retry_s = min(2 * retry_s, _LONGEST_RETRY_S)

    def narrow(self, layout: Layout) -> None:
        """From now on, receive only frames of this layout and awaited ones, if the bus can leave out the others."""
        if self._bus.narrows:
            self._wanted = filters_of(layout)
            self._tell_bus()

    def _tell_bus(self) -> None:
        if self._wanted is None:
            return
        if self._heard is not None:
            self._bus.narrow(())
            return
        awaited = [match.filter for matches, _ in self._waiters for match in matches]
        if self._expected is not None:
            awaited.append(self._expected[0].filter)
        awaited += [overdue.answer.filter for overdue in self._overdue]
        self._bus.narrow(fewest([*self._wanted, *awaited]))

    @contextmanager
    def _waiting(self, matches: tuple[Match, ...], *, is_question: bool = False) -> Iterator[asyncio.Queue[Reply]]:
        queue: asyncio.Queue[Reply] = asyncio.Queue()
        entry = (matches, queue)
        self._waiters.append(entry)
        if is_question:
            self._questions += 1
            self._no_question.clear()
        self._tell_bus()
        try:
            yield queue
        finally:
            self._waiters.remove(entry)
            if is_question:
                self._questions -= 1
                self._late.append((now_ns() + _LATE_NS, matches))
                if not self._questions:
                    self._no_question.set()
            self._tell_bus()

    async def request(
        self, identifier: int, payload: bytes, reply: Match, *, timeout_s: float, tries: int = 1
    ) -> Reply:
        """Send one frame and return the first answer to it; older frames do not count.

        It is sent up to ``tries`` times, for lines that lose frames; sending it twice must do no harm.

        Raises:
            HandshakeTimeout: no answer came within ``timeout_s``.
            BusSendError: as ``send``.
        """
        with self._waiting((reply,), is_question=True) as queue:
            for _ in range(tries):
                await self.send(identifier, payload)
                # not wait_for: that of Python 3.11 forgets cancellations
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(timeout_s):
                        return await queue.get()
        sent = f"{identifier_text(identifier)} [{payload.hex(' ').upper()}]"
        times = "" if tries == 1 else f", {tries} times"
        raise HandshakeTimeout(f"{self.bus_name}: no answer to {sent} within {timeout_s:g} s{times}")

    async def ask(
        self,
        identifier: int,
        payload: bytes,
        answer: Match,
        *,
        timeout_s: float,
        extra_s: float = 0.0,
        on_late: Callable[[float], None] = lambda _late_s: None,
    ) -> bool:
        """Send one frame and wait for an answer that may be data; nothing else is sent on this bus meanwhile.

        The frame is sent once every ``request`` and ``collect`` has ended. For repeated questions, see
        :class:`skinware_drivers.polling.Poll`.

        Args:
            identifier: of the frame.
            payload: of the frame.
            answer: the frames that answer it.
            timeout_s: time in which the answer should come.
            extra_s: time to wait for it after that.
            on_late: called with the time from ``timeout_s`` to a late answer, s (0 or less: it was only read late),
                up to five seconds later, unless the question was asked again.

        Returns:
            Whether an answer came within ``timeout_s`` and ``extra_s``.

        Raises:
            BusSendError: as ``send``.
        """
        while True:
            await self._no_question.wait()
            async with self._data_question:
                if self._questions:
                    continue
                came = asyncio.Event()
                self._overdue = [one for one in self._overdue if one.answer != answer and one.until_ns > now_ns()]
                self._expected = answer, came
                self._tell_bus()
                try:
                    await self._send(identifier, payload, timeout_s)
                    sent_ns = now_ns()
                    due_ns = sent_ns + round(timeout_s * NS_PER_S)
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(timeout_s + extra_s):
                            await came.wait()
                    if not came.is_set():
                        self._overdue.append(_Overdue(answer, due_ns, sent_ns + _LATE_NS, on_late))
                    elif self._came_ns > due_ns:
                        on_late((self._came_ns - due_ns) / NS_PER_S)
                finally:
                    self._expected = None
                    self._tell_bus()
                return came.is_set()

    async def collect(self, identifier: int, payload: bytes, reply: Match, *, duration_s: float) -> list[Reply]:
        """Send one frame and return all answers that come within ``duration_s``.

        Raises:
            BusSendError: as ``send``.
        """
        with self._waiting((reply,), is_question=True) as queue:
            await self.send(identifier, payload)
            await asyncio.sleep(duration_s)
        return [queue.get_nowait() for _ in range(queue.qsize())]

    async def listen(self, duration_s: float) -> Counter[Heard]:
        """Send nothing, and return counts of the frames on the bus, except those of declared modules."""
        heard: Counter[Heard] = Counter()
        self._heard = heard
        self._tell_bus()
        try:
            await asyncio.sleep(duration_s)
        finally:
            self._heard = None
            self._tell_bus()
        return heard

    @contextmanager
    def follow(self, *matches: Match) -> Iterator[asyncio.Queue[Reply]]:
        """Put every frame that matches into a queue, in order of arrival; a context manager."""
        with self._waiting(matches) as queue:
            yield queue

    async def sleep(self, duration_s: float) -> None:
        """Let time pass while the bus is read."""
        await asyncio.sleep(duration_s)

    @property
    def is_listening(self) -> bool:
        """Whether ``offer`` must be called: frames that are not of the layout are awaited."""
        self._forget_late()
        return bool(self._waiters or self._late or self._heard is not None)

    @property
    def awaited(self) -> Sequence[Filter]:
        """Filters that let the awaited frames through; none if ``is_listening`` is false."""
        self._forget_late()
        if self._heard is not None:
            return (Filter(0, 0),)
        waiting = [matches for matches, _ in self._waiters] + [matches for _, matches in self._late]
        return [match.filter for matches in waiting for match in matches]

    @property
    def expects_data(self) -> bool:
        """Whether ``hear`` must be called: a question is open, or overdue, whose answer may be data."""
        return self._expected is not None or bool(self._overdue)

    def hear(self, batch: FrameBatch, rows: npt.NDArray[np.int64]) -> None:
        """Look among frames of this bus, data or not, for the answer of ``ask`` (called by the runner)."""
        for overdue in tuple(self._overdue):
            likely = rows[_any_match((overdue.answer,), batch.wire["identifier"][rows])].tolist()
            came_ns = next((int(batch.time_ns[row]) for row in likely if overdue.answer.fits(_reply(batch, row))), None)
            if came_ns is not None:
                self._overdue.remove(overdue)
                overdue.on_late((came_ns - overdue.due_ns) / NS_PER_S)
        if self._expected is None:
            return
        match, came = self._expected
        likely = rows[_any_match((match,), batch.wire["identifier"][rows])].tolist()
        fitting = next((row for row in likely if match.fits(_reply(batch, row))), None)
        if fitting is not None and not came.is_set():
            self._came_ns = int(batch.time_ns[fitting])
            came.set()

    def _forget_late(self) -> None:
        while self._late and self._late[0][0] < now_ns():
            self._late.popleft()

    def offer(self, batch: FrameBatch, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Give frames of this bus to the handshakes that wait (called by the runner); return the rows that fit none.

        A late answer fits its question for a few seconds after the timeout.
        """
        if not len(rows) or not self.is_listening:
            return rows
        expected = np.zeros(len(rows), bool)
        identifier = batch.wire["identifier"][rows]
        if self._heard is not None:
            first, length = batch.wire["payload"][rows, 0], batch.wire["length"][rows]
            self._heard.update(
                Heard(*row) for row in zip(identifier.tolist(), first.tolist(), length.tolist(), strict=True)
            )
        waiting: list[tuple[tuple[Match, ...], asyncio.Queue[Reply] | None]] = [*self._waiters]
        waiting += [(matches, None) for _, matches in self._late]
        for matches, queue in waiting:
            for number in np.flatnonzero(_any_match(matches, identifier)).tolist():
                reply = _reply(batch, rows[number])
                if any(match.fits(reply) for match in matches):
                    expected[number] = True
                    if queue is not None:
                        queue.put_nowait(reply)
        return rows[~expected]


def _any_match(matches: Sequence[Match], identifier: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
    found = np.zeros(len(identifier), bool)
    for match in matches:
        value, mask = match.filter
        found |= (identifier & mask) == value
    return found


def _reply(batch: FrameBatch, row: int) -> Reply:
    wire = batch.wire[row]
    payload = wire["payload"][: min(int(wire["length"]), batch.payload_size)].tobytes()
    return Reply(int(batch.time_ns[row]), int(wire["identifier"]), payload)
