"""iCub's Ethernet boards: a literal datagram, and the driver behind UDP."""

from __future__ import annotations

import random
import socket
import struct

import pytest

from skinware.errors import ConfigurationError
from skinware.status import PatchState
from skinware_drivers.can.roboskin_layout import Kind
from skinware_drivers.registry import make_bus
from skinware_drivers.serial.framing import Framed
from skinware_drivers.streams.icub_eth import IcubEthOptions, rops
from skinware_drivers.testing.driving import emulated_on, emulated_skin
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.devices.icub_eth import EmulatedIcubEth, datagram
from tests.streams.peers import LOCAL, free_port

HEAD, TAIL = bytes.fromhex("40 F0F0F0F0F0F0F0"), bytes.fromhex("C0 F0F0F0F0F0 8010")
DATAGRAM = bytes.fromhex(
    "78563412 3800 0200 0807060504030201 2A00000000000000"  # 56 bytes, 2 operations, time, number 42
    "04 04 0500 04000001 0102030405000000 1122334455667788"  # a joint, with time
    "00 04 1800 02000003 18 0A 02 00 7384 40F0F0F0F0F0F0F0 7384 C0F0F0F0F0F08010"  # the first skin: two records
    "21436587"
)


def test_a_datagram_is_taken_apart_to_can_frames() -> None:
    framer = rops(1).framer()
    assert framer.feed(DATAGRAM) == [Framed(0x473, HEAD, 84), Framed(0x473, TAIL, 84)]
    assert (framer.counters.frames, framer.counters.frame_bytes, framer.pending) == (1, 84, 0)


def test_operations_of_the_emulated_board_have_whole_words() -> None:
    """The robot's newer parser (embot_prot_eth_rop.cpp) reads no others."""
    [joint_size] = struct.unpack_from("<H", datagram(0, [(0x473, HEAD)], 1, 0), 26)
    assert joint_size % 4 == 0


def test_the_second_skin_is_on_another_port() -> None:
    second = DATAGRAM.replace(bytes.fromhex("02000003"), bytes.fromhex("02010003"))
    assert [len(rops(port).framer().feed(second)) for port in (1, 2)] == [0, 2]
    assert [len(rops(port).framer().feed(DATAGRAM)) for port in (1, 2)] == [2, 0]


def test_an_overtaken_frame_becomes_one_that_the_bus_refuses() -> None:
    framer = rops(1).framer()
    found = [
        framer.feed(DATAGRAM[:16] + number.to_bytes(8, "little") + DATAGRAM[24:]) for number in (9, 11, 10, 11, 12)
    ]
    assert [[len(frame.body) for frame in frames] for frames in found] == [[8, 8], [8, 8], [1500], [8, 8], [8, 8]]
    assert len(framer.feed(DATAGRAM[:16] + bytes(8) + DATAGRAM[24:])[0].body) == 1500
    framer.feed(DATAGRAM[:16] + bytes(6) + b"\1\0" + DATAGRAM[24:])
    assert len(framer.feed(DATAGRAM[:16] + bytes(8) + DATAGRAM[24:])[0].body) == 8  # the board begins again


def test_a_new_stream_begins_with_any_number() -> None:
    framing = rops(1)
    for number in (12, 9):  # a board restarted while its bus was away
        frames = framing.framer().feed(DATAGRAM[:16] + number.to_bytes(8, "little") + DATAGRAM[24:])
        assert [len(frame.body) for frame in frames] == [8, 8]


@pytest.mark.parametrize(
    ("there", "instead", "frames"),
    [
        ("02000003", "02020003", 0),  # a third skin, which no board has
        ("02000003", "03000003", 0),  # another variable
        ("02000003", "02000002", 0),  # another endpoint
        ("00 04 1800", "00 03 1800", 0),  # somebody sets it
        ("00 04 1800", "40 04 1800", 0),  # another version
        ("00 04 1800", "00 04 1900", 0),  # more than there is
        ("00 04 1800", "00 04 1700", 1),  # the last record is not whole
        ("18 0A 02", "18 0B 02", 0),  # items of another size
        ("18 0A 02", "18 0A 03", 2),  # more items than there are
        ("18 0A 02", "01 0A 02", 0),  # more items than there is room for
        ("18 0A 02", "18 0A 00", 0),
        ("7384 40", "7394 40", 1),  # nine bytes of CAN
    ],
)
def test_what_is_no_skin_data_is_left_out(there: str, instead: str, frames: int) -> None:
    changed = DATAGRAM.replace(bytes.fromhex(there), bytes.fromhex(instead))
    assert changed != DATAGRAM
    framer = rops(1).framer()
    assert len(framer.feed(changed)) == frames
    assert framer.counters.frames == 1


def test_damage_is_counted_and_never_raised() -> None:
    rng = random.Random(3)
    for _ in range(2000):
        wire = bytearray(DATAGRAM)
        for _ in range(rng.randint(1, 4)):
            wire[rng.randrange(len(wire))] = rng.randrange(256)
        framer = rops(1).framer()
        framer.feed(bytes(wire) + DATAGRAM)
        counters = framer.counters
        assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes + framer.pending


def test_the_emulated_board_says_what_is_published() -> None:
    told = datagram(0, [(0x473, HEAD), (0x473, TAIL)], 42, 0x0102030405060708)
    assert told[:4] == DATAGRAM[:4]
    assert told[-4:] == DATAGRAM[-4:]
    assert told[8:24] == DATAGRAM[8:24]
    assert [(frame.identifier, frame.body) for frame in rops(1).framer().feed(told)] == [(0x473, HEAD), (0x473, TAIL)]


@pytest.mark.parametrize("skin", [0, 1])
def test_boards_behind_udp(skin: int, namespace: object) -> None:
    port = free_port(socket.SOCK_DGRAM)
    board = make_bus(f"udp://{LOCAL}:{port}", payload_size=4096, for_devices=True)
    options = {"port": skin + 1, "learn_s": 0.3, "modules": ({"board": 2, "triangles": (0,), "kind": "fingertip"},)}
    with emulated_on(board, EmulatedIcubEth, boards=(1, 2), triangles=3, skin=skin, pattern="cycle"):
        with emulated_skin("icub_eth", bus=f"udp://:{port}", driver_options=options) as running:
            frame = read_until(running.reader, lambda f: not f.status.any())
            assert (frame.patch_state == PatchState.LIVE).all()
            structure = frame.structure
            assert structure.patch_name.tolist() == [b"board 1", b"board 2"]
            assert structure.module_kind.tolist() == [b"triangle"] * 3 + [b"fingertip"] + [b"triangle"] * 2
            assert structure.sensor_uid[12:14].tolist() == [0x10100, 0x10101]
            assert running.driver.status()["buses"][0]["sent"] == 0


def test_impossible_options() -> None:
    with pytest.raises(ConfigurationError):
        IcubEthOptions(kind="round")
    with pytest.raises(ConfigurationError):
        IcubEthOptions(modules=(Kind(board=20, triangles=(1,)),))
