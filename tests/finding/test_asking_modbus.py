"""skin-find on Modbus: devices are read on request only, and never written to."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from skinware import Namespace
from skinware_drivers.cli.find import look
from skinware_drivers.finding.guess import known_drivers
from skinware_drivers.finding.looking import can_ask
from skinware_drivers.testing.waiting import wait_until
from tests.finding.fakes import see_only
from tests.modbus.peers import Action, device, rtu_server, tcp_server

pytestmark = [
    # pymodbus 3.16 leaves a question that came last unanswered, and its coroutine never awaited, when it is shut down
    pytest.mark.filterwarnings("ignore:.*ServerRequestHandler:pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore:.*ServerRequestHandler:RuntimeWarning"),
]
HAND = [100 + n for n in range(2200)]
ANSWER = "unit 1 lets 9 registers be read at 3000, where this driver wants them"


@pytest.fixture(autouse=True)
def nothing_else(namespace: Namespace, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    see_only(namespace, tmp_path, monkeypatch)


def found_on(bus: str, *, probe: bool, drivers: tuple[str, ...] = ("inspire",)) -> dict[str, Any]:
    """Return the output on a bus."""
    (found,) = asyncio.run(look((bus,), 0.1, probe=probe, driver_names=drivers))["buses"]
    return dict(found)


def noting(functions: list[int]) -> Action:
    """What a device does with a question: notes its function, and answers."""

    async def note(function: int, *_: Any) -> None:
        functions.append(function)

    return note


def test_these_drivers_read() -> None:
    readers = {name for name, driver in known_drivers("modbus").items() if can_ask(driver)}
    assert readers >= {"dfrobot", "inspire", "revo2", "revo3"}


def test_nobody_is_asked_without_a_word() -> None:
    functions: list[int] = []
    with tcp_server(device(1, 3000, HAND, noting(functions))) as bus:
        found = found_on(bus, probe=False)
    assert (found["heard"], found["probe"]) == (None, None)
    assert functions == []


@pytest.mark.parametrize("over", [tcp_server, rtu_server], ids=["tcp", "rtu"])
def test_who_has_the_registers_answers_and_nothing_is_written(over: Any) -> None:
    functions: list[int] = []
    with over(device(1, 3000, HAND, noting(functions))) as bus:
        wait_until(lambda: found_on(bus, probe=True)["probe"].answers == {"inspire": ANSWER})  # it waits for 0.1 s only
    assert set(functions) == {3}


def test_a_device_with_other_registers_says_so() -> None:
    with tcp_server(device(1, 10, [1, 2, 3])) as bus:
        probe = found_on(bus, probe=True)["probe"]
    assert probe.answers == {}
    assert "exception 2" in probe.problems["inspire"]


@pytest.mark.parametrize(
    ("maker", "answers"), [(0x3343, {"dfrobot": "DFRobot tactile array, unit 1, 4x8"}), (3343, {})]
)
def test_an_array_of_dfrobot_says_itself_what_it_is(maker: int, answers: dict[str, str]) -> None:
    functions: list[int] = []
    with rtu_server(device(1, 0, [0, maker, *[1] * 41, 0], noting(functions))) as bus:

        def is_found() -> bool:
            probe = found_on(bus, probe=True, drivers=("dfrobot",))["probe"]
            return probe.answers == answers and not probe.problems  # it waits for 0.1 s only

        wait_until(is_found)
    assert set(functions) == {4}
