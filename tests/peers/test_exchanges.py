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
from skinware_drivers.serial.anyskin import AnySkinDriver, AnySkinOptions
from skinware_drivers.testing.vectors import decode_frames, decode_stream
from skinware_drivers.virtual.devices.linkerhand import EmulatedLinkerHand, EmulatedLinkerHandOptions

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
