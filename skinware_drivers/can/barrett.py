"""Barrett hand BH280 on CAN: 24 tactile cells on each of three fingers and the palm, read on request.

Wire format: owd ``openwam/CANbus.cc`` (github.com/personalrobotics/owd, 126b940, 2015-11-13), which drives real hands.
1 Mbit/s (CANbus.cc:240). Identifiers: bit 10: to a group, bits 9 to 5: sender, bits 4 to 0: receiver or group; the host
is 0, the hand's pucks are nodes 11 to 14, and group 5 is all of them. Set a property: ``80 | property, 00, value``
(four bytes, little-endian) to the node; ask for one: ``property`` to the node or group. The answer to a set or a
question of TACT is data; the answer about another property has bit 7 of the property set.

* TACT = 2, full: five frames to group 9 (``identifier & 0x41F == 0x409``), each with its number 0 to 4 in the first
  four bits and then five values of 12 bits (the last of frame 4 is unused), in 1/256 N/cm2. CANbus.cc stores each by
  its number, in any order; this driver publishes a set whose frames came from 0 to 4, all five.
* TACT = 1, top 10: one frame to group 8 (``== 0x408``): a map of 24 bits (the first bit is cell 0) of which ten are
  set, and the values of these ten cells in ascending order, four bits each, in N/cm2. The other cells are weaker;
  they are published as 0.

TACT is property 106 in firmware from 142 on; older firmware has none (``property_list.cpp`` in
BarrettTechnology/libbarrett 109faf6, 2018-07-18).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import ConfigurationError, HandshakeTimeout
from skinware.sensor_types import PRESSURE
from skinware_drivers import Link, Match, Module, Options, Patch, Poll, taxels
from skinware_drivers.can import CanAdapter
from skinware_drivers.fields import Bits, Byte, Identifier, Packed
from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values

FIRST_NODE, LAST_NODE = 11, 14
CELLS = 24
HAND_GROUP = 0x405
_VERSION, _TACT, _SET = 0, 106, 0x80
_REPLY_S = 0.1
_NODE = Bits(shift=5, width=5)
_PA_PER_N_CM2 = 1e4
_FULL = tuple(
    Frame(
        f"fifth {i}",
        when=(Identifier(0x409, mask=0x41F), Byte(0, i << 4, mask=0xF0)),
        length=(8,),
        patch=_NODE,
        values=Values(0, Packed(12, skip=4), 5, to=[5 * i + k if 5 * i + k < CELLS else None for k in range(5)]),
    )
    for i in range(5)
)


def _spread_top_10(
    payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[Any]]:
    """Return values of all 24 cells from the map and the ten values; cells outside the map are 0."""
    del length
    listed = np.unpackbits(np.ascontiguousarray(payload[:, :3]), axis=1).astype(bool)
    rank = np.cumsum(listed, axis=1) - 1
    listed &= rank < 10
    levels = np.stack([payload[:, 3:8] >> 4, payload[:, 3:8] & 0xF], axis=2).reshape(len(payload), 10)
    values = np.where(listed, np.take_along_axis(levels, np.clip(rank, 0, 9), axis=1), 0)
    row, cell = np.divmod(np.arange(values.size, dtype=np.int64), CELLS)
    return row, cell, values.reshape(-1)


_TOP_10 = Frame(
    "top 10", when=(Identifier(0x408, mask=0x41F),), length=(8,), patch=_NODE, values=Expand(_spread_top_10)
)


class BarrettOptions(Options, frozen=True):
    nodes: Annotated[tuple[int, ...], Meta(description="nodes with tactile cells, 11-14")] = (11, 12, 13, 14)
    format: Annotated[
        Literal["full", "top10"], Meta(description="all cells in 12 bits, or the ten strongest in four")
    ] = "full"
    period_ms: Annotated[int, Meta(description="time between two requests, ms", ge=5, le=1000)] = 20

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.nodes or len(set(self.nodes)) < len(self.nodes):
            raise ConfigurationError(f"nodes {self.nodes}: give at least one, and none twice")
        if not set(self.nodes) <= set(range(FIRST_NODE, LAST_NODE + 1)):
            raise ConfigurationError(f"nodes {self.nodes}: the hand has {FIRST_NODE} to {LAST_NODE}")


class BarrettDriver(CanAdapter[BarrettOptions]):
    """The hand's tactile cells, a patch for each node; uid = node << 8 | cell.

    Values are raw: 1/256 N/cm2 in the format ``full``, N/cm2 in ``top10``; the scale of the type converts to pascals.
    """

    dtype = np.uint16

    def __init__(self, options: BarrettOptions) -> None:
        super().__init__(options)
        self.patches = tuple(
            Patch(
                "palm" if node == LAST_NODE else f"finger {node - FIRST_NODE + 1}",
                [Module(taxels(CELLS, first_uid=node << 8), kind="pad")],
                key=node,
            )
            for node in options.nodes
        )
        if options.format == "full":
            names = tuple(frame.name for frame in _FULL)
            self.layout: Layout = Layout(_FULL, Cycle(names, within="patch", maximum_age_s=self.period_s / 2))
            greatest, scale = 4095, _PA_PER_N_CM2 / 256
        else:
            self.layout = Layout((_TOP_10,))
            greatest, scale = 15, _PA_PER_N_CM2
        self.types = (PRESSURE.measured(scale=scale, minimum=0, maximum=greatest * scale),)

    @property
    def polls(self) -> Sequence[Poll]:
        return (Poll(HAND_GROUP, bytes([_TACT]), self.period_s),)

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Return the nodes of the options, if at least one of them answers; a listener does not ask."""
        if not link.listen_only and not any([await self._answers(link, node) for node in self.options.nodes]):
            raise HandshakeTimeout(f"none of the nodes {', '.join(map(str, self.options.nodes))} answers")
        return self.patches

    async def configure(self, link: Link) -> None:
        """Choose the format; each node answers with data."""
        for patch in self.patches:
            await self.revive(link, patch)

    async def start(self, link: Link) -> None:
        """Wait for a period, so that the answers to ``configure`` are not taken for those to the first question."""
        await link.sleep(self.period_s)

    async def probe(self, link: Link, patch: Patch) -> bool:
        return await self._answers(link, patch.key)

    async def revive(self, link: Link, patch: Patch) -> None:
        value = 2 if self.options.format == "full" else 1
        await link.send(patch.key, bytes((_SET | _TACT, 0)) + value.to_bytes(4, "little"))

    async def _answers(self, link: Link, node: int) -> bool:
        reply = Match(node << 5, mask=0x3E0, prefix=bytes([_SET | _VERSION]))
        with contextlib.suppress(HandshakeTimeout):
            await link.request(node, bytes([_VERSION]), reply, timeout_s=_REPLY_S)
            return True
        return False
