"""Boards that moved their baseline without a word are shown as suspect, and no others.

The firmware re-calibrates a board after five cycles in which some channel did not acknowledge though its triangle is
connected; several such triangles count together (embot_app_application_theSkin.cpp).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import pytest

from skinware import Status
from tests.sdk.test_publisher import Desk
from tests.sdk.test_roboskin_wire import MS, Wire, halves

NO_ACK, NOT_CONNECTED, BOTH = "0001", "0002", "0003"


class Boards(Desk):
    """Boards 7 and 8 as a user sees them."""

    def cycle(self, tails: Mapping[int, str], board: int = 7) -> None:
        """Both boards send a burst; ``tails`` = triangle of ``board``: its diagnostics."""
        self.clock.now_ns += 50 * MS
        frames: list[Wire] = []
        for address in (7, 8):
            for triangle in range(16):
                tail = tails.get(triangle, "0000") if address == board else "0000"
                at_ns = self.clock.now_ns + triangle * 260_000
                frames += halves(triangle, 240, time_ns=at_ns, board=address, tail=tail)
        self.feed(frames)

    def suspects(self) -> list[bool]:
        """Whether every sensor of board 7, of board 8 is suspect."""
        status = self.reader.read().status & Status.SUSPECT
        assert all(len(set(of_board.tolist())) == 1 for of_board in (status[:192], status[192:]))
        return [bool(status[0]), bool(status[192])]


@contextmanager
def seven_and_eight(monkeypatch: pytest.MonkeyPatch) -> Iterator[Boards]:
    boards = Boards(monkeypatch, boards=(7, 8), watched=True)
    try:
        yield boards
    finally:
        boards.close()


def test_five_cycles_without_acknowledgement_move_the_baseline_of_a_board(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with seven_and_eight(monkeypatch) as boards:
        for _ in range(4):
            boards.cycle({3: NO_ACK})
            assert boards.suspects() == [False, False]
        boards.cycle({3: NO_ACK})
        assert boards.suspects() == [True, False]


def test_the_cycles_need_not_follow_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    with seven_and_eight(monkeypatch) as boards:
        for _ in range(4):
            boards.cycle({3: NO_ACK})
            boards.cycle({})
        assert boards.suspects() == [False, False]
        boards.cycle({3: NO_ACK}, board=8)
        assert boards.suspects() == [False, False]  # every board counts for itself
        boards.cycle({5: NO_ACK})
        assert boards.suspects() == [True, False]


def test_several_triangles_count_together(monkeypatch: pytest.MonkeyPatch) -> None:
    with seven_and_eight(monkeypatch) as boards:
        boards.cycle({1: NO_ACK, 2: NO_ACK, 9: NO_ACK}, board=8)
        assert boards.suspects() == [False, False]
        boards.cycle({1: NO_ACK, 15: NO_ACK}, board=8)
        assert boards.suspects() == [False, True]


@pytest.mark.parametrize("tail", [NOT_CONNECTED, BOTH, "0010"], ids=["mtb3", "mtb4", "out of range"])
def test_triangles_not_connected_or_out_of_range_move_nothing(monkeypatch: pytest.MonkeyPatch, tail: str) -> None:
    with seven_and_eight(monkeypatch) as boards:
        for _ in range(10):
            boards.cycle({3: tail, 4: tail})
        assert boards.suspects() == [False, False]


def test_suspicion_outlasts_the_flag_and_ends_with_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    with seven_and_eight(monkeypatch) as boards:
        boards.cycle(dict.fromkeys(range(5), NO_ACK))
        boards.cycle({})
        boards.cycle({})
        assert boards.suspects() == [True, False]
        assert set((boards.reader.read().status[:192] & Status.NO_ACK).tolist()) == {0}
        boards.watch.forget(0)
        for _ in range(4):
            boards.cycle({3: NO_ACK})
            assert boards.suspects() == [False, False]
        boards.cycle({3: NO_ACK})
        assert boards.suspects() == [True, False]


def test_a_board_that_is_set_up_anew_goes_on_counting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its count is a static variable of the firmware: a set-up does not reset it."""
    with seven_and_eight(monkeypatch) as boards:
        for _ in range(3):
            boards.cycle({3: NO_ACK})
        boards.watch.forget(0)
        boards.cycle({3: NO_ACK})
        assert boards.suspects() == [False, False]
        boards.cycle({3: NO_ACK})  # the fifth
        assert boards.suspects() == [True, False]
        boards.watch.forget(0)
        for _ in range(2):
            boards.cycle({3: NO_ACK})
            assert boards.suspects() == [False, False]  # by either count
        boards.cycle({3: NO_ACK})  # the fifth, if it had restarted when it was first set up anew
        assert boards.suspects() == [True, False]
