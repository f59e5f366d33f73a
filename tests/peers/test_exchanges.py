"""Exchanges with makers' programs, as tools/peers kept them (PEERS_KEEP=FOLDER): the same bytes are the same values.

The bytes are what our emulators sent, the values what the makers' programs showed of them: docs/reference/peers.md.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware_drivers.can.linkerhand import LinkerHandDriver, LinkerHandOptions
from skinware_drivers.serial.ability_hand import AbilityHandDriver, AbilityHandOptions
from skinware_drivers.serial.anyskin import AnySkinDriver, AnySkinOptions
from skinware_drivers.testing.vectors import decode_frames, decode_stream
from skinware_drivers.virtual.devices.linkerhand import EmulatedLinkerHand, EmulatedLinkerHandOptions
from tests.peers.paxini_boards import known

FOLDER = Path(__file__).parents[1] / "data" / "peers"
HANDS = sorted(FOLDER.glob("linkerhand_*.json"))
BOARDS = [FOLDER / "anyskin.json", FOLDER / "reskin_sensor.json"]
MS = 1_000_000


def kept(file: Path) -> dict[str, Any]:
    made: dict[str, Any] = json.loads(file.read_text())
    return made


def hand(exchange: dict[str, Any], **more: bool) -> LinkerHandDriver:
    options = exchange["options"]
    return LinkerHandDriver(LinkerHandOptions(hands=tuple(options["hands"]), touch=options["touch"], **more))


def payloads(exchange: dict[str, Any]) -> list[bytes]:
    return [bytes.fromhex(payload) for _, payload in exchange["frames"]]


@pytest.mark.parametrize("file", HANDS, ids=lambda file: file.stem)
def test_a_hand_shows_what_its_makers_program_showed(file: Path) -> None:
    exchange = kept(file)
    frames = [(identifier, payload) for identifier, payload in exchange["frames"]]
    shown = decode_frames(hand(exchange), frames, strict=False, apart_s=0.00013)
    assert shown.values.tolist() == exchange["values"]
    assert len(set(exchange["values"])) > 10


@pytest.mark.parametrize("file", HANDS, ids=lambda file: file.stem)
def test_a_hand_is_asked_as_its_makers_program_asks(file: Path) -> None:
    exchange = kept(file)
    asked = [payload for payload in payloads(exchange) if len(payload) == 2]
    assert asked == [poll.payload for poll in hand(exchange, ask=True).polls]


@pytest.mark.parametrize("file", HANDS, ids=lambda file: file.stem)
def test_an_emulated_hand_answers_its_makers_program_in_the_same_frames(file: Path) -> None:
    """All that is not a value: the command, the row and the length of each frame."""
    exchange = kept(file)
    (number,), touch = exchange["options"]["hands"], exchange["options"]["touch"]
    emulated = EmulatedLinkerHand(EmulatedLinkerHandOptions(hands=(number,), touch=touch, program_ms=0), log=[])
    now_ns, answers = MS, []
    emulated.skip(now_ns)
    for payload in payloads(exchange):
        if len(payload) == 2:
            emulated.receive(number, payload, now_ns)
            now_ns += 100 * MS
            answers += [(frame.payload[:2], len(frame.payload)) for frame in emulated.emit(now_ns)]
    assert answers == [(each[:2], len(each)) for each in payloads(exchange) if len(each) > 2]


@pytest.mark.parametrize("file", BOARDS, ids=lambda file: file.stem)
def test_a_magnetic_skin_shows_what_its_makers_program_showed(file: Path) -> None:
    exchange = kept(file)
    mags, stream = exchange["options"]["mags"], bytes.fromhex(exchange["stream"])
    size = 16 * mags + 2
    for at, theirs in enumerate(exchange["values"]):
        shown = decode_stream(
            AnySkinDriver(AnySkinOptions(mags=mags)), stream[at * size : (at + 2) * size], strict=False
        )
        assert np.asarray(shown.values, float).tolist() == theirs
    assert len({value for values in exchange["values"] for value in values}) > 3


def test_a_hand_of_psyonic_shows_what_its_makers_program_showed() -> None:
    """The program shows newtons, by its formula."""
    exchange = kept(FOLDER / "ability_hand.json")
    for answer, theirs in zip(exchange["answers"], exchange["values"], strict=True):
        volts = decode_stream(AbilityHandDriver(AbilityHandOptions()), answer).values * 3.3 / 4096
        assert (121591 * volts / (33000 + 10000 * volts) + 0.878894 * (volts > 0)).tolist() == pytest.approx(theirs)
        assert len(set(theirs)) > 3


@pytest.mark.parametrize("board", ["converter", "high_speed"])
def test_a_board_of_paxini_shows_what_paxini_sdk_showed(board: str) -> None:
    exchange = kept(FOLDER / f"paxini_{board}.json")
    for frame, theirs in zip(exchange["frames"], exchange["values"], strict=True):
        assert decode_stream(known(board), frame).values.tolist() == theirs
        assert len(set(theirs)) > 10
