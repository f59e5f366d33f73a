"""Inspire's hand: bytes of its manual, a server of somebody else's making, and hands with something wrong."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import pytest

from skinware import DriverReader, DriverSnapshot
from skinware.errors import ConfigurationError
from skinware.status import Status
from skinware_drivers.description import assemble
from skinware_drivers.link import Heard, Link
from skinware_drivers.modbus import wire
from skinware_drivers.modbus.inspire import InspireDriver, InspireOptions
from skinware_drivers.modbus.registers import Wanted
from skinware_drivers.polling import ZeroWatch
from skinware_drivers.registry import make_bus
from skinware_drivers.testing.waiting import read_until, wait_until
from skinware_drivers.virtual.devices.registers import EmulatedInspire, EmulatedInspireOptions
from skinware_drivers.virtual.hardware import WireFrame
from tests.modbus.peers import device, rtu_server, tcp_server
from tests.modbus.rig import PATIENTLY, PYMODBUS, driven, patient, with_options

pytestmark = PYMODBUS
N = 1062
DOUBT = int(Status.SUSPECT)
AS_SENT = np.arange(100, 100 + N)
"""What the taxel of register 3000 + 2 n tells: 100 + n."""
FIRST = {"tip": 3000, "top": 3018, "pad": 3210}
PALM_AT, PALM_ROWS, PALM_COLUMNS = (4900 - 3000) // 2, 8, 14


def adapter(**options: Any) -> InspireDriver:
    return InspireDriver(InspireOptions(**options))


def reads(driver: InspireDriver) -> list[tuple[int, int]]:
    wanted = Wanted(driver.registers, driver.address_step, driver.largest_gap, driver.most_registers)
    return [(read.address, read.count) for read in wanted.reads()]


def right() -> np.ndarray[Any, np.dtype[np.int64]]:
    """What the sensors show of that, in their order: the palm's rows from the other end of its columns."""
    palm = AS_SENT[PALM_AT:].reshape(PALM_COLUMNS, PALM_ROWS)
    return np.concatenate([AS_SENT[:PALM_AT], palm[:, ::-1].T.ravel()])


@contextmanager
def reading(name: str, **options: Any) -> Iterator[DriverReader]:
    with driven(with_options(name, PATIENTLY), adapter(**options)) as (_, reader):
        yield reader


def is_current(frame: DriverSnapshot) -> bool:
    return not (frame.status & (Status.NEVER_SEEN | Status.STALE)).any()


def answers(command: str, values: Sequence[int], **options: Any) -> bytes:
    """What an emulated hand answers to bytes."""
    hand = EmulatedInspire(EmulatedInspireOptions(**options), source=lambda _n, _c: values)
    hand.skip(10**9)
    hand.receive(0, bytes.fromhex(command), 10**9 + 1)
    frames: list[WireFrame] = hand.emit(2 * 10**9)
    return b"".join(frame.payload for frame in frames)


def feeling(values: Sequence[int]) -> type[EmulatedInspire]:
    """A hand that feels this."""

    class Hand(EmulatedInspire):
        def __init__(self, options: EmulatedInspireOptions, **more: Any) -> None:
            super().__init__(options, **{**more, "source": lambda _n, _c: values})

    return Hand


# What is asked


def test_the_whole_hand_is_nine_reads_of_which_the_addresses_count_bytes() -> None:
    asked = reads(adapter())
    assert asked == [(3000 + 250 * n, 125) for n in range(8)] + [(5000, 62)]
    first = wire.rtu_frame(wire.Message(1, wire.question_to_read(3, *asked[0])))
    assert first == bytes.fromhex("01 03 0B B8 00 7D 07 EA")


def test_or_a_read_of_each_matrix_at_the_address_that_the_manual_gives() -> None:
    asked = reads(adapter(by_matrix=True))
    assert len(asked) == 17
    assert asked[:3] == [(3000, 9), (3018, 96), (3210, 80)]
    assert asked[12:] == [(4480, 9), (4498, 96), (4690, 9), (4708, 96), (4900, 112)]
    frames = [wire.rtu_frame(wire.Message(1, wire.question_to_read(3, *read))) for read in asked[:2]]
    assert frames == [bytes.fromhex("01 03 0B B8 00 09 07 CD"), bytes.fromhex("01 03 0B CA 00 60 67 F8")]


def test_it_asks_the_unit_that_it_is_told() -> None:
    assert {block.unit for block in adapter(unit=255).registers} == {255}
    with pytest.raises(ConfigurationError, match="unit"):
        InspireOptions(unit=256)


def test_it_does_not_ask_faster_than_a_serial_line_can_answer() -> None:
    def period_s(bus: str, **options: Any) -> float:
        driver = adapter(**options)
        driver.fit(make_bus(bus, payload_size=driver.payload_size))
        return driver.period_s

    assert period_s("modbus:tcp://127.0.0.1:6000") == 0.02
    assert 0.2 < period_s("modbus:/dev/null") < 0.35
    assert 0.02 < period_s("modbus:/dev/null?baudrate=921600") < 0.05
    assert period_s("modbus:/dev/null", period_ms=10) == 0.01


def test_an_untouched_hand_has_hardly_any_load_and_no_dead_matrix() -> None:
    shapes = [module.kind.split("x") for module in adapter().patches[0].modules]
    ends = np.cumsum([int(rows) * int(columns) for rows, columns in shapes])[:-1]
    matrices = np.split(np.array(EmulatedInspire.rest), ends)
    assert [matrix.any() for matrix in matrices] == [True] * 17
    assert max(matrix.sum() for matrix in matrices) < 10


# What it means


def test_every_matrix_is_a_grid_of_its_own() -> None:
    [patch] = adapter().patches
    modules = {module.name: (module.kind, len(module.channels)) for module in patch.modules}
    assert patch.name == "right hand"
    assert list(modules)[:4] == ["little tip", "little top", "little pad", "ring tip"]
    assert list(modules)[-5:] == ["thumb tip", "thumb top", "thumb middle", "thumb pad", "palm"]
    assert modules["index tip"] == ("3x3", 9)
    assert modules["index top"] == ("12x8", 96)
    assert modules["index pad"] == ("10x8", 80)
    assert modules["thumb pad"] == ("12x8", 96)
    assert modules["palm"] == ("8x14", 112)
    assert sum(n for _, n in modules.values()) == N


def test_the_palm_begins_in_its_last_row_and_goes_up_its_columns() -> None:
    palm = adapter().patches[0].modules[-1]
    uids = np.array([sensor.uid for sensor in palm.channels if sensor is not None]).reshape(8, 14)
    points = uids - PALM_AT + 1
    assert (points[7, 0], points[6, 0], points[7, 1]) == (1, 2, 9)
    assert (points[0, 0], points[0, 13]) == (8, 112)


@pytest.mark.parametrize("side", ["right", "left"])
def test_all_taxels_have_nominal_places(side: str) -> None:
    driver = adapter(side=side)
    places = driver.geometry
    assert places is not None
    structure = assemble([("bus", driver.patches)], driver.types, driver.dtype).structure
    mine = places.of(structure, "pressure")
    assert mine.known.all()
    assert set(mine.frame) == {f"{side}_hand_nominal"}
    apart = np.linalg.norm(mine.position_m[:, None] - mine.position_m[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 0.0019
    ends = np.cumsum([len(module.channels) for module in driver.patches[0].modules])[:-1]
    little, *_, thumb, _palm = [x.mean() for x in np.split(mine.position_m[:, 0], ends)]
    assert (thumb > little) == (side == "right")


# The emulated hand, byte by byte


def test_the_emulated_hand_answers_as_the_manual_says() -> None:
    values = list(range(N))
    tip = answers("01 03 0B B8 00 09 07 CD", values)
    assert tip[:3] == bytes.fromhex("01 03 12")
    assert tip[3:21] == b"".join(n.to_bytes(2, "big") for n in range(9))
    over_tcp = answers("0001 0000 0006 01 03 0BB8 0009", values)
    assert over_tcp == bytes.fromhex("0001 0000 0015 01 03 12") + tip[3:21]
    assert answers("01 03 0B B8 00 09 07 CD", values, swapped=True)[3:7] == bytes.fromhex("0000 0100")


@pytest.mark.parametrize("told", ["01 06 03 EC 00 01 88 7B", "01 10 0B B8 00 01 02 00 01 AD 1E"])
def test_the_emulated_hand_lets_nobody_write(told: str) -> None:
    data = bytes.fromhex(told)[:-2]
    command = wire.rtu_frame(wire.Message(data[0], data[1:]))
    assert answers(command.hex(), [0] * N)[1] & 0x80


# A server of somebody else's making


async def count_bytes(
    _function: int, start: int, address: int, count: int, registers: list[int], _values: object
) -> None:
    """Make a server whose addresses count registers answer as one whose addresses count bytes."""
    first = (address - 3000) // 2
    told = AS_SENT[first : first + count].tolist()
    registers[address - start : address - start + len(told)] = told


@pytest.mark.parametrize("over", [tcp_server, rtu_server], ids=["tcp", "rtu"])
def test_a_server_whose_addresses_count_bytes(over: Any) -> None:
    with over(device(1, 3000, [0] * 3000, count_bytes)) as name, reading(name) as reader:
        read_until(reader, lambda frame: not frame.status.any() and (frame.values == right()).all())


def test_a_hand_that_takes_its_time_is_asked_as_fast_as_it_answers() -> None:
    """Asked faster, no frame would have all matrices of one cycle."""
    answer_s = 0.01

    async def slowly(*question: Any) -> None:
        await asyncio.sleep(answer_s)
        await count_bytes(*question)

    driver, whole = adapter(), 0
    with (
        tcp_server(device(1, 3000, [0] * 3000, slowly)) as name,
        driven(with_options(name, PATIENTLY), driver) as (_, reader),
    ):
        assert driver.period_s >= 9 * answer_s

        def whole_in_a_row() -> bool:
            nonlocal whole
            frame = read_until(reader, lambda frame: not frame.status.any())
            following = read_until(reader, lambda other: other.sequence > frame.sequence)
            whole = 0 if following.status.any() else whole + 1
            return whole == 3

        wait_until(whole_in_a_row)


def test_matrix_by_matrix_it_does_not_matter_what_addresses_count() -> None:
    registers = np.zeros(3000, int)
    for block in adapter().registers:
        first = (block.address - 3000) // 2
        registers[block.address - 3000 :][: block.count] = AS_SENT[first : first + block.count]
    with tcp_server(device(1, 3000, registers.tolist())) as name, reading(name, by_matrix=True) as reader:
        read_until(reader, lambda frame: not frame.status.any() and (frame.values == right()).all())


# What is wrong with a hand


def test_values_that_no_taxel_has_are_doubted_and_the_end_of_the_range_is_told(caplog: Any) -> None:
    values = [4095, 4096, 4097, 65280, *[5] * (N - 4)]
    with patient("inspire", feeling(values)) as skin:
        frame = read_until(skin.reader, is_current)
        beyond = int(Status.OUT_OF_RANGE)
        assert frame.status[:5].tolist() == [0, beyond, DOUBT, DOUBT, 0]
        assert frame.values[:4].tolist() == values[:4]
        wait_until(lambda: "add byte_order=little" in caplog.text)


def test_bytes_in_the_other_order_are_told_and_put_right_by_an_option(caplog: Any) -> None:
    swapped = [value >> 8 | (value & 255) << 8 for value in AS_SENT.tolist()]

    async def swap(_f: int, start: int, address: int, count: int, registers: list[int], _v: object) -> None:
        first = (address - 3000) // 2
        told = swapped[first : first + count]
        registers[address - start : address - start + len(told)] = told

    with tcp_server(device(1, 3000, [0] * 3000, swap)) as name:
        with reading(name) as reader:
            frame = read_until(reader, lambda frame: not (frame.status & Status.NEVER_SEEN).any())
            assert ((frame.status & DOUBT) != 0).sum() > N // 2
            wait_until(lambda: "add byte_order=little" in caplog.text)
        with reading(f"{name}?byte_order=little") as reader:
            read_until(reader, lambda frame: not frame.status.any() and (frame.values == right()).all())


def doubted(frame: DriverSnapshot) -> list[str]:
    """The modules of which all values are suspect; none may be so in part."""
    is_doubted = (frame.status & DOUBT) != 0
    modules = np.unique(frame.structure.sensor_module[is_doubted])
    assert is_doubted[np.isin(frame.structure.sensor_module, modules)].all()
    return [frame.structure.module_names[int(module)] for module in modules]


@pytest.mark.parametrize("way", ["native", "python"])
def test_a_dead_matrix_is_named_and_an_idle_one_fresh(way: str, caplog: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    if way == "python":
        monkeypatch.setattr("skinware_drivers.native.library", lambda: None)
    monkeypatch.setattr(ZeroWatch, "patience_s", 0.2)
    caplog.set_level(logging.INFO)
    with patient("inspire", pattern="idle", zero=(13, 17)) as skin:
        frame = read_until(skin.reader, lambda frame: frame.module_untouched.sum() == 2 and not frame.status.any())
        names = np.array(frame.structure.module_names)[frame.module_untouched].tolist()
        assert names == ["right hand, thumb tip", "right hand, palm"]
        assert frame.fresh("pressure", max_age_s=60).all()

        def is_named(name: str) -> bool:
            return any(name in text for text in caplog.messages if text.startswith("nothing but 0 has come from"))

        wait_until(lambda: all(map(is_named, names)))


def test_a_matrix_that_shows_something_at_last_is_believed_from_then_on() -> None:
    felt = [0] * N
    with patient("inspire", feeling(felt)) as skin:
        read_until(skin.reader, lambda frame: bool(frame.module_untouched.all()))
        felt[:9] = [0, 0, 1, *[0] * 6]
        frame = read_until(skin.reader, lambda frame: bool(frame.values[2] == 1) and is_current(frame))
        assert frame.module_untouched.tolist() == [False] + [True] * 16
        felt[2] = 0
        frame = read_until(skin.reader, lambda frame: bool(frame.values[2] == 0) and is_current(frame))
        assert not frame.module_untouched[0]


@pytest.mark.parametrize(("cycle_s", "period_s"), [(2.7, 3.4), (0.7, 0.9), (0.026, 0.0325), (0.02, 0.02), (0.0, 0.02)])
def test_the_period_follows_how_long_a_cycle_takes(cycle_s: float, period_s: float) -> None:
    class Listening:
        bus_name, log = "a bus", logging.getLogger("skinware.driver")
        passed_s = 0.0

        async def listen(self, duration_s: float) -> Counter[Heard]:
            begun_s, self.passed_s = self.passed_s, self.passed_s + duration_s
            heard = Counter[Heard]()
            if cycle_s:
                for read in range(int(begun_s / cycle_s * 9), int(self.passed_s / cycle_s * 9)):
                    heard[Heard(read % 9, 0, 0)] += 1
            return heard

    driver = adapter()
    driver.fit(make_bus("modbus:tcp://127.0.0.1:1"))
    asyncio.run(driver.learn_period(cast("Link", Listening())))
    assert driver.period_s == pytest.approx(period_s, rel=0.15)
