"""PSYONIC's Ability Hand: 30 force-sensitive resistors, six on each finger, over its UART. It never moves the hand.

Wire format: the maker's programs (github.com/psyonicinc/ability-hand-api, MIT), with the byte stuffing that they need.
A message stands between ``7E``; ``7D`` and the byte with bit 5 inverted replace 7E and 7D in it; its last byte makes
the sum of all bytes 0. A question is the hand's address and a command. The commands A0, A1 and A2 are *read only*
(``read_only.py`` of the maker): unlike the commands that move the hand, they carry no target.

An answer has a header, whose lower four bits are its kind: six positions and six currents (kind 0) or speeds (1), i16;
the sensors of index, middle, ring, little finger and thumb, 12 bits each, the lower ones first; and a byte of
temperatures. Answers of kind 2 have no touch.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE
from skinware.status import Status
from skinware_drivers import Link, Match, Module, Options, Patch, Poll, taxels
from skinware_drivers.fields import Bits, Identifier, Packed, Sentinel
from skinware_drivers.hand import Grid, Hand
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.serial import HDLC, LRC, Delimited, Field, SerialAdapter, Split

_READ_TOUCH, _READ_NO_TOUCH = b"\xa0", b"\xa2"
_FINGERS = ("index", "middle", "ring", "little", "thumb")
_SITES = Grid(21, 9, 0.001)
_CELLS = [down * _SITES.columns + 4 + across for down, across in ((0, 0), (6, 0), (6, -4), (20, -4), (6, 4), (20, 4))]
"""Down and across the finger, mm, from its outermost sensor: upper and lower tip, upper and lower left, and right.
Source: the maker's ``fsrlocs_to_xml.py``, fingers of the large hand; it does not say which side is the left one."""
_N = len(_CELLS)
_TOUCH_AT, _FINGER_BYTES, _BODY = 24, 9, 70
_MOST = 4095
_FINGER = 0x100
"""First identifier of the parts of an answer; lower ones are headers and addresses."""
_WITHOUT_TOUCH = Match(0x02, 0x70F)
_IDENTIFY_S = 0.3


class AbilityHandOptions(Options, frozen=True):
    address: Annotated[int, Meta(ge=0, le=0xFF, description="of the hand")] = 0x50
    period_ms: Annotated[int, Meta(ge=2, description="time from question to question, ms")] = 10
    side: Annotated[Literal["right", "left"], Meta(description="which hand it is, for views")] = "right"
    zero: Annotated[Literal["suspect", "good"], Meta(description="status of a sensor that reads 0")] = "suspect"


def _by_finger(header: int, body: bytes) -> Iterable[tuple[int, bytes]]:
    """Split an answer with touch into five parts, one for each finger."""
    if header & 0x0F > 1 or len(body) != _BODY:
        return [(header, body)]
    touch = body[_TOUCH_AT:]
    return [(_FINGER | n, touch[n * _FINGER_BYTES :][:_FINGER_BYTES]) for n in range(len(_FINGERS))]


class AbilityHandDriver(SerialAdapter[AbilityHandOptions]):
    """One hand on a serial line; uid = 6 * finger + site, in the order of the wire. Each finger is a module."""

    framing = Split(Delimited(HDLC, maximum_body=_BODY, checksum=LRC, identifier=Field(0)), _by_finger)
    baudrate = 460_800
    types = (PRESSURE.measured(unit="counts", minimum=0, maximum=_MOST),)
    dtype = np.uint16

    def __init__(self, options: AbilityHandOptions) -> None:
        super().__init__(options)
        zero, most = Sentinel(Status.SUSPECT, 0), Sentinel(Status.OUT_OF_RANGE, _MOST)
        flags = [zero, most] if options.zero == "suspect" else [most]
        values = Values(0, Packed(12, order="little"), _N)
        finger = Identifier(_FINGER, 0x7F8)
        self.layout = Layout([Frame("finger", [finger], [_FINGER_BYTES], values, module=Bits(0, 3), flags=flags)])
        modules = [Module(taxels(_N, first_uid=_N * key), key, "6 points", name) for key, name in enumerate(_FINGERS)]
        self.patches = (Patch(f"{options.side} hand", modules),)
        hand, found = Hand(options.side), []
        for key, name in enumerate(_FINGERS):
            [place] = hand.down(name, [_SITES])
            found.append(_SITES.at(place, ["pressure"], range(_N * key, _N * (key + 1)), _CELLS))
        self.geometry = Geometry.joined(found)

    @property
    def polls(self) -> Sequence[Poll]:
        return (Poll(self.options.address, _READ_TOUCH, self.period_s),)

    async def attend(self, link: Link) -> None:
        with link.follow(_WITHOUT_TOUCH) as heard:
            await heard.get()
        link.log.warning("the hand sends answers without touch: another program asks for them (its reply mode is 2)")

    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str:  # noqa: ARG003
        """Ask for positions, as the maker's program does on every port when it searches for a hand."""
        address = AbilityHandOptions().address
        await link.request(address, _READ_NO_TOUCH, _WITHOUT_TOUCH, timeout_s=_IDENTIFY_S)
        return f"Ability Hand at address {address:#x}"
