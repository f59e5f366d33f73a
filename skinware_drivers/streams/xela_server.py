"""Messages of XELA's server: JSON, one message a line; taken apart into one frame for each sensor.

A frame has the number of its sensor as identifier, and as body the time in ms u32, then x, y and z of each taxel,
float32, all little-endian. Where the server tells forces they are these; where it does not, the raw counts, and the
identifier has the bit ``RAW``. Whenever a sensor is new, or is not what it was, and now and then, a frame with the
identifier 0 tells all that were seen so far, as JSON: ``{number: [model, taxels, whether forces are told]}``.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, ConfigurationError
from skinware.geometry import Geometry
from skinware.sensor_types import FORCE, PRESSURE, SHEAR_X, SHEAR_Y, SensorType
from skinware.status import Status
from skinware_drivers.description import Module, Patch, SkinTables, taxels
from skinware_drivers.hand import Grid
from skinware_drivers.layout import DeviceTime, Frame, Identifier, Layout, Sentinel, Values
from skinware_drivers.link import Link, Match
from skinware_drivers.options import check_options
from skinware_drivers.polling import Notice, Watch, ZeroWatch
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Framed, Framer, Framing

MOST_TAXELS = 1024
MOST_SENSORS = 128
RAW = 0x400
_AXES = 3
_MOST_TEXT = 64
_LONGEST = 1 << 17
_TELL_EVERY = 256
_U16 = 0xFFFF
_U32 = 0xFFFF_FFFF

Seen = dict[str, tuple[str, int, bool]]
"""By number of the sensor: model, taxels, whether it tells forces."""


@dataclass(frozen=True)
class XelaMessages(Framing):
    """The framing; only to be received."""

    maximum_body: int = field(default=4 + 4 * _AXES * MOST_TAXELS, init=False)

    def framer(self) -> Framer:
        return _Messages()

    def encode(self, identifier: int, payload: bytes) -> bytes:
        """Refuse: the server is told nothing.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"XELA's server is only read ({identifier:#x}, {len(payload)} bytes)")


class _Messages(Framer):
    def __init__(self) -> None:
        super().__init__()
        self._seen: Seen = {}
        self._untold = 0  # messages since it was last told what was seen

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        *lines, rest = stream.split(b"\n")
        found: list[Framed] = []
        done = 0
        for line in lines:
            done += len(line) + 1
            self._count(line, self._take_apart(line, self._before + done, found))
        if len(rest) > _LONGEST:  # no message, and nothing to hold back
            self.counters.refused += 1
            self.counters.skipped_bytes += len(rest)
            done = len(stream)
        return found, done

    def _count(self, line: bytes, is_good: bool | None) -> None:
        """Every byte of a line, once: of a message with values, of one without, or of none."""
        counters = self.counters
        if is_good:
            counters.frame_bytes += len(line) + 1
        elif is_good is None:
            counters.idle_bytes += len(line) + 1
        else:
            counters.refused += 1
            counters.skipped_bytes += len(line) + 1

    def _take_apart(self, line: bytes, end: int, found: list[Framed]) -> bool | None:
        """Find the frames of a message; None: it is in order and has no sensor, as the first one of a connection."""
        try:
            message = msgspec.json.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return False
        if not isinstance(message, dict):
            return False
        numbers = [key for key in message if key.isascii() and key.isdecimal()]
        if not numbers:
            return None if "message" in message else False
        if len(numbers) > MOST_SENSORS:
            return False
        frames, is_news, is_good = [], False, True
        for number in numbers:
            sensor = _sensor(number, message[number], message.get("time"))
            if sensor is None:
                is_good = False
                continue
            identifier, seen, body = sensor
            frames.append(Framed(identifier, body, end))
            if self._seen.get(number) != seen:
                is_news, self._seen[number] = True, seen
        self._untold += 1
        if frames and (is_news or self._untold >= _TELL_EVERY) and len(self._seen) <= MOST_SENSORS:
            self._untold = 0
            found.append(Framed(0, msgspec.json.encode(self._seen), end))
        found += frames
        return is_good or bool(frames)


def _sensor(key: str, sensor: Any, time: Any) -> tuple[int, tuple[str, int, bool], bytes] | None:
    """Identifier, what the sensor is, and body; None if it makes no sense."""
    if not isinstance(sensor, dict) or not 1 <= (number := int(key[:9])) <= 255 or key != str(number):
        return None
    model, taxels, time = sensor.get("model"), sensor.get("taxels"), sensor.get("time", time)
    if not isinstance(model, str) or len(model) > _MOST_TEXT or not isinstance(time, int | float):
        return None
    if type(taxels) is not int or not 1 <= taxels <= MOST_TAXELS or not math.isfinite(time):
        return None
    forces = sensor.get("calibrated")
    values = forces or _counts(sensor)
    if not isinstance(values, list) or len(values) != _AXES * taxels:
        return None
    try:
        body = struct.pack(f"<I{len(values)}f", int(time * 1e3) & _U32, *values)
    except (struct.error, OverflowError, TypeError):
        return None
    return number | (0 if forces else RAW), (model, taxels, bool(forces)), body


def _counts(sensor: dict[str, Any]) -> list[int] | None:
    """Raw counts: hexadecimal numbers with commas between them, or (newer servers also) a list."""
    data = sensor.get("data")
    try:
        values = [int(text, 16) for text in data.split(",")] if isinstance(data, str) else sensor.get("integer")
        fit = values is not None and all(type(value) is int and 0 <= value <= _U16 for value in values)
    except (TypeError, ValueError):
        return None
    return values if fit else None


log: logging.Logger = logging.getLogger("skinware.driver")

_STRUCTURE = Match(0)
_FIRST_S = 5.0
_COUNTS = tuple(kind.measured(unit="counts", minimum=0) for kind in (SHEAR_X, SHEAR_Y, PRESSURE))
_NAMES = (tuple(kind.name for kind in _COUNTS), tuple(kind.name for kind in FORCE))
_GRID_OF = re.compile(r"(?:uSPa|XR19|XR18)(\d)(\d)")
_GRID_TEXT = re.compile(r"(\d+)=(\d{1,3})x(\d{1,3})")
_APART_M = 0.04
_PITCH_M = 0.0047


class XelaServerOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver.

    Raises:
        ConfigurationError: an option is out of its limits.
    """

    period_ms: Annotated[
        float, Meta(ge=1, le=10_000, description="nominal time between two messages of the server, ms")
    ] = 10
    learn_s: Annotated[
        float, Meta(ge=0.05, le=60, description="how long to collect sensors after the first message, s")
    ] = 0.3
    grids: Annotated[
        tuple[str, ...],
        Meta(description="rows and columns of sensors whose model does not tell them, as 2=5x6 for sensor 2"),
    ] = ()

    def __post_init__(self) -> None:
        check_options(self)
        for text in self.grids:
            if _GRID_TEXT.fullmatch(text) is None:
                raise ConfigurationError(f"option grids: {text!r}: write NUMBER=ROWSxCOLUMNS, as 2=5x6")

    def grid(self, number: int, model: str, count: int) -> Grid | None:
        """How the taxels of a sensor are arranged; None: nobody has said, or what was said does not fit."""
        said = {int(match[1]): match for text in self.grids if (match := _GRID_TEXT.fullmatch(text))}
        match = said.get(number)
        rows, columns = (int(match[2]), int(match[3])) if match else _of_model(model)
        return Grid(rows, columns, _PITCH_M) if rows * columns == count else None


class XelaServerDriver(SerialAdapter[XelaServerOptions]):
    """All sensors of one server, each a patch; uid = sensor << 16 | taxel, for all axes of it."""

    framing: Framing = XelaMessages()
    dtype: npt.DTypeLike = np.float32
    layout: Layout

    def __init__(self, options: XelaServerOptions) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3
        self.types: Sequence[SensorType] = ()
        self.geometry: Geometry | None = None
        self._known: Seen = {}

    @property
    def payload_size(self) -> int:
        return -(-self.framing.maximum_body // 8) * 8

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Learn from the first messages which sensors there are.

        Raises:
            BusError: there are no messages with sensors.
        """
        with link.follow(_STRUCTURE) as told:
            self.change_framing(XelaMessages())  # which tells them anew
            try:
                async with asyncio.timeout(_FIRST_S):
                    seen = _read(await told.get())
            except TimeoutError:
                raise BusError(f"{link.bus_name}: no message with a sensor within {_FIRST_S:g} s") from None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self.options.learn_s):
                    while True:
                        seen = _read(await told.get())
        for number, (model, count, has_forces) in seen.items():
            what = "forces" if has_forces else "counts; for newtons: calibration = on in xServ.ini, if it has the model"
            log.info("%s: sensor %s: %s, %d taxels, %s", link.bus_name, number, model, count, what)
        self._known = seen
        return self._describe(seen)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Which sensors the server has; nobody else is waited for."""
        if "websocket:" not in link.bus_name:
            return None
        patches = await cls(XelaServerOptions()).describe(link)
        return f"XELA's server with {', '.join(patch.name for patch in patches)}"

    async def attend(self, link: Link) -> None:
        with link.follow(_STRUCTURE) as told:
            while True:
                seen = _read(await told.get())
                if any(self._known.get(number) != sensor for number, sensor in seen.items()):
                    self.tell(self._describe(self._known)[0], Notice.CHANGED)

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        """Sensors that tell nothing but 0."""
        return ZeroWatch(tables)

    def _describe(self, seen: Seen) -> list[Patch]:
        frames, patches, places = [], [], []
        has_counts, has_forces = (any(forces is kind for _, _, forces in seen.values()) for kind in (False, True))
        self.types = (*(_COUNTS if has_counts else ()), *(FORCE if has_forces else ()))
        for position, (key, (model, count, forces)) in enumerate(sorted(seen.items(), key=lambda item: int(item[0]))):
            number, names = int(key), _NAMES[forces]
            grid = self.options.grid(number, model, count)
            uids = [number << 16 | taxel for taxel in range(count)]
            kind = f"{grid.rows}x{grid.columns}" if grid else model
            module = Module(taxels(count, *names, first_uid=number << 16), kind=kind, name=model)
            patches.append(Patch(f"sensor {number} {model}", [module], key=number))
            frames.append(
                Frame(
                    f"sensor {number}",
                    [Identifier(number if forces else number | RAW)],
                    [4 + 12 * count],
                    Values(4, "<f4", 3 * count),
                    patch=number,
                    time=DeviceTime(0, "<u4", 1e-3),
                    flags=[] if forces else [Sentinel(Status.OUT_OF_RANGE, 0xFFFF)],
                )
            )
            if grid:
                places.append(grid.at((_APART_M * position, 0.0, 0.0), names, uids))
        self.layout = Layout(frames)
        self.geometry = Geometry.joined(places) if places else None
        return patches


def _read(told: object) -> Seen:
    payload: bytes = told.payload  # type: ignore[attr-defined]
    return msgspec.json.decode(payload, type=Seen)


def _of_model(model: str) -> tuple[int, int]:
    match = _GRID_OF.fullmatch(model)
    return (int(match[1]), int(match[2])) if match else (0, 0)
