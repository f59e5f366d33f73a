"""Polls of a serial line: what its baud rate cannot carry in time is refused, or told of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers import Bits, Frame, Identifier, Layout, Match, Module, NoOptions, Patch, Poll, Values, taxels
from skinware_drivers.serial import SUM8, Field, Packet, SerialAdapter, Unframed
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.testing.waiting import wait_until
from tests.sdk.driving import driving_lines
from tests.serial.lines import line

FINGERS = (1, 2, 3)


class Hand(SerialAdapter[NoOptions]):
    """Questions of 4 bytes, answers of 15."""

    framing = Packet(sync=(0xA5,), identifier=Field(1), length=15, checksum=SUM8)
    commands = Packet(sync=(0xA5,), identifier=Field(1), length=4, checksum=SUM8)
    types = (PRESSURE.measured(unit="counts", maximum=4095),)
    dtype = np.uint16
    layout = Layout([Frame("pressures", length=[12], values=Values(0, "<u2", 6), patch=Bits(0, 3))])
    patches = tuple(Patch(f"finger {n}", [Module(taxels(6, first_uid=n << 8))], key=n) for n in FINGERS)
    polls: Sequence[Poll] = tuple(Poll(n, b"\x04", 0.02, answer=Match(n), timeout_s=0.005) for n in FINGERS)


def on(path: str, **of_class: object) -> tuple[Hand, SerialBus]:
    adapter = type("Hand", (Hand,), of_class)(NoOptions())
    bus = SerialBus(*split(path), payload_size=adapter.payload_size)
    adapter.fit(bus)
    return adapter, bus


def split(path: str) -> tuple[str, dict[str, str]]:
    name, _, query = path.partition("?")
    return name, dict(pair.split("=") for pair in query.split("&") if pair)


@pytest.mark.parametrize(
    ("path", "of_class", "n_bytes", "baudrate"),
    [
        ("/dev/x", {"baudrate": 1_000_000}, 4 + 15, 1_000_000),
        ("/dev/x?baudrate=9600", {"baudrate": 1_000_000}, 4 + 15, 9600),
        ("/dev/x", {"baudrate": 9600, "commands": Unframed()}, 1 + 15, 9600),
        (
            "/dev/x",
            {"baudrate": 9600, "layout": Layout([Frame("another", [Identifier(9)], [12], Values(0, "<u2", 6))])},
            4,  # what answers is no data: nobody knows how long it is
            9600,
        ),
    ],
)
def test_question_and_answer_take_their_time(
    path: str, of_class: dict[str, object], n_bytes: int, baudrate: int
) -> None:
    adapter, _ = on(path, **of_class)
    assert adapter.wire_s(Hand.polls[0]) == pytest.approx(10 * n_bytes / baudrate)
    assert adapter.wire_s(replace(Hand.polls[0], answer=None, timeout_s=None)) <= adapter.wire_s(Hand.polls[0])


def test_a_line_too_slow_for_the_timeout_is_refused() -> None:
    words = "poll 001 waits 5 ms for its answer, but question and answer alone take 19.8 ms on the line"
    with (
        line() as wire,
        pytest.raises(ConfigurationError, match=words),
        driving_lines([on(wire.path, baudrate=9600)], "hand", wait=False) as running,
    ):
        wait_until(lambda: running.failure is not None)


def test_a_line_too_slow_for_the_period_is_told_of_once(caplog: pytest.LogCaptureFixture) -> None:
    often = tuple(replace(poll, period_s=0.01) for poll in Hand.polls)
    with line() as wire:
        adapter, bus = on(wire.path, baudrate=38400, polls=often)
        with driving_lines([(adapter, bus)], "hand", wait=False):
            wait_until(lambda: bus.counters.polls_unanswered > 3)
    doubts = [text for text in caplog.messages if "take 148 % of the time that their periods leave on the line" in text]
    assert len(doubts) == 1
