"""A hand that its own program asks, on the same CAN interface as a driver that only listens."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from skinware import DriverReader
from skinware_drivers.can.linkerhand import LinkerHandDriver, LinkerHandOptions
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import read_until
from tests.can.rig import can_frame, sender
from tests.can.test_drivers_on_can import emulating

pytestmark = [pytest.mark.can, pytest.mark.timeout(200)]

LEFT = 0x28
LAST_ROW = 0x90
PERIOD_S = 0.5
"""From one round of questions to the next: far longer than a round takes where the lab has little time."""
ROUNDS = 10


class Program:
    """Moves a hand, and asks for its fingers one after the other, as its maker's programs do.

    Attributes:
        rounds: whole ones, so far.
        answers: frames that it got.
    """

    def __init__(self, interface: str) -> None:
        self.rounds = 0
        self.answers = 0
        self._socket = sender(interface)
        self._socket.settimeout(0.5)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            self._socket.send(can_frame(LEFT, bytes.fromhex("01FF80FF10FF20")))
            for finger in range(1, 6):
                self._socket.send(can_frame(LEFT, bytes([0xB0 | finger, 0xA4])))
                with contextlib.suppress(TimeoutError):
                    while self._socket.recv(16)[9] != LAST_ROW:
                        self.answers += 1
            self.rounds += 1

    @classmethod
    @contextmanager
    def running(cls, interface: str) -> Iterator[Program]:
        program = cls(interface)
        program._thread.start()
        try:
            yield program
        finally:
            program._stop.set()
            program._thread.join()
            program._socket.close()


def test_a_driver_shows_what_the_hands_own_program_asks_for_and_sends_nothing(
    vcan: Callable[[], str],
) -> None:
    bus = vcan()
    listener = LinkerHandDriver(LinkerHandOptions(period_ms=round(1e3 * PERIOD_S)))
    lines = [(listener, make_bus(bus))]
    with (
        emulating("linkerhand", bus, pattern="idle", hands=(LEFT,), touch="10x4", program_ms=0) as hand,
        Program.running(bus) as program,
        driving_lines(lines, "hand", wait=False) as driver,
    ):
        assert driver.ready.wait(120)
        with DriverReader("hand") as reader:
            first = read_until(reader, lambda frame: not frame.status.any())
            assert first.structure.n_sensors == 5 * 40
            rounds = program.rounds
            read_until(reader, lambda frame: frame.sequence > first.sequence + ROUNDS and not frame.status.any())
        (shown,) = driver.status()["buses"]
        assert program.rounds > rounds
    assert shown["sent"] == 0
    assert shown["unknown"] == shown["bad_length"] == shown["bad_content"] == 0
    assert program.answers
    assert hand.last["send_failures"] == 0
