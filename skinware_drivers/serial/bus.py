"""A serial line as a bus: bytes are read in chunks as large as they come, and cut into frames by a framer."""

from __future__ import annotations

import contextlib
import os
import select
from dataclasses import replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from skinware.errors import BusNotAvailable, BusSendError
from skinware.realtime import NS_PER_S, now_ns
from skinware.samples import Unused
from skinware.status import BusReason
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.framing import Encoding, Framed, Framer, Framing, Unframed, fill_rows
from skinware_drivers.serial.opening import DEFAULT_BAUDRATE, SerialOptions, find_port, open_port
from skinware_drivers.serial.ports import Port, PtyPort

_CHUNK = 1 << 16
_MORE_WAITS = 2048  # a read that gave so much is followed by another
_MOST_UNSENT = 1 << 16
_SPAN_NS = NS_PER_S
"""What was skipped is held against what was good so often."""


class SerialBus(Bus):
    """A serial line.

    Its name is ``serial:PATH?key=value`` (or only ``/dev/...``), where PATH is a device or one of pyserial's URLs;
    with ``serial_number`` or ``vid_pid`` the port of that USB device, under whatever path it has when it is opened.

    Every frame has the time at which its last byte was read. Frames arrive in the order of the stream. Damaged ones
    are counted in ``counters.errors``, and in more detail in ``counters.framing``.

    Args:
        channel: path or URL; empty if the options say which USB device.
        options: see :class:`skinware_drivers.serial.opening.SerialOptions`.
        payload_size: longest body that fits into a batch; longer ones are counted as refused.
        listen_only: refuse every ``send``.

    Raises:
        ConfigurationError: an option is unknown or has a bad value.
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
        self._backlog: list[tuple[list[Framed], npt.NDArray[np.int64]]] = []
        self._framer: Framer = self._framing.framer()
        self._reads: list[tuple[int, int]] = []
        self._told, self._told_ns, self._is_garbled = replace(self.counters.framing), 0, False

    @property
    def baudrate(self) -> int:
        """Bits per second, as the bus' name says or ``use`` did; a bus that is open may still have the one before."""
        return self._serial_options.baudrate or self._baudrate

    def use(self, framing: Framing, commands: Encoding | None = None, baudrate: int | None = None) -> None:
        """Say what is on the line. What was received but not fetched is dropped.

        Args:
            framing: how frames are received.
            commands: how they are sent, if in another way.
            baudrate: unless the bus' name says another; takes effect when it is opened next.
        """
        self._framing, self._commands = framing, commands or framing
        self._baudrate = baudrate or self._baudrate
        self._begin_anew()

    def open(self) -> None:
        """Open the port for us alone, raw, with nothing in its buffers.

        Raises:
            BusNotAvailable: not there, not permitted or taken; the message says what to do.
            ConfigurationError: no such kind of port, or it has no such baud rate.
        """
        if self._port is not None:
            return
        port = self._open_port()
        self._port = port
        self._begin_anew()
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
        """A descriptor that is readable when ``receive`` has something to do; -1 while the bus is closed."""
        return -1 if self._epoll is None else self._epoll.fileno()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Append the frames that have arrived, at most ``batch.free``; the others stay, and the bus stays readable.

        Raises:
            BusNotAvailable: the port went away.
        """
        if self._port is None:
            raise BusNotAvailable(f"{self!r} is not open")
        if self._unsent:
            self._send_on()
        if not self._backlog:
            self._read(self._port)
        taken = 0
        while self._backlog and batch.free:
            framed, time_ns = self._backlog[0]
            count = min(len(framed), batch.free)
            rows = slice(batch.stop, batch.stop + count)
            fill_rows(batch.wire[rows], framed[:count])
            batch.time_ns[rows], batch.bus[rows] = time_ns[:count], ordinal
            batch.stop += count
            taken += count
            if count == len(framed):
                self._backlog.pop(0)
            else:
                self._backlog[0] = framed[count:], time_ns[count:]
        self._stay_readable(bool(self._backlog))
        self.counters.frames += taken
        return taken

    def send(self, identifier: int, payload: bytes) -> None:
        """Send one frame; what the port does not take at once follows when it can.

        Raises:
            BusSendError: not open, only listening, nothing that can be sent, or the port takes nothing any more.
        """
        try:
            self._send(identifier, payload)
        except BusSendError:
            self.counters.send_failures += 1
            raise
        self.counters.sent += 1

    def close(self) -> None:
        """Let go of the port. Idempotent."""
        if self._epoll is not None:
            self._epoll.close()
            self._epoll = None
            os.close(self._event)
        if self._port is not None:
            self._port.close()
            self._port = None

    def reason(self, time_ns: int) -> BusReason:
        """``BUS_ERRORS`` while most of what is received belongs to no frame: another baud rate, or another device."""
        return BusReason.BUS_ERRORS if self._is_garbled and time_ns < self._told_ns + 2 * _SPAN_NS else BusReason.NONE

    @property
    def note(self) -> str:
        """What a person should know about the port."""
        return "" if self._port is None else self._port.note

    def _begin_anew(self) -> None:
        counters = self.counters.framing
        counters.skipped_bytes += self._framer.pending
        self._framer = self._framing.framer()
        self._framer.counters = counters
        self._told, self._told_ns, self._is_garbled = replace(counters), 0, False
        self._reads.clear()
        self._backlog.clear()

    def _read(self, port: Port) -> None:
        chunk = more = port.read(_CHUNK)
        while len(more) >= _MORE_WAITS and len(chunk) < _CHUNK:
            try:
                more = port.read(_CHUNK - len(chunk))
            except BusNotAvailable:  # which the next read says again
                break
            chunk += more
        if not chunk:
            return
        time_ns = now_ns()
        framer, counters = self._framer, self.counters.framing
        known = framer.position
        damaged = counters.checksum_errors + counters.refused
        framed = framer.feed(chunk)
        damaged = counters.checksum_errors + counters.refused - damaged
        self.counters.errors += damaged
        if damaged and not len(framed):
            self.samples.note(Unused.REFUSED, 0, chunk)
        self._reads.append((framer.position, time_ns))
        fitting = [frame for frame in framed if len(frame.body) <= self.payload_size]
        self.counters.refused += len(framed) - len(fitting)
        if fitting:
            self._backlog.append((fitting, self._times(fitting, known, time_ns)))
        self._forget_reads()
        if time_ns > self._told_ns + _SPAN_NS:
            self._tell_garbled(time_ns)

    def _tell_garbled(self, time_ns: int) -> None:
        """Whether more was skipped than was good since it was last told."""
        now, before = self.counters.framing, self._told
        self._is_garbled = now.skipped_bytes - before.skipped_bytes > now.frame_bytes - before.frame_bytes
        self._told, self._told_ns = replace(now), time_ns

    def _times(self, framed: list[Framed], known: int, time_ns: int) -> npt.NDArray[np.int64]:
        """(n,) int64 ns: when the last byte of each frame was read."""
        if framed[0].end > known:
            return np.full(len(framed), time_ns)
        ends, times = zip(*self._reads, strict=True)  # some were held back behind a false beginning
        found: npt.NDArray[np.int64] = np.array(times)[np.searchsorted(ends, [frame.end for frame in framed])]
        return found

    def _forget_reads(self) -> None:
        """Keep the times of the bytes that are still held back."""
        undecided = self._framer.position - self._framer.pending
        if not self._framer.pending:
            self._reads.clear()
        while self._reads and self._reads[0][0] <= undecided:
            self._reads.pop(0)

    def _send(self, identifier: int, payload: bytes) -> None:
        self.may_send_by(self._port)
        try:
            data = self._commands.encode(identifier, payload)
        except ValueError as error:
            raise BusSendError(f"{self!r}: {error}") from None
        if len(self._unsent) + len(data) > _MOST_UNSENT:
            raise BusSendError(f"{self!r}: the port takes nothing any more ({len(self._unsent)} bytes wait)")
        waited = bool(self._unsent)
        self._unsent += data
        if not waited:
            try:
                self._send_on()
            except BusNotAvailable as error:
                self._unsent = b""
                raise BusSendError(str(error)) from None

    def _send_on(self) -> None:
        """Write what waits, as far as the port takes it, and be woken when it takes more."""
        port, epoll = self._port, self._epoll
        if port is None or epoll is None:
            return
        try:
            written = port.write(self._unsent)
        except OSError as error:
            raise BusNotAvailable(f"{self!r} went away, perhaps unplugged ({error.strerror or error})") from None
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

    ``note`` tells the path. What is sent while nobody reads fills the kernel's buffer and is then refused.
    """

    def _open_port(self) -> Port:
        return PtyPort(self._path)


def _split_options(channel: str, options: dict[str, str]) -> tuple[dict[str, str], str]:
    """Our options, and those that belong to a URL of pyserial's, as its query."""
    if "://" not in channel:
        return dict(options), ""
    own = set(SerialOptions.__struct_fields__)
    query = "&".join(f"{key}={text}" if text else key for key, text in options.items() if key not in own)
    return {key: text for key, text in options.items() if key in own}, f"?{query}" if query else ""


__all__ = ["PtyBus", "SerialBus"]
