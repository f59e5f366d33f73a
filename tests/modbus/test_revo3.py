"""BrainCo's Revo3: the maker's tables, what a hand says of itself, a server of somebody else's making, and writes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader, Structure
from skinware.errors import ConfigurationError
from skinware_drivers.description import assemble
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.revo3 import Revo3Driver, Revo3Options, places
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.driving import driving_lines, emulated_on_a_pty, emulated_skin
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual import Device
from skinware_drivers.virtual.devices.registers import EmulatedRevo3, EmulatedRevo3Options
from tests.modbus.peers import Action, rtu_server
from tests.modbus.peers import device as server_device
from tests.modbus.rig import PATIENTLY, PYMODBUS, driven, patient, with_options

pytestmark = PYMODBUS
AT = {"palm": 4200, "thumb tip": 4250, "thumb pad": 4290, "index tip": 4350, "index pad": 4400, "little pad": 4700}
POINTS = [36, 31, 57, 21, 52, 21, 52, 21, 52, 21, 52]
MATRIX = [53, 56, 22, 22, 27, 22, 27, 22, 27, 22, 27]
BEGINS = [4200, 4250, 4290, 4350, 4400, 4460, 4500, 4560, 4600, 4660, 4700]
PACKED = [5240, 5340, 5380, 5440, 5480, 5540, 5580, 5640, 5680, 5740, 5780]
COUNTS, NEWTONS = ("pressure", "counts", 1.0), "N"


def adapter(**options: Any) -> Revo3Driver:
    return Revo3Driver(Revo3Options(**options))


def structure_of(driver: Revo3Driver) -> Structure:
    return assemble([("bus", driver.patches)], driver.types, driver.dtype).structure


@contextmanager
def reading(name: str, **options: Any) -> Iterator[DriverReader]:
    with driven(with_options(name, PATIENTLY), adapter(**options)) as (_, reader):
        yield reader


# What is asked, and what it means


def test_the_arrays_are_where_the_table_says() -> None:
    driver = adapter()
    modules = {module.name: block for module, block in zip(driver.patches[0].modules, driver.registers, strict=True)}
    assert {name: modules[name].address for name in AT} == AT
    assert [block.count for block in driver.registers] == POINTS
    assert {(block.unit, block.function) for block in driver.registers} == {(1, 4)}
    assert sum(len(module.channels) for module in driver.patches[0].modules) == 416


def test_a_matrix_hand_has_as_many_taxels_as_the_makers_program_begins_with() -> None:
    driver = adapter(mapping="matrix", unit=126)
    places_of = [(block.address, block.count) for block in driver.registers]
    assert places_of == [(5240 + 60 * pad, count) for pad, count in enumerate(MATRIX)]
    first = driver.wanted.reads()[0]
    assert wire.rtu_frame(wire.Message(first.unit, first.question))[:4] == bytes.fromhex("7E 03 14 78")


def test_a_packed_hand_has_two_taxels_in_a_register() -> None:
    driver = adapter(mapping="packed")
    assert [block.address for block in driver.registers] == PACKED
    assert [block.count for block in driver.registers] == [27, 28, 11, 11, 14, 11, 14, 11, 14, 11, 14]


def test_the_line_is_as_fast_as_the_makers_programs_open_it() -> None:
    assert adapter().baudrate == 5_000_000


@pytest.mark.parametrize("points", [(1, 2), (0, *POINTS[1:]), (201, *POINTS[1:])])
def test_points_that_cannot_be(points: tuple[int, ...]) -> None:
    with pytest.raises(ConfigurationError, match="points"):
        Revo3Options(points=points)


def test_taxels_are_in_the_rows_and_columns_of_the_makers_table() -> None:
    grid, cells = places("pressure", "right", 0, 36)
    assert (grid.rows, grid.columns, cells[0], cells[-1]) == (9, 6, 1, 53)
    left_grid, left = places("pressure", "left", 0, 36)
    assert (left_grid, left[0], left[-1]) == (grid, 0, 48)
    assert sorted(left) == sorted(6 * (cell // 6) + 5 - cell % 6 for cell in cells)
    found = [places("pressure", "right", pad, count) for pad, count in enumerate(POINTS)]
    shapes = {(grid.rows, grid.columns, len(cells)) for grid, cells in found}
    assert shapes == {(9, 6, 36), (9, 7, 31), (14, 8, 57), (8, 6, 21), (13, 8, 52)}


@pytest.mark.parametrize("mapping", ["pressure", "matrix", "packed"])
@pytest.mark.parametrize("side", ["right", "left"])
def test_all_taxels_have_nominal_places_of_their_own(mapping: Any, side: Any) -> None:
    driver = adapter(mapping=mapping, side=side)
    assert driver.geometry is not None
    structure = structure_of(driver)
    assert structure.module_names[:3] == (f"{side} hand, palm", f"{side} hand, thumb tip", f"{side} hand, thumb pad")
    found = driver.geometry.of(structure, "pressure")
    assert found.known.all()
    apart = np.linalg.norm(found.position_m[:, None] - found.position_m[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 0.0019


# The emulated hand, byte by byte


@pytest.mark.parametrize(
    ("mapping", "read", "answer"),
    [
        ("pressure", "01 04 10 68 00 02", "01 04 04 0001 0002"),
        ("matrix", "01 03 14 78 00 02", "01 03 04 0001 0002"),
        ("packed", "01 03 14 78 00 02", "01 03 04 0102 0304"),
        ("matrix", "01 03 14 47 00 02", "01 03 04 0035 0038"),
        ("pressure", "01 03 0F B7 00 02", "01 03 04 0000 0002"),
        ("pressure", "01 03 00 87 00 01", "01 03 02 0001"),
        ("packed", "01 03 00 87 00 01", "01 03 02 0002"),
        ("pressure", "01 03 14 47 00 02", "01 83 02"),
    ],
)
def test_the_emulated_hand_answers_as_the_table_says(mapping: Any, read: str, answer: str) -> None:
    options = EmulatedRevo3Options(mapping=mapping, values="force")
    hand = EmulatedRevo3(options, source=lambda _n, _c: [n % 256 for n in range(1, 417)])
    hand.skip(10**9)
    data = bytes.fromhex(read)
    hand.receive(0, wire.rtu_frame(wire.Message(data[0], data[1:])), 2 * 10**9)
    assert b"".join(frame.payload for frame in hand.emit(3 * 10**9))[:-2] == bytes.fromhex(answer)


# What the hand says of itself decides


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("hand", "counts", "kinds"),
    [
        ({}, POINTS, {COUNTS}),
        ({"values": "raw"}, POINTS, {COUNTS}),
        ({"values": "force"}, POINTS, {("force_z", "counts", 1.0)}),
        ({"sums": True}, [1, 3, 6, 3, 5, 3, 5, 3, 5, 3, 5], {("force_z", NEWTONS, 1e-3)}),
        ({"mapping": "packed"}, MATRIX, {COUNTS}),
        ({"mapping": "packed", "values": "force"}, MATRIX, {("force_z", NEWTONS, 1e-2)}),
        (
            {"mapping": "packed", "values": "force", "adc_pads": (0, 10)},
            MATRIX,
            {("force_z", NEWTONS, 1e-2), COUNTS},
        ),
        ({"mapping": "matrix"}, MATRIX, {COUNTS}),
        ({"mapping": "matrix", "values": "force"}, MATRIX, {("force_z", NEWTONS, 1e-4)}),
        ({"mapping": "packed", "points": (100, *[20] * 10)}, [100, *[20] * 10], {COUNTS}),
        ({"points": (30, *POINTS[1:])}, [30, *POINTS[1:]], {COUNTS}),
        ({"side": "left"}, POINTS, {COUNTS}),
    ],
)
def test_counts_units_and_modes_are_those_that_the_hand_says(
    hand: Mapping[str, Any], counts: list[int], kinds: set[tuple[str, str, float]]
) -> None:
    with patient("revo3", **hand) as skin:
        frame = read_until(skin.reader, lambda frame: not frame.status.any())
        structure = skin.reader.structure
        assert np.bincount(structure.sensor_module).tolist() == counts
        assert {(kind.name, kind.unit, kind.scale) for kind in structure.types} == kinds
        assert structure.module_names[0] == f"{hand.get('side', 'right')} hand, palm"
        assert len(frame.values) == sum(counts)


def test_the_number_of_a_hand_is_found() -> None:
    with emulated_skin("revo3", EmulatedRevo3, unit=127) as skin:
        read_until(skin.reader, lambda frame: not frame.status.any())


class Changing(EmulatedRevo3):
    """Sends sums after its second start."""

    starts = 0

    def boot(self, device: Device, now_ns: int) -> None:
        self.starts += 1
        super().boot(device, now_ns)

    def _sends_sums(self, device: Device) -> bool:
        return self.starts > 1 or super()._sends_sums(device)


@pytest.mark.thorough
def test_a_hand_that_sends_something_else_after_a_restart_is_described_again(caplog: Any) -> None:
    caplog.set_level("INFO")
    with emulated_skin("revo3", Changing, restart=(1,), restart_after_s=2) as skin:
        read_until(skin.reader, lambda frame: not frame.status.any())
        assert len(skin.reader.structure.sensor_uid) == 416
        wait_until(lambda: "sends something else now: mapping pressure, 42 sums of zones" in caplog.text)
        wait_until(lambda: "new generation" in caplog.text)
        with DriverReader("skin", timeout_s=30) as reader:
            assert len(read_until(reader, lambda frame: not frame.status.any()).values) == 42


@contextmanager
def refused(emulator: type[EmulatedRevo3], **options: Any) -> Iterator[None]:
    with emulated_on_a_pty(emulator, **options) as port:
        bus = make_bus(f"modbus:{port}?{PATIENTLY}", payload_size=256)
        with driving_lines([(adapter(), bus)], "hand", wait=False):
            yield


def test_a_hand_that_does_not_say_its_mapping_is_refused_until_an_option_says_it(caplog: Any) -> None:
    with refused(EmulatedRevo3, says_mapping=False):
        wait_until(lambda: "register 135 of the hand says None" in caplog.text)
    with emulated_on_a_pty(EmulatedRevo3, says_mapping=False) as port:
        with reading(f"modbus:{port}", mapping="pressure") as reader:
            read_until(reader, lambda frame: not frame.status.any())


class Fingertips(EmulatedRevo3):
    """A hand of forces and torques, by its maker's program."""

    def _settings(self, device: Device) -> dict[int, int]:
        return {**super()._settings(device), 135: 3}


def test_a_family_that_is_not_read_is_refused_by_its_number(caplog: Any) -> None:
    with refused(Fingertips):
        wait_until(lambda: "says 3, neither 1 (pressure) nor 2 (matrix)" in caplog.text)


# A server of somebody else's making, whose hand says of itself what is asked


def registers(mapping: str = "pressure") -> np.ndarray[Any, np.dtype[np.int64]]:
    """Of a hand whose taxels send 1, 2, 3 ..., from 101 on."""
    found, taxel = np.zeros(6000, np.int64), 1
    found[1], found[135] = 0, 1 if mapping == "pressure" else 2
    found[101] = 1
    found[5191:5202] = MATRIX
    begins = BEGINS if mapping == "pressure" else list(range(5240, 5900, 60))
    for begin, n in zip(begins, POINTS if mapping == "pressure" else MATRIX, strict=True):
        found[begin:][:n] = range(taxel, taxel + n)
        taxel += n
    return found[101:]


@pytest.mark.parametrize("mapping", ["pressure", "matrix"])
def test_a_server_with_a_hand_to_which_nothing_is_written_unless_somebody_wants_it(mapping: str) -> None:
    writes = []

    async def note(function: int, _s: int, address: int, count: int, _r: object, values: list[int] | None) -> None:
        if function == 16:
            writes.append((address, values))

    switches, zero = (4000, 4011) if mapping == "pressure" else (5900, 5214)
    with serving(mapping, note) as name, reading(name, period_ms=20) as reader:
        n = sum(POINTS if mapping == "pressure" else MATRIX)
        read_until(reader, lambda frame: not frame.status.any() and (frame.values == np.arange(1, n + 1)).all())
        assert writes == []
        reader.call("zero")
        reader.call("enable")
        assert writes == [(zero, [1]), (switches, [1] * 11)]


def test_the_form_of_a_matrix_hand_follows_from_registers_that_only_one_form_has() -> None:
    with serving("matrix") as name, reading(name, mapping="packed", period_ms=20) as reader:
        assert len(reader.structure.sensor_uid) == sum(MATRIX)
        frame = read_until(reader, lambda frame: not frame.status.any())
        assert frame.values[:4].tolist() == [0, 1, 0, 2]


@contextmanager
def serving(mapping: str, action: Action | None = None) -> Iterator[str]:
    with rtu_server(server_device(1, 101, registers(mapping).tolist(), action), baudrate=460_800) as name:
        yield name


# What is wrong with a hand


def test_pads_that_are_off_are_untouched_until_they_are_switched_on() -> None:
    with patient("revo3", enabled=False) as skin:
        read_until(skin.reader, lambda frame: bool(frame.module_untouched.all()))
        skin.reader.call("enable")
        read_until(skin.reader, lambda frame: not frame.module_untouched.any() and not frame.status.any())
