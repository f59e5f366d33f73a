"""Wonik Allegro hand V5: the air pressure of its fingertips (4F, Plus), or sixteen pads (Sense). Listens only.

Wire format: the maker's allegro_hand_ros2_v5 and allegro_hand_ros2_V5_Sense, and a user's allegro_hand_v5_plus_python.
The hand sends by itself once its own program has set the period and switched the servos on. This driver never sends.

On CAN, 1 Mbit/s, little-endian, identifier = number of the message << 2:

* 4F, Plus: message 0F0 has the index and middle fingertip, 0F2 the ring finger and thumb; an int32 in Pa each. The
  manual calls the messages 050 and 052: both pairs are read. Zero is the pressure of the air in the manual, and a
  vacuum (101,325 at rest) in a published program: option ``zero_pa``.
* Sense: message 054 has palm, thumb 1, 2 and tip, index finger 1, 2, 3 and tip; 055 the middle and ring finger in the
  same order. A byte each, in 0.4 kPa; FF: no value. The maker's program for CAN does not divide the palm's value by
  ten, the program for UDP does: option ``palm``. Messages 056 and 057 of older firmware are not read.

Sense over UDP, from its port 7000 to port 8000, every 3 ms, little-endian: ``56 35 42 32``, version 1, type, length
u16, number u32, ms u32. Type 2 continues with 164 bytes: number of the sample u32, position and current of 16 joints
(int16), the sixteen pads (u16, 0.1 kPa), velocity of the joints (int32). The length counts the bytes behind the header
(tcpdef.h in Wonikrobotics-git/allegro_hand_ros2_V5_Sense db81588, 2026-05-27); only datagrams of 180 bytes are
decoded. No source names a value that means "none"; 65535, which is no pressure, is marked as suspect.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from skinware.errors import BusError, HandshakeTimeout
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE
from skinware.status import Status
from skinware_drivers import Link, Match, Module, Options, Patch, taxels
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.can import CanAdapter
from skinware_drivers.fields import Byte, Identifier, Reply, Sentinel, SequenceNumber
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.layout import Expand, Frame, Layout, Values
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.serial import SerialAdapter, Unframed

log: logging.Logger = logging.getLogger("skinware.driver")

TIPS = {"index and middle": (0x3C0, 0x140), "ring and thumb": (0x3C8, 0x148)}
"""Modules of hands with fingertips, and the identifiers of their frames; uid: 0 to 3, index finger to thumb."""
PADS = {"palm, thumb and index": 0x150, "middle and ring": 0x154}
"""Modules of hands with pads, and the identifiers of their frames; uid: 0 palm, 1 thumb, 4 index, 8 middle, 12 ring."""
N_PADS = 16
_TIP_FRAMES = [
    Frame(f"{name}, {one:03X}", [Identifier(one)], [8], Values(0, "<i4", 2), module=ids[0])
    for name, ids in TIPS.items()
    for one in ids
]
_NONE, _MOST = 0xFF, 0xFE
_PAD_FLAGS = (Sentinel(Status.NO_ACK, _NONE), Sentinel(Status.OUT_OF_RANGE, _MOST))
_PAD_FRAMES = [
    Frame(name, [Identifier(one)], [8], Values(0, "u1", 8), module=one, flags=_PAD_FLAGS) for name, one in PADS.items()
]
_ENDS = 0xFF00
"""Offset of the two special values FE and FF where values are wider than a byte."""
_PA_IN_A_BYTE, _PA_OVER_UDP = 400.0, 100.0
_AIR_PA = range(60_000, 150_000)
"""Pressure of the air, from the highest towns to the sea, with a press added."""
_FROM_PAD_TO_PAD_M = 0.02
_LONGEST_DATAGRAM = 1472
_TWICE = 1.5
"""Messages per period above which two hands are assumed."""


class AllegroV5Options(Options, frozen=True):
    model: Annotated[
        Literal["auto", "tips", "sense"],
        Meta(description="tips: 4F or Plus, with fingertips; sense: V5 Sense; auto: by the frames"),
    ] = "auto"
    zero_pa: Annotated[
        int, Meta(description="what an untouched fingertip sends, Pa: 0, or 101325 for the pressure of the air")
    ] = 0
    side: Annotated[Literal["right", "left"], Meta(description="which hand it is, for the places")] = "right"
    palm: Annotated[
        Literal["alike", "tenfold"],
        Meta(description="on CAN, the unit of a Sense's palm: the unit of the other pads, or ten times that"),
    ] = "alike"
    period_ms: Annotated[
        Annotated[int, Meta(ge=1)] | None,
        Meta(description="nominal time between two messages, ms; default: 10 on CAN, 3 over UDP"),
    ] = None
    learn_s: Annotated[float, Meta(description="time of listening for the model, s", gt=0)] = 0.5


class AllegroV5UdpDriver(SerialAdapter[AllegroV5Options]):
    """One V5 Sense over UDP; each datagram is a sample."""

    types = (PRESSURE.measured(scale=_PA_OVER_UDP, minimum=0),)
    dtype = np.uint16
    period_s = 0.003
    framing = Unframed(_LONGEST_DATAGRAM)
    layout = Layout(
        [
            Frame(
                "sample",
                [Byte(at, value) for at, value in enumerate((0x56, 0x35, 0x42, 0x32, 1, 2))],
                [180],
                Values(84, "<u2", N_PADS),
                sequence=SequenceNumber(16, "<u4"),
                flags=[Sentinel(Status.SUSPECT, 0xFFFF)],
            )
        ]
    )
    patches = (Patch("hand", [Module(taxels(N_PADS), kind="pads")]),)
    watch = ZeroWatch

    def __init__(self, options: AllegroV5Options) -> None:
        super().__init__(options)
        self.geometry = _places_of_pads(options.side)

    async def probe(self, link: Link, patch: Patch) -> bool:  # noqa: ARG002
        return False


class AllegroV5Driver(CanAdapter[AllegroV5Options]):
    """One hand on CAN, or a V5 Sense over UDP."""

    elsewhere: ClassVar[Sequence[type[AnyAdapter]]] = (AllegroV5UdpDriver,)
    payload_size = 8
    period_s = 0.01
    layout = Layout([*_TIP_FRAMES, *_PAD_FRAMES])
    watch = ZeroWatch

    async def describe(self, link: Link) -> Sequence[Patch]:
        """Return the hand of the option ``model``, or of the frames that are heard."""
        model = self.options.model
        of_tips = [Match(one) for ids in TIPS.values() for one in ids]
        with link.follow(*of_tips) as frames:
            counted = Counter[int]()
            for one, times in (await link.listen(self.options.learn_s)).items():
                counted[one.identifier] += times
        heard = set(counted)
        self._refuse_two(link, counted)
        if model == "sense":
            self._take_pads()
            return self.patches
        if model == "tips" or not heard.isdisjoint(match.value for match in of_tips):
            self._take_tips()
            self._judge_zero([frames.get_nowait() for _ in range(frames.qsize())])
        elif not heard.isdisjoint(PADS.values()):
            self._take_pads()
        else:
            raise HandshakeTimeout(
                f"{link.bus_name}: no frames of the hand's skin are heard; its own program has to set a period and to"
                " switch the servos on"
            )
        return self.patches

    async def join(self, link: Link, known: Sequence[Patch]) -> Sequence[Patch]:  # noqa: ARG002
        return known

    async def probe(self, link: Link, patch: Patch) -> bool:  # noqa: ARG002
        return False

    def _refuse_two(self, link: Link, counted: Counter[int]) -> None:
        """Refuse two hands of different identifiers on one bus, and warn of two alike: their frames have no number."""
        tips, pads = set(counted) & {one for ids in TIPS.values() for one in ids}, set(counted) & set(PADS.values())
        doubled = [name for name, ids in TIPS.items() if set(ids) <= tips]
        if (tips and pads) or doubled:
            what = " and ".join(f"{one:03X}" for one in sorted(tips | pads))
            raise BusError(
                f"{link.bus_name}: {what} are heard, which no single hand sends: the values of two hands on one bus"
                " mix; give each a bus of its own"
            )
        most = max((counted[one] for one in tips | pads), default=0)
        if most > _TWICE * self.options.learn_s / self.period_s + 1:
            link.log.warning(
                "a message comes every %.1f ms, not every %.0f ms: if two hands are on this bus, their values mix:"
                " give each a bus of its own; if there is one hand, set its period_ms",
                1e3 * self.options.learn_s / most,
                1e3 * self.period_s,
            )

    def _take_tips(self) -> None:
        self.types = (PRESSURE.measured(offset=-float(self.options.zero_pa)),)
        self.dtype, self.layout = np.int32, Layout(_TIP_FRAMES)
        modules = [
            Module(taxels(2, first_uid=2 * at), ids[0], "tips", name) for at, (name, ids) in enumerate(TIPS.items())
        ]
        self.patches = [Patch("hand", modules)]
        hand, tip = Hand(self.options.side), Grid(1, 1)
        places = [hand.down(part, [tip])[0] for part in ("index", "middle", "ring", "thumb")]
        self.geometry = Geometry.joined([tip.at(place, ["pressure"], [uid]) for uid, place in enumerate(places)])

    def _take_pads(self) -> None:
        factor = 10 if self.options.palm == "tenfold" else 1
        self.types = (PRESSURE.measured(scale=_PA_IN_A_BYTE, minimum=0, maximum=factor * _MOST * _PA_IN_A_BYTE),)
        if factor == 1:
            self.dtype, self.layout = np.uint8, Layout(_PAD_FRAMES)
        else:
            flags = [Sentinel(one.status, one.value + _ENDS) for one in _PAD_FLAGS]
            values = (Expand(partial(_expand, factor=factor)), Expand(partial(_expand, factor=1)))
            frames = zip(_PAD_FRAMES, values, strict=True)
            self.dtype = np.uint16
            self.layout = Layout([replace(frame, values=one, flags=flags) for frame, one in frames])
        modules = [
            Module(taxels(8, first_uid=8 * at), one, "pads", name) for at, (name, one) in enumerate(PADS.items())
        ]
        self.patches = [Patch("hand", modules)]
        self.geometry = _places_of_pads(self.options.side)

    def _judge_zero(self, frames: Sequence[Reply]) -> None:
        """Warn if most fingertips seem to send the pressure of the air, and the option does not say so."""
        payloads = b"".join(frame.payload for frame in frames if len(frame.payload) == 8)
        values = np.frombuffer(payloads, "<i4")
        if len(values) and int(np.median(values)) - self.options.zero_pa in _AIR_PA:
            log.warning(
                "the fingertips send about %.0f Pa, as if it were the pressure of the air: give zero_pa=%d, if nothing"
                " touches them",
                *(2 * [float(np.median(values))]),
            )


def _expand(
    payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8], factor: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.uint16]]:
    sent = payload[:, :8].astype(np.uint16)
    value = sent * np.array([factor] + 7 * [1], np.uint16)
    row, channel = np.divmod(np.arange(8 * len(length)), 8)
    return row, channel, np.where(sent >= _MOST, sent + np.uint16(_ENDS), value).ravel()


def _places_of_pads(side: Literal["right", "left"]) -> Geometry:
    """Return nominal places; pads count from the root of a finger to its tip (allegro_node.cpp:266, same commit)."""
    pad, uids = Grid(1, 1, _FROM_PAD_TO_PAD_M), iter(range(N_PADS))
    counts = {"palm": 1, "thumb": 3, "index": 4, "middle": 4, "ring": 4}
    return Geometry.joined(
        [
            pad.at(centre, ["pressure"], [next(uids)])
            for part, count in counts.items()
            for centre in reversed(Hand(side).down(part, [pad] * count))
        ]
    )
