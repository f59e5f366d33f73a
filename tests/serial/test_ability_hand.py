"""PSYONIC's Ability Hand: bytes by hand (from the maker's programs, not captured), and that nothing ever moves it."""

from __future__ import annotations

import logging
from typing import Any, ClassVar

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot, Status
from skinware_drivers.serial.ability_hand import AbilityHandDriver, AbilityHandOptions
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.devices.ability_hand import EmulatedAbilityHand, EmulatedAbilityHandOptions, message
from tests.sdk.driving import driving_lines, read_until
from tests.serial.lines import line
from tests.serial.spoken import Spoken

READ_TOUCH = bytes.fromhex("7E 50 A0 10 7E")
READ_POSITIONS = bytes.fromhex("7E 50 A2 0E 7E")
MOVE = message(bytes.fromhex("50 10") + bytes(12))


def answer(header: int, first: bytes) -> bytes:
    """An answer whose sensors begin with these bytes."""
    return message(bytes([header]) + bytes(24) + first.ljust(45, b"\0") + b"\0")


def test_the_question_is_the_maker_s_and_carries_no_target() -> None:
    driver = AbilityHandDriver(AbilityHandOptions())
    [poll] = driver.polls
    assert driver.framing.encode(poll.identifier, poll.payload) == READ_TOUCH
    other = AbilityHandDriver(AbilityHandOptions(address=0x7D))
    assert other.framing.encode(0x7D, b"\xa0") == bytes.fromhex("7E 7D 5D A0 E3 7E")


def test_the_emulated_hand_byte_for_byte() -> None:
    values = [0x123, 0xABC, 0x7E7, *[0] * 26, 0xFFF]
    device = EmulatedAbilityHand(EmulatedAbilityHandOptions(), source=lambda _n, _c: values)
    hand = Spoken(device)
    [said] = hand.answers(READ_TOUCH)
    assert said[0] == said[-1] == 0x7E
    assert len(said) == 72 + 2
    assert said[1:26] == bytes([0xA0]) + bytes(range(24))
    assert said[26:31] == bytes.fromhex("23 C1 AB E7 07")
    assert hand.answers(READ_TOUCH[:-2] + b"\x11\x7e") == []  # a wrong sum
    [positions] = hand.answers(READ_POSITIONS)
    assert len(positions) == 38 + 1 + 2
    assert device.moves() == 0
    assert hand.answers(MOVE)
    assert device.moves() == 1


def test_no_flipped_bit_makes_an_answer() -> None:
    """LRC finds all of them; of two, it cannot."""
    good = answer(0xA0, bytes.fromhex("23 C1 AB"))
    for bit in range(8, 8 * (len(good) - 1)):
        damaged = bytearray(good)
        damaged[bit // 8] ^= 1 << bit % 8
        framer = AbilityHandDriver.framing.framer()
        assert not [frame for frame in framer.feed(bytes(damaged)) if frame.identifier >= 0x100]


def shown(
    stream: bytes, listen_only: bool = False, at_least: int = 1, **options: Any
) -> tuple[DriverSnapshot, dict[str, Any]]:
    """What a driver shows of a line on which this comes again and again, and what its bus counts by so many answers."""
    driver = AbilityHandDriver(AbilityHandOptions(**options))
    with line() as port:
        bus = SerialBus(port.path, payload_size=driver.payload_size, listen_only=listen_only)
        with driving_lines([(driver, bus)], "hand", listen_only=listen_only, wait=False) as running:
            wait_until(lambda: running.runner is not None and running.runner.builder.writer is not None)
            with DriverReader("hand", timeout_s=30) as reader:

                def is_seen(frame: DriverSnapshot) -> bool:
                    port.write(stream)
                    return not (frame.status & (Status.NEVER_SEEN | Status.STALE)).any()

                frame = read_until(reader, is_seen)
                wait_until(lambda: running.status()["buses"][0]["frames"] >= at_least)
                return frame, running.status()["buses"][0]


def test_answers_to_every_program_are_taken() -> None:
    headers = (0x10, 0x11, 0x20, 0x31, 0x40, 0x41, 0xA0, 0xA1)
    sensors = bytes.fromhex("23 C1 AB FF FF FF 01 00 00")
    frame, bus = shown(b"".join(answer(header, sensors) for header in headers), at_least=40, zero="good")
    assert frame.values[:7].tolist() == [0x123, 0xABC, 0xFFF, 0xFFF, 1, 0, 0]
    assert np.flatnonzero(frame.status & Status.OUT_OF_RANGE).tolist() == [2, 3]
    assert (bus["unknown"], bus["bad_length"]) == (0, 0)


def test_dead_sensors_and_places() -> None:
    frame, _ = shown(answer(0xA0, bytes.fromhex("23 C1 AB")))
    assert np.flatnonzero(frame.status & Status.SUSPECT).tolist() == list(range(2, 30))
    structure = frame.structure
    assert structure.patch_names[0] == "right hand"
    assert structure.module_names[4] == "right hand, thumb"
    assert structure.geometry is not None
    place = structure.geometry.position_m
    assert place[0, 0] - place[12, 0] == pytest.approx(0.048)  # index and ring finger of a right hand
    assert len({tuple(row) for row in place.tolist()}) == 30


def test_a_listener_hears_what_another_program_asks_for_and_sends_nothing() -> None:
    """On a tap with both directions: questions of the other program are none of ours, and no wrong lengths."""
    frame, bus = shown(MOVE + answer(0x10, bytes.fromhex("23 C1 AB")), listen_only=True, at_least=6)
    assert frame.values[:2].tolist() == [0x123, 0xABC]
    assert (bus["sent"], bus["bad_length"]) == (0, 0)
    assert bus["unknown"] >= 1


def test_it_is_told_if_another_program_asks_for_answers_without_touch(caplog: pytest.LogCaptureFixture) -> None:
    driver = AbilityHandDriver(AbilityHandOptions())
    without = message(bytes([0x12]) + bytes(37))
    with caplog.at_level(logging.WARNING), line() as port:
        bus = SerialBus(port.path, payload_size=driver.payload_size, listen_only=True)
        with driving_lines([(driver, bus)], "hand", wait=False, listen_only=True):

            def is_told() -> bool:
                port.write(without)
                return any("answers without touch" in text for text in caplog.messages)

            wait_until(is_told)


class Watched(EmulatedAbilityHand):
    """A hand of which it is known how often it was told to move."""

    hands: ClassVar[list[EmulatedAbilityHand]] = []

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.hands.append(self)


def test_the_driver_never_moves_the_hand() -> None:
    faults: dict[str, Any] = {"lose": 0.02, "truncate": 0.02, "corrupt": 0.02, "repeat": 0.02}
    Watched.hands.clear()
    with emulated_skin(AbilityHandDriver, Watched, pattern="cycle", **faults) as skin:
        for _ in range(20):
            frame = read_until(skin.reader, lambda f: not (f.status & Status.STALE).any())
            assert len(set(frame.values.tolist())) == 1
    assert [hand.moves() for hand in Watched.hands] == [0]
