"""Every other CAN interface, through python-can: a thread puts its messages one by one into a queue."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections import deque
from typing import Any, ClassVar

import can

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusReason, Unused
from skinware.wire import IS_FD
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Bus, FrameBatch, identifier_text
from skinware_drivers.counters import BusCounters

log: logging.Logger = logging.getLogger("skinware.driver")

_QUEUE_FRAMES = 1 << 16
_POLL_S = 0.2
_MOST_FAILURES = 50
"""Calls of ``recv`` that may fail in a row before the interface counts as failed and is opened again: python-can's
slcan, for example, keeps bytes that it cannot decode, and fails with every frame after them."""
_SWITCHED, _PASSIVE = 0x01, 0x02
"""Flags of a CAN FD frame: bit rate switched, sender error passive."""
_CLOSE_S = 0.8
"""Time that closing an interface may take; a driver ends within about a second, whatever its interfaces do."""
_LISTENING: dict[str, dict[str, Any]] = {
    "cantact": {"monitor": True},
    "kvaser": {"driver_mode": False},
    "nixnet": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "seeedstudio": {"operation_mode": "silent"},
    "slcan": {"listen_only": True},
    "vector": {"listen_only": True},
}
"""Arguments that put an interface's controller into listen-only mode, without acknowledging (python-can's sources)."""
_WITHOUT_CONTROLLER = ("udp_multicast", "virtual")
_ECHOING = ("udp_multicast",)
"""Interfaces that always receive the frames that they send."""
_STAMPED_BY_KERNEL = ("udp_multicast",)
"""Interfaces whose messages have the kernel's time of arrival, CLOCK_REALTIME (python-can's sources)."""
_ECHO_NS = NS_PER_S
"""An echo that has not come by then was lost."""


class PythonCanBus(Bus):
    """A bus of one of python-can's interfaces (``slcan``, ``udp_multicast``, ``kvaser``, ``pcan`` ...).

    The exceptions of these interfaces and the libraries below them are not documented, and change: after any of them
    the bus has failed and is opened again.

    Frames are stamped when they arrive here, as the clock of most interfaces' own stamps is unknown; those of
    ``udp_multicast`` are the kernel's. The options are those of the interface's class.

    Args:
        interface: python-can's name of the interface.
    """

    medium: ClassVar[str] = "can"
    opens_slowly: ClassVar[bool] = True

    def __init__(
        self,
        interface: str,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
    ) -> None:
        super().__init__(channel, options, payload_size=payload_size, listen_only=listen_only)
        self.interface = interface
        self._bus: can.BusABC | None = None
        self._messages: _MessageQueue | None = None
        self._was_open = False
        self._echoes: deque[tuple[int, int, bytes]] = deque()  # of sent frames: time, identifier, payload

    def open(self) -> None:
        keywords: dict[str, Any] = {name: _typed(text) for name, text in self.options.items()}
        if self.payload_size > 8:
            keywords.setdefault("fd", True)
        if self.listen_only:
            keywords = _LISTENING.get(self.interface, {}) | keywords
        try:
            self._bus = can.Bus(interface=self.interface, channel=self.channel or None, **keywords)
        except Exception as error:  # noqa: BLE001  (see the class)
            is_refused = isinstance(error, TypeError | can.CanInterfaceNotImplementedError | ValueError)
            if is_refused and not self._was_open:
                raise ConfigurationError(f"bus {self.interface}:{self.channel}: {error}") from None
            why = f"bus {self.interface}:{self.channel} cannot be opened: {error}"
            raise BusNotAvailable(why, reason=BusReason.FAILED) from None
        self._was_open = True
        is_stamped = self.interface in _STAMPED_BY_KERNEL
        self._messages = _MessageQueue(self._bus, f"bus {self.interface}:{self.channel}", self.counters, is_stamped)

    @property
    def note(self) -> str:
        if not self.listen_only or self.interface in (*_LISTENING, *_WITHOUT_CONTROLLER):
            return ""
        return (
            f"bus {self.interface}:{self.channel}: nothing is sent, but its controller acknowledges the frames that it"
            " hears: this interface has no listen-only mode"
        )

    def check(self) -> None:
        messages = self._messages
        if messages is not None and messages.failure is not None and not messages.queue:
            why = f"bus {self.interface}:{self.channel} failed: {messages.failure}"
            raise BusNotAvailable(why, reason=BusReason.FAILED)

    def fileno(self) -> int:
        return self._messages.fd if self._messages is not None else -1

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        messages = self._messages
        if messages is None:
            raise BusNotAvailable(f"bus {self.channel} is not open")
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(messages.fd)
        count = 0
        while messages.queue and batch.free:
            time_ns, identifier, payload, flags = messages.queue.popleft()
            if self._echoes and self._is_echo(time_ns, identifier, payload):
                continue
            if self.tap.is_open:
                self.tap.keep_frame(time_ns, identifier, payload, flags=flags)
            if identifier & ERROR_FLAG:
                self.counters.errors += 1
                continue
            if identifier & REMOTE_FLAG or len(payload) > batch.payload_size:
                self.counters.refused += 1
                self.samples.note(Unused.REFUSED, identifier, payload)
                continue
            batch.append(ordinal, time_ns, identifier, payload)
            count += 1
        if not count:
            self.check()
        if messages.queue or messages.failure is not None:  # the failure comes after the last messages: look again
            os.eventfd_write(messages.fd, 1)
        self.counters.frames += count
        return count

    def send(self, identifier: int, payload: bytes) -> None:
        bus = self.may_send_by(self._bus)
        message = can.Message(
            arbitration_id=identifier & ~EXTENDED_FLAG,
            is_extended_id=bool(identifier & EXTENDED_FLAG),
            data=payload,
            is_fd=len(payload) > 8,
        )
        sent_ns = now_ns()  # not later than an answer
        try:
            bus.send(message, timeout=0)
        except Exception as error:  # noqa: BLE001  (see the class)
            self.counters.send_failures += 1
            raise BusSendError(f"bus {self.channel}: frame {identifier_text(identifier)} not sent ({error})") from None
        self.counters.sent += 1
        if self.interface in _ECHOING:
            self._echoes.append((sent_ns, identifier, payload))
        if self.tap.is_open:
            self.tap.keep_frame(sent_ns, identifier, payload, is_sent=True)

    def _is_echo(self, time_ns: int, identifier: int, payload: bytes) -> bool:
        """Return whether a message is one of our own, each of which comes back once."""
        while self._echoes and time_ns - self._echoes[0][0] > _ECHO_NS:
            self._echoes.popleft()
        for index, echo in enumerate(self._echoes):
            if echo[1:] == (identifier, payload):
                del self._echoes[index]
                return True
        return False

    def close(self) -> None:
        """Stop taking messages and shut the interface down. Idempotent.

        An interface that hangs is left to itself after 0.8 s, and a warning is logged.
        """
        messages, self._bus, self._messages = self._messages, None, None
        self._echoes.clear()
        if messages is not None:
            messages.close()


class _MessageQueue:
    """The messages of one opened interface. A thread takes them and shuts the interface down, as both may hang.

    Attributes:
        queue: time of arrival, identifier (with its flags), payload and flags of CAN FD of each message.
        failure: why no more messages come; None as long as they may.
        fd: an eventfd that is written when one of the two changes; the thread owns and closes it.
    """

    def __init__(self, bus: can.BusABC, name: str, counters: BusCounters, is_stamped: bool) -> None:
        self.queue: deque[tuple[int, int, bytes, int]] = deque()
        self.failure: str | None = None
        self.fd: int = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._bus, self._name, self._counters, self._is_stamped = bus, name, counters, is_stamped
        self._last_ns = now_ns()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            log.warning("%s: its interface hangs while it is closed, and is left to itself", self._name)

    def _work(self) -> None:
        try:
            self._take_all()
        except Exception as error:  # noqa: BLE001  (see PythonCanBus)
            self.failure = str(error) or type(error).__name__
            os.eventfd_write(self.fd, 1)
        self._closing.wait()
        try:
            self._bus.shutdown()
        except Exception as error:  # noqa: BLE001  (see PythonCanBus)
            log.debug("%s: %s", self._name, error)
        os.close(self.fd)

    def _take_all(self) -> None:
        """Take messages. One that the library refuses is counted, unless all that follow are refused, too."""
        failures = 0
        while not self._closing.is_set():
            try:
                message = self._bus.recv(_POLL_S)
            except OSError:
                raise
            except Exception:
                failures += 1
                if failures >= _MOST_FAILURES:
                    raise
                self._counters.refused += 1
                continue
            if message is None:
                continue
            failures = 0
            if len(self.queue) >= _QUEUE_FRAMES:
                self._counters.dropped += 1
                continue
            identifier = message.arbitration_id
            for is_so, flag in (
                (message.is_extended_id and not message.is_error_frame, EXTENDED_FLAG),
                (message.is_remote_frame, REMOTE_FLAG),
                (message.is_error_frame, ERROR_FLAG),
            ):
                identifier |= flag if is_so else 0
            payload = b"" if message.is_remote_frame else bytes(message.data)
            flags = 0
            if message.is_fd:
                flags = IS_FD | (_SWITCHED if message.bitrate_switch else 0)
                flags |= _PASSIVE if message.error_state_indicator else 0
            self.queue.append((self._arrival_ns(message), identifier, payload, flags))
            os.eventfd_write(self.fd, 1)

    def _arrival_ns(self, message: can.Message) -> int:
        """Return when a message came, CLOCK_MONOTONIC ns; not before the last one, if the other clock steps."""
        came_ns = now_ns()
        if self._is_stamped:
            came_ns = min(came_ns, max(self._last_ns, came_ns - time.time_ns() + round(message.timestamp * NS_PER_S)))
        self._last_ns = came_ns
        return came_ns


def _typed(text: str) -> int | float | bool | str:
    """Return an option as python-can's constructors expect it: numbers and truth values are not texts."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    return text
