"""A wire that is asked to carry more than it can: told as what it is, not as boards that restart."""

from __future__ import annotations

import logging
import re

import pytest

from skinware import DriverReader
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.can.roboskin_setup import BoardSetUp, warn_of_full_bus
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual import device
from skinware_drivers.virtual.hardware import Event
from tests.sdk.driving import commands, driving, emulated


class Answering(RoboskinDriver):
    """Whose boards get their answers through, be the wire ever so full."""

    async def probe(self, link: Link, patch: Patch) -> bool:
        return True


@pytest.mark.thorough
def test_boards_that_find_no_room_are_not_taken_for_restarted(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "_BIT_NS", 20_000)  # a slow wire, so that the machine need not be fast
    monkeypatch.setattr(device, "_USUAL_NS", 2_600_000)
    log: list[Event] = []
    boards = (1, 2, 3)
    bus = emulated(log, boards=boards, pattern="idle")
    with (
        caplog.at_level(logging.WARNING),
        driving(bus, period_ms=150, driver=Answering) as running,
        DriverReader("roboskin") as reader,
    ):
        wait_until(lambda: "answers, but its data finds no room: the bus is full" in caplog.text)
        load = running.status()["buses"][0]["load"]
        assert load > 0.9
        first = reader.read()
        wait_until(lambda: bool(reader.read().module_time_ns.max() > first.module_time_ns.max() + 3 * 10**9))
    set_up = [identifier for _, identifier, payload in commands(log) if payload.startswith("4d")]
    assert sorted(set_up) == [0x200 | board for board in boards]  # once each
    assert "has restarted" not in caplog.text


@pytest.mark.parametrize(
    ("boards", "period_ms", "words"),
    [
        (12, 50, ""),
        (14, 59, ""),
        (14, 50, "14 boards every 50 ms need 116 % .* the first 12 fit, or all of them with period_ms = 59"),
        (3, 10, "3 boards every 10 ms need 125 % .* the first 2 fit, or all of them with period_ms = 13"),
    ],
)
def test_how_many_boards_fit_is_told(boards: int, period_ms: int, words: str, caplog: pytest.LogCaptureFixture) -> None:
    options = RoboskinOptions(period_ms=period_ms)
    warn_of_full_bus("can0", [BoardSetUp(options, board + 1) for board in range(boards)])
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == bool(words)
    assert all(re.match(f"can0: {words}", line) for line in told)
