"""BrainCo's Revo2 Touch: published bytes, a server of somebody else's making, switching on, and hands without touch."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import AsyncMock

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot
from skinware.errors import BusError, ConfigurationError, HandshakeTimeout
from skinware.status import Status
from skinware_drivers.description import assemble
from skinware_drivers.link import Link
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.revo2 import Revo2Driver, Revo2Options
from skinware_drivers.polling import Notice
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.driving import driving_lines, emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.devices.registers import EmulatedRevo2, EmulatedRevo2Options
from tests.modbus.peers import Action, device, rtu_server
from tests.modbus.rig import PATIENTLY, PYMODBUS, driven, patient, with_options

pytestmark = PYMODBUS
READ = "7E 04 10 68 00 1E FE D1"
ENABLE = "7E 10 0F A0 00 05 0A 00 01 00 01 00 01 00 01 00 01 4E E4"
CALIBRATE = "7E 10 0F AA 00 05 0A 00 01 00 01 00 01 00 01 00 01 44 EE"
FORCES = [1000, 20, 300, 0, 0, 0, 2500, 7, 359, 1, 2, 3, 4, 5, 6]
PROXIMITIES = [1, 65535, 65536, 0x0102_0304, 0]
WORDS = [*FORCES, 0, 1, 0, 65535, 1, 0, 0x0102, 0x0304, 0, 0, 0, 0, 0, 0, 0]


def adapter(**options: Any) -> Revo2Driver:
    return Revo2Driver(Revo2Options(**options))


def told(hand: EmulatedRevo2, command: str, now_ns: int) -> bytes:
    """What a hand answers to bytes."""
    hand.receive(0, bytes.fromhex(command), now_ns)
    return b"".join(frame.payload for frame in hand.emit(now_ns + 10**9))


def has_no_data(frame: DriverSnapshot) -> bool:
    return bool(((frame.status & Status.NOT_CONNECTED) != 0).all())


@contextmanager
def reading(name: str, **options: Any) -> Iterator[DriverReader]:
    with driven(with_options(name, PATIENTLY), adapter(**options)) as (_, reader):
        yield reader


def hand_of(words: list[int], action: Action | None = None) -> Any:
    """A left hand on a pymodbus server: its switches and its input registers are in one space."""
    before = [0] * (4200 - 901)
    before[0], before[970 - 901] = 2, 1
    return device(126, 901, before + words, action)


# What is asked


def test_one_read_gets_all_of_a_left_hand() -> None:
    [read] = adapter(side="left").wanted.reads()
    assert (read.address, read.count) == (4200, 30)
    whole = wire.rtu_frame(wire.Message(read.unit, wire.question_to_read(read.function, read.address, 30)))
    assert whole == bytes.fromhex(READ)


def test_the_number_of_a_hand_follows_its_side_or_an_option() -> None:
    assert {block.unit for block in adapter().registers} == {127}
    assert {block.unit for block in adapter(unit=3, side="left").registers} == {3}
    with pytest.raises(ConfigurationError, match="unit"):
        Revo2Options(unit=255)


def test_switching_on_and_calibrating_are_the_published_writes() -> None:
    hand = EmulatedRevo2(EmulatedRevo2Options(unit=126, enabled=False), source=lambda _n, _c: [*FORCES, *PROXIMITIES])
    hand.skip(10**9)
    assert told(hand, READ, 2 * 10**9)[:5] == bytes.fromhex("7E 04 3C FF FF")
    assert told(hand, ENABLE, 4 * 10**9)[:6] == bytes.fromhex("7E 10 0F A0 00 05")
    assert told(hand, CALIBRATE, 6 * 10**9)[:6] == bytes.fromhex("7E 10 0F AA 00 05")
    data = told(hand, READ, 8 * 10**9)
    assert data[:3] == bytes.fromhex("7E 04 3C")
    assert np.frombuffer(data[3:-2], ">u2")[:25].tolist() == WORDS[:25]


# What it means


def test_a_finger_is_a_tip_with_three_axes_and_a_proximity() -> None:
    driver = adapter()
    structure = assemble([("bus", driver.patches)], driver.types, driver.dtype).structure
    assert structure.module_names[:2] == ("right hand, thumb tip", "right hand, index tip")
    assert structure.module_names[-1] == "right hand, little proximity"
    assert driver.geometry is not None
    for sensor_type in structure.types:
        places = driver.geometry.of(structure, sensor_type.name)
        assert len(places) == 5
        assert places.known.all()


def test_a_server_with_a_hand() -> None:
    with rtu_server(hand_of(WORDS), baudrate=460_800) as name, reading(name, side="left") as reader:
        expected = np.array([*FORCES, *PROXIMITIES], np.float32)
        frame = read_until(reader, lambda frame: not frame.status.any())
        assert frame.values.tolist() == expected.tolist()


def test_a_server_with_a_hand_that_is_switched_on_and_calibrated_on_request() -> None:
    writes = []

    async def note(function: int, _s: int, address: int, count: int, _r: object, values: list[int] | None) -> None:
        if function == 16:
            writes.append((address, values))

    ones = [1] * 5
    with rtu_server(hand_of(WORDS, note), baudrate=460_800) as name:
        with reading(name, side="left") as reader:
            read_until(reader, lambda frame: not frame.status.any())
            assert writes == []
            reader.call("enable")
            reader.call("calibrate")
            assert writes == [(4000, ones), (4010, ones)]
        writes.clear()
        with reading(name, side="left", enable=True) as reader:
            read_until(reader, lambda frame: not frame.status.any())
            assert writes == [(4000, ones)]


# What is wrong with a hand


def test_a_hand_that_is_not_switched_on_shows_no_data_and_says_what_to_do(caplog: Any) -> None:
    with patient("revo2", enabled=False) as skin:
        read_until(skin.reader, has_no_data)
        wait_until(lambda: "touch is not switched on" in caplog.text)
        skin.reader.call("enable")
        read_until(skin.reader, lambda frame: not frame.status.any())


def test_only_ffff_of_the_right_width_means_none() -> None:
    words = [*[0xFFFF] * 3, *FORCES[3:], 0, 0xFFFF, 0xFFFF, 0xFFFF, *[0, 1] * 3, *[0] * 5]
    with rtu_server(hand_of(words), baudrate=460_800) as name, reading(name, side="left") as reader:
        frame = read_until(reader, lambda frame: not (frame.status & (Status.NEVER_SEEN | Status.STALE)).any())
        assert frame.status.tolist() == [16, 16, 16, *[0] * 12, 0, 16, 0, 0, 0]


def test_a_hand_without_touch_is_switched_on_more_and_more_rarely(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, pauses, told_of = adapter(enable=True, edition="touch"), list[float](), list[Notice]()

    async def sleep(pause_s: float) -> None:
        pauses.append(pause_s)
        if len(pauses) == 9:
            raise BusError("enough")

    async def read(*_: object, **_more: object) -> np.ndarray[Any, np.dtype[np.uint16]]:
        return np.full(15, 0 if len(pauses) == 1 else 0xFFFF, np.uint16)

    monkeypatch.setattr(asyncio, "sleep", sleep)
    monkeypatch.setattr(driver, "read", read)
    driver.heard_by = lambda _patch, notice: told_of.append(notice)
    with pytest.raises(BusError, match="enough"):
        asyncio.run(driver.attend(Link(make_bus("modbus:/dev/null"))))
    assert pauses == [1, 1, 2, 4, 8, 16, 32, 60, 60]
    assert told_of == [Notice.RESTARTED] * 7


def test_a_finger_whose_status_is_not_normal_is_not_shown_as_good() -> None:
    with patient("revo2", abnormal=(1,), missing=(4,)) as skin:
        frame = read_until(skin.reader, lambda frame: not (frame.status & (Status.NEVER_SEEN | Status.STALE)).any())
        of_uid = dict(zip(skin.reader.structure.sensor_uid.tolist(), frame.status.tolist(), strict=True))
        assert of_uid == {0: 0, 1: Status.SUSPECT, 2: 0, 3: 0, 4: Status.NOT_CONNECTED}


def test_status_registers_that_mean_something_else_can_be_left_out() -> None:
    words = [*WORDS[:25], 900, 901, 902, 903, 904]
    with rtu_server(hand_of(words), baudrate=460_800) as name:
        with reading(name, side="left", status=False) as reader:
            read_until(reader, lambda frame: not frame.status.any())


def test_the_low_word_of_proximities_comes_first_on_request() -> None:
    words = [*FORCES, 1, 0, 65535, 0, 0, 1, 0x0304, 0x0102, 0, 0, 0, 0, 0, 0, 0]
    with rtu_server(hand_of(words), baudrate=460_800) as name:
        with reading(with_options(name, "word_order=little"), side="left") as reader:
            frame = read_until(reader, lambda frame: not frame.status.any())
            assert frame.values.tolist() == np.array([*FORCES, *PROXIMITIES], np.float32).tolist()


# The other editions


@pytest.mark.parametrize(
    ("hand", "counts", "kinds"),
    [
        ({"edition": "pressure"}, [9, 9, 9, 9, 9, 46, 6], {("pressure", "counts", 1.0), ("total_force_z", "N", 1e-3)}),
        (
            {"edition": "pressure", "kind": 1},
            [9, 9, 9, 9, 9, 46, 6],
            {("pressure", "Pa", 1000), ("total_force_z", "N", 1e-3)},
        ),
        (
            {"edition": "pressure", "kind": 2},
            [9, 9, 9, 9, 9, 46, 6],
            {("force_z", "N", 1e-3), ("total_force_z", "N", 1e-3)},
        ),
        (
            {"edition": "force3d"},
            [93, 93, 93, 93, 12],
            {(f"{what}_{axis}", "counts", 1.0) for what in ("force", "total_force") for axis in "xyz"},
        ),
        (
            {"edition": "array_pressure", "side": "left"},
            [5, 5, 5, 5, 5],
            {(name, "counts", 1.0) for name in ("force_x", "force_y", "force_z", "moment_x", "moment_y")},
        ),
        ({"side": "left", "unit": 126}, [3] * 5 + [1] * 5, None),
    ],
)
def test_the_hand_is_asked_which_edition_it_is(
    hand: Mapping[str, Any], counts: list[int], kinds: set[tuple[str, str, float]] | None
) -> None:
    with emulated_skin("revo2", EmulatedRevo2, **hand) as skin:
        read_until(skin.reader, lambda frame: not frame.status.any())
        structure = skin.reader.structure
        assert np.bincount(structure.sensor_module).tolist() == counts
        if kinds is not None:
            assert {(kind.name, kind.unit, kind.scale) for kind in structure.types} == kinds
        assert structure.patch_names[0] == f"{hand.get('side', 'right')} hand"


def test_forces_of_three_axes_are_two_signed_bytes_and_a_register() -> None:
    registers = np.zeros(8000 - 901, np.int64)
    registers[970 - 901] = 4
    registers[7200 - 901 : 7204 - 901] = [0xFF01, 511, 0x0102, 33023]
    with rtu_server(device(127, 901, registers.tolist()), baudrate=460_800) as name, reading(name) as reader:
        frame = read_until(reader, lambda frame: not frame.status.any())
        kinds = {kind.name: kind.id for kind in reader.structure.types}
        of_type = [frame.values[reader.structure.sensor_type == kinds[f"force_{axis}"]] for axis in "xyz"]
        assert [values[:2].tolist() for values in of_type] == [[-1, 1], [1, 2], [511, 33023]]


def test_fingers_are_suspect_until_their_sensors_are_warm() -> None:
    with emulated_skin("revo2", EmulatedRevo2, edition="array_pressure", cold=True) as skin:
        read_until(skin.reader, lambda frame: bool((frame.status == Status.SUSPECT).all()))


@pytest.mark.parametrize(
    ("edition", "operation", "registers"),
    [
        ("touch", "enable", (4000, 5)),
        ("touch", "calibrate", (4010, 5)),
        ("touch", "reset", (4005, 5)),
        ("pressure", "enable", (6200, 6)),
        ("pressure", "calibrate", (6310, 6)),
        ("force3d", "enable", (7001, 4)),
        ("force3d", "calibrate", (7006, 4)),
        ("array_pressure", "enable", (8000, 1)),
        ("array_pressure", "calibrate", (8010, 1)),
    ],
)
def test_operations_write_what_the_makers_program_writes(
    monkeypatch: pytest.MonkeyPatch, edition: Any, operation: str, registers: tuple[int, int]
) -> None:
    driver, written = adapter(edition=edition), list[Any]()

    async def write(_link: object, address: int, values: Sequence[int], *, unit: int) -> None:
        written.append((address, list(values), unit))

    async def sleep(_pause_s: float) -> None: ...

    monkeypatch.setattr(driver, "write", write)
    monkeypatch.setattr(asyncio, "sleep", sleep)
    asyncio.run(getattr(driver, operation)(Link(make_bus("modbus:/dev/null")), []))
    address, count = registers
    assert written == [(address, [1] * count, 127)]


@pytest.mark.parametrize(("lost", "unit"), [(0, 126), (1, 126), (2, 127)])
def test_a_lost_answer_does_not_make_it_read_the_other_hand(lost: int, unit: int) -> None:
    driver, link = adapter(), Link(make_bus("modbus:/dev/null"))
    driver.read = AsyncMock(side_effect=[*[HandshakeTimeout("lost")] * lost, np.zeros(1)])  # type: ignore[method-assign]
    assert asyncio.run(driver.find_unit(link, (126, 127), 0)) == unit


def test_an_edition_without_a_reset_says_so() -> None:
    with pytest.raises(BusError, match="no such registers"):
        asyncio.run(adapter(edition="force3d").reset(Link(make_bus("modbus:/dev/null")), []))


def test_serial_number_and_firmware_are_told() -> None:
    with patient("revo2") as skin:
        [names] = skin.reader.call("names").values()
        assert names == "serial number BCXTR0000000001, firmware 1.0.14.U"


def test_an_edition_of_another_number_is_refused(caplog: Any) -> None:
    registers = [0] * (4230 - 901)
    registers[970 - 901] = 9
    with rtu_server(device(127, 901, registers), baudrate=460_800) as name:
        with driving_lines([(adapter(), make_bus(with_options(name, PATIENTLY)))], "hand", wait=False):
            wait_until(lambda: "register 970 says 9" in caplog.text)
