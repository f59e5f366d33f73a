"""What literal bytes become, and that nothing of them is passed over in silence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers import Frame, Layout, Link, Match, Module, NoOptions, Patch, Values, taxels
from skinware_drivers.modbus import ModbusAdapter, Registers
from skinware_drivers.serial import SUM8, Packet, SerialAdapter
from skinware_drivers.testing.vectors import Shown, decode_frames, decode_stream
from skinware_drivers.virtual import EmulatorOptions
from tests.testing.fingertips import EmulatedFingertips, Fingertips

PROXIMAL, DISTAL = (0x101, "00 0001 0002 0003"), (0x101, "01 0004 0005 0006")


class Declared(Fingertips):
    async def describe(self, link: Link) -> Sequence[Patch]:
        return self.patches[:1]


class AsksFirst(Fingertips):
    """It learns its patches from its devices."""

    patches = ()

    async def describe(self, link: Link) -> Sequence[Patch]:
        await link.request(0x82, b"\2", Match(0x182), timeout_s=0.1)
        return [Patch("finger 2", [Module(taxels(6))], key=2)]


class FindsNone(Fingertips):
    async def describe(self, link: Link) -> Sequence[Patch]:
        return ()


class Strip(SerialAdapter[NoOptions]):
    framing = Packet(sync=(0xF0,), length=4, checksum=SUM8)
    types = (PRESSURE.measured(unit="counts"),)
    patches = (Patch("strip", [Module(taxels(2))]),)
    layout = Layout([Frame("all", length=[2], values=Values(0, "u1", 2))])


class Pad(ModbusAdapter[NoOptions]):
    dtype = np.uint16
    registers = (Registers(2, 2),)
    types = (PRESSURE.measured(unit="counts"),)
    patches = (Patch("pad", [Module(taxels(2))]),)


class LowByteFirst(Pad):
    byte_order = "little"


ASKED, REPLIED = "01 03 00 02 00 02 65 CB", "01 03 04 00 05 01 00 EB A2"
ASKED_ELSE, REPLIED_ELSE = "01 03 00 09 00 01 54 08", "01 03 02 00 07 F9 86"
REFUSED = "01 83 02 C0 F1"


def decode(*frames: tuple[int, str], **more: bool) -> Shown:
    return decode_frames(Declared(NoOptions()), frames, **more)  # type: ignore[arg-type]


def registers(digits: str, **more: bool) -> Shown:
    return decode_stream(Pad(NoOptions()), digits, **more)  # type: ignore[arg-type]


def stream(digits: str, **more: bool) -> Shown:
    return decode_stream(Strip(NoOptions()), digits, **more)  # type: ignore[arg-type]


def test_what_is_whole_is_shown() -> None:
    shown = decode(PROXIMAL, DISTAL)
    assert shown.values.tolist() == [1, 2, 3, 4, 5, 6]
    assert shown.problems == ()
    assert stream("F0 01 02 F3 F0 03 04 F7").values.tolist() == [3, 4]
    assert registers(ASKED + REPLIED).values.tolist() == [5, 256]
    assert registers(ASKED_ELSE + REPLIED_ELSE + ASKED + REPLIED).values.tolist() == [5, 256]
    assert decode_stream(LowByteFirst(NoOptions()), ASKED + REPLIED).values.tolist() == [0x500, 1]


@pytest.mark.parametrize(
    ("decoding", "words"),
    [
        (
            lambda **m: decode(PROXIMAL, DISTAL, (0x133, "01"), **m),
            r"frame 2, 133 \[1\] 01: no frame of the layout",
        ),
        (lambda **m: decode((0x102, PROXIMAL[1]), **m), r"frame 0, 102 \[7\].*: no frame .* names no patch"),
        (
            lambda **m: decode((0x101, "00 01"), **m),
            r"frame 0, 101 \[2\] 00 01: the layout has no frame of this le",
        ),
        (lambda **m: decode((0x101, "07" * 7), **m), r"frame 0, .*its content is that of no frame of the"),
        (
            lambda **m: decode((0x101, "07" * 9), **m),
            r"frame 0, .*too long, the longest of the layout has 8 bytes",
        ),
        (lambda **m: decode(PROXIMAL, **m), r"1 frames wait for the others of their cycle"),
        (lambda **m: decode(DISTAL, PROXIMAL, DISTAL, **m), r"1 frames have no partners of their cycle"),
        (
            lambda **m: stream("F0 01 02 F4", **m),
            r"1 x the checksum is wrong(?s:.*)4 bytes belong to no good packet",
        ),
        (lambda **m: stream("55 F0 01 02 F3", **m), r"1 bytes belong to no good packet"),
        (lambda **m: stream("F0 01 02 F3 F0 01", **m), r"the last 2 bytes are no whole packet"),
        (lambda **m: stream("", **m), r"no part of it is data of this driver"),
        (lambda **m: registers(REPLIED, **m), r"bytes belong to no good packet|no whole packet"),
        (lambda **m: registers(ASKED + REPLIED[:-2] + "FF", **m), r"1 x the checksum is wrong|no whole packet"),
        (lambda **m: registers(ASKED + REPLIED[:-3], **m), r"the last 8 bytes are no whole packet"),
        (lambda **m: registers(ASKED_ELSE + REPLIED_ELSE, **m), r"no part of it is data of this driver"),
        (lambda **m: registers(ASKED + REFUSED, **m), r"no part of it is data of this driver"),
    ],
)
def test_what_is_not_shown_fails_the_test_unless_it_is_meant_to(decoding: Callable[..., Shown], words: str) -> None:
    with pytest.raises(pytest.fail.Exception, match=words):
        decoding()
    assert decoding(strict=False).problems


def test_what_describe_finds_counts() -> None:
    assert decode(PROXIMAL, DISTAL).structure.n_patches == 1  # and not the two that are declared
    devices = EmulatedFingertips(EmulatorOptions())
    shown = decode_frames(AsksFirst(NoOptions()), [(0x102, PROXIMAL[1]), (0x102, DISTAL[1])], devices=devices)
    assert shown.values.tolist() == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("driver", [AsksFirst, FindsNone])
def test_without_devices_that_answer_it_says_what_is_missing(driver: type[Fingertips]) -> None:
    with pytest.raises(pytest.fail.Exception, match="give emulated ones as `devices=`"):
        decode_frames(driver(NoOptions()), [PROXIMAL])


def test_an_identifier_of_29_bits_without_its_flag() -> None:
    with pytest.raises(ConfigurationError, match=r"written EXTENDED_FLAG \| 0x18DA00F1"):
        decode((0x18DA00F1, "00"))
