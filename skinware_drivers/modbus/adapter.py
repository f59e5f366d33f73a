"""The base class of drivers of Modbus devices, which declare only which registers hold which values."""

from __future__ import annotations

import contextlib
import logging
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, cast, get_args

import msgspec
import numpy as np
import numpy.typing as npt

from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.status import Status
from skinware_drivers.adapter import Adapter
from skinware_drivers.bus import Bus
from skinware_drivers.decoding.decoder import Updates
from skinware_drivers.description import SkinTables
from skinware_drivers.fields import AnyFlag, Identifier, Match
from skinware_drivers.layout import Frame, Layout
from skinware_drivers.link import Link
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.bus import ModbusBus
from skinware_drivers.modbus.master import ANSWERS
from skinware_drivers.modbus.registers import Order, Registers, Wanted
from skinware_drivers.options import OptionsT
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.serial.ports import DEFAULT_BAUDRATE

log: logging.Logger = logging.getLogger("skinware.driver")

_MOST_BLOCKS = 200
_LIMITS: dict[str, tuple[float, float]] = {
    "address_step": (1, 0xFFFF),
    "largest_gap": (0, 0xFFFF),
    "most_registers": (1, wire.MOST_REGISTERS),
    "timeout_s": (1e-6, 3600),
    "period_s": (1e-6, 3600),
}
_WORDS = {"byte_order": get_args(Order), "word_order": get_args(Order)}
_UNHURRIED = 1.25
"""Factor on the time that bytes take: devices need some before they answer."""
_LISTEN_S, _PERIODS, _LONGEST_LISTEN_S = 0.3, 4, 2.0
_SILENT_S, _SLOWEST_CYCLE_S = 1.0, 10.0
"""A device that sends nothing for so long is silent; longest cycle that is measured."""
_ENOUGH_CYCLES, _TOO_SLOW = 4, 1.1
"""A cycle that takes so many periods is too long: counts in a third of a second are exact to a tenth."""


class ModbusException(BusError):
    """A device answered a question with an exception.

    Attributes:
        code: 1 to 255; see the Modbus specification.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class ModbusAdapter(Adapter[OptionsT]):
    """One Modbus line or connection of a driver; see :class:`skinware_drivers.adapter.Adapter`.

    It reads, and never writes by itself. ``layout`` follows from the registers.

    Attributes:
        registers: blocks of registers, each with values of one module.
        flags: conditions that set status bits in every block, for example a value that means "none".
        timeout_s: longest wait for a reply.
        turnaround_s: pause after a reply; None: that of the standard.
        baudrate: of serial lines, unless the options of the bus give one.
        byte_order: of the bytes of a register.
        word_order: of the registers of a value that has several.
        address_step: from the address of one register to the next: 2 where addresses count bytes.
        largest_gap: unwanted registers that are read along at most, to save a question.
        most_registers: of a read.
        asks_first: ask for no registers before ``describe`` has asked the device which it has.
        follows_line: lengthen ``period_s`` where a serial line is too slow for it; see also :meth:`learn_period`.
    """

    medium: ClassVar[str] = "modbus"
    registers: Sequence[Registers] = ()
    flags: Sequence[AnyFlag] = ()
    timeout_s: float = 0.1
    turnaround_s: float | None = None
    baudrate: int = DEFAULT_BAUDRATE
    byte_order: Order = "big"
    word_order: Order = "big"
    address_step: int = 1
    largest_gap: int = 16
    most_registers: int = wire.MOST_REGISTERS
    asks_first: ClassVar[bool] = False
    follows_line: bool = False
    _line: ModbusBus | None = None

    def __init__(self, options: OptionsT) -> None:
        super().__init__(options)
        if self.registers:
            self.layout = self._layout()

    @property
    def payload_size(self) -> int:
        """Bytes of the longest frame, answers to the driver's own questions included."""
        return max(self.layout.payload_size if self.registers else 0, 256)

    @property
    def wanted(self) -> Wanted:
        """The registers that a bus asks for; ``wanted.reads()`` are the questions of a cycle."""
        sizes = self.address_step, self.largest_gap, self.most_registers
        return Wanted(self.registers, *sizes, self.byte_order, self.word_order)

    def check(self) -> None:
        """Check the driver and its registers."""
        is_declared, name = type(self).describe is Adapter.describe, type(self).__name__
        if is_declared and not self.registers:
            raise ConfigurationError(f"{name} has no `registers`")
        for what, words in _WORDS.items():
            if getattr(self, what) not in words:
                raise ConfigurationError(f"{name}: {what} = {getattr(self, what)!r}: give {' or '.join(words)}")
        super().check()
        if not is_declared:
            return
        modules = {patch.key: [module.key for module in patch.modules] for patch in self.patches}
        for block in self.registers:
            if block.patch is not None and block.patch not in modules:
                raise ConfigurationError(f"{block.name}: no patch has the key {block.patch}; there are: {[*modules]}")
            patches = list(modules) if block.patch is None else [block.patch]
            there = [key for patch in patches for key in modules[patch]]
            if block.module is not None and block.module not in there:
                raise ConfigurationError(f"{block.name}: no module has the key {block.module}; there are: {there}")

    def fit(self, bus: Bus) -> None:
        """Set what the bus asks for."""
        super().fit(bus)
        self._line = bus if isinstance(bus, ModbusBus) else None
        self.use_registers(() if self.asks_first and not bus.listen_only else self.registers)

    def use_registers(self, registers: Sequence[Registers]) -> None:
        """Read other registers from now on, for devices that are asked in ``describe`` which they have.

        Raises:
            ConfigurationError: they cannot be read.
        """
        self.registers = registers
        if registers:
            self.layout = self._layout()
        if self._line is not None:
            if self.follows_line:
                self.period_s = max(self.period_s, _UNHURRIED * self._line.cycle_s(self.wanted, self.baudrate))
            self._line.use(self.wanted, self.period_s, self.timeout_s, self.turnaround_s, self.baudrate)

    async def probe(self, link: Link, patch: object) -> bool:  # noqa: ARG002
        """Return False: the registers of a silent device are asked for all the time."""
        return False

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Read the first registers that the driver wants, which changes nothing in any device.

        A device that answers need not be the driver's: Modbus knows no names, and many devices have registers there.
        """
        of_default_options: Callable[[msgspec.Struct], ModbusAdapter[Any]] = cls
        adapter = of_default_options(cls.Options())
        if not adapter.registers:
            return None
        first = adapter.registers[0]
        count = min(first.count, adapter.most_registers)
        await adapter.read(link, first.address, count, unit=first.unit, function=first.function)
        return f"unit {first.unit} lets {count} registers be read at {first.address}, where this driver wants them"

    async def read(
        self, link: Link, address: int, count: int = 1, *, unit: int = 1, function: int = wire.READ_HOLDING
    ) -> npt.NDArray[np.uint16]:
        """Read registers once; return (count,) uint16.

        Raises:
            HandshakeTimeout: no answer.
            ModbusException: the device refuses.
        """
        question = wire.question_to_read(function, address, count)
        answer = await self._ask(link, unit, question)
        return np.frombuffer(answer[2:], self._register).astype(np.uint16)

    async def read_or_none(
        self, link: Link, address: int, count: int = 1, *, unit: int = 1, function: int = wire.READ_HOLDING
    ) -> tuple[int, ...] | None:
        """Read registers once; return None where the device refuses, because it has no such registers.

        Raises:
            HandshakeTimeout: no answer.
        """
        try:
            return tuple((await self.read(link, address, count, unit=unit, function=function)).tolist())
        except ModbusException:
            return None

    async def find_unit(self, link: Link, units: Sequence[int], address: int) -> int:
        """Return the first of these units that answers a question for a register, or refuses it; else the last one."""
        for unit in units[:-1]:
            for _ in range(2):  # an answer that is lost must not lead to another device
                with contextlib.suppress(HandshakeTimeout):
                    await self.read_or_none(link, address, unit=unit)
                    return unit
        return units[-1]

    async def write(self, link: Link, address: int, values: Sequence[int], *, unit: int = 1) -> None:
        """Write registers (function 16): only those of the device's documentation, and only when a person wants it.

        Raises:
            HandshakeTimeout: no answer.
            ModbusException: the device refuses.
            ValueError: too many, or none.
        """
        if not 1 <= len(values) <= wire.MOST_WRITTEN:
            raise ValueError(f"{len(values)} registers: give 1 to {wire.MOST_WRITTEN}")
        data = np.array(values, self._register).tobytes()
        await self._ask(link, unit, struct.pack(">BHHB", wire.WRITE_MANY, address, len(values), len(data)) + data)

    @property
    def _register(self) -> np.dtype[np.uint16]:
        order = self.byte_order if self._line is None else self._line.byte_order
        return np.dtype(">u2" if order == "big" else "<u2")

    async def learn_period(self, link: Link) -> None:
        """With ``follows_line``, measure how long a cycle takes: for ``describe`` of devices that need several reads.

        If a device is asked faster than it answers, no cycle is ever complete, and some values are always stale.
        """
        if not self.follows_line or self._line is None or self._line.is_recorded:
            return
        times: Counter[int] = Counter()
        passed_s, cycles, longest_s = 0.0, 0.0, _LONGEST_LISTEN_S
        while cycles < _ENOUGH_CYCLES and passed_s < longest_s:
            step_s = max(_LISTEN_S, _PERIODS * self.period_s)
            for one, n in (await link.listen(step_s)).items():
                times[one.identifier] += n
            passed_s += step_s
            cycles = max(times.values(), default=0)
            if not cycles and passed_s > _SILENT_S:
                return
            longest_s = _LONGEST_LISTEN_S if cycles > 1 else _SLOWEST_CYCLE_S
        if cycles < _ENOUGH_CYCLES:
            cycles = times.total() / max(1, len(times))
        if (cycle_s := passed_s / cycles) > _TOO_SLOW * self.period_s:
            link.log.info("a cycle takes about %.0f ms", 1e3 * cycle_s)
            self.period_s = _UNHURRIED * cycle_s
            self.use_registers(self.registers)

    async def _ask(self, link: Link, unit: int, question: bytes) -> bytes:
        timeout_s = 4 * self.timeout_s + 1  # the read before, and the gateway's question, come first
        reply = await link.request(unit, question, Match(ANSWERS | unit), timeout_s=timeout_s)
        if not wire.is_reply(question, reply.payload):  # late, to a question that was given up
            raise BusError(f"{link.bus_name}, unit {unit}: it answered another question")
        if code := wire.exception_of(reply.payload):
            raise ModbusException(f"{link.bus_name}, unit {unit}: {wire.exception_text(code)}", code)
        return reply.payload

    def _layout(self) -> Layout:
        name, declared = type(self).__name__, cast("object", self.registers)
        if not isinstance(declared, Sequence) or not all(isinstance(each, Registers) for each in declared):
            raise ConfigurationError(f"{name}: `registers` is a list of Registers(address, count, ...)")
        if len(self.registers) > _MOST_BLOCKS:
            raise ConfigurationError(f"{len(self.registers)} blocks of registers: give at most {_MOST_BLOCKS}")
        for what, (least, most) in _LIMITS.items():
            number = getattr(self, what)
            if not (isinstance(number, int | float) and least <= number <= most):
                raise ConfigurationError(f"{name}: {what} = {number!r}: give {least:g} to {most:g}")
        frames, owners = [], dict[tuple[int | None, int | None, int], Registers]()
        for number, block in enumerate(self.registers):
            block.check(self.address_step)
            for channel in (channel for run in block.runs for channel in run.channels if channel is not None):
                owner = owners.setdefault((block.patch, block.module, channel), block)
                if owner is not block:
                    raise ConfigurationError(
                        f"{owner.name} and {block.name} both have the value of channel {channel}: say which patch or"
                        " module each is of, or with `to` which channels it has"
                    )
            frames.append(
                Frame(
                    f"{block.name} ({number})",
                    [Identifier(number)],
                    [2 * block.count],
                    block.runs,
                    patch=block.patch,
                    module=block.module,
                    flags=[*self.flags, *block.flags],
                )
            )
        return Layout(frames)


class ExplainingWatch(ZeroWatch):
    """Also log, once each, what status bits that came from the wire mean for a device.

    Attributes:
        meanings: status bits, and what to log.
    """

    meanings: ClassVar[Sequence[tuple[Status, str]]]

    def __init__(self, tables: SkinTables) -> None:
        super().__init__(tables)
        self._unsaid = dict(self.meanings)

    def look(self, updates: Updates) -> None:
        super().look(updates)
        if not self._unsaid:
            return
        status = updates.status[updates.sensors < self.tables.structure.n_sensors]
        for bit in [bit for bit in self._unsaid if (status & bit).any()]:
            log.warning("%s", self._unsaid.pop(bit))


def above_text(full_scale: int) -> str:
    """Return the meaning of values above the greatest value of a taxel."""
    return (
        f"values above {full_scale}, which no taxel has, are suspect; if there are many, the device may send the bytes"
        " of registers in the other order: add byte_order=little to the options of the bus"
    )
