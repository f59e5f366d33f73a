"""Hands that are dead or pressed to the end of what they can tell: they tell it, and are not shown as untouched."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any, NamedTuple

import pytest

from skinware.status import Status
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual import Emulator
from skinware_drivers.virtual.devices.ability_hand import EmulatedAbilityHand
from skinware_drivers.virtual.devices.allegro_v5 import EmulatedAllegroV5, EmulatedAllegroV5Tips
from skinware_drivers.virtual.devices.flexitac import EmulatedFlexiTac
from skinware_drivers.virtual.devices.linkerhand import EmulatedLinkerHand
from skinware_drivers.virtual.devices.paxini import EmulatedPaxini
from skinware_drivers.virtual.devices.tesollo import EmulatedTesollo
from skinware_drivers.virtual.devices.weiss import EmulatedWeissDsa
from skinware_drivers.virtual.devices.xela import EmulatedXelaServer

pytestmark = pytest.mark.usefixtures("namespace")


class Hand(NamedTuple):
    """One kind of hand.

    Attributes:
        driver: its name.
        emulator: of it.
        emulated: how it is emulated.
        options: of the driver.
        end: the greatest that every value of it can be; None: there is no such value.
        by_value: 0 is doubted at once, value by value.
    """

    driver: str
    emulator: type[Emulator[Any]]
    emulated: Mapping[str, Any] = {}
    options: Mapping[str, Any] = {}
    end: int | None = None
    by_value: bool = False


SOON = {"learn_s": 0.3}
HANDS = {
    "ability_hand": Hand("ability_hand", EmulatedAbilityHand, end=4095, by_value=True),
    "allegro_v5": Hand("allegro_v5", EmulatedAllegroV5, end=254),
    "allegro_v5 tips": Hand("allegro_v5", EmulatedAllegroV5Tips),
    "flexitac": Hand("flexitac", EmulatedFlexiTac, end=255, by_value=True),
    "linkerhand 12x6": Hand("linkerhand", EmulatedLinkerHand, options=SOON, end=255),
    "linkerhand fingers": Hand("linkerhand", EmulatedLinkerHand, {"touch": "fingers"}, SOON, end=255),
    "linkerhand whole": Hand("linkerhand", EmulatedLinkerHand, {"touch": "hand_12x6"}, SOON, end=255),
    "paxini converter": Hand("paxini", EmulatedPaxini, {"board": "converter"}, {"board": "converter", "sensors": (3,)}),
    "paxini high speed": Hand("paxini", EmulatedPaxini, {"board": "high_speed"}, {"board": "high_speed"}),
    "tesollo": Hand("tesollo", EmulatedTesollo, end=255),
    "weiss_dsa": Hand("weiss_dsa", EmulatedWeissDsa, end=4095),
    "xela_server": Hand("xela_server", EmulatedXelaServer),
    "xela_server counts": Hand("xela_server", EmulatedXelaServer, {"calibrated": False}, end=0xFFFF),
}


def feeling(emulator: type[Emulator[Any]], felt: list[int]) -> type[Emulator[Any]]:
    """A hand of which every value is this one."""

    class Feeling(emulator):  # type: ignore[misc,valid-type]
        def __init__(self, options: Any, **more: Any) -> None:
            super().__init__(options, **{**more, "source": lambda _n, _c: felt * len(self.places())})

    return Feeling


@pytest.mark.thorough
@pytest.mark.parametrize("hand", HANDS.values(), ids=HANDS)
def test_dead_and_saturated_hands_are_told(
    hand: Hand, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ZeroWatch, "patience_s", 0.2)
    caplog.set_level(logging.INFO)
    felt = [0]
    emulator = feeling(hand.emulator, felt)
    with emulated_skin(hand.driver, emulator, driver_options=hand.options, **hand.emulated) as skin:
        if hand.by_value:
            read_until(skin.reader, lambda frame: bool((frame.status == Status.SUSPECT).all()))
        else:
            read_until(skin.reader, lambda frame: bool(frame.module_untouched.all()) and not frame.status.any())
            wait_until(lambda: "nothing but 0 has come from" in caplog.text)
        if hand.end is not None:
            felt[0] = hand.end
            read_until(skin.reader, lambda frame: bool((frame.status == Status.OUT_OF_RANGE).all()))
