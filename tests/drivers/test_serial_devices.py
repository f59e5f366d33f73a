"""Serial devices of others: bytes by hand (synthesised from published programs, not captured), and pseudo terminals.

What every driver must do is in ``test_conformance``; here is what only these wires have.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot, PatchState, Status
from skinware.status import BusState
from skinware_drivers.serial.anyskin import AnySkinDriver, AnySkinOptions
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.skintalk import SkintalkDriver, SkintalkOptions
from skinware_drivers.serial.tactile_glove import TactileGloveDriver, TactileGloveOptions
from skinware_drivers.testing.driving import EmulatedSkin, driving_lines
from skinware_drivers.virtual.devices.anyskin import EmulatedAnySkin, EmulatedAnySkinOptions
from skinware_drivers.virtual.devices.skintalk import EmulatedSkintalk, EmulatedSkintalkOptions
from skinware_drivers.virtual.devices.tactile_glove import EmulatedTactileGlove, EmulatedTactileGloveOptions
from tests.sdk.driving import read_until, restarted_on_demand
from tests.serial.lines import line

MS = 1_000_000
BAD = Status.STALE | Status.NEVER_SEEN
ANYSKIN = AnySkinDriver(AnySkinOptions())
GLOVE = TactileGloveDriver(TactileGloveOptions())
SKINTALK = SkintalkDriver(SkintalkOptions())

ONE_MAG = bytes.fromhex("0000cc41 0000803f 000000c0 0000c842 0d0a")  # 25.5, 1, -2, 100
GLOVE_TWO = bytes.fromhex("3c010abc00 7b01f00100")  # taxel 0: 0xABC; taxel 63: 0x001 and bits of unknown meaning
CELLS = bytes.fromhex("5510000001 558f7fffff 5511ffffff 5520800000")


def is_fresh(frame: DriverSnapshot) -> bool:
    return not (frame.status & BAD).any()


def found(driver: Any, stream: bytes) -> list[tuple[int, bytes]]:
    framed = driver.framing.framer().feed(stream)
    return [(frame.identifier, frame.body) for frame in framed]


def spoken(hardware: Any, duration_ms: int) -> bytes:
    """What emulated devices send in the beginning."""
    now_ns = 10**12
    hardware.skip(now_ns)
    hardware.receive(0, b"1", now_ns)
    return b"".join(frame.payload for frame in hardware.emit(now_ns + duration_ms * MS))


# -- the emulators, byte by byte


def test_emulated_anyskin() -> None:
    options = EmulatedAnySkinOptions(mags=1)
    assert spoken(EmulatedAnySkin(options, source=lambda _n, _c: (25, 1, -2, 100)), 15)[:18] == (
        bytes.fromhex("0000c841 0000803f 000000c0 0000c842 0d0a")
    )
    assert len(spoken(EmulatedAnySkin(EmulatedAnySkinOptions()), 1000)) in (99 * 82, 100 * 82)


def test_emulated_glove() -> None:
    options = EmulatedTactileGloveOptions(taxels=3)
    stream = spoken(EmulatedTactileGlove(options, source=lambda _n, _c: (0xABC, 0, 0xFFF)), 31)
    assert stream[:15] == bytes.fromhex("3c010abc00 3d01000000 3e010fff00")


def test_emulated_skintalk() -> None:
    options = EmulatedSkintalkOptions(patches=(8,), cells=3)
    hardware = EmulatedSkintalk(options, source=lambda _n, _c: (1, -1, -(1 << 23)))
    assert spoken(hardware, 21)[:15] == bytes.fromhex("5580000001 5581ffffff 5582800000")
    hardware.receive(0, b"0", 10**12 + 100 * MS)
    hardware.emit(10**12 + 200 * MS)
    assert hardware.emit(10**12 + 2000 * MS) == []


def test_octocan3_has_commands_of_its_own(emulated_skin: Callable[..., EmulatedSkin]) -> None:
    options = {"firmware": "octocan3", "patches": (1,)}
    skin = emulated_skin(SkintalkDriver, EmulatedSkintalk, driver_options=options, **options)
    read_until(skin.reader, is_fresh)
    skin.reader.call("calibrate")
    read_until(skin.reader, is_fresh)


# -- framing


def test_anyskin_with_line_ends_in_the_values() -> None:
    line_ends = struct.pack("<4f", *np.frombuffer(b"\r\n" * 8, "<f4"))
    one = AnySkinDriver(AnySkinOptions(mags=1))
    messages = [ONE_MAG, line_ends + b"\r\n", ONE_MAG, ONE_MAG]
    assert found(one, b"".join(messages)) == [(0, message[:-2]) for message in messages]
    assert found(one, ONE_MAG[5:] + b"".join(messages))[-2:] == [(0, ONE_MAG[:-2])] * 2
    assert found(one, ONE_MAG[:9]) == []


def test_a_packet_of_the_glove_that_lost_bytes_does_not_pass_with_the_next() -> None:
    whole = [bytes((0x3C + i, 1, 0, i, 0)) for i in range(8)]
    passing = b"".join(whole[:3]) + whole[3][:2] + b"".join(whole[4:])  # 3F 01 40 01 00 looks like a packet
    assert found(GLOVE, passing) == [(0x3C + i, bytes((0, i))) for i in (0, 1, 2, 4, 5, 6)]


def test_a_record_of_skintalk_counts_if_another_follows() -> None:
    records = [(0x10, b"\0\0\1"), (0x8F, b"\x7f\xff\xff"), (0x11, b"\xff\xff\xff"), (0x20, b"\x80\0\0")]
    assert found(SKINTALK, CELLS) == records[:3]
    assert found(SKINTALK, CELLS + b"\x55") == records
    assert found(SKINTALK, CELLS[:7] + CELLS[10:] + b"\x55") == [records[0], *records[2:]]


@pytest.mark.parametrize(
    ("driver", "hardware"),
    [
        (ANYSKIN, EmulatedAnySkin(EmulatedAnySkinOptions())),
        (GLOVE, EmulatedTactileGlove(EmulatedTactileGloveOptions())),
        (SKINTALK, EmulatedSkintalk(EmulatedSkintalkOptions())),
    ],
    ids=["anyskin", "glove", "skintalk"],
)
def test_flipped_bits_and_garbage_are_survived_and_accounted_for(driver: Any, hardware: Any) -> None:
    """In whatever pieces it comes: all bytes are accounted for, the same is found, and the last frames are right."""
    rng = random.Random(3)
    clean = spoken(hardware, 400)
    n_clean = len(found(driver, clean))
    dirty = bytearray(clean)
    for _ in range(20):
        dirty[rng.randrange(len(dirty) // 2)] ^= 1 << rng.randrange(8)
    del dirty[501:508]
    dirty[900:900] = rng.randbytes(300)
    whole, pieces = driver.framing.framer(), driver.framing.framer()
    at_once = [frame.body for frame in whole.feed(bytes(dirty))]
    one_by_one = [frame.body for i in range(0, len(dirty), 7) for frame in pieces.feed(bytes(dirty[i : i + 7]))]
    assert at_once == one_by_one
    counters = whole.counters
    assert counters == pieces.counters
    assert counters.bytes_in == counters.frame_bytes + counters.idle_bytes + counters.skipped_bytes + whole.pending
    assert counters.skipped_bytes > 200
    last = found(driver, clean)[-n_clean // 3 :]
    assert at_once[-len(last) :] == [body for _, body in last]


# -- drivers, on pseudo terminals


def shown(adapter: Any, stream: bytes, n_seen: int) -> tuple[DriverSnapshot, dict[str, Any]]:
    """What a driver shows of a stream that comes again and again, once so many sensors are seen."""
    with (
        line() as port,
        driving_lines([(adapter, SerialBus(port.path, payload_size=adapter.payload_size))], "it") as on,
    ):
        with DriverReader("it", timeout_s=30) as reader:

            def is_seen(frame: DriverSnapshot) -> bool:
                return int(((frame.status & Status.NEVER_SEEN) == 0).sum()) == n_seen

            port.write(stream * 4)
            frame = read_until(reader, is_seen)
            return frame, on.status()


def test_anyskin_values_and_those_that_are_none() -> None:
    values = struct.pack("<4f", 25.5, float("nan"), float("inf"), -1.5)
    frame, _ = shown(AnySkinDriver(AnySkinOptions(mags=1)), values + b"\r\n", 4)
    assert [t.name for t in frame.structure.types] == [
        "temperature",
        "magnetic_field_x",
        "magnetic_field_y",
        "magnetic_field_z",
    ]
    assert (frame.status & Status.SUSPECT).tolist() == [0, Status.SUSPECT, Status.SUSPECT, 0]
    assert frame.values[[0, 3]].tolist() == [25.5, -1.5]


def test_glove_values_rise_with_pressure_in_their_type_s_scale() -> None:
    frame, _ = shown(GLOVE, GLOVE_TWO, 2)
    assert frame.values[[0, 63]].tolist() == [0xABC, 1]
    pressure = frame.structure.types[0]
    assert (pressure.offset + pressure.scale * frame.values[[0, 63]].astype(float)).tolist() == [4095 - 0xABC, 4094]


def test_skintalk_values_and_addresses_that_are_not_there() -> None:
    adapter = SkintalkDriver(SkintalkOptions(patches=(1, 2), cells=2))
    frame, status = shown(adapter, CELLS, 3)  # patch 8, cell 15 is not there
    structure = frame.structure
    assert structure.sensor_uid.tolist() == [0x10, 0x11, 0x20, 0x21]
    assert frame.values[:3].tolist() == [1, -1, -(1 << 23)]
    assert status["buses"][0]["unknown"] >= 1


DEVICES = pytest.mark.parametrize(
    ("driver", "emulator"),
    [
        (AnySkinDriver, EmulatedAnySkin),
        (TactileGloveDriver, EmulatedTactileGlove),
        (SkintalkDriver, EmulatedSkintalk),
    ],
    ids=["anyskin", "glove", "skintalk"],
)


@DEVICES
def test_a_bad_line_and_a_restart(emulated_skin: Callable[..., EmulatedSkin], driver: Any, emulator: Any) -> None:
    """Lost, short, garbled and repeated frames, and a moment without power: all sensors are fresh again."""
    chance = 0.02 if driver is AnySkinDriver else 0.001  # of a frame, of which the others have many in a cycle
    faults = dict.fromkeys(("lose", "truncate", "corrupt", "repeat"), chance)
    devices = restarted_on_demand(emulator)
    skin = emulated_skin(driver, devices, boot_s=0.6, **faults)
    read_until(skin.reader, is_fresh)

    def falls_silent(frame: DriverSnapshot) -> bool:
        devices.restart_now = True  # without power until it is noticed: a driver that is held up excuses a moment
        return PatchState.STALE in frame.patch_state

    read_until(skin.reader, falls_silent)
    devices.restart_now = False
    read_until(skin.reader, lambda frame: bool((frame.patch_state == PatchState.LIVE).all()) and is_fresh(frame))


@DEVICES
def test_unplugged(driver: Any, emulator: Any) -> None:
    """Nothing is shown as fresh that comes from a line which is gone."""
    adapter = driver(driver.Options())
    stream = spoken(emulator(emulator.Options()), 200)
    with line() as port, driving_lines([(adapter, SerialBus(port.path, payload_size=adapter.payload_size))], "it"):
        with DriverReader("it", timeout_s=30) as reader:
            port.write(stream)
            read_until(reader, lambda frame: not (frame.status & Status.NEVER_SEEN).any())
            port.unplug()
            read_until(reader, lambda f: f.bus_state[0] == BusState.GONE and bool((f.status & Status.STALE).all()))
