"""A Modbus line or connection as a bus: its frames are the blocks of registers that a driver declared."""

from __future__ import annotations

import os
import select
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import msgspec
from msgspec import Meta

from skinware.errors import BusNotAvailable, BusSendError, ConfigurationError
from skinware.realtime import NS_PER_S, now_ns
from skinware.samples import Unused
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.master import Listener, Master, Talk, Timing
from skinware_drivers.modbus.registers import Order, Wanted
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.opening import DEFAULT_BAUDRATE, SerialOptions, find_port, open_port
from skinware_drivers.serial.ports import Port
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.address import Address, parse_address
from skinware_drivers.streams.tcp import TcpOptions, TcpPort, TcpServerBus, connect
from skinware_drivers.virtual.timer import MonotonicTimer, Timer

DEFAULT_PORT = 502
_TCP = "tcp://"
_SILENT_CHARACTERS, _BITS_PER_CHARACTER = 3.5, 11


class ModbusOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of a Modbus bus; those of a serial line, or of a connection, come beside them."""

    timeout_ms: Annotated[
        Annotated[float, Meta(gt=0)] | None, Meta(description="wait so long for a reply; default: as the driver says")
    ] = None
    turnaround_ms: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        Meta(description="pause after a reply; default: as the driver says, or 3.5 characters"),
    ] = None
    listen: Annotated[bool, Meta(description="send nothing: overhear another master on a tapped line")] = False
    byte_order: Annotated[Order | None, Meta(description="of a register; default: as the driver says")] = None
    word_order: Annotated[Order | None, Meta(description="of registers of a value; default: likewise")] = None


def device_end(channel: str, options: dict[str, str] | None = None, **more: Any) -> Bus:
    """The end at which emulated devices are: as bytes, which they take apart themselves.

    Raises:
        ConfigurationError: no such address, or an option is unknown or has a bad value.
    """
    if channel.startswith(_TCP):
        address = parse_address("modbus:tcp", channel.removeprefix(_TCP), default_port=DEFAULT_PORT, needs_host=False)
        return TcpServerBus(str(address), options, **more)
    return SerialBus(channel, options, **more)


class ModbusBus(Bus):
    """Its name is ``modbus:tcp://HOST[:PORT]`` or ``modbus:/dev/ttyUSB0``, with ``?key=value``.

    As master, it asks for the registers of :meth:`use` by itself, one question at a time. With ``listen``, or opened to
    listen only, it follows what another master on the same line asks, and sends nothing.

    ``send`` has a message (function and data) sent to a unit between two reads; the answer is a frame of the identifier
    ``ANSWERS | unit``. Only reads and writes of registers can be sent.

    Args:
        channel: ``tcp://HOST[:PORT]``, or the path of a port.
        options: see :class:`ModbusOptions`.
        payload_size: longest frame.
        listen_only: send nothing.
        make_timer: gives the timer that wakes it.

    Raises:
        ConfigurationError: no such address, an option is unknown or has a bad value, or a connection is to be tapped.
    """

    medium: ClassVar[str] = "modbus"
    opens_slowly: ClassVar[bool] = True
    device_end: ClassVar[Callable[..., Bus] | None] = staticmethod(device_end)

    def __init__(
        self,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
        make_timer: Callable[[], Timer] = MonotonicTimer,
    ) -> None:
        given = dict(options or {})
        own = {key: given.pop(key) for key in list(given) if key in ModbusOptions.__struct_fields__}
        self._modbus = options_from_strings(ModbusOptions, own)
        listens = listen_only or self._modbus.listen
        super().__init__(channel, options, payload_size=payload_size, listen_only=listens)
        self._address: Address | None = None
        if channel.startswith(_TCP):
            self._address = parse_address("modbus:tcp", channel.removeprefix(_TCP), default_port=DEFAULT_PORT)
            self._tcp_options = options_from_strings(TcpOptions, given)
            if listens:
                raise ConfigurationError(f"{self.name}: only a line can be tapped, not a connection: it needs a master")
        else:
            self._serial_options = options_from_strings(SerialOptions, given)
        self._make_timer = make_timer
        self._wanted = Wanted(())
        self._timing = Timing(NS_PER_S, NS_PER_S, 0)
        self._baudrate = DEFAULT_BAUDRATE
        self._port: Port | None = None
        self._talk: Talk | None = None
        self._unsent = b""

    @property
    def name(self) -> str:
        """As a user writes it."""
        return f"bus modbus:{self.channel}"

    @property
    def asks(self) -> bool:
        """Whether it waits for a reply: what comes next depends on how soon that is taken."""
        return not self.listen_only

    def use(self, wanted: Wanted, period_s: float, timeout_s: float, turnaround_s: float | None, baudrate: int) -> None:
        """Say what is asked for; takes effect at once, and anew when it is opened.

        Args:
            wanted: which registers; what the options of the bus say comes first.
            period_s: time from one cycle to the next.
            timeout_s: how long to wait for a reply.
            turnaround_s: pause after a reply; None: what the standard wants of a serial line, none over TCP.
            baudrate: unless the bus' name says another.
        """
        self._baudrate = baudrate if self._address is not None else self._serial_options.baudrate or baudrate
        if turnaround_s is None:
            turnaround_s = 0 if self._address else _SILENT_CHARACTERS * _BITS_PER_CHARACTER / self._baudrate
        if (turnaround_ms := self._modbus.turnaround_ms) is not None:
            turnaround_s = turnaround_ms / 1e3
        if (timeout_ms := self._modbus.timeout_ms) is not None:
            timeout_s = timeout_ms / 1e3
        self._timing = Timing(*(round(time_s * NS_PER_S) for time_s in (period_s, timeout_s, turnaround_s)))
        byte_order = self._modbus.byte_order or wanted.byte_order
        word_order = self._modbus.word_order or wanted.word_order
        self._wanted = replace(wanted, byte_order=byte_order, word_order=word_order)
        if self._port is not None:
            self._begin_anew()

    def open(self) -> None:
        """Connect, or open the line for us alone.

        Raises:
            BusNotAvailable: not there, not permitted or taken; the message says what to do.
            ConfigurationError: no such kind of port, or it has no such baud rate.
        """
        if self._port is not None:
            return
        self._port = self._open_port()
        self._timer = self._make_timer()
        self._epoll = select.epoll()
        self._epoll.register(self._port.fileno(), select.EPOLLIN)
        self._epoll.register(self._timer.fileno(), select.EPOLLIN)
        self._begin_anew()

    def _open_port(self) -> Port:
        if self._address is not None:
            return TcpPort(f"modbus:tcp://{self._address}", connect(self._address), self._tcp_options.patience_s)
        return open_port(find_port(self.channel, self._serial_options), self._serial_options, self._baudrate)

    def _begin_anew(self) -> None:
        self._unsent = b""
        if self.listen_only:
            self._talk = Listener(self._wanted, self.counters)
        else:
            over_tcp = self._address is not None
            self._talk = Master(
                self._wanted, self._timing, self.counters, over_tcp=over_tcp, name=self.name, begun_ns=now_ns()
            )
        self._wake()

    def fileno(self) -> int:
        """A descriptor that is readable when ``receive`` has something to do; -1 while the bus is closed."""
        return -1 if self._port is None else self._epoll.fileno()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Take replies, ask what is due, and append the frames that are whole.

        Raises:
            BusNotAvailable: the port went away, or no Modbus comes from it.
        """
        port, talk = self._port, self._talk
        if port is None or talk is None:
            raise BusNotAvailable(f"{self!r} is not open")
        if chunk := port.read(CHUNK):
            damaged = self.counters.framing.checksum_errors
            try:
                talk.heard(chunk, now_ns())
            except ValueError as error:
                raise BusNotAvailable(f"{self.name}: {error}") from None
            if self.counters.framing.checksum_errors > damaged:
                self.samples.note(Unused.REFUSED, 0, chunk)
        self._say(port, talk)
        taken = 0
        while talk.rows and batch.free:
            row = talk.rows.popleft()
            if len(row.payload) > batch.payload_size:
                self.counters.refused += 1
                continue
            batch.append(ordinal, row.time_ns, row.identifier, row.payload)
            taken += 1
        self.counters.frames += taken
        self._wake()
        return taken

    def send(self, identifier: int, payload: bytes) -> None:
        """Have a message sent to a unit between two reads.

        Args:
            identifier: the unit.
            payload: function and data.

        Raises:
            BusSendError: closed, only listening, too many wait already, or nothing but reads and writes of registers.
        """
        self.may_send_by(self._port)
        message = wire.Message(identifier, payload)
        if not 0 <= identifier <= 255 or not payload or not wire.reply_size(payload):
            raise BusSendError(f"{self.name}: [{payload.hex(' ')}] to unit {identifier} cannot be sent")
        if not isinstance(self._talk, Master) or not self._talk.command(message):
            self.counters.send_failures += 1
            raise BusSendError(f"{self.name}: too many questions wait to be asked")
        self._wake()

    def close(self) -> None:
        """Let go of the port. Idempotent."""
        if self._port is not None:
            self._epoll.close()
            self._timer.close()
            self._port.close()
            self._port = self._talk = None

    @property
    def note(self) -> str:
        """What a person should know about the port."""
        return "" if self._port is None else self._port.note

    def _say(self, port: Port, talk: Talk) -> None:
        said = talk.say(now_ns())
        if said or self._unsent:
            self._unsent += said
            try:
                self._unsent = self._unsent[port.write(self._unsent) :]
            except OSError as error:
                raise BusNotAvailable(f"{self.name}: {os.strerror(error.errno or 0)}") from None

    def _wake(self) -> None:
        """Be readable when something is due, or is still to be handed out."""
        talk = self._talk
        if talk is not None:
            self._timer.wake_at(0 if talk.rows or self._unsent else talk.due_ns)


__all__ = ["DEFAULT_PORT", "ModbusBus", "ModbusOptions", "device_end"]
