"""XELA's uSkin sensors behind the maker's own server (``xela_server``, XELA Suite), which speaks JSON over a websocket.

Wire format: XELA's programs xela_server_ros and xela_server_ros2 (github.com/mcsix, version 1.7.6; MIT); also the
programs of others that read the same server. The server listens on port 5000. First it sends ``{"message":
"Welcome"}``, then messages such as ::

    {"message": 1476, "time": 1695690788.83, "sensors": 1, "type": "routine",
     "1": {"sensor": "1", "model": "uSPa44", "taxels": 16, "time": 1695690788.83,
           "data": "B8BF,37B0,881E, ...", "calibrated": [0.70, 4.32, -4.43, ...]}}

with an entry for each sensor under its number: x, y and z of each taxel, "starting from top left and continuing
line-by-line"; in ``data`` as hexadecimal counts of 16 bits, in ``calibrated`` as forces in newtons, if the server
has a calibration for the model and ``calibration = on`` in its file xServ.ini. The message number is no sample number.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
from collections.abc import Sequence
from typing import Annotated

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
from skinware_drivers.serial.framing import Framing
from skinware_drivers.streams.xela_messages import RAW, Seen, XelaMessages

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
