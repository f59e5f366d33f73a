"""Turns of other threads of a process, while somebody in it must not wait for long."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest

import skinware
from skinware.realtime import TURN_S, short_turns

WITHIN_S = 3e-6


def test_turns_are_short_until_the_last_one_has_ended() -> None:
    before_s = sys.getswitchinterval()
    first, second = short_turns(), short_turns()
    try:
        first.__enter__()
        second.__enter__()
        assert sys.getswitchinterval() == pytest.approx(TURN_S, abs=WITHIN_S)
        first.__exit__(None, None, None)
        assert sys.getswitchinterval() == pytest.approx(TURN_S, abs=WITHIN_S)
        second.__exit__(None, None, None)
        assert sys.getswitchinterval() == pytest.approx(before_s, abs=WITHIN_S)
    finally:
        sys.setswitchinterval(before_s)


def test_turns_that_are_shorter_already_stay_so() -> None:
    before_s = sys.getswitchinterval()
    try:
        sys.setswitchinterval(TURN_S / 10)
        with short_turns():
            assert sys.getswitchinterval() == pytest.approx(TURN_S / 10, abs=WITHIN_S)
    finally:
        sys.setswitchinterval(before_s)


@pytest.mark.parametrize(
    "loop",
    [lambda reader: reader.samples(), lambda reader: reader.in_order()],
    ids=["newest", "in order"],
)
def test_a_loop_over_frames_shortens_them_for_as_long_as_it_lives(
    loop: Callable[[skinware.ServiceReader], Iterator[skinware.Sample]],
) -> None:
    before_s = sys.getswitchinterval()
    with skinware.ServiceWriter("turns", {"a": (np.int64, (1,))}) as writer, skinware.ServiceReader("turns") as reader:
        writer.begin()
        writer.commit(1)
        for _ in loop(reader):
            assert sys.getswitchinterval() == pytest.approx(TURN_S, abs=WITHIN_S)
            break
        assert sys.getswitchinterval() == pytest.approx(before_s, abs=WITHIN_S)
        reader.read()
        next(reader.samples(rate_hz=100))
        assert sys.getswitchinterval() == pytest.approx(before_s, abs=WITHIN_S)
