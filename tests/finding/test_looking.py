"""Listening and asking, on emulated boards: the boards that are found, and the frames that are sent."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

from skinware.errors import BusNotAvailable, HandshakeTimeout
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import Bus, FrameBatch
from skinware_drivers.can import roboskin_setup
from skinware_drivers.can.allegro_v5 import AllegroV5Driver
from skinware_drivers.can.barrett import BarrettDriver
from skinware_drivers.can.canopen_patch import CanopenDriver
from skinware_drivers.can.cyskin_cpm import CyskinCpmDriver
from skinware_drivers.can.linkerhand import LinkerHandDriver
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.xela import XelaDriver
from skinware_drivers.finding import looking
from skinware_drivers.finding.looking import HeardOnBus, ProbeAnswer, ask, ask_port, listen
from skinware_drivers.finding.without_driver import attended
from skinware_drivers.link import Link
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.devices.allegro_v5 import (
    EmulatedAllegroV5,
    EmulatedAllegroV5Options,
    EmulatedAllegroV5Tips,
    EmulatedAllegroV5TipsOptions,
)
from skinware_drivers.virtual.devices.cyskin_cpm import EmulatedCyskinCpm, EmulatedCyskinCpmOptions
from skinware_drivers.virtual.devices.linkerhand import EmulatedLinkerHand, EmulatedLinkerHandOptions
from skinware_drivers.virtual.devices.xela import EmulatedXela, EmulatedXelaOptions
from skinware_drivers.virtual.hardware import EmulatedHardware, Event
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions
from tests.sdk.driving import Chatter, commands, emulated, troubled

DRIVERS: dict[str, type[AnyAdapter]] = {"roboskin": RoboskinDriver}
DISCOVERY = 0x70F


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roboskin_setup, "_DISCOVERY_S", 0.1)


def heard_on(bus: Bus, listen_s: float = 0.15) -> HeardOnBus:
    bus.listen_only = True
    heard = asyncio.run(listen("bus", listen_s, DRIVERS, bus))
    bus.listen_only = False
    return heard


def asked_on(bus: Bus, monkeypatch: pytest.MonkeyPatch, **how: Any) -> ProbeAnswer:
    """Listen, then ask on the same bus."""
    heard = heard_on(bus)
    monkeypatch.setattr(looking, "make_bus", lambda *_, **__: bus)
    return asyncio.run(ask(heard, DRIVERS, **how))


def sent(log: list[Event]) -> set[int]:
    """Identifiers that boards reacted to."""
    return {identifier for _, identifier, _ in commands(log)}


def test_streaming_boards_are_heard_and_nothing_is_sent() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), streaming=True)
    heard = heard_on(bus)
    assert [(one.driver, one.patches) for one in heard.guesses] == [("roboskin", ("board 7", "board 8"))]
    assert heard.frames == heard.classes[0].frames > 0
    assert heard.load == pytest.approx(heard.rate_hz * 130e-6, rel=0.1)  # 8 bytes under 11 bits, at 1 Mbit/s
    assert (commands(log), bus.counters.sent, bus.fileno()) == ([], 0, -1)


class Measured(VirtualCanBus):
    """A bus with a bit rate, on which every batch of frames takes half a second."""

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        self.bit_rate = 1_000_000
        self.wire_bits += 500_000
        return super().receive(batch, ordinal)


def test_the_load_is_as_the_bus_counts_it_while_it_is_heard() -> None:
    bus = Measured("", hardware=EmulatedRoboskin(EmulatorOptions(boards=(7,), streaming=True)))
    bus.wire_bits = 1e15  # from before
    heard = heard_on(bus)
    assert heard.load is not None
    assert heard.load * heard.duration_s == pytest.approx(0.5 * ((bus.wire_bits - 1e15) / 500_000), rel=1e-6)


def test_live_boards_are_asked_one_by_one_and_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(8,), streaming=True)
    answer = asked_on(bus, monkeypatch)
    assert answer.answers == {"roboskin": "ROBOSKIN: board 7 (mtb4 1.25.0), board 8 (mtb 2.10.14)"}
    assert DISCOVERY not in sent(log)
    assert heard_on(bus).guesses[0].patches == ("board 7", "board 8")


def test_force_sends_the_discovery_that_silences(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(8,), streaming=True)
    answer = asked_on(bus, monkeypatch, force=True)
    assert "board 8 (mtb 2.10.14)" in answer.answers["roboskin"]
    assert DISCOVERY in sent(log)
    assert heard_on(bus).guesses[0].patches == ("board 7",)


def test_a_silent_bus_is_asked_by_discovery(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[Event] = []
    answer = asked_on(emulated(log, boards=(3, 12)), monkeypatch)
    assert answer.answers == {"roboskin": "ROBOSKIN: board 3 (mtb4 1.25.0), board 12 (mtb4 1.25.0)"}
    assert sent(log) == {DISCOVERY}


def test_a_boot_loader_is_told_from_an_application(monkeypatch: pytest.MonkeyPatch) -> None:
    loader = Chatter((0x750, b"\xff\x0b\x02\x07"))  # as if it answered: every 10 ms
    bus = VirtualCanBus("", hardware=loader)
    silent = HeardOnBus("bus", duration_s=1.0)
    monkeypatch.setattr(looking, "make_bus", lambda *_, **__: bus)
    answer = asyncio.run(ask(silent, DRIVERS))
    assert answer.answers == {"roboskin": "ROBOSKIN: board 5 (mtb4 2.7, in its boot loader)"}


def test_a_bus_of_strangers_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    strangers = Chatter((0x181, b"\x01\x02"))
    answer = asked_on(VirtualCanBus("", hardware=strangers), monkeypatch)
    assert "no driver knows what is sending" in answer.refused
    assert strangers.heard == []


def test_a_bus_that_a_driver_has_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[Event] = []
    answer = asked_on(emulated(log), monkeypatch, owner="driver 'torso'")
    assert answer.refused.startswith("driver 'torso' has it")
    assert commands(log) == []


def test_a_bus_that_cannot_be_opened_is_told_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = troubled()
    bus.down = True
    heard = heard_on(bus)
    assert (heard.problem, heard.frames) == ("the bus is down", 0)
    assert asyncio.run(ask(heard, DRIVERS)).refused == "the bus is down"
    silent = HeardOnBus("bus", duration_s=1.0)
    monkeypatch.setattr(looking, "make_bus", lambda *_, **__: bus)
    assert asyncio.run(ask(silent, DRIVERS)).refused == "the bus is down"


def test_a_bus_that_goes_away_while_it_is_heard_does_no_harm() -> None:
    bus = troubled(streaming=True)
    bus.fail_next_receive(BusNotAvailable("the bus went down", is_down=True))
    assert heard_on(bus).problem == ""


class Answers(RoboskinDriver):
    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:
        assert not idle
        return "it is me"


class Silent(Answers):
    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:
        raise HandshakeTimeout("no answer")


class Hangs(Answers):
    @classmethod
    async def identify(cls, link: Link, *, idle: bool) -> str | None:
        await link.sleep(1000)
        return "late"


class ModelOptions(RoboskinOptions, frozen=True, kw_only=True):
    model: str


class NeedsOptions(Answers):
    Options = ModelOptions


def test_a_port_is_asked_by_one_driver_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []

    def make(name: str, **_: object) -> VirtualCanBus:
        names.append(name)
        return emulated()

    monkeypatch.setattr(looking, "make_bus", make)
    monkeypatch.setattr(looking, "_IDENTIFY_S", 0.1)
    drivers: dict[str, type[AnyAdapter]] = {"a": Silent, "b": Answers, "c": Hangs, "d": NeedsOptions}
    answer = asyncio.run(ask_port("/dev/ttyUSB0", drivers))
    assert names == ["serial:/dev/ttyUSB0"] * 3
    assert answer.asked == ["a", "b", "c"]
    assert answer.answers == {"b": "it is me"}
    assert answer.problems.keys() == {"c", "d"}
    assert answer.problems["d"] == "it has options that must be given"


def test_drivers_that_do_not_say_how_to_ask_ask_nobody() -> None:
    async def on(bus: Bus) -> Sequence[str | None]:
        async with attended(bus) as link:
            return [await XelaDriver.identify(link, idle=True)]

    bus = emulated()
    assert asyncio.run(on(bus)) == [None]
    assert bus.counters.sent == 0
    silent = HeardOnBus("bus", duration_s=1.0)
    assert asyncio.run(ask(silent, {"xela": XelaDriver})).refused == "there is no harmless question in xela"
    assert (
        "no installed driver has a harmless question"
        in asyncio.run(ask_port("/dev/ttyUSB0", {"a": XelaDriver})).refused
    )


@pytest.mark.parametrize(
    ("emulator", "driver", "patches"),
    [
        (EmulatedRoboskin(EmulatorOptions(boards=(7,), streaming=True)), "roboskin", ("board 7",)),
        (EmulatedXela(EmulatedXelaOptions(streaming=True)), "xela", ("board 1",)),
        (EmulatedCyskinCpm(EmulatedCyskinCpmOptions(streaming=True)), "cyskin_cpm", ("finger",)),
        (EmulatedLinkerHand(EmulatedLinkerHandOptions(hands=(0x28,))), "linkerhand", ("left hand",)),
        (EmulatedAllegroV5(EmulatedAllegroV5Options()), "allegro_v5", ("hand",)),
        (EmulatedAllegroV5Tips(EmulatedAllegroV5TipsOptions()), "allegro_v5", ("hand",)),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_devices_are_taken_for_what_they_are_and_for_nothing_else(
    emulator: EmulatedHardware, driver: str, patches: tuple[str, ...]
) -> None:
    bus = VirtualCanBus("", hardware=emulator, listen_only=True)
    drivers: dict[str, type[AnyAdapter]] = {
        "allegro_v5": AllegroV5Driver,
        "barrett": BarrettDriver,
        "canopen": CanopenDriver,
        "cyskin_cpm": CyskinCpmDriver,
        "linkerhand": LinkerHandDriver,
        "roboskin": RoboskinDriver,
        "xela": XelaDriver,
    }
    heard = asyncio.run(listen("bus", 0.2, drivers, bus))
    assert [(one.driver, one.share, one.patches) for one in heard.guesses] == [(driver, 1.0, patches)]
