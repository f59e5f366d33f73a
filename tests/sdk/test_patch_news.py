"""Patches that fall silent and come back are told of: each of them, together, and never without end."""

from __future__ import annotations

import logging

import pytest

from skinware import DriverReader
from skinware_drivers.running.news import LINE_EVERY_S, LINES_AT_ONCE, PatchChange, PatchNews
from skinware_drivers.testing.waiting import wait_until
from tests.sdk.clock import Clock
from tests.sdk.driving import driving, emulated, follow, hardware_of

pytestmark = pytest.mark.usefixtures("hurry")


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def news(clock: Clock, caplog: pytest.LogCaptureFixture) -> PatchNews:
    caplog.set_level(logging.WARNING)
    return PatchNews("can0", clock)


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.getMessage().startswith("can0")]


def test_one_board_is_named_once_it_has_settled(
    news: PatchNews, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    assert news.catch_up() is None
    news.note("board 8", is_live=False)
    assert news.catch_up() is None
    clock.pass_s(0.25)
    assert news.catch_up() == PatchChange("can0", ["board 8"], [])
    clock.pass_s(5)
    assert news.catch_up() is None
    news.note("board 8", is_live=True)
    clock.pass_s(0.25)
    assert news.catch_up() == PatchChange("can0", [], ["board 8"])
    assert told(caplog) == ["can0: board 8 fell silent", "can0: board 8 is live again"]


def test_thirty_boards_that_go_at_once_are_one_line(
    news: PatchNews, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    boards = [f"board {number}" for number in range(30)]
    changes = []
    for is_live in (False, True):
        for board in boards:  # within half a second, looked at after each
            news.note(board, is_live=is_live)
            clock.pass_s(0.015)
            changes.append(news.catch_up())
        clock.pass_s(0.25)
        changes.append(news.catch_up())
    assert [change for change in changes if change] == [
        PatchChange("can0", boards, []),
        PatchChange("can0", [], boards),
    ]
    names = "(board 0, board 1, board 2, board 3, board 4, board 5 and 24 more)"
    assert told(caplog) == [f"can0: 30 patches fell silent {names}", f"can0: 30 patches are live again {names}"]


def test_what_never_settles_is_told_each_second(news: PatchNews, clock: Clock) -> None:
    changes = []
    for number in range(40):
        news.note(f"board {number}", is_live=False)
        clock.pass_s(0.1)
        changes.append(news.catch_up())
    assert [len(change.silent) for change in changes if change] == [10, 10, 10, 10]


def test_some_go_while_others_come(news: PatchNews, clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    news.note("board 1", is_live=False)
    news.note("board 2", is_live=True)
    news.note("board 3", is_live=False)
    news.note("board 3", is_live=True)  # silent for a moment only
    clock.pass_s(0.25)
    assert news.catch_up() == PatchChange("can0", ["board 1"], ["board 2", "board 3"])
    assert told(caplog) == [
        "can0: board 1 fell silent; 2 patches are live again (board 2, board 3) (changes not logged before: 1)"
    ]


def test_a_board_that_comes_and_goes_for_an_hour_fills_no_log(
    news: PatchNews, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    changes = []
    for number in range(3600):
        news.note("board 8", is_live=bool(number % 2))
        for _ in range(4):
            clock.pass_s(0.25)
            changes.append(news.catch_up())
    clock.pass_s(LINE_EVERY_S)
    changes.append(news.catch_up())
    lines = told(caplog)
    assert lines[:2] == ["can0: board 8 fell silent", "can0: board 8 is live again"]
    assert len(lines) == len([change for change in changes if change]) <= LINES_AT_ONCE + 3600 / LINE_EVERY_S + 1
    assert lines[-1].startswith("can0: board 8 is live again (changes not logged before: ")
    kept_back = sum(int(line.rpartition(" ")[2].rstrip(")")) for line in lines if "(" in line)
    assert kept_back + len(lines) == 3600


def test_boards_of_a_running_driver(caplog: pytest.LogCaptureFixture) -> None:
    boards = (3, 4, 5, 7, 8)
    bus = emulated(boards=boards, pattern="idle", boot_s=0.05)
    with caplog.at_level(logging.WARNING), driving(bus) as running, DriverReader("roboskin") as reader:
        follow(reader, lambda f: not f.status.any())

        def kill() -> None:
            for board in boards[1:]:
                hardware_of(bus).kill(board, bus._clock())

        running.do(kill)
        wait_until(lambda: "bus0: 4 patches fell silent (" in caplog.text)
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        wait_until(lambda: "bus0: board 8 is live again" in caplog.text)
    assert caplog.text.count("fell silent") == 1
