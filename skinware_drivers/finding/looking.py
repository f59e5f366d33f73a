"""Listen to buses, and ask which devices are on them."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from skinware.errors import BusError, BusNotAvailable, ConfigurationError, HandshakeTimeout
from skinware.realtime import NS_PER_S, now_ns
from skinware_drivers.adapter import Adapter, AnyAdapter
from skinware_drivers.bus import Bus
from skinware_drivers.bus_names import BusName
from skinware_drivers.finding.guess import Guess, IdentifierClass, Traffic, guess, with_default_options
from skinware_drivers.finding.without_driver import attended
from skinware_drivers.registry import make_bus
from skinware_drivers.running.news import reason_text, share_of_time
from skinware_drivers.streams.dds import HeardTopic, TopicBus

_CAN_PAYLOAD = 64
_IDENTIFY_S, _DISCOVERY_S = 5.0, 3.0


@dataclass(frozen=True)
class HeardOnBus:
    """The traffic of a CAN bus.

    Attributes:
        problem: the reason why it cannot be read; else empty.
        load: share of the bus' time, 0 to 1; None: the bit rate is unknown.
        trouble: state of the controller if something is wrong: ``error-passive``.
        dropped: number of frames that were read too late.
    """

    bus: str
    problem: str = ""
    duration_s: float = 0.0
    frames: int = 0
    rate_hz: float = 0.0
    load: float | None = None
    error_frames: int = 0
    trouble: str = ""
    dropped: int = 0
    classes: list[IdentifierClass] = field(default_factory=list)
    guesses: list[Guess] = field(default_factory=list)


@dataclass(frozen=True)
class ProbeAnswer:
    """The answers on a bus.

    Attributes:
        answers: devices in words, by driver.
        refused: the reason why no driver asked; else empty.
    """

    bus: str
    asked: list[str] = field(default_factory=list)
    answers: dict[str, str] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    refused: str = ""


async def listen(
    bus_name: str, duration_s: float, drivers: Mapping[str, type[AnyAdapter]], bus: Bus | None = None
) -> HeardOnBus:
    """Listen to a CAN bus. Nothing is sent.

    Args:
        bus: of this name, not opened yet; default: it is made.
    """
    bus = bus or make_bus(bus_name, payload_size=_CAN_PAYLOAD, listen_only=True)
    traffic, bits_before = Traffic(), bus.wire_bits
    try:
        async with attended(bus, traffic.take):
            begun_ns = now_ns()
            await asyncio.sleep(duration_s)
            passed_ns = now_ns() - begun_ns  # more than the duration on a busy machine
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
        dropped=bus.counters.dropped,
        classes=traffic.classes(),
        guesses=await guess(traffic, bus, dict(drivers)),
    )


async def ask(
    heard: HeardOnBus, drivers: Mapping[str, type[AnyAdapter]], *, force: bool = False, owner: str = ""
) -> ProbeAnswer:
    """Ask which devices are on a CAN bus, without disturbing any.

    On a silent bus all drivers ask. If frames are heard, only the drivers that know them ask, and only questions that
    are harmless for devices that send. A bus of a running driver (owner), and one with unknown frames are left alone.
    """
    if heard.problem:
        return ProbeAnswer(heard.bus, refused=heard.problem)
    idle = force or not heard.frames
    known = {one.driver for one in heard.guesses if one.likely}
    meant = {name: driver for name, driver in drivers.items() if idle or name in known}
    asking = {name: driver for name, driver in meant.items() if can_ask(driver)}
    if not force and owner:
        return ProbeAnswer(heard.bus, refused=f"{owner} has it; use skin-config to ask through that driver")
    if not meant:
        return ProbeAnswer(
            heard.bus, refused="no driver knows what is sending there, so a request could mean anything to it"
        )
    if not asking:
        return ProbeAnswer(heard.bus, refused=f"there is no harmless question in {', '.join(meant)}")
    return await _ask_all(make_bus(heard.bus, payload_size=_CAN_PAYLOAD), heard.bus, asking, idle)


async def ask_port(path: str, drivers: Mapping[str, type[AnyAdapter]]) -> ProbeAnswer:
    """Ask which device is on a serial port, one driver after the other; opening it resets some microcontrollers.

    Args:
        path: of the port; or the name of a bus over a network, or of Modbus.
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
            answer = await _ask_all(bus, path, {name: driver}, idle=False)
        except ConfigurationError as error:  # such as a baud rate that the port does not have
            problems[name] = str(error)
            continue
        if answer.refused:
            return answer
        asked.append(name)
        answers.update(answer.answers)
        problems.update(answer.problems)
    none = "no installed driver has a harmless question for serial devices"
    return ProbeAnswer(path, asked, answers, problems, "" if asked or problems else none)


def topics_on(bus_name: str, duration_s: float, drivers: Mapping[str, type[AnyAdapter]]) -> list[HeardTopic]:
    """Return the topics of a domain (``dds://0``, ``ros2://0``), and which drivers can read each; nothing is published.

    Args:
        duration_s: to listen, at least 3 s: programs that run already are found one after the other.

    Raises:
        BusNotAvailable: the domain cannot be joined.
    """
    bus = make_bus(bus_name)
    if not isinstance(bus, TopicBus):
        return []
    bus.topics = ()
    bus.open()
    try:
        time.sleep(max(duration_s, _DISCOVERY_S))
        found = bus.heard()
    finally:
        bus.close()
    return [
        replace(
            heard,
            drivers=tuple(
                driver
                for driver, kind in drivers.items()
                if any(
                    one.dds_type == heard.type_name
                    and (one.name == heard.topic or getattr(kind, "reads_any_name", False))
                    for one in getattr(kind, "topics", ())
                )
            ),
        )
        for heard in found
    ]


def can_ask(driver: type[AnyAdapter]) -> bool:
    return inspect.getattr_static(driver, "identify") is not inspect.getattr_static(Adapter, "identify")


async def _ask_all(bus: Bus, bus_name: str, drivers: Mapping[str, type[AnyAdapter]], idle: bool) -> ProbeAnswer:
    answers, problems = {}, {}
    try:
        async with attended(bus) as link:
            for name, driver in drivers.items():
                try:
                    answer = await asyncio.wait_for(driver.identify(link, idle=idle), _IDENTIFY_S)
                except HandshakeTimeout:
                    continue
                except BusError as error:
                    problems[name] = str(error)
                except TimeoutError:
                    problems[name] = f"did not end within {_IDENTIFY_S:g} s"
                else:
                    if answer:
                        answers[name] = answer
    except BusNotAvailable as error:
        return ProbeAnswer(bus_name, refused=str(error))
    return ProbeAnswer(bus_name, list(drivers), answers, problems)
