"""Layouts are compared with frames that were heard."""

from __future__ import annotations

import asyncio
from typing import Annotated

import msgspec
import numpy as np

from skinware.sensor_types import PRESSURE
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.can import CanAdapter
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Bits, Byte, Identifier
from skinware_drivers.finding.guess import Guess, Traffic, guess, known_drivers
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.virtual.bus import VirtualCanBus
from tests.finding.fakes import SKIN, traffic_of


class Fingertip(CanAdapter[NoOptions]):
    types = (PRESSURE,)
    dtype = np.uint16
    patches = (Patch("thumb", [Module(taxels(8))]),)
    layout = Layout(
        [
            Frame(f"half {i}", [Identifier(0x405 + i)], (8,), Values(0, "<u2", 4, range(4 * i, 4 * i + 4)))
            for i in (0, 1)
        ],
        Cycle(("half 0", "half 1"), maximum_age_s=0.01),
    )


class Everything(CanAdapter[NoOptions]):
    """Takes any frame of class 4 for its own."""

    types = (PRESSURE,)
    layout = Layout([Frame("any", [Identifier(0x400, mask=0x700)], (8,), Values(0, "u1", 8), patch=Bits(4, 4))])


class Long(CanAdapter[NoOptions]):
    """29-bit identifiers, and a constant beyond the end of classic frames."""

    types = (PRESSURE,)
    layout = Layout(
        [Frame("fd", [Identifier(EXTENDED_FLAG | 0x1230000, 0x1FFF0000), Byte(20, 0x55)], (24,), Values(0, "u1", 16))]
    )


class NeedsOptions(CanAdapter[msgspec.Struct]):
    class Options(msgspec.Struct):
        model: Annotated[str, msgspec.Meta(description="which")]

    types = (PRESSURE,)


class FindsOut(CanAdapter[NoOptions]):
    """It learns its layout from its hardware."""

    types = (PRESSURE,)


def guessed(traffic: Traffic, **drivers: type[AnyAdapter]) -> list[Guess]:
    return asyncio.run(guess(traffic, VirtualCanBus("", listen_only=True), drivers))


def test_boards_are_named_as_their_driver_names_them() -> None:
    traffic = traffic_of(*SKIN, (0x482, "40" + "F0" * 7), (0x482, "C0" + "F0" * 5), times=5)
    assert guessed(traffic, roboskin=RoboskinDriver) == [Guess("roboskin", 20, 1.0, ("board 7", "board 8"), True)]


def test_a_half_that_never_has_its_other_half_is_not_known() -> None:
    assert guessed(traffic_of(SKIN[0], times=9), roboskin=RoboskinDriver) == []
    assert guessed(traffic_of((0x405, "00" * 8)), fingertip=Fingertip) == []
    whole = guessed(traffic_of((0x405, "00" * 8), (0x406, "00" * 8), (0x7, "")), fingertip=Fingertip)
    assert whole == [Guess("fingertip", 2, 2 / 3, ("thumb",), True)]


def test_who_asks_for_more_wins_and_the_others_are_possibilities() -> None:
    found = guessed(traffic_of(*SKIN, times=5), everything=Everything, roboskin=RoboskinDriver)
    assert [(one.driver, one.likely, one.patches) for one in found] == [
        ("roboskin", True, ("board 7",)),
        ("everything", False, ("patch 7",)),
    ]


def test_two_kinds_of_skin_on_one_bus_are_both_likely() -> None:
    traffic = traffic_of(*SKIN, (0x405, "00" * 8), (0x406, "00" * 8))
    found = guessed(traffic, fingertip=Fingertip, roboskin=RoboskinDriver)
    assert {(one.driver, one.likely, one.frames) for one in found} == {("fingertip", True, 2), ("roboskin", True, 2)}


def test_long_identifiers_and_long_payloads_count() -> None:
    right = (EXTENDED_FLAG | 0x1234567, "00" * 20 + "55" + "00" * 3)
    wrong = [
        (0x567, right[1]),
        (EXTENDED_FLAG | 0x1244567, right[1]),
        (right[0], "00" * 24),
        (right[0], "00" * 20),
    ]
    assert [one.frames for one in guessed(traffic_of(right, *wrong), long=Long)] == [1]
    assert guessed(traffic_of((*right[:1], "00" * 8), payload_size=8), long=Long) == []


def test_drivers_that_say_too_little_are_left_out() -> None:
    assert guessed(traffic_of(*SKIN), needs=NeedsOptions, finds=FindsOut) == []
    assert guessed(Traffic(), roboskin=RoboskinDriver) == []


def test_installed_drivers_are_those_of_the_medium_and_of_the_names() -> None:
    assert known_drivers("can")["roboskin"] is RoboskinDriver
    assert "roboskin" not in known_drivers("serial")
    assert list(known_drivers("can", ["roboskin"])) == ["roboskin"]
