"""Asking on serial ports: emulated devices behind pseudo terminals, each asked by all drivers that ask."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import pytest

from skinware import Namespace
from skinware_drivers.cli.find import look
from skinware_drivers.finding import ports
from skinware_drivers.finding.guess import known_drivers
from skinware_drivers.finding.looking import ProbeAnswer, ask_port, can_ask
from skinware_drivers.finding.ports import SerialPort
from skinware_drivers.testing.driving import emulated_on_a_pty
from skinware_drivers.virtual.devices.agni import EmulatedAgni
from skinware_drivers.virtual.devices.openpatch import EmulatedOpenPatch
from skinware_drivers.virtual.devices.paxini import EmulatedPaxini
from skinware_drivers.virtual.devices.weiss import EmulatedWeissDsa, EmulatedWeissWts
from skinware_drivers.virtual.devices.wuji_glove import EmulatedWujiGlove
from tests.finding.fakes import see_only
from tests.serial.lines import Line, line, opened

DEVICES: dict[str, tuple[Any, str]] = {
    "agni": (EmulatedAgni, "AGNI device 7 with 2 sensors"),
    "openpatch": (EmulatedOpenPatch, "open patch: emulated 1"),
    "paxini": (EmulatedPaxini, "Paxini sensor 3: PAXINI PXSR-STDDP03F-v1.0.5"),
    "weiss_dsa": (EmulatedWeissDsa, "Weiss DSA controller with 6 matrices"),
    "weiss_wts": (EmulatedWeissWts, "WTS with 4 x 8 cells"),
    "wuji_glove": (EmulatedWujiGlove, "Wuji left glove"),
}
_MOST_TRIES = 5  # a machine that does much else may be late with an answer


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch, namespace: Namespace, tmp_path: Any) -> Callable[[str], None]:
    """Makes a path the only port of the machine."""
    see_only(namespace, tmp_path, monkeypatch)

    def make(path: str) -> None:
        monkeypatch.setattr(ports, "serial_ports", lambda: [SerialPort(path, "", None, (), True, "", True)])

    return make


def test_these_drivers_ask() -> None:
    assert {name for name, driver in known_drivers("serial").items() if can_ask(driver)} >= set(DEVICES)


@pytest.mark.thorough
def test_each_device_answers_its_driver_and_no_other() -> None:
    drivers = known_drivers("serial", DEVICES)

    async def ask_until_it_answers(path: str, name: str) -> ProbeAnswer:
        for _ in range(_MOST_TRIES):
            answer = await ask_port(path, drivers)
            if answer.answers:
                return answer
        pytest.fail(f"{name} does not answer")

    async def ask_all(paths: dict[str, str]) -> list[ProbeAnswer]:
        return await asyncio.gather(*(ask_until_it_answers(path, name) for name, path in paths.items()))

    with ExitStack() as running:
        paths = {
            name: running.enter_context(emulated_on_a_pty(emulator, streaming=True))
            for name, (emulator, _) in DEVICES.items()
        }
        answers = asyncio.run(ask_all(paths))
    for (name, (_, told)), answer in zip(DEVICES.items(), answers, strict=True):
        assert answer.answers == {name: told}
        assert answer.asked == sorted(DEVICES)


def test_nothing_is_sent_unless_it_is_asked_for(port: Callable[[str], None]) -> None:
    with line() as device:
        port(device.path)
        found = asyncio.run(look((device.path,), 0.0))
        assert found["ports"][0]["probe"] is None
        assert nothing_came(device)


def test_a_port_that_is_in_use_is_not_asked_and_said_to_be_so(port: Callable[[str], None]) -> None:
    with line() as device, opened(device.path):
        port(device.path)
        found = asyncio.run(look((device.path,), 0.0, probe=True, driver_names=("agni",)))
        assert "another program has it open" in found["ports"][0]["probe"].refused
        assert nothing_came(device)


def nothing_came(device: Line) -> bool:
    try:
        os.read(device.master, 1)
    except BlockingIOError:
        return True
    return False
