"""Contactile's PapillArray: packets by hand, what is no packet, commands, and sensors that come and go."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence

import numpy as np
import pytest

from skinware.errors import BusError, HandshakeTimeout
from skinware.status import PatchState, Status
from skinware_drivers.serial.contactile import PapillArrayDriver
from skinware_drivers.serial.papillarray_packets import PapillArrayPackets
from skinware_drivers.testing.comparison import until_fresh
from skinware_drivers.testing.driving import emulated_skin
from skinware_drivers.testing.rig import play
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.devices.contactile import EmulatedPapillArray, EmulatedPapillArrayOptions
from skinware_drivers.virtual.hand_clock import HandClock
from tests.drivers.test_conformance import TestPapillArray as Conformance
from tests.serial.spoken import Spoken

# A packet of one sensor with two pillars. Positions count from its first byte, 02; three zeros follow the table.
TABLE = bytes.fromhex("02 0100 1800 0300 2400 0400 6200 0500 8000 0600 9800 000000")
CONTROLLER = bytes.fromhex("07000000 40420f0001000000")
PILLARS = bytes.fromhex("0100 2800 0200 2e00 4800 0200") + struct.pack("<6f", 0.5, -0.25, 2, 0.125, -0.0625, 0.5)
PILLARS += bytes.fromhex("0200") + struct.pack("<6f", 1, 2, 3, 4, 5, 6)
TOTAL = bytes.fromhex("0100 6600 0200") + struct.pack("<6f", 1.5, 1.75, 5, -7, 8, 9)
SLIP_OF_PILLARS = bytes.fromhex("0100 8400 0200 8a00 9100 0100 fe 000080bf 0100 03 0000403f")
SLIP = bytes.fromhex("0100 9c00 0100 02 0000403f 00002041")
DATA = TABLE + CONTROLLER + PILLARS + TOTAL + SLIP_OF_PILLARS + SLIP
STAMP = bytes.fromhex("07000000 40420f00")
NEWS = 0x400
FRAMES = {
    3: STAMP + PILLARS[12:36] + PILLARS[38:],
    4: STAMP + TOTAL[6:],
    5: STAMP + struct.pack("<2b2f", -2, 3, -1, 0.75),
    6: STAMP + struct.pack("<b2f", 2, 0.75, 10),
}


def packet(data: bytes, *, wrong: int = 0) -> bytes:
    return b"\x55\x66\x77\x88" + data + struct.pack("<H", sum(data) + wrong) + b"\xaa\xbb\xcc\xdd"


def changed(at: int, byte: int) -> bytes:
    return packet(DATA[:at] + bytes([byte]) + DATA[at + 1 :])


def test_a_packet_one_byte_at_a_time() -> None:
    framer = PapillArrayPackets().framer()
    stream = b"\x55\x66\x55\x66\x77" + packet(DATA) + b"\xdd" + packet(DATA) + b"\x55\x66"
    frames = [frame for at in range(len(stream)) for frame in framer.feed(stream[at : at + 1])]
    news = struct.pack("<8H", *(number for kind, body in FRAMES.items() for number in (kind, len(body))))
    found = [(frame.identifier, frame.body) for frame in frames]
    assert found == [(NEWS, news), *FRAMES.items(), *FRAMES.items()]
    counters = framer.counters
    assert (counters.skipped_bytes, framer.pending) == (6, 2)
    assert counters.bytes_in == counters.frame_bytes + counters.skipped_bytes + framer.pending


def test_blocks_that_are_not_known_or_missing() -> None:
    """Other blocks are skipped; frames of a missing one are missing."""
    unknown = DATA.replace(bytes.fromhex("0400 6200"), bytes.fromhex("0700 6200"))
    frames = PapillArrayPackets().framer().feed(packet(unknown))
    assert [frame.identifier for frame in frames] == [NEWS, 3, 5, 6]


@pytest.mark.parametrize(
    "bad",
    [
        packet(DATA, wrong=1),
        packet(DATA)[:-30],  # cut short
        packet(b""),
        changed(0, 9),  # size of a position
        changed(1, 2),  # no block of the Controller
        changed(7, 0xFF),  # a block beyond the end
        changed(36, 21),  # sensors
        changed(40, 0xFF),  # pillars
        changed(46, 1),  # type of a pillar
        changed(44, 0x20),  # a pillar before the first
    ],
    ids=lambda bad: f"{len(bad)}-{sum(bad)}",
)
def test_what_is_no_packet(bad: bytes) -> None:
    framer = PapillArrayPackets().framer()
    frames = framer.feed(packet(DATA) + bad + packet(DATA))
    assert [frame.identifier for frame in frames if frame.identifier != NEWS] == [*FRAMES] * 2
    assert framer.counters.refused + framer.counters.checksum_errors > 0


def test_no_end_within_a_packets_length() -> None:
    framer = PapillArrayPackets().framer()
    assert not framer.feed(b"\x55\x66\x77\x88" + bytes(5000))
    assert (framer.counters.refused, framer.pending) == (1, 0)


def test_commands_of_the_driver() -> None:
    """It sets the rate, takes zero, starts and stops the detection of slip."""

    async def scenario(clock: HandClock) -> None:
        case = type("Touched", (Conformance,), {"driver_options": {"rate_hz": 100}})()
        async with case.running(clock) as rig:
            await until_fresh(rig)
            assert rig.runner is not None
            adapter, link = rig.adapter, rig.runner.lines[0].link
            assert isinstance(adapter, PapillArrayDriver)
            await adapter.tare(link, ())
            await adapter.slip(link, ())
            await adapter.slip(link, (), on=False)
        assert [payload for _, payload in rig.wire.sent][-3:] == [b"z\n", b"S\n", b"s\n"]
        assert {payload for _, payload in rig.wire.sent[:-3]} == {b"f100\n"}

    play(scenario)


def test_the_emulated_controller_obeys() -> None:
    """Commands of the maker's library end with a zero, too; packets come at the rate that was set."""
    controller = Spoken(EmulatedPapillArray(EmulatedPapillArrayOptions()))
    assert len(controller.answers(b"f100\n", 1000)) == pytest.approx(100, abs=2)
    assert not _states(controller.answers(b"", 100)).any()
    assert set(_states(controller.answers(b"S\n\0", 4000)).ravel().tolist()) == {-2, 1}
    assert not _states(controller.answers(b"s\n\0", 100))[-1].any()
    assert len(controller.answers(b"f250\n", 1000)) == pytest.approx(250, abs=2)


def _states(packets: Sequence[bytes]) -> np.ndarray[tuple[int, int], np.dtype[np.int8]]:
    """The slip states of the first sensor's pillars."""
    frames = PapillArrayPackets().framer().feed(b"".join(packets))
    return np.array([np.frombuffer(frame.body, "i1", 9, 8) for frame in frames if frame.identifier == 5])


def test_values_after_taking_zero() -> None:
    controller = Spoken(EmulatedPapillArray(EmulatedPapillArrayOptions()))
    controller.answers(b"", 2000)  # a press has begun
    controller.answers(b"z\n", 1)
    [packets] = controller.answers(b"", 1)
    frames = {frame.identifier: frame.body for frame in PapillArrayPackets().framer().feed(packets)}
    pillars, total = (np.frombuffer(frames[kind], "<f4", offset=8) for kind in (3, 4))
    assert (np.abs(pillars) < 0.1).all()
    assert (np.abs(total) < 1).all()
    assert struct.unpack_from("<b2f", frames[6], 8) == (0, -1, -1)


def test_listening_only() -> None:
    async def scenario(clock: HandClock) -> None:
        async with Conformance().running(clock, listen_only=True) as rig:
            await until_fresh(rig)
            assert not rig.wire.sent

    play(scenario)


def test_a_block_that_alone_is_no_longer_sent() -> None:
    """Its sensors become stale; the others, in the same packets, stay fresh."""

    async def scenario(clock: HandClock) -> None:
        async with Conformance().running(clock) as rig:
            await until_fresh(rig)
            rig.devices.silent.add("total")
            await rig.sleep(0.5)
            frame = rig.record.frames[-1]
            stale = np.flatnonzero(frame.status & Status.STALE)
            names = frame.structure.module_name[np.unique(frame.structure.sensor_module[stale])]
            assert names.tolist() == [b"sensor 0 total", b"sensor 1 total"]
            assert (frame.patch_state == PatchState.LIVE).all()
            assert not rig.counters()["errors"]

    play(scenario)


def test_what_is_sent_only_later(caplog: pytest.LogCaptureFixture) -> None:
    """A block, or a sensor, makes the driver describe the Controller again."""
    caplog.set_level("INFO", "skinware.driver")

    async def scenario(clock: HandClock) -> None:
        case = type("Short", (Conformance,), {"emulator_options": {"silence": ("slip",), "silence_after_s": 0}})()
        async with case.running(clock) as rig:
            frame = await until_fresh(rig)
            assert frame.structure.n_sensors == 156
            rig.devices.silent.clear()
            await rig.sleep(0.5)
            assert not rig.counters()["unknown"]

    play(scenario)
    sizes = re.findall(r"new generation: .*?sensors: (\d+)", caplog.text)
    assert sizes == ["162"]


def test_what_a_port_says_of_itself() -> None:
    async def scenario(clock: HandClock) -> None:
        async with Conformance().handshakes(clock) as rig:
            found = await PapillArrayDriver.identify(rig.link, idle=False)
            assert found == "Contactile PapillArray Controller, 2 sensors"
            assert not rig.wire.sent

    play(scenario)


def test_a_silent_port() -> None:
    async def scenario(clock: HandClock) -> None:
        case = type("Dead", (Conformance,), {"emulator_options": {"dead": (1,), "dead_after_s": 0}})()
        async with case.handshakes(clock) as rig:
            with pytest.raises(HandshakeTimeout, match="are sensors plugged in"):
                await rig.adapter.describe(rig.link)

    play(scenario)


def test_a_controller_without_sensors() -> None:
    async def scenario(clock: HandClock) -> None:
        silent = ("pillars", "total", "pillar_slip", "slip")
        case = type("Alone", (Conformance,), {"emulator_options": {"silence": silent, "silence_after_s": 0}})()
        async with case.handshakes(clock) as rig:
            with pytest.raises(BusError, match="without a sensor"):
                await rig.adapter.describe(rig.link)

    play(scenario)


def test_on_a_port() -> None:
    """A press is felt by pillars at their places, and by the whole sensor."""
    with emulated_skin("papillarray", name="gripper", driver_options={"rate_hz": 100}) as skin:
        frame = read_until(skin.reader, lambda f: bool((f.physical("total_force_z") > 2).all()))
        structure = frame.structure
        assert structure.patch_name.tolist() == [b"PapillArray"]
        assert [name.decode() for name in structure.module_name[:4]] == [
            "sensor 0 pillars",
            "sensor 0 total",
            "sensor 0 slip of pillars",
            "sensor 0 slip",
        ]
        pillars = frame.physical("force_z").reshape(2, 9)
        np.testing.assert_allclose(pillars.sum(axis=1), frame.physical("total_force_z"), rtol=1e-4)
        assert (frame.physical("displacement_z") < 2.5e-3).all()
        assert (frame.physical("friction") == -1).all()
