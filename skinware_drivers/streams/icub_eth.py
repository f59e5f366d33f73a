"""ROBOSKIN boards behind iCub's Ethernet boards (EMS, MC4PLUS, MC2PLUS): the CAN frames in their UDP datagrams.

What is in a datagram: ``icub_rops``. What is in the CAN frames: ``skinware_drivers.can.roboskin_layout``. Only listened
to: the robot's own program sets the boards up, starts their skin service, and is whom they send to.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError
from skinware.sensor_types import SensorType
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import SKIN_TYPES
from skinware_drivers.can.roboskin_options import Kind, RoboskinOptions
from skinware_drivers.description import Patch, SkinTables
from skinware_drivers.layout import Layout
from skinware_drivers.link import Link
from skinware_drivers.options import check_options
from skinware_drivers.polling import Watch
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.framing import Framing
from skinware_drivers.streams.icub_rops import rops


class IcubEthOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Options of the driver; those of ``roboskin`` that matter to who listens.

    Raises:
        ConfigurationError: an option is out of its limits.
    """

    port: Annotated[Literal[1, 2], Meta(description="CAN port of the Ethernet board that the skin is on")] = 1
    period_ms: Annotated[int, Meta(ge=1, le=255, description="time between two updates, as the boards are set up")] = 50
    skin_type: Annotated[int, Meta(ge=0, le=15, description="skin type that the boards are set up with")] = 0
    kind: Annotated[str, Meta(description="kind of all modules: triangle, fingertip or palm; empty: by skin_type")] = ""
    modules: Annotated[tuple[Kind, ...], Meta(description="modules of other kinds")] = ()
    old_style: Annotated[bool, Meta(description="set up in the old way: skin data in message class 3")] = False
    learn_s: Annotated[float, Meta(gt=0, le=60, description="how long to learn which modules send, s")] = 1.0

    def __post_init__(self) -> None:
        check_options(self)
        self.of_roboskin()

    def of_roboskin(self) -> RoboskinOptions:
        """As the driver of the boards on CAN knows them.

        Raises:
            ConfigurationError: they are none.
        """
        given = msgspec.structs.asdict(self)
        del given["port"]
        return RoboskinOptions(**given)


class IcubEthDriver(SerialAdapter[IcubEthOptions]):
    """The skin boards on one CAN port of an Ethernet board; patches, modules and uids are those of ``roboskin``."""

    framing: Framing = rops(1)
    types: Sequence[SensorType] = SKIN_TYPES
    dtype: npt.DTypeLike = np.uint8
    layout: Layout
    payload_bytes: ClassVar[int] = 8

    def __init__(self, options: IcubEthOptions) -> None:
        super().__init__(options)
        self.framing = rops(options.port)
        self._boards = RoboskinDriver(options.of_roboskin())
        self.layout, self.period_s = self._boards.layout, self._boards.period_s

    @property
    def payload_size(self) -> int:
        return self.payload_bytes

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Learn from the data which boards and modules there are.

        Raises:
            BusError: there are no skin data.
        """
        patches = self._boards.patches_heard(await link.listen(self.options.learn_s), ())
        if not patches:
            raise BusError(f"{link.bus_name}: no skin data: has the robot's program started the skin of this board?")
        return patches

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:
        return self._boards.patches_heard(await link.listen(self.options.learn_s), known)

    async def revive(self, link: Link, patch: Patch) -> None:
        """Wait: nobody but the robot's program sets a board up."""

    @classmethod
    def watch(cls, tables: SkinTables) -> Watch:
        return RoboskinDriver.watch(tables)
