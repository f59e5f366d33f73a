"""Read a Modbus line or connection as a bus, whose frames are the blocks of registers that a driver declares."""

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
from skinware.status import Unused
from skinware_drivers.bus import Bus, FrameBatch, KernelBus
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.gateway import Gateway, Guests
from skinware_drivers.modbus.master import Listener, Master, Talk, Timing
from skinware_drivers.modbus.native_master import NativeMaster
from skinware_drivers.modbus.registers import Order, Wanted
from skinware_drivers.native.structs import Source
from skinware_drivers.options import options_from_strings
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.ports import DEFAULT_BAUDRATE, DescriptorPort, Port, SerialOptions, find_port, open_port
from skinware_drivers.serial.stream import CHUNK
from skinware_drivers.streams.bus import Address, parse_address
from skinware_drivers.streams.tcp import TcpOptions, TcpPort, TcpServerBus, connect
from skinware_drivers.virtual.hand_clock import REAL_CLOCK, Clock, Timer

DEFAULT_PORT = 502
_TCP = "tcp://"
_SILENT_CHARACTERS, _BITS_PER_CHARACTER = 3.5, 11
_FRAME_BYTES = 3
"""Unit and checksum around a message on a line."""


class ModbusOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    timeout_ms: Annotated[
        Annotated[float, Meta(gt=0)] | None, Meta(description="longest wait for a reply; default: of the driver")
    ] = None
    turnaround_ms: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        Meta(description="pause after a reply; default: of the driver, or 3.5 characters"),
    ] = None
    listen: Annotated[bool, Meta(description="send nothing: overhear another master on a tapped line")] = False
    byte_order: Annotated[Order | None, Meta(description="of the bytes of a register; default: of the driver")] = None
    word_order: Annotated[Order | None, Meta(description="of the registers of a value; default: of the driver")] = None
    gateway: Annotated[
        str, Meta(description="let other programs ask, too: PORT or HOST:PORT, or the path of a new port")
    ] = ""
    gateway_writes: Annotated[bool, Meta(description="no: refuse every write of the gateway's programs")] = True
    gateway_public: Annotated[bool, Meta(description="other machines may reach the gateway")] = False


def device_end(channel: str, options: dict[str, str] | None = None, **more: Any) -> Bus:
    """Make the device's end, for emulators: a bus of bytes, which they take apart themselves."""
    if channel.startswith(_TCP):
        address = parse_address("modbus:tcp", channel.removeprefix(_TCP), default_port=DEFAULT_PORT, needs_host=False)
        return TcpServerBus(str(address), options, **more)
    return SerialBus(channel, options, **more)


class ModbusBus(KernelBus):
    """A Modbus line or connection: ``modbus:tcp://HOST[:PORT]`` or ``modbus:/dev/ttyUSB0``, with ``?key=value``.

    As master, it asks for the registers of :meth:`use` by itself, one question at a time. With ``listen``, or opened to
    listen only, it follows the questions of another master on the same line and sends nothing.

    ``send`` sends a message (function and data) to a unit between two reads; its answer is a frame with the identifier
    ``ANSWERS | unit``. Only reads and writes of registers can be sent.

    With a ``gateway``, other programs ask through it between two reads.

    Args:
        channel: ``tcp://HOST[:PORT]``, or the path of a port.
    """

    medium: ClassVar[str] = "modbus"
    opens_slowly: ClassVar[bool] = True
    is_recorded: ClassVar[bool] = False
    """A recording, which goes on while a driver listens: the driver would miss that part."""
    device_end: ClassVar[Callable[..., Bus] | None] = staticmethod(device_end)

    def __init__(
        self,
        channel: str,
        options: dict[str, str] | None = None,
        *,
        payload_size: int = 8,
        listen_only: bool = False,
        clock: Clock = REAL_CLOCK,
    ) -> None:
        given = dict(options or {})
        own = {key: given.pop(key) for key in list(given) if key in ModbusOptions.__struct_fields__}
        self._modbus = options_from_strings(ModbusOptions, own)
        listens = listen_only or self._modbus.listen
        super().__init__(channel, options, payload_size=payload_size, listen_only=listens)
        self._address: Address | None = None
        if channel.startswith(_TCP):
            self._address = parse_address("modbus:tcp", channel.removeprefix(_TCP), default_port=DEFAULT_PORT)
            self._tcp_options = options_from_strings(TcpOptions, given, ModbusOptions.__struct_fields__)
            if listens:
                raise ConfigurationError(f"{self.name}: a connection cannot be tapped as a line can: it needs a master")
        else:
            self._serial_options = options_from_strings(SerialOptions, given, ModbusOptions.__struct_fields__)
        self._gateway: Gateway | None = None
        if self._modbus.gateway:
            if listens:
                raise ConfigurationError(f"{self.name}: a bus that only listens cannot ask for others: no gateway")
            guests = Guests(may_write=self._modbus.gateway_writes, over_tcp=self._address is not None)
            self._gateway = Gateway(self._modbus.gateway, guests, is_public=self._modbus.gateway_public)
        self._clock: Clock = clock
        self._wanted = Wanted(())
        self._timing = Timing(NS_PER_S, NS_PER_S, 0)
        self._baudrate = DEFAULT_BAUDRATE
        self._port: Port | None = None
        self._talk: Talk | None = None
        self._timer: Timer | None = None
        self._epoll: select.epoll | None = None
        self._unsent = b""
        self._left = b""  # read by C and not understood

    @property
    def name(self) -> str:
        return f"bus modbus:{self.channel}"

    @property
    def asks(self) -> bool:
        """Whether it waits for replies, so that the next question depends on how soon a reply is taken."""
        return not self.listen_only

    @property
    def byte_order(self) -> Order:
        """Order of the bytes of a register: from the options of the bus, else from the driver."""
        return self._wanted.byte_order

    def use(self, wanted: Wanted, period_s: float, timeout_s: float, turnaround_s: float | None, baudrate: int) -> None:
        """Set what to ask for, now and after each opening. Options of the bus override these arguments.

        Args:
            turnaround_s: pause after a reply; None: that of the standard on a serial line, none over TCP.
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
        if self._address is None and any(block.unit == 0 for block in wanted.blocks):
            raise ConfigurationError(f"{self.name}: unit 0 means all units of a line, and none answers: which unit?")
        if self._port is not None:
            self._begin()

    def cycle_s(self, wanted: Wanted, baudrate: int) -> float:
        """Return the time that the bytes of a cycle and the silence between them take on a serial line, s; 0 over TCP.

        Args:
            baudrate: unless the options of the bus give one.
        """
        if self._address is not None:
            return 0.0
        characters = sum(
            len(read.question) + wire.reply_size(read.question) + 2 * (_FRAME_BYTES + _SILENT_CHARACTERS)
            for read in wanted.reads()
        )
        return characters * _BITS_PER_CHARACTER / (self._serial_options.baudrate or baudrate)

    def open(self) -> None:
        if self._epoll is not None:
            return
        self._port = port = self._open_port()
        if self._gateway is not None:
            try:
                self._gateway.open()
            except BusNotAvailable:
                self._port = None
                port.close()
                raise
        self._timer = self._clock.timer()
        epoll = select.epoll()
        for each in (port, self._timer, self._gateway):
            if each is not None:
                epoll.register(each.fileno(), select.EPOLLIN)
        self._begin()
        self._epoll = epoll  # last: the driver looks at it while a thread opens the bus

    def _open_port(self) -> Port:
        if self._address is not None:
            return TcpPort(f"modbus:tcp://{self._address}", connect(self._address), self._tcp_options.patience_s)
        return open_port(find_port(self.channel, self._serial_options), self._serial_options, self._baudrate)

    def _begin(self) -> None:
        self._unsent = self._left = b""
        if self.listen_only:
            self._talk = Listener(self._wanted, self.counters)
        else:
            over_tcp = self._address is not None
            guests = None if self._gateway is None else self._gateway.guests
            if guests is not None:
                guests.give_up()
            self._talk = NativeMaster(
                self._wanted,
                self._timing,
                self.counters,
                over_tcp=over_tcp,
                name=self.name,
                begun_ns=now_ns(),
                guests=guests,
                before=self._talk.unanswered if isinstance(self._talk, Master) else None,
            )
        self._wake()

    def fileno(self) -> int:
        epoll = self._epoll
        return -1 if epoll is None else epoll.fileno()

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Take replies, ask what is due, and append the frames that are whole."""
        port, talk = self._port, self._talk
        if port is None or talk is None:
            raise BusNotAvailable(f"{self!r} is not open")
        if self._gateway is not None:
            self._gateway.serve(now_ns())
        left, self._left = self._left, b""
        come = port.read(CHUNK)
        self.tap.keep_bytes(now_ns(), come)
        if chunk := left + come:
            damaged = self.counters.framing.checksum_errors
            try:
                talk.heard(chunk, now_ns())
            except ValueError as error:
                raise BusNotAvailable(f"{self.name}: {error}") from None
            if self.counters.framing.checksum_errors > damaged:
                self.samples.note(Unused.REFUSED, 0, chunk)
        self._say(port, talk)
        if self._gateway is not None:
            self._gateway.watch()
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

    @property
    def reads_natively(self) -> bool:
        """Whether C asks and takes the replies as long as all are good."""
        return not self.listen_only and isinstance(self._port, DescriptorPort | None)

    def hand_over(self, batch: FrameBatch, source: Source) -> bool:  # noqa: ARG002
        talk, port = self._talk, self._port
        if not isinstance(talk, NativeMaster) or not isinstance(port, DescriptorPort):
            return False
        if self._epoll is None or self._timer is None:  # a thread is opening it
            return False
        if self._unsent or self._left:
            return False
        address = talk.hand_over(port.fileno(), -1 if self._gateway is None else self._gateway.fileno())
        if address is None:
            return False
        self._timer.wake_at(None)  # C looks at the time itself
        source.fd, source.asker, source.tap = self.fileno(), address, self.tap.address
        return True

    def take_back(self, source: Source) -> None:  # noqa: ARG002
        if isinstance(self._talk, NativeMaster):
            self._left = self._talk.take_back()
            self._wake()

    def nothing_received(self, number: int) -> int:  # noqa: ARG002
        """Return 0: Python reads again what C could not."""
        return 0

    def send(self, identifier: int, payload: bytes) -> None:
        """Send function and data of a read or write of registers to a unit (``identifier``) between two reads."""
        self.may_send_by(self._port)
        message = wire.Message(identifier, payload)
        if not 0 <= identifier <= 255 or not payload or not wire.reply_size(payload):
            raise BusSendError(f"{self.name}: [{payload.hex(' ')}] to unit {identifier} cannot be sent")
        if not isinstance(self._talk, Master) or not self._talk.command(message):
            self.counters.send_failures += 1
            raise BusSendError(f"{self.name}: too many questions wait to be asked")
        self._wake()

    def close(self) -> None:
        epoll, port, timer = self._epoll, self._port, self._timer
        self._epoll = self._port = self._timer = self._talk = None  # first: a thread may close it, too
        for each in (epoll, timer, self._gateway, port):
            if each is not None:
                each.close()

    @property
    def note(self) -> str:
        notes = [] if self._port is None else [self._port.note, "" if self._gateway is None else self._gateway.note]
        return ", ".join(filter(None, notes))

    def _say(self, port: Port, talk: Talk) -> None:
        said = talk.say(now_ns())
        if said or self._unsent:
            self._unsent += said
            sent_ns = now_ns()  # not later than an answer
            try:
                written = port.write(self._unsent)
            except OSError as error:
                raise BusNotAvailable(f"{self.name}: {os.strerror(error.errno or 0)}") from None
            self.tap.keep_bytes(sent_ns, self._unsent[:written], is_sent=True)
            self._unsent = self._unsent[written:]

    def _wake(self) -> None:
        """Be readable when something is due, or has still to be handed out."""
        talk, timer = self._talk, self._timer
        if talk is not None and timer is not None:
            timer.wake_at(0 if talk.rows or self._unsent or self._left else talk.due_ns)
