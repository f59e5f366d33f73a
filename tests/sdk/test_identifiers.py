"""Identifiers of 29 bits are written in one way, and what is written in another is refused with that way."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from skinware.errors import ConfigurationError, HandshakeTimeout
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch, check_identifier, identifier_text
from skinware_drivers.fields import Identifier, Match
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link
from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid

WRONG, RIGHT = 0x18DA00F1, EXTENDED_FLAG | 0x18DA00F1
VALUES = Values(0, "u1", 1)


class Silent:
    listen_only = narrows = False
    medium = "can"
    name = channel = "silent"

    def send(self, identifier: int, payload: bytes) -> None:
        pass


class Pad(Emulator[EmulatorOptions]):
    full_scale = swing = 255
    period_s = 0.01
    identifier = RIGHT

    def places(self) -> np.ndarray:
        return on_a_grid(1, 1)

    def boot(self, device: Device, now_ns: int) -> None:
        self.start(device, now_ns)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        return [(self.identifier, bytes(values))]


class WrongPad(Pad):
    identifier = WRONG


def emulate(pad: type[Pad]) -> list[int]:
    device = pad(EmulatorOptions())
    device.skip(0)
    return [frame.identifier for frame in device.emit(12_000_000)]


def test_as_text_they_are_what_candump_writes() -> None:
    assert [identifier_text(i) for i in (0x12, 0x7FF, RIGHT, EXTENDED_FLAG | 0x12)] == [
        "012",
        "7FF",
        "18DA00F1",
        "00000012",
    ]


@pytest.mark.parametrize(
    "use",
    [
        check_identifier,
        lambda identifier: Layout([Frame("f", [Identifier(identifier)], [1], VALUES)]),
        lambda identifier: emulate(Pad if identifier == RIGHT else WrongPad),
    ],
)
def test_the_flag_is_asked_for_where_it_is_missing(use: Callable[[int], object]) -> None:
    use(RIGHT)
    with pytest.raises(ConfigurationError, match=r"one of 29 bits is written EXTENDED_FLAG \| 0x18DA00F1"):
        use(WRONG)


@pytest.mark.parametrize("identifier", [-1, EXTENDED_FLAG | 0x2000_0000, 1 << 40])
def test_what_no_frame_has_is_refused(identifier: int) -> None:
    with pytest.raises(ConfigurationError, match="11 bits, or 29 and EXTENDED_FLAG"):
        check_identifier(identifier)


def test_an_answer_of_29_bits_is_none_of_11_and_the_other_way_round() -> None:
    """Their low bits are alike, and the default mask, or any other, does not hide the difference."""

    async def asks_for(identifier: int, answer: int, mask: int | None) -> bool:
        link = Link(Silent())  # type: ignore[arg-type]
        match = Match(identifier) if mask is None else Match(identifier, mask)
        question = asyncio.create_task(link.request(0x1, b"", match, timeout_s=0.05))
        await asyncio.sleep(0)
        batch = FrameBatch(1)
        batch.append(0, 0, answer, b"")
        link.offer(batch, np.arange(1))
        try:
            return (await question).identifier == answer
        except HandshakeTimeout:
            return False

    for mask in (None, 0x7FF):
        assert asyncio.run(asks_for(0x750, 0x750, mask))
        assert not asyncio.run(asks_for(0x750, EXTENDED_FLAG | 0x18DAF750, mask))
        assert not asyncio.run(asks_for(EXTENDED_FLAG | 0x750, 0x750, mask))
        assert asyncio.run(asks_for(EXTENDED_FLAG | 0x750, EXTENDED_FLAG | 0x750, mask))


def test_the_flag_in_the_value_says_it() -> None:
    assert Identifier(RIGHT).extended
    assert not Identifier(0x7FF).extended
    assert Identifier(RIGHT, 0xFF00) == Identifier(RIGHT, EXTENDED_FLAG | 0xFF00)
