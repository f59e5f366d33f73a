"""DFRobot's arrays: the maker's registers, a server of somebody else's making, and arrays with something wrong."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot
from skinware.errors import BusError, ConfigurationError
from skinware.status import Status
from skinware_drivers.description import assemble
from skinware_drivers.link import Link
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.dfrobot import DfrobotDriver, DfrobotOptions
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.driving import emulated_on_a_pty
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.devices.registers import EmulatedDfrobot, EmulatedDfrobotOptions
from tests.modbus.peers import Action, device, rtu_server
from tests.modbus.rig import PATIENTLY, PYMODBUS, driven, with_options

pytestmark = PYMODBUS
READ_MODEL = "01 04 00 2B 00 01 41 C2"
READ_CELLS = "01 04 00 07 00 24 41 D0"
READ_ALL = "01 04 00 06 00 25 D1 D0"
NO_DATA, DOUBT, BEYOND = int(Status.NOT_CONNECTED), int(Status.SUSPECT), int(Status.OUT_OF_RANGE)


def adapter(**options: Any) -> DfrobotDriver:
    return DfrobotDriver(DfrobotOptions(**options))


def described(**options: Any) -> DfrobotDriver:
    """A driver that knows the shapes."""
    driver = adapter(**options)
    asyncio.run(driver.describe(Link(make_bus("modbus:/dev/null"))))
    return driver


def questions(driver: DfrobotDriver) -> list[bytes]:
    return [wire.rtu_frame(wire.Message(read.unit, read.question)) for read in driver.wanted.reads()]


def array(unit: int, cells: Sequence[int], *, model: int, state: int = 1, action: Action | None = None) -> Any:
    """An array on a pymodbus server: its registers from 0 to 43, the cells in the order of the wire."""
    registers = [0, 0x3343, 0, 0, 0, 0x1000, state, *cells, *[0] * (36 - len(cells)), model]
    return device(unit, 0, registers, action)


@contextmanager
def reading(name: str, **options: Any) -> Iterator[DriverReader]:
    with driven(with_options(name, PATIENTLY), adapter(**options)) as (_, reader):
        yield reader


@contextmanager
def emulated_reading(emulator: type[EmulatedDfrobot], units: tuple[int, ...] = (1,)) -> Iterator[DriverReader]:
    with emulated_on_a_pty(emulator, units=units) as port, reading(f"modbus:{port}", units=units) as reader:
        yield reader


def feeling(values: Sequence[int], unready: Sequence[int] = ()) -> type[EmulatedDfrobot]:
    """Arrays that feel this, and of which these are not ready; both may change."""

    class Arrays(EmulatedDfrobot):
        def __init__(self, options: EmulatedDfrobotOptions, **more: Any) -> None:
            super().__init__(options, **{**more, "source": lambda _n, _c: values})

        def beside(self, device: Any) -> Any:
            return {**super().beside(device), 6: int(device.number not in unready)}

    return Arrays


def answer(question: str, values: Sequence[int], **options: Any) -> bytes:
    """What an emulated array answers to bytes."""
    arrays = EmulatedDfrobot(EmulatedDfrobotOptions(**options), source=lambda _n, _c: values)
    arrays.skip(10**9)
    arrays.receive(0, bytes.fromhex(question), 10**9 + 1)
    return b"".join(frame.payload for frame in arrays.emit(2 * 10**9))


def is_current(frame: DriverSnapshot) -> bool:
    return not (frame.status & (Status.NEVER_SEEN | Status.STALE)).any()


# What is asked


def test_state_and_cells_are_one_question_or_the_cells_alone_as_published() -> None:
    assert questions(described(shapes=("6x6",))) == [bytes.fromhex(READ_ALL)]
    assert questions(described(shapes=("6x6",), state=False)) == [bytes.fromhex(READ_CELLS)]


def test_one_shape_is_that_of_all_units() -> None:
    driver = described(units=(1, 31), shapes=("4x8",))
    assert [(block.unit, block.address, block.count) for block in driver.registers] == [(1, 6, 33), (31, 6, 33)]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"units": ()}, "units"),
        ({"units": (0,)}, "units"),
        ({"units": (32,)}, "units"),
        ({"units": (2, 2)}, "name each array once"),
        ({"units": (1, 2, 3), "shapes": ("6x6", "4x8")}, "give one, or 3"),
        ({"shapes": ("8x4",)}, "shapes"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        DfrobotOptions(**options)


def test_who_only_listens_is_told_the_shapes_and_looks_for_what_other_programs_read() -> None:
    link = Link(make_bus("modbus:/dev/null", listen_only=True))
    with pytest.raises(BusError, match="say option shapes"):
        asyncio.run(adapter().describe(link))
    driver = adapter(shapes=("6x6",))
    asyncio.run(driver.describe(link))
    assert questions(driver) == [bytes.fromhex(READ_CELLS)]


# What it means


@pytest.mark.parametrize(("shape", "rows", "columns"), [("6x6", 6, 6), ("4x8", 4, 8)])
def test_the_first_register_is_at_the_left_of_the_lowest_row(shape: Any, rows: int, columns: int) -> None:
    driver = described(units=(1, 7), shapes=(shape,))
    structure = assemble([("bus", driver.patches)], driver.types, driver.dtype).structure
    assert structure.module_names == ("unit 1", "unit 7")
    assert structure.module_kind.tolist() == [shape.encode()] * 2
    assert driver.geometry is not None
    places = driver.geometry.of(structure, "pressure")
    n = rows * columns
    assert places.known.all()
    assert places.frame.tolist() == ["unit_1_nominal"] * n + ["unit_7_nominal"] * n
    uid = np.array([sensor.uid for sensor in driver.patches[1].modules[0].channels if sensor is not None])
    assert sorted(uid - (7 << 8)) == list(range(n))
    by_register = places.position_m[n:][np.argsort(uid)].reshape(rows, columns, 3)
    assert (np.diff(by_register[:, :, 0], axis=1) > 0.0019).all()
    assert (np.diff(by_register[:, :, 1], axis=0) > 0.0019).all()


# The emulated array, byte by byte


def test_the_emulated_array_answers_as_published() -> None:
    assert answer(READ_MODEL, [0] * 36) == bytes.fromhex("01 04 02 00 01 78 F0")
    assert answer(READ_MODEL, [0] * 32, shapes=("4x8",)) == bytes.fromhex("01 04 02 00 00 B9 30")
    cells = answer(READ_CELLS, range(36))
    assert cells[:5] == bytes.fromhex("01 04 48 00 1E")  # 30: the left one of the lowest row
    assert cells[-4:-2] == bytes.fromhex("00 05")
    assert answer(READ_ALL, range(36))[:7] == bytes.fromhex("01 04 4A 00 01 00 1E")
    assert answer(READ_ALL, range(36), unready=(1,))[:7] == bytes.fromhex("01 04 4A 00 00 00 00")


# A server of somebody else's making


def test_a_line_with_arrays_of_both_shapes_to_which_nothing_is_written() -> None:
    asked = set()

    async def note(function: int, _s: int, address: int, count: int, *_: object) -> None:
        asked.add((function, address, count))

    square, wide = np.arange(100, 136), np.arange(200, 232)
    arrays = [array(3, square.tolist(), model=1, action=note), array(31, wide.tolist(), model=0, action=note)]
    right = np.concatenate([square.reshape(6, 6)[::-1].ravel(), wide.reshape(4, 8)[::-1].ravel()])
    with rtu_server(*arrays) as name, reading(name, units=(3, 31)) as reader:
        frame = read_until(reader, lambda frame: not frame.status.any())
        assert frame.values.tolist() == right.tolist()
        assert frame.structure.module_names == ("unit 3", "unit 31")
    assert asked == {(4, 43, 1), (4, 6, 37), (4, 6, 33)}


@pytest.mark.parametrize(
    ("model", "told"),
    [(7, "unit 1: model 7 is neither 0 .4x8. nor 1 .6x6.: say option shapes$"), (0x100, "and byte_order=little")],
)
def test_a_model_that_nobody_knows_is_told(model: int, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async def read(*_: object, **_more: object) -> np.ndarray[Any, np.dtype[np.uint16]]:
        return np.array([model], np.uint16)

    driver = adapter()
    monkeypatch.setattr(driver, "read", read)
    with pytest.raises(BusError, match=told):
        asyncio.run(driver.describe(Link(make_bus("modbus:/dev/null"))))


def test_a_shape_that_is_given_is_not_asked() -> None:
    cells = list(range(1, 33))
    with rtu_server(array(1, cells, model=7)) as name, reading(name, shapes=("4x8",)) as reader:
        read_until(reader, lambda frame: not frame.status.any() and sorted(frame.values.tolist()) == cells)


# What is wrong with an array


def test_an_array_that_is_not_ready_shows_no_data_and_the_others_do(caplog: Any) -> None:
    values, unready = [100] * 36, [2]
    with emulated_reading(feeling(values, unready), units=(1, 2)) as reader:
        frame = read_until(reader, is_current)
        assert frame.status.tolist() == [0] * 36 + [NO_DATA] * 36
        wait_until(lambda: "unit 2 is not ready" in caplog.text)
        unready.clear()
        read_until(reader, lambda frame: not frame.status.any())
    assert "unit 1 is not ready" not in caplog.text
    assert caplog.text.count("is not ready") == 1


def test_an_array_whose_state_is_not_read_is_taken_as_it_is() -> None:
    with rtu_server(array(1, range(1, 37), model=1, state=0)) as name, reading(name, state=False) as reader:
        read_until(reader, lambda frame: not frame.status.any() and bool((frame.values > 0).all()))


def test_the_end_of_the_range_is_told_and_what_is_beyond_is_doubted(caplog: Any) -> None:
    values = [4095, 4096, 0xFFFF, *[5] * 33]
    with emulated_reading(feeling(values)) as reader:
        frame = read_until(reader, is_current)
        assert frame.status[:4].tolist() == [BEYOND, DOUBT, DOUBT, 0]
        assert frame.values[:4].tolist() == values[:4]
        wait_until(lambda: "values above 4095, which no taxel has" in caplog.text)


def test_bytes_in_the_other_order_are_put_right_by_an_option_of_the_bus_also_when_the_shape_is_asked() -> None:
    with emulated_on_a_pty("dfrobot", swapped=True, pattern="idle") as port:
        with reading(f"modbus:{port}?byte_order=little") as reader:
            read_until(reader, lambda frame: not frame.status.any() and bool((frame.values == 20).all()))


def test_bytes_in_the_other_order_are_told_where_the_shape_is_given(caplog: Any) -> None:
    with emulated_on_a_pty("dfrobot", swapped=True, pattern="idle") as port:
        with reading(f"modbus:{port}", shapes=("6x6",)) as reader:
            frame = read_until(reader, is_current)
            assert frame.status.tolist() == [NO_DATA | DOUBT] * 36
            wait_until(lambda: "add byte_order=little" in caplog.text)


def test_an_array_that_has_sent_only_0_is_untouched_and_fresh(caplog: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ZeroWatch, "patience_s", 0.2)
    caplog.set_level(logging.INFO)
    values = [0] * 36
    with emulated_reading(feeling(values)) as reader:
        read_until(reader, lambda frame: bool(frame.module_untouched.all()) and not frame.status.any())
        wait_until(lambda: "nothing but 0 has come from unit 1" in caplog.text)
        values[7] = 1
        read_until(reader, lambda frame: not frame.module_untouched.any() and not frame.status.any())
