"""BrainCo's Revo3: the maker's tables, a server of somebody else's making, and what is written on request."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from skinware import DriverReader
from skinware.errors import ConfigurationError
from skinware_drivers.description import assemble
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.revo3 import Revo3Driver, Revo3Options
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual.devices.revo3 import EmulatedRevo3, EmulatedRevo3Options
from tests.modbus.peers import device, rtu_server
from tests.modbus.rig import PATIENTLY, PYMODBUS, driven, patient, with_options

pytestmark = PYMODBUS
AT = {"palm": 4200, "thumb tip": 4250, "thumb pad": 4290, "index tip": 4350, "index pad": 4400, "little pad": 4700}
POINTS = [36, 31, 57, 21, 52, 21, 52, 21, 52, 21, 52]
LONGER = (40, 31, 60, 21, 52, 21, 52, 21, 52, 21, 52)
BEGINS = [4200, 4250, 4290, 4350, 4400, 4460, 4500, 4560, 4600, 4660, 4700]


def adapter(**options: Any) -> Revo3Driver:
    return Revo3Driver(Revo3Options(**options))


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
    assert {(block.unit, block.function) for block in driver.registers} == {(127, 4)}
    assert sum(len(module.channels) for module in driver.patches[0].modules) == 416


def test_a_matrix_hand_is_six_reads_of_two_pads() -> None:
    reads = adapter(mapping="matrix", side="left").wanted.reads()
    assert [(read.address, read.count) for read in reads] == [(5240 + 120 * n, 120) for n in range(5)] + [(5840, 52)]
    first = wire.rtu_frame(wire.Message(reads[0].unit, wire.question_to_read(3, 5240, 120)))
    assert first[:6] == bytes.fromhex("7E 03 14 78 00 78")
    assert reads[0].function == 3


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"points": (1, 2)}, "give 11 numbers from 1 to 60"),
        ({"points": (61, *POINTS[1:]), "mapping": "matrix"}, "give 11 numbers from 1 to 60"),
        ({"points": LONGER}, "are published"),
    ],
)
def test_points_that_cannot_be(options: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        Revo3Options(**options)


@pytest.mark.parametrize("points", [tuple(POINTS), LONGER])
def test_all_taxels_have_nominal_places_of_their_own(points: tuple[int, ...]) -> None:
    driver = adapter(mapping="matrix", points=points)
    assert driver.geometry is not None
    structure = assemble([("bus", driver.patches)], driver.types, driver.dtype).structure
    assert structure.module_names[:3] == ("right hand, palm", "right hand, thumb tip", "right hand, thumb pad")
    places = driver.geometry.of(structure, "pressure")
    assert places.known.all()
    apart = np.linalg.norm(places.position_m[:, None] - places.position_m[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 0.0019


# The emulated hand, byte by byte


@pytest.mark.parametrize(
    ("mapping", "read", "begins"),
    [("pressure", "7E 04 10 68 00 02", "7E 04 04 0001 0002"), ("matrix", "7E 03 14 78 00 02", "7E 03 04 0001 0002")],
)
def test_the_emulated_hand_answers_as_the_table_says(mapping: Any, read: str, begins: str) -> None:
    options = EmulatedRevo3Options(unit=126, mapping=mapping)
    hand = EmulatedRevo3(options, source=lambda _n, _c: range(1, 417))
    hand.skip(10**9)
    data = bytes.fromhex(read)
    hand.receive(0, wire.rtu_frame(wire.Message(data[0], data[1:])), 2 * 10**9)
    assert b"".join(frame.payload for frame in hand.emit(3 * 10**9))[:-2] == bytes.fromhex(begins)


# A server of somebody else's making


def registers(mapping: str = "pressure") -> np.ndarray[Any, np.dtype[np.int64]]:
    """Of a hand whose taxels tell 1, 2, 3 ..., from 4000 on."""
    begins = BEGINS if mapping == "pressure" else range(5240, 5900, 60)
    found, taxel = np.zeros(2000, np.int64), 1
    for begin, n in zip(begins, POINTS, strict=True):
        found[begin - 4000 :][:n] = range(taxel, taxel + n)
        taxel += n
    return found


@pytest.mark.parametrize("mapping", ["pressure", "matrix"])
def test_a_server_with_a_hand_to_which_nothing_is_written_unless_somebody_wants_it(mapping: str) -> None:
    writes = []

    async def note(function: int, _s: int, address: int, count: int, _r: object, values: list[int] | None) -> None:
        if function == 16:
            writes.append((address, values))

    expected = np.arange(1, 417)
    switches, zero = (4000, 4011) if mapping == "pressure" else (5900, 5214)
    with (
        rtu_server(device(127, 4000, registers(mapping).tolist(), note), baudrate=460_800) as name,
        reading(name, mapping=mapping, period_ms=20) as reader,
    ):
        read_until(reader, lambda frame: not frame.status.any() and (frame.values == expected).all())
        assert writes == []
        reader.call("zero")
        reader.call("enable")
        assert writes == [(zero, [1]), (switches, [1] * 11)]


# What is wrong with a hand


def test_pads_that_are_off_are_untouched_until_they_are_switched_on() -> None:
    with patient("revo3", enabled=False) as skin:
        read_until(skin.reader, lambda frame: bool(frame.module_untouched.all()))
        skin.reader.call("enable")
        read_until(skin.reader, lambda frame: not frame.module_untouched.any() and not frame.status.any())
