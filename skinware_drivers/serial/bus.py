"""A serial line as a bus: bytes are read in chunks as they come, and become frames in a stream."""

from __future__ import annotations

import contextlib
import os
import select
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

from skinware.errors import BusNotAvailable, BusSendError
from skinware.realtime import NS_PER_S, now_ns
from skinware.status import BusReason, Unused
from skinware_drivers.bus import FrameBatch, KernelBus
from skinware_drivers.native.structs import Source
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.framing import Encoding, Framing, Unframed
from skinware_drivers.serial.ports import (
    DEFAULT_BAUDRATE,
    DescriptorPort,
    Port,
    PtyPort,
    SerialOptions,
    find_port,
    open_port,
)
from skinware_drivers.serial.stream import CHUNK, NativeStream, Stream, stream_of

_MORE_WAITS = 2048  # a read that gave so much is followed by another
_SPAN_NS = NS_PER_S
"""Time between two comparisons of skipped with good bytes."""


class SerialBus(KernelBus):
    """A serial line.

    Its name is ``serial:PATH?key=value`` (or only ``/dev/...``), where PATH is a device or one of pyserial's URLs;
    with ``serial_number`` or ``vid_pid`` the port of that USB device, at its path when it is opened.

    Every frame has the time at which its last byte was read. Frames arrive in the order of the stream. Damaged ones
    are counted in ``counters.errors``, and in more detail in ``counters.framing``.

    Args:
        channel: path or URL; empty if the options name a USB device.
        payload_size: bytes of the longest body that fits into a batch; longer ones are counted as refused.
    """

    medium: ClassVar[str] = "serial"
    opens_slowly: ClassVar[bool] = True

    def __init__(
        self,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
    ) -> None:
        own, of_url = _split_options(channel, options or {})
        self._path = channel + of_url
        name = self._path or "&".join(f"{key}={own[key]}" for key in ("serial_number", "vid_pid") if key in own)
        super().__init__(name, own, payload_size=payload_size, listen_only=listen_only)
        self._serial_options = options_from_strings(SerialOptions, own)
        self._framing: Framing = Unframed(payload_size)
        self._commands: Encoding = self._framing
        self._baudrate = DEFAULT_BAUDRATE
        self._port: Port | None = None
        self._epoll: select.epoll | None = None
        self._event = -1
        self._woken = False
        self._unsent = b""
        self._stream: Stream = stream_of(self._framing, payload_size, self.counters)
        self._handed: tuple[NativeStream, DescriptorPort] | None = None  # to C
        self._judged, self._judged_ns, self._is_garbled = replace(self.counters.framing), 0, False

    @property
    def baudrate(self) -> int:
        """Bits per second, by the name of the bus or ``use``; an open bus may still have an earlier rate."""
        return self._serial_options.baudrate or self._baudrate

    def use(self, framing: Framing, commands: Encoding | None = None, baudrate: int | None = None) -> None:
        """Set the framing, also of bytes that were received and are no whole frame of the framing before.

        Args:
            commands: how they are sent, if in another way.
            baudrate: unless the name of the bus gives another; takes effect when the bus is opened next.
        """
        self._framing, self._commands = framing, commands or framing
        self._baudrate = baudrate or self._baudrate
        self._restart(self._stream.rest())
        if self._port is not None:
            self._stay_readable(self._stream.is_behind)

    def open(self) -> None:
        """Open the port exclusively, raw, with empty buffers."""
        if self._port is not None:
            return
        port = self._open_port()
        self._port = port
        self._restart()
        self._unsent = b""
        self._woken = False
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll = select.epoll()
        self._epoll.register(port.fileno(), select.EPOLLIN)
        self._epoll.register(self._event, select.EPOLLIN)

    def _open_port(self) -> Port:
        path = find_port(self._path, self._serial_options)
        return open_port(path, self._serial_options, self.baudrate)

    def fileno(self) -> int:
        return -1 if self._epoll is None else self._epoll.fileno()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append the frames that have arrived, at most ``batch.free``; if others remain, the bus stays readable."""
        if self._port is None:
            raise BusNotAvailable(f"{self!r} is not open")
        if self._unsent:
            self._send_on()
        if not self._stream.is_behind:
            self._read(self._port)
        taken = self._stream.fill(batch, ordinal)
        if damaged := self._stream.take_damaged():
            self.samples.note(Unused.REFUSED, 0, damaged)
        if self._stream.is_lost and not taken:
            raise BusNotAvailable(f"{self.name}: out of step: the bytes received are no answer; opening it again")
        self._stay_readable(self._stream.is_behind or self._stream.is_lost)
        self._judge(now_ns())
        return taken

    @property
    def reads_natively(self) -> bool:
        """Whether C finds the frames and reads the port, as far as the port is known."""
        return isinstance(self._stream, NativeStream) and isinstance(self._port, DescriptorPort | None)

    def hand_over(self, batch: FrameBatch, source: Source) -> bool:
        stream, port = self._stream, self._port
        if not isinstance(stream, NativeStream) or not isinstance(port, DescriptorPort):
            return False
        if self._unsent or self._epoll is None:  # Python sends on; a thread is opening it
            return False
        self._stay_readable(False)  # C asks the stream itself
        self._handed = stream, port
        source.fd, source.stream = self.fileno(), stream.hand_over(port.fileno(), batch)
        source.tap = self.tap.address
        return True

    def take_back(self, source: Source) -> None:  # noqa: ARG002
        if self._handed is not None:
            self._handed[0].count()
            self._handed = None
        if self._port is not None:
            self._stay_readable(self._stream.is_behind)
        self._judge(now_ns())

    def nothing_received(self, number: int) -> int:
        if self._handed is None:
            return 0
        raise self._handed[1].gone(number)

    def send(self, identifier: int, payload: bytes) -> None:
        """Send one frame; bytes that the port does not take at once follow later."""
        try:
            self._send(identifier, payload)
        except BusSendError:
            self.counters.send_failures += 1
            raise
        self.counters.sent += 1

    def close(self) -> None:
        if self._epoll is not None:
            self._epoll.close()
            self._epoll = None
            os.close(self._event)
        if self._port is not None:
            self._port.close()
            self._port = None

    def reason(self, time_ns: int) -> BusReason:
        """Return ``BUS_ERRORS`` while most bytes belong to no frame: another baud rate, or another device."""
        return BusReason.BUS_ERRORS if self._is_garbled and time_ns < self._judged_ns + 2 * _SPAN_NS else BusReason.NONE

    @property
    def note(self) -> str:
        return "" if self._port is None else self._port.note

    def _restart(self, rest: Sequence[tuple[bytes, int]] = ()) -> None:
        kept = sum(len(piece) for piece, _ in rest)
        if kept > CHUNK:
            kept, rest = 0, ()
        self.counters.framing.skipped_bytes += self._stream.pending - kept
        self.counters.framing.bytes_in -= kept
        self._stream = stream_of(self._framing, self.payload_size, self.counters)
        self._stream.begin(rest)
        self._judged, self._judged_ns, self._is_garbled = replace(self.counters.framing), 0, False

    def _read(self, port: Port) -> None:
        chunk = more = port.read(CHUNK)
        while len(more) >= _MORE_WAITS and len(chunk) < CHUNK:
            try:
                more = port.read(CHUNK - len(chunk))
            except BusNotAvailable:  # the next read raises it again
                break
            chunk += more
        if chunk:
            self._hear(chunk, now_ns())

    def _hear(self, chunk: bytes, time_ns: int) -> None:
        self.tap.keep_bytes(time_ns, chunk)
        self._stream.add(chunk, time_ns)

    def _judge(self, time_ns: int) -> None:
        """Judge now and then whether more bytes were skipped than were good."""
        now, before = self.counters.framing, self._judged
        if now.bytes_in == before.bytes_in or time_ns <= self._judged_ns + _SPAN_NS:
            return
        self._is_garbled = now.skipped_bytes - before.skipped_bytes > now.frame_bytes - before.frame_bytes
        self._judged, self._judged_ns = replace(now), time_ns

    def _send(self, identifier: int, payload: bytes) -> None:
        port = self.may_send_by(self._port)
        try:
            data = self._commands.encode(identifier, payload)
        except ValueError as error:
            raise BusSendError(f"{self!r}: {error}") from None
        if self._unsent and len(self._unsent) + len(data) > port.longest_wait:
            raise BusSendError(f"{self!r}: the port takes nothing any more ({len(self._unsent)} bytes wait)")
        self._stream.asked()
        if self._stream.is_lost:
            self._stay_readable(True)
        waited = bool(self._unsent)
        self._unsent += data
        if not waited:
            try:
                self._send_on()
            except BusNotAvailable as error:
                self._unsent = b""
                raise BusSendError(str(error)) from None

    def _send_on(self) -> None:
        """Write the bytes that wait, as far as the port takes them, and wake up when it takes more."""
        port, epoll = self._port, self._epoll
        if port is None or epoll is None:
            return
        sent_ns = now_ns()  # not later than an answer
        try:
            written = port.write(self._unsent)
        except OSError as error:
            raise BusNotAvailable(f"{self!r} went away, perhaps unplugged ({error.strerror or error})") from None
        self.tap.keep_bytes(sent_ns, self._unsent[:written], is_sent=True)
        self._unsent = self._unsent[written:]
        wanted = select.EPOLLIN | (select.EPOLLOUT if self._unsent else 0)
        with contextlib.suppress(OSError):
            epoll.modify(port.fileno(), wanted)

    def _stay_readable(self, wanted: bool) -> None:
        if wanted and not self._woken:
            os.eventfd_write(self._event, 1)
        elif self._woken and not wanted:
            os.eventfd_read(self._event)
        self._woken = wanted


class PtyBus(SerialBus):
    """A serial port that others can open: the device's end, for emulators. Its name is ``pty`` or ``pty:LINK``.

    ``note`` has the path. Bytes that no program reads fill the kernel's buffer; further ones are refused.
    """

    def _open_port(self) -> Port:
        return PtyPort(self._path)


def _split_options(channel: str, options: dict[str, str]) -> tuple[dict[str, str], str]:
    """Return the options of the bus, and the others as the query of a URL of pyserial's."""
    if "://" not in channel:
        return dict(options), ""
    own = set(SerialOptions.__struct_fields__)
    query = "&".join(f"{key}={text}" if text else key for key, text in options.items() if key not in own)
    return {key: text for key, text in options.items() if key in own}, f"?{query}" if query else ""
