"""XELA's server: JSON messages, one a line, that become one frame for each sensor.

The identifier of a frame is the number of its sensor. The body is the time in ms (u32), then x, y and z of each taxel
(float32), all little-endian: forces if the server sends them, else raw counts, with the bit ``RAW`` in the identifier.
When a sensor is new or has changed, and now and then, a frame with the identifier 0 lists all sensors seen so far, as
JSON: ``{number: [model, taxels, whether it sends forces]}``.
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
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import DeviceTime, Identifier, Match, Reply, Sentinel
from skinware_drivers.hand import Grid, Place
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.options import Options
from skinware_drivers.polling import Notice, ZeroWatch
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Framed, Framer, Framing, ReceivedFraming

MOST_TAXELS = 1024
MOST_SENSORS = 128
RAW = 0x400
_AXES = 3
_MOST_TEXT = 64
_LONGEST = 1 << 17
_LIST_EVERY = 256
_U16 = 0xFFFF
_U32 = 0xFFFF_FFFF

Seen = dict[str, tuple[str, int, bool]]
"""By number of the sensor: model, taxels, whether it sends forces."""


@dataclass(frozen=True)
class XelaMessages(ReceivedFraming):
    """The framing, for receiving only."""

    maximum_body: int = field(default=4 + 4 * _AXES * MOST_TAXELS, init=False)

    def framer(self) -> Framer:
        return _SeenMessages()


class _SeenMessages(Framer):
    def __init__(self) -> None:
        super().__init__()
        self._seen: Seen = {}
        self._unlisted = 0  # messages since the last list of sensors

    def _find(self, stream: bytes) -> tuple[list[Framed], int]:
        *lines, rest = stream.split(b"\n")
        found: list[Framed] = []
        done = 0
        for line in lines:
            done += len(line) + 1
            is_good = self._take_apart(line, self._before + done, found)
            if is_good:
                self.counters.frame_bytes += len(line) + 1
            elif is_good is None:
                self.counters.idle_bytes += len(line) + 1
            else:
                self.counters.refused += 1
                self.counters.skipped_bytes += len(line) + 1
        if len(rest) > _LONGEST:  # no message, and nothing to hold back
            self.counters.refused += 1
            self.counters.skipped_bytes += len(rest)
            done = len(stream)
        return found, done

    def _take_apart(self, line: bytes, end: int, found: list[Framed]) -> bool | None:
        """Append the frames of a message to ``found``; return None for one without sensors, False for a bad one."""
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
        self._unlisted += 1
        if frames and (is_news or self._unlisted >= _LIST_EVERY) and len(self._seen) <= MOST_SENSORS:
            self._unlisted = 0
            found.append(Framed(0, msgspec.json.encode(self._seen), end))
        found += frames
        return is_good or bool(frames)


def _sensor(key: str, sensor: Any, time: Any) -> tuple[int, tuple[str, int, bool], bytes] | None:
    """Return identifier, description and body of a sensor; None if they make no sense."""
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
    """Return the raw counts, from hexadecimal numbers with commas or (newer servers also) a list."""
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


class XelaServerOptions(Options, frozen=True):
    period_ms: Annotated[
        float, Meta(ge=1, le=10_000, description="nominal time between two messages of the server, ms")
    ] = 10
    learn_s: Annotated[
        float, Meta(ge=0.05, le=60, description="how long to collect sensors after the first message, s")
    ] = 0.3
    grids: Annotated[
        tuple[str, ...],
        Meta(description="rows and columns of sensors whose model name lacks them, as 2=5x6 for sensor 2"),
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for text in self.grids:
            if _GRID_TEXT.fullmatch(text) is None:
                raise ConfigurationError(f"option grids: {text!r}: write NUMBER=ROWSxCOLUMNS, as 2=5x6")

    def grid(self, number: int, model: str, count: int) -> Grid | None:
        """Return the grid of a sensor's taxels, by the options or its model; None: unknown, or it does not fit."""
        given = {int(match[1]): match.groups()[1:] for text in self.grids if (match := _GRID_TEXT.fullmatch(text))}
        match = _GRID_OF.fullmatch(model)
        rows, columns = map(int, given.get(number, match.groups() if match else (0, 0)))
        return Grid(rows, columns, _PITCH_M) if rows * columns == count else None


class XelaServerDriver(SerialAdapter[XelaServerOptions]):
    """All sensors of one server, each a patch; uid = sensor << 16 | taxel, for all axes of it."""

    framing: Framing = XelaMessages()
    dtype: npt.DTypeLike = np.float32
    layout: Layout
    watch = ZeroWatch
    payload_size = -(-framing.maximum_body // 8) * 8

    def __init__(self, options: XelaServerOptions) -> None:
        super().__init__(options)
        self.period_s: float = options.period_ms / 1e3
        self.types: Sequence[SensorType] = ()
        self.geometry: Geometry | None = None
        self._known: Seen = {}

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Learn the sensors from the first messages."""
        with link.follow(_STRUCTURE) as lists:
            self.change_framing(XelaMessages())  # lists them again
            try:
                async with asyncio.timeout(_FIRST_S):
                    seen = _read(await lists.get())
            except TimeoutError:
                raise BusError(f"{link.bus_name}: no message with a sensor within {_FIRST_S:g} s") from None
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self.options.learn_s):
                    while True:
                        seen = _read(await lists.get())
        for number, (model, count, has_forces) in seen.items():
            what = "forces" if has_forces else "counts; for newtons: calibration = on in xServ.ini, if it has the model"
            log.info("%s: sensor %s: %s, %d taxels, %s", link.bus_name, number, model, count, what)
        self._known = seen
        return self._describe(seen)

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:  # noqa: ARG003
        """Return the sensors of the server; other buses are not waited for."""
        if "websocket:" not in link.bus_name:
            return None
        patches = await cls(XelaServerOptions()).describe(link)
        return f"XELA's server with {', '.join(patch.name for patch in patches)}"

    async def attend(self, link: Link) -> None:
        with link.follow(_STRUCTURE) as lists:
            while True:
                seen = _read(await lists.get())
                if any(self._known.get(number) != sensor for number, sensor in seen.items()):
                    self.tell(self._describe(self._known)[0], Notice.CHANGED)

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
                places.append(grid.at(Place("sensors_nominal", (_APART_M * position, 0.0, 0.0)), names, uids))
        self.layout = Layout(frames)
        self.geometry = Geometry.joined(places) if places else None
        return patches


def _read(frame: Reply) -> Seen:
    return msgspec.json.decode(frame.payload, type=Seen)
