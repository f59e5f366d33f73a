"""Hands of Tesollo: vectors of the wire, and the driver on emulated hands behind TCP."""

from __future__ import annotations

import asyncio
import struct
from typing import Any, cast

import numpy as np
import pytest

from skinware import Status
from skinware.errors import BusError, ConfigurationError
from skinware.status import PatchState
from skinware_drivers.fields import Reply
from skinware_drivers.link import Link
from skinware_drivers.registry import make_bus
from skinware_drivers.streams.tesollo import TesolloDriver, TesolloOptions, _Hand
from skinware_drivers.testing.driving import emulated_on, emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.devices.tesollo import EmulatedTesollo, EmulatedTesolloOptions
from tests.commands import run
from tests.serial.spoken import Spoken
from tests.streams.peers import LOCAL, free_port

VERSION, EVERYTHING, ZERO = bytes.fromhex("000308"), bytes.fromhex("0008010102030405"), bytes.fromhex("00030B")


def test_bytes_of_commands_are_those_of_the_vectors() -> None:
    driver = TesolloDriver(TesolloOptions())
    [poll] = driver.polls
    assert driver.framing.encode(poll.identifier, poll.payload) == EVERYTHING
    assert driver.framing.encode(8, b"") == VERSION
    assert driver.framing.encode(11, b"") == ZERO


def test_an_answer_of_238_bytes_is_taken_apart() -> None:
    """DG-5F with TACTILE_M: 3 + 20 motors of 8 bytes + 5 fingers of 15."""
    hand = _Hand(0x5F22, b"\1\5", 3, (0, 1, 2, 3, 4))
    framer = TesolloDriver(TesolloOptions())._framing(hand).framer()
    fingers = [bytes([16 * finger + cell for cell in range(15)]) for finger in range(5)]
    answer = bytes.fromhex("00EE01") + bytes(160) + b"".join(fingers)
    assert len(answer) == 238
    assert [(frame.identifier, frame.body) for frame in framer.feed(answer)] == [
        (0x100 + finger, fingers[finger]) for finger in range(5)
    ]


@pytest.mark.parametrize("pads", [True, False])
def test_fingers_without_sensors_may_have_bytes_or_not(pads: bool) -> None:
    hand = _Hand(0x3F02, b"\1\5", 5, (0, 2))
    framer = TesolloDriver(TesolloOptions())._framing(hand).framer()
    first, last = struct.pack(">18H", *range(0x100, 0x112)), struct.pack(">18H", *range(0x200, 0x212))
    body = bytes(12 * 8) + first + (bytes(36) if pads else b"") + last
    found = framer.feed(struct.pack(">HB", len(body) + 3, 1) + body)
    assert [(frame.identifier, frame.body) for frame in found] == [(0x100, first), (0x102, last)]


def test_the_emulated_hand_byte_for_byte() -> None:
    hand = Spoken(EmulatedTesollo(EmulatedTesolloOptions(hand="3f", fitted=5, pads=True, pattern="cycle")))
    assert hand.answers(VERSION) == [bytes.fromhex("0009 08 3F02 0105 03 05")]
    for cycle in range(2):
        [answer] = hand.answers(EVERYTHING)
        assert answer[:3] == struct.pack(">HB", 3 + 96 + 45, 1)
        assert answer[99:] == bytes([cycle]) * 15 + bytes(15) + bytes([cycle]) * 15
    assert hand.answers(bytes.fromhex("00040105")) == [bytes.fromhex("003001") + b"\2" * 15 + bytes(15) + b"\2" * 15]
    assert hand.answers(ZERO) == []
    [answer] = hand.answers(bytes.fromhex("0009010102030405 06"))
    assert len(answer) == 3 + 96 + 45 + 4
    [answer] = hand.answers(bytes.fromhex("00070101020304"))
    assert len(answer) == 3 + 96


@pytest.mark.parametrize(
    ("tips", "dtype", "kind", "count"),
    [
        ("tactile_m", np.uint8, "3x5", 75),
        ("tactile_s", np.uint16, "3x6", 90),
        ("six_axes", np.int16, "force", 30),
        ("four_axes", np.int16, "force", 20),
    ],
)
def test_a_hand_behind_tcp(tips: str, dtype: type, kind: str, count: int, namespace: object) -> None:
    port = free_port()
    device = make_bus(f"tcp://{LOCAL}:{port}", payload_size=4096, for_devices=True)
    with emulated_on(device, EmulatedTesollo, tips=tips, pattern="cycle"):
        with emulated_skin("tesollo", bus=f"tcp://{LOCAL}:{port}") as skin:
            frame = read_until(skin.reader, lambda f: (f.patch_state == PatchState.LIVE).all() and int(f.values[0]) > 3)
            assert frame.values.dtype == dtype
            assert len(frame.values) == count
            assert len(set(frame.values.tolist())) == 1
            structure = frame.structure
            assert structure.module_kind.tolist() == [kind.encode()] * 5
            assert structure.module_name[:2].tolist() == [b"thumb tip", b"index tip"]
            assert structure.geometry is not None
            assert structure.geometry.known.all()
            if kind == "force":
                assert [(t.name, t.unit, t.scale) for t in structure.types][2:4] == [
                    ("force_z", "N", 0.1),
                    ("torque_x" if tips == "six_axes" else "torque_z", "N m", 0.001),
                ]
                skin.reader.call("tare")
            else:
                with pytest.raises(Exception, match="only hands with force sensors"):
                    skin.reader.call("tare")


@pytest.mark.thorough
def test_a_hand_is_asked_for_its_model_over_tcp_only(namespace: object) -> None:
    port = free_port()
    device = make_bus(f"tcp://{LOCAL}:{port}", payload_size=4096, for_devices=True)
    with emulated_on(device, EmulatedTesollo):
        for asked in ("paxini", "tesollo"):  # what the first asks looks like the beginning of a long question
            found = run("skin-find", f"tcp://{LOCAL}:{port}", "--probe", "--driver", asked)
        assert "answers: Tesollo DG-5F right" in found.stdout
    assert asyncio.run(TesolloDriver.identify(Link(make_bus("/dev/ttyUSB0")), idle=True)) is None


def test_saturated_cells_are_flagged() -> None:
    class Pressed(EmulatedTesollo):
        full_scale = 255

        def feel(self, *_: Any) -> list[int]:
            return [255, 254] + [0] * 73

    with emulated_skin(TesolloDriver, Pressed) as skin:
        frame = read_until(skin.reader, lambda f: int(f.values[0]) == 255)
        assert frame.status[:3].tolist() == [Status.OUT_OF_RANGE, 0, 0]


class Says:
    """A hand that says of itself what the test says."""

    def __init__(self, answer: str) -> None:
        self._body = bytes.fromhex(answer)[3:]

    async def request(self, *_: Any, **__: Any) -> Reply:
        return Reply(0, 8, self._body)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ("0007 08 5F22 0105", "does not report its sensors: say sensors"),
        ("0009 08 5F22 0105 00 00", "says it has no sensors"),
        ("0009 08 5F22 0105 03 00", "says it has no sensors"),
        ("0009 08 5F22 0105 09 1F", "says it has no sensors"),
        ("0009 08 3F01 0105 03 07", "model 3F01"),
    ],
)
def test_hands_that_are_refused(answer: str, words: str) -> None:
    with pytest.raises(BusError, match=words):
        asyncio.run(TesolloDriver(TesolloOptions())._ask_version(cast("Link", Says(answer))))


def test_sensors_of_fewer_axes_measure_what_the_makers_program_says() -> None:
    types, names = TesolloDriver(TesolloOptions())._channels(4)
    assert [(kind.name, kind.unit, kind.scale) for kind in types][2:] == [
        ("force_z", "N", 0.1),
        ("torque_z", "N m", 0.001),
    ]
    assert names == ["force_x", "force_y", "force_z", None, None, "torque_z"]
    assert TesolloDriver(TesolloOptions())._channels(2)[1] == ["force_x", "force_y", "force_z", None, None, None]
    with pytest.raises(ConfigurationError, match="sensors"):
        TesolloOptions(sensors=9)  # type: ignore[arg-type]


def test_the_fourth_of_four_axes_is_the_last_of_six_places() -> None:
    hand = Spoken(EmulatedTesollo(EmulatedTesolloOptions(hand="3f", tips="four_axes", fitted=1, pattern="cycle")))
    assert hand.answers(VERSION) == [bytes.fromhex("0009 08 3F02 0105 04 01")]
    hand.answers(EVERYTHING)
    assert hand.answers(bytes.fromhex("00040105")) == [bytes.fromhex("000f01 0001 0001 0001 0000 0000 0001")]


def test_an_old_hand_tells_nothing_of_its_sensors(namespace: object) -> None:
    with emulated_skin("tesollo", old=True, hand="4f", fitted=15, driver_options={"sensors": 3}) as skin:
        frame = read_until(skin.reader, lambda f: not f.status.any())
        assert frame.structure.module_name.tolist() == [b"finger %d tip" % finger for finger in (1, 2, 3, 4)]
        assert frame.structure.patch_name.tolist() == [b"DG-4F"]


def test_a_connection_that_is_out_of_step_is_made_anew(namespace: object) -> None:
    """A hand that answers once with half an answer."""

    class Stutters(EmulatedTesollo):
        count = 0

        def messages(self, device: Any, values: Any) -> Any:
            [whole] = super().messages(device, values)
            Stutters.count += 1
            return [whole[:100]] if Stutters.count == 50 else [whole]

    port = free_port()
    device = make_bus(f"tcp://{LOCAL}:{port}", payload_size=4096, for_devices=True)
    with emulated_on(device, Stutters, pattern="cycle"):
        with emulated_skin("tesollo", bus=f"tcp://{LOCAL}:{port}") as skin:
            wait_until(lambda: Stutters.count > 60)
            wait_until(lambda: skin.driver.status()["buses"][0]["skipped_bytes"] >= 100)
            frame = read_until(skin.reader, lambda f: (f.patch_state == PatchState.LIVE).all())
            assert len(set(frame.values.tolist())) == 1
