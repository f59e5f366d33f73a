"""Looks at the buses of this machine, and on request asks who is there."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field

from skinware.errors import BusError, BusNotAvailable, ConfigurationError, HandshakeTimeout
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.bus_names import BusName
from skinware_drivers.finding.guess import Guess, IdentifierClass, Traffic, guess, likely, with_default_options
from skinware_drivers.finding.without_driver import attended
from skinware_drivers.registry import make_bus
from skinware_drivers.running.news import reason_text, share_of_time

_CAN_PAYLOAD = 64
_IDENTIFY_S = 5.0


@dataclass(frozen=True)
class HeardOnBus:
    """What was heard on a CAN bus.

    Attributes:
        bus: its name.
        problem: why it could not be listened to; empty if it could.
        duration_s: how long.
        frames: how many frames.
        rate_hz: how many a second.
        load: how much of the bus' time they took, 0 to 1; None where the bit rate is not known.
        error_frames: what the controller told of errors.
        trouble: what is wrong with the bus, as far as its controller tells: ``error-passive``; empty if nothing is.
        lost: frames that were not taken in time.
        classes: identifiers.
        guesses: which drivers know them.
    """

    bus: str
    problem: str = ""
    duration_s: float = 0.0
    frames: int = 0
    rate_hz: float = 0.0
    load: float | None = None
    error_frames: int = 0
    trouble: str = ""
    lost: int = 0
    classes: list[IdentifierClass] = field(default_factory=list)
    guesses: list[Guess] = field(default_factory=list)


@dataclass(frozen=True)
class Answer:
    """What came back when a bus was asked.

    Attributes:
        bus: its name.
        asked: drivers that asked.
        answers: what they made of it, by driver.
        problems: what went wrong in asking, by driver.
        refused: why nobody was asked; empty if somebody was.
    """

    bus: str
    asked: list[str] = field(default_factory=list)
    answers: dict[str, str] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    refused: str = ""


async def listen(bus_name: str, duration_s: float, drivers: Mapping[str, type[AnyAdapter]]) -> HeardOnBus:
    """Listen to a CAN bus. Nothing is sent.

    Args:
        bus_name: as for ``--bus``.
        duration_s: how long.
        drivers: those that may know the frames.

    Raises:
        ConfigurationError: that cannot be the name of a bus.
    """
    bus = make_bus(bus_name, payload_size=_CAN_PAYLOAD, listen_only=True)
    return await listen_on(bus, bus_name, duration_s, drivers)


async def listen_on(bus: Bus, bus_name: str, duration_s: float, drivers: Mapping[str, type[AnyAdapter]]) -> HeardOnBus:
    """As :func:`listen`, on a bus that is made already."""
    traffic, bits_before = Traffic(), bus.wire_bits
    try:
        async with attended(bus, traffic.take):
            begun_ns = now_ns()
            await asyncio.sleep(duration_s)
            passed_ns = now_ns() - begun_ns  # on a busy machine, more than was asked for
            reason = bus.reason(now_ns())
    except BusNotAvailable as error:
        return HeardOnBus(bus_name, str(error))
    return HeardOnBus(
        bus=bus_name,
        duration_s=passed_ns / NS_PER_S,
        frames=traffic.frames,
        rate_hz=traffic.frames * NS_PER_S / passed_ns,
        load=share_of_time(bus, bus.wire_bits - bits_before, passed_ns),
        error_frames=bus.counters.errors,
        trouble=reason_text(reason) if reason else "",
        lost=bus.counters.lost,
        classes=traffic.classes(),
        guesses=await guess(traffic, bus, dict(drivers)),
    )


async def ask(
    heard: HeardOnBus, drivers: Mapping[str, type[AnyAdapter]], *, force: bool = False, owner: str = ""
) -> Answer:
    """Ask who is on a CAN bus, as far as that disturbs nobody.

    On a silent bus all drivers ask. Where something sends, only those that know it, and only what harms no device
    that is sending. A bus that a running driver has, and one with frames that nobody knows, are left alone.

    Args:
        heard: what was heard on the bus just now.
        drivers: those that may ask.
        force: ask in spite of all that, and as if nobody were sending.
        owner: who has the bus, if somebody has.
    """
    if heard.problem:
        return Answer(heard.bus, refused=heard.problem)
    idle = force or not heard.frames
    known = {one.driver for one in likely(heard.guesses)}
    meant = {name: driver for name, driver in drivers.items() if idle or name in known}
    asking = {name: driver for name, driver in meant.items() if can_ask(driver)}
    if not force and owner:
        return Answer(heard.bus, refused=f"{owner} has it; ask that: skin-config")
    if not meant:
        return Answer(
            heard.bus, refused="no driver knows what is sending there, so a request could mean anything to it"
        )
    if not asking:
        return Answer(heard.bus, refused=f"there is no harmless question in {', '.join(meant)}")
    return await _ask_all(make_bus(heard.bus, payload_size=_CAN_PAYLOAD), heard.bus, asking, idle)


async def ask_port(path: str, drivers: Mapping[str, type[AnyAdapter]]) -> Answer:
    """Ask who is on a serial port, one driver after the other; opening it resets some microcontrollers.

    Args:
        path: of the port; or the name of a bus over a network, or of Modbus.
        drivers: those that may ask, of serial devices or of Modbus.
    """
    asked: list[str] = []
    answers: dict[str, str] = {}
    problems: dict[str, str] = {}
    for name, driver in drivers.items():
        if not can_ask(driver):
            continue
        adapter = with_default_options(driver)
        if adapter is None:
            problems[name] = "it has options that must be given"
            continue
        try:
            kind = "modbus" if driver.medium == "modbus" else "serial"
            bus_name = path if BusName.of(path).is_only_asked else f"{kind}:{path}"
            bus = make_bus(bus_name, payload_size=adapter.payload_size)
            adapter.fit(bus)
            told = await _ask_all(bus, path, {name: driver}, idle=False)
        except ConfigurationError as error:  # say, a baud rate that the port cannot do
            problems[name] = str(error)
            continue
        if told.refused:
            return told
        asked.append(name)
        answers.update(told.answers)
        problems.update(told.problems)
    nobody = "no installed driver has a harmless question for serial devices"
    return Answer(path, asked, answers, problems, "" if asked or problems else nobody)


def can_ask(driver: type[AnyAdapter]) -> bool:
    """Whether a driver knows a question that harms nobody."""
    return inspect.getattr_static(driver, "identify") is not inspect.getattr_static(Adapter, "identify")


async def _ask_all(bus: Bus, bus_name: str, drivers: Mapping[str, type[AnyAdapter]], idle: bool) -> Answer:
    answers, problems = {}, {}
    try:
        async with attended(bus) as link:
            for name, driver in drivers.items():
                try:
                    told = await asyncio.wait_for(driver.identify(link, idle=idle), _IDENTIFY_S)
                except HandshakeTimeout:
                    continue
                except BusError as error:
                    problems[name] = str(error)
                except TimeoutError:
                    problems[name] = f"did not come to an end within {_IDENTIFY_S:g} s"
                else:
                    if told:
                        answers[name] = told
    except BusNotAvailable as error:
        return Answer(bus_name, refused=str(error))
    return Answer(bus_name, list(drivers), answers, problems)
