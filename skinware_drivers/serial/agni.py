"""Devices that speak the AGNI serial protocol (Bielefeld University), and report which sensors they have.

Wire format: agni_serial_protocol, ``serial_protocol_defines.h`` and ``serial_protocol.cpp`` (BSD). All messages:
``F0 C4 | id | ... | exclusive or of all bytes before``.

* Commands to the device (id 0): a number: C0 (configuration), F1 (start), 00 (stop), F0 (alive?); D0 (period) adds
  count u16 LE, then sensor u8 and period u16 LE, in 0.1 ms, for each (service_set_period_cb in
  ubi-agni/agni_serial_protocol 18b224d, 2024-06-25). The device answers C0 and F0 only.
* Configuration (id 0): version 01, device u8, count n, n descriptors: type u16, payload length u16. Little-endian in
  the newer program, big-endian in an older one: option ``descriptors``. Sensor k of them (from 1) sends under id k.
* Data (id 1 to C9): time u32, payload; only the configuration gives their length.
* Alive (id F0): empty. Errors (id FE): u8 - F0 checksum, F1 unknown command, F2 unknown sensor; 01 to EE is the length
  of a text that follows (read_error): such errors are skipped as noise.

The wire does not say of which type the values of a sensor are: options ``devices`` and ``values``. That program does
not say of which unit the device's time is: option ``time_unit_us``.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.errors import BusError
from skinware_drivers import Link, Match, Module, Notice, Options, Patch, Sensor, operation
from skinware_drivers.fields import DeviceTime
from skinware_drivers.layout import Layout
from skinware_drivers.serial import XOR, Field, LengthTable, Packet, SerialAdapter, Unframed
from skinware_drivers.serial.agni_devices import DEVICES, TIME, AgniDevice, Name

_BEGIN = b"\xf0\xc4"
_IN_A_MS = 10
_LONGEST_MS = 0xFFFF // _IN_A_MS
_CONFIGURATION, _START, _STOP, _PERIOD, _ALIVE, _ERROR = 0xC0, 0xF1, 0x00, 0xD0, 0xF0, 0xFE
_MOST_SENSORS = 0xC9
_MOST_BYTES = 4096  # of a sensor's payload
_TIMEOUT_S, _TRIES = 0.5, 3
_ERRORS = {0xF0: "a wrong checksum", 0xF1: "an unknown command", 0xF2: "an unknown sensor"}


class AgniOptions(Options, frozen=True):
    period_ms: Annotated[
        int, Meta(ge=0, le=_LONGEST_MS, description="time between two messages; 0: leave the device's own")
    ] = 0
    usual_period_ms: Annotated[int, Meta(ge=1, description="the device's own period, if period_ms is 0")] = 10
    descriptors: Annotated[Literal["little", "big"], Meta(description="byte order of the sensor descriptors")] = (
        "little"
    )
    devices: Annotated[
        tuple[Name, ...],
        Meta(description="the makers' name of each sensor, in order; the last one is also that of all others"),
    ] = ("undefined",)
    values: Annotated[
        Literal["u1", "i1", "<u2", ">u2", "<i2", ">i2", "<f4"],
        Meta(description="numpy dtype of the values of an undefined sensor"),
    ] = "<u2"
    time_unit_us: Annotated[float, Meta(ge=0, description="unit of the device's time; 0: the time of receipt")] = 0.0


def command(number: int, arguments: bytes = b"") -> bytes:
    sent = _BEGIN + bytes((0, number)) + arguments
    return sent + XOR.to_bytes(sent)


def _framing(totals: dict[int, int], at: int, sync: tuple[int, ...] = tuple(_BEGIN)) -> Packet:
    table = LengthTable(at, totals)
    return Packet(sync=sync, length=table, checksum=XOR, identifier=Field(2), header=3)


class AgniDriver(SerialAdapter[AgniOptions]):
    framing = _framing({n: 7 + 4 * n for n in range(1, _MOST_SENSORS + 1)}, 5, (*_BEGIN, 0))
    commands = Unframed(1024)
    payload_size = _MOST_BYTES + 8

    def __init__(self, options: AgniOptions) -> None:
        super().__init__(options)
        self._period_ms = options.period_ms
        self.period_s = (options.period_ms or options.usual_period_ms) / 1e3
        self._configuration = b""
        self._patch: Patch | None = None
        self._n_sensors = 0
        undefined = AgniDevice(options.values, size=np.dtype(options.values).itemsize)
        self._devices = {"undefined": undefined, **DEVICES}
        self._names: Sequence[Name] = options.devices or ("undefined",)
        known = [self._devices[name] for name in self._names]
        self.types = list(dict.fromkeys(kind for device in known for kind in device.types))
        dtypes = [np.dtype(device.dtype).newbyteorder("=") for device in known]
        self.dtype = np.dtype(np.float32)
        if not any(dtype.kind == "f" for dtype in dtypes):
            common = np.result_type(*dtypes)
            self.dtype = np.dtype(np.int16) if common == np.int8 else common

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Ask the device for its sensors; it may still be sending for an earlier program."""
        if link.listen_only:
            raise BusError("a device reports the length of its messages only on request: listening is not enough")
        if self._patch is not None:
            self.change_framing(type(self).framing)
        await self.stop(link)
        configuration = await self._ask(link)
        version, device, n_sensors = configuration[:3]
        if version != 1 or len(configuration) != 3 + 4 * n_sensors:
            raise BusError(f"the device speaks version {version} of the protocol, this driver version 1")
        order = "<" if self.options.descriptors == "little" else ">"
        sensors = list(struct.iter_unpack(f"{order}HH", configuration[3:]))
        modules, frames, first_uid = [], [], 0
        time = DeviceTime(0, "<u4", self.options.time_unit_us / 1e6) if self.options.time_unit_us else None
        for number, (kind, length) in enumerate(sensors, 1):
            name = self._name(number)
            known = self._devices[name]
            count = known.count(length) if length <= _MOST_BYTES else 0
            if not count:
                raise BusError(
                    f"sensor {number} of type {kind} has {length} bytes: {self._wanted(name)}, up to {_MOST_BYTES}"
                    " bytes; look at the options devices, values and descriptors"
                )
            names = [of_value.name for of_value in known.types] * (count // len(known.types))
            channels = [Sensor(what, first_uid + n) for n, what in enumerate(names)]
            modules.append(Module(channels, number, f"type {kind}", "" if name == "undefined" else name))
            frames += known.frames(number, length, time, self.period_s)
            first_uid += count
        link.log.info("device %d with %d sensors", device, n_sensors)
        self.layout = Layout(frames)
        totals = {number: 3 + TIME + length + 1 for number, (_, length) in enumerate(sensors, 1)}
        self.change_framing(_framing({**totals, 0: 7 + 4 * n_sensors, _ALIVE: 4, _ERROR: 5}, 2))
        self._configuration, self._n_sensors = configuration, n_sensors
        self._patch = Patch(f"device {device}", modules)
        return [self._patch]

    def _name(self, number: int) -> Name:
        """Return the makers' name of sensor ``number``, from 1 on."""
        return self._names[min(number, len(self._names)) - 1]

    def _wanted(self, name: Name) -> str:
        if name == "undefined":
            return f"no whole number of values {self.options.values!r}"
        known = self._devices[name]
        return f"{name} sends {known.size}" + ("" if known.is_single else " for each value")

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask for its number and its number of sensors, which it answers also while it sends."""
        _, device, n_sensors = (await cls._ask(link))[:3]
        return f"AGNI device {device} with {n_sensors} sensors"

    async def configure(self, link: Link) -> None:
        if self._period_ms:
            each = b"".join(
                struct.pack("<BH", sensor, _IN_A_MS * self._period_ms) for sensor in range(1, self._n_sensors + 1)
            )
            await link.send(0, command(_PERIOD, struct.pack("<H", self._n_sensors) + each))

    async def start(self, link: Link) -> None:
        """Start all sensors; the device does not answer."""
        await link.send(0, command(_START))

    async def stop(self, link: Link) -> None:
        await link.send(0, command(_STOP))

    async def probe(self, link: Link, patch: Patch) -> bool:
        """Return whether the same device answers: then it was reset, and no longer sends by itself."""
        described = self.framing
        self.change_framing(type(self).framing)
        try:
            configuration = await self._ask(link, tries=1)
        finally:
            self.change_framing(described)
        if configuration == self._configuration:
            return True
        self.tell(patch, Notice.CHANGED)
        return False

    async def attend(self, link: Link) -> None:
        with link.follow(Match(_ERROR)) as heard:
            while True:
                error = (await heard.get()).payload[0]
                link.log.warning("the device received %s", _ERRORS.get(error, f"error {error:#04x}"))

    @operation()
    async def period(self, link: Link, patches: Sequence[Patch], ms: int) -> None:  # noqa: ARG002
        """Set the time between two messages of every sensor; the device does not answer."""
        if not 1 <= ms <= _LONGEST_MS:
            raise ValueError(f"{ms} ms: give 1 to {_LONGEST_MS}")
        self._period_ms = ms
        self.period_s = ms / 1e3
        await self.configure(link)

    @staticmethod
    async def _ask(link: Link, tries: int = _TRIES) -> bytes:
        reply = await link.request(0, command(_CONFIGURATION), Match(0), timeout_s=_TIMEOUT_S, tries=tries)
        return reply.payload
