"""Recorded wires as buses of drivers: the same values come of them, and a decoder's mistake is found again."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skinware.recording
from skinware import DriverReader
from skinware.errors import BadRecording, ConfigurationError
from skinware.recording import Series, WireItem
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import ERROR_FLAG, REMOTE_FLAG, Bus, FrameBatch
from skinware_drivers.bus_names import BusName
from skinware_drivers.can import CanAdapter
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.proving.captures import check_capture
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.recorded_wire import RecordedWire
from skinware_drivers.wire_tap import WireTap
from tests.can.rig import TIP_IDENTIFIER, Tip
from tests.commands import run, running
from tests.recording.rig import recording
from tests.recording.test_wire_export import Sent, keep, write_recording
from tests.recording.test_wires import batches_lost
from tests.sdk.cable import Cable
from tests.sdk.test_flow import EndOfCable

MS = 1_000_000
UNASKED = ("agni", "allegro_v5", "cyskin_cpm", "linkerhand", "skintalk", "tactile_glove", "xela")
"""Devices that send by themselves: between their frames, nothing moves the time."""
OPTIONS: dict[str, dict[str, Any]] = {
    "allegro_v5": {"model": "sense"},
    "linkerhand": {"hands": (0x27,), "touch": "12x6"},
}
"""Of those that would listen first, to learn who is there: a recording of a few frames has none to spare."""
DRIVERS = (
    *UNASKED,
    "ability_hand",
    "anyskin",
    "barrett",
    "canopen",
    "flexitac",
    "openpatch",
    "paxini",
    "roboskin",
    "weiss_wts",
    "wuji_glove",
)


def record(path: Path, adapter: AnyAdapter, bus: Bus, frames: int, *, updates: int = 0) -> Series:
    """Record a driver and its wire until there are so many snapshots, and of each patch so many updates."""
    with recording(path, with_wires=True) as recorder, driving_lines([(adapter, bus)], "skin") as driver:
        wait_until(lambda: all(patch["updates"] >= updates for patch in driver.status()["patches"]))
        wait_until(lambda: recorder.messages.get("/skin/skin/frame", 0) >= frames)
    with skinware.recording.open(path) as opened:
        assert opened.problems == []
        assert not batches_lost(opened, "skin")
        return opened["skin"].read()


def updates_of(series: Series) -> list[list[tuple[int, bytes]]]:
    """Of each module: time and values, whenever they were new."""
    structure, values = series.structure, series.column("values")
    times = series.column("module_time_ns")
    found: list[list[tuple[int, bytes]]] = []
    for module in range(structure.n_modules):
        mine = values[:, np.asarray(structure.sensor_module) == module]
        is_new = (times[:, module] != 0) & np.r_[True, np.diff(times[:, module]) != 0]
        rows = np.flatnonzero(is_new)
        found.append([(int(times[row, module]), mine[row].tobytes()) for row in rows])
    return found


def require_equal(
    folder: Path, capture: Callable[[Path], None], driver: type[AnyAdapter], options: Mapping[str, Any]
) -> None:
    """Have something captured, and decode it again; it is captured anew, twice at most, if there is a difference.

    A driver that was held up for long may have asked what it does not ask in the replay, which waits for that.
    """
    for number in range(3):
        file = folder / f"{number}.mcap"
        capture(file)
        compared, _ = check_capture(file, driver, options)
        if compared.difference is None:
            break
    assert compared.difference is None
    assert compared.compared >= 10


@pytest.mark.thorough
@pytest.mark.parametrize("driver", DRIVERS)
def test_every_driver_decodes_its_wire_to_the_same_values(tmp_path: Path, driver: str) -> None:
    kind, options = load_driver(driver), OPTIONS.get(driver, {})

    def capture(file: Path) -> None:
        adapter = kind(kind.Options(**options))
        record(file, adapter, make_bus("virtual", payload_size=adapter.payload_size, driver=driver), 25, updates=12)

    require_equal(tmp_path, capture, kind, options)


class Mistaken(CanAdapter[NoOptions]):
    """Tip, but for its last two taxels, which somebody has exchanged."""

    types, dtype, patches, period_s = Tip.types, Tip.dtype, Tip.patches, Tip.period_s
    _values = Values(0, "u1", 8, to=(0, 1, 2, 3, 4, 5, 7, 6))
    layout = Layout([Frame("all", [Identifier(TIP_IDENTIFIER)], length=(8,), values=_values)])


def test_a_mistake_of_a_decoder_is_found_again(tmp_path: Path, cable: Cable) -> None:
    """Recorded with the mistake, and decoded without it from what was recorded: values differ there, and only there."""
    first, again = tmp_path / "first.mcap", tmp_path / "again.mcap"
    numbers = np.random.default_rng(5)
    with (
        recording(first, with_wires=True) as recorder,
        driving_lines([(Mistaken(NoOptions()), EndOfCable(cable.end))], "skin", wait=False) as driver,
    ):
        for _ in range(40):
            cable.put(TIP_IDENTIFIER, numbers.bytes(8))
            time.sleep(0.02)
        driver.wait()
        wait_until(lambda: recorder.messages.get("/skin/skin/frame", 0) > 15)
    with skinware.recording.open(first) as opened:
        wrong = opened["skin"].read()
        n_frames = len(opened.wires[0].frames())
    assert n_frames == 40
    mended = record(again, Tip(NoOptions()), make_bus(f"replay:{first}"), 15)
    known = {values: at_ns for at_ns, values in updates_of(wrong)[0]}
    found = [values for _, values in updates_of(mended)[0]]
    exchanged = [values[:6] + values[:5:-1] for values in found]
    assert sum(values in known for values in exchanged) >= 10
    assert not any(values in known for values in found if values[6] != values[7])


def item(at_ms: float, identifier: int | None, data: bytes = b"", *, is_sent: bool = False) -> WireItem:
    return WireItem(7_000 * MS + round(at_ms * MS), 0, is_sent, identifier, 0, data)


def begun(items: Sequence[WireItem], **how: Any) -> RecordedWire:
    wire = RecordedWire(iter(items), 7_000 * MS, **how)
    wire.skip(0)
    return wire


def emitted(wire: RecordedWire, until_ms: float, step_ms: float = 1.0) -> list[tuple[float, int]]:
    """(ms, identifier) of what is given by then, if somebody looks each ms."""
    found = []
    for number in range(round(until_ms / step_ms) + 1):
        now_ns = round(number * step_ms * MS)
        found += [(frame.time_ns / MS, frame.identifier) for frame in wire.emit(now_ns)]
    return found


def test_frames_come_with_their_own_times() -> None:
    wire = RecordedWire(iter([item(5, 1), item(6.5, 2), item(20, 3)]), 7_005 * MS)
    assert wire.next_due_ns() is None
    assert wire.skip(0) == 0
    assert wire.next_due_ns() == 0
    assert emitted(wire, 30, 4) == [(0, 1), (1.5, 2), (15, 3)]
    assert wire.next_due_ns() is None
    assert wire.totals()["frames"] == 3


def test_speed() -> None:
    wire = begun([item(0, 1), item(10, 2), item(30, 3)], speed=2.0)
    assert emitted(wire, 30) == [(0, 1), (5, 2), (15, 3)]


def test_at_full_speed_only_questions_are_waited_for() -> None:
    items = [item(0, 1), item(900, 2), item(1800, 0x10, is_sent=True), item(2700, 3), item(3600, 4)]
    wire = RecordedWire(iter(items), 7_000 * MS, speed=math.inf)
    wire.skip(5 * MS)
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(6 * MS)] == [(5 * MS, 1), (6 * MS, 2)]
    assert wire.emit(7 * MS) == []
    assert wire.skip(500 * MS) == 0
    wire.receive(0x10, b"", 600 * MS)
    assert wire.next_due_ns() == 600 * MS
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(601 * MS)] == [(601 * MS, 3), (601 * MS, 4)]


def test_an_answer_comes_after_its_question_with_the_same_delay() -> None:
    items = [item(0, 0x10, is_sent=True), item(2, 0x20), item(50, 0x10, is_sent=True), item(52, 0x20)]
    wire = begun(items)
    assert emitted(wire, 30) == []
    wire.receive(0x11, b"", 30 * MS)  # another question
    assert wire.emit(31 * MS) == []
    wire.receive(0x10, b"", 40 * MS)
    assert wire.next_due_ns() == 40 * MS
    assert [frame.time_ns for frame in wire.emit(41 * MS)] == []
    assert [frame.time_ns for frame in wire.emit(45 * MS)] == [42 * MS]
    wire.receive(0x10, b"", 80 * MS)  # earlier than it was: the answer comes when it came
    assert [frame.time_ns for frame in wire.emit(100 * MS)] == [92 * MS]


def test_a_question_that_is_repeated_is_not_taken_for_the_next_one() -> None:
    items = [item(0, 0x10, b"a", is_sent=True), item(2, 1), item(10, 0x10, b"b", is_sent=True), item(12, 2)]
    wire = begun(items)
    wire.receive(0x10, b"a", 1 * MS)
    wire.receive(0x10, b"a", 2 * MS)  # its answer was not here yet
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(40 * MS)] == [(3 * MS, 1)]
    wire.receive(0x10, b"b", 50 * MS)
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(60 * MS)] == [(52 * MS, 2)]


def test_a_question_that_is_not_asked_any_more_is_waited_for_once() -> None:
    items = [item(0, 0x10, is_sent=True), item(1, 1), item(10, 0x10, is_sent=True), item(11, 2)]
    wire = begun(items)
    assert wire.next_due_ns() == 2000 * MS
    assert emitted(wire, 2100) == [(2001, 1), (2011, 2)]


def test_a_question_that_comes_earlier_than_it_did_is_answered_at_once() -> None:
    """Whoever was held up when it was recorded: the answer came in time then, and must do so now."""
    items = [item(0, 0x10, b"a", is_sent=True), item(1, 1), item(900, 0x10, b"b", is_sent=True), item(902, 2)]
    wire = begun(items)
    wire.receive(0x10, b"a", 0)
    assert emitted(wire, 5) == [(1, 1)]
    wire.receive(0x10, b"b", 6 * MS)
    assert wire.next_due_ns() == 6 * MS
    assert wire.emit(6 * MS) == []
    assert wire.next_due_ns() == 8 * MS
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(8 * MS)] == [(8 * MS, 2)]


def test_an_answer_that_was_read_late_comes_soon_after_its_question() -> None:
    """Whoever was held up read it late, and took it. Whoever is not would have given it up by then."""
    items = [item(0, 0x10, b"a", is_sent=True), item(300, 1), item(301, 2), item(310, 0x10, b"b", is_sent=True)]
    wire = begun([*items, item(315, 0x10, b"c", is_sent=True), item(329, 3)])
    wire.receive(0x10, b"a", 0)
    assert emitted(wire, 60) == [(20, 1), (21, 2)]
    wire.receive(0x10, b"b", 60 * MS)
    wire.receive(0x10, b"c", 70 * MS)  # the one before had no answer then, either
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(90 * MS)] == [(84 * MS, 3)]


def test_an_answer_comes_at_once_to_who_asks_again() -> None:
    items = [item(0, 0x10, b"a", is_sent=True), item(15, 1), item(16, 2), item(20, 0x10, b"a", is_sent=True)]
    wire = begun([*items, item(21, 3)])
    wire.receive(0x10, b"a", 0)
    assert emitted(wire, 9) == []
    wire.receive(0x10, b"a", 10 * MS)
    assert wire.next_due_ns() == 10 * MS
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(10 * MS)] == [(10 * MS, 1)]
    assert wire.next_due_ns() == 11 * MS, "the rest of it has its own delay, and so has the next answer"
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(11 * MS)] == [(11 * MS, 2), (11 * MS, 3)]


def test_what_comes_by_itself_comes_at_its_time_whatever_is_asked() -> None:
    items = [item(0, 0x10, is_sent=True), item(2, 1), item(50, 2), item(100, 3)]
    wire = begun(items)
    wire.receive(0x10, b"", 0)
    assert emitted(wire, 10) == [(2, 1)]
    wire.receive(0x10, b"", 10 * MS)
    wire.receive(0x11, b"", 20 * MS)
    assert [(frame.time_ns, frame.identifier) for frame in wire.emit(200 * MS)] == [(50 * MS, 2), (100 * MS, 3)]


def test_who_only_listens_is_not_waited_for() -> None:
    wire = begun([item(0, 0x10, is_sent=True), item(1, 1)], waits=False)
    assert emitted(wire, 2) == [(1, 1)]


def test_error_and_remote_frames_are_not_sent_again() -> None:
    wire = begun([item(0, ERROR_FLAG | 4, bytes(8)), item(0, REMOTE_FLAG | 5), item(0, 6)])
    assert emitted(wire, 1) == [(0, 6)]


def test_the_end_is_told(caplog: pytest.LogCaptureFixture) -> None:
    wire = begun([item(0, 1)], name="replay:walk.mcap (can0)")
    emitted(wire, 1)
    emitted(wire, 1)
    assert [record.message for record in caplog.records] == ["replay:walk.mcap (can0): the recording is over"]


def two_wires(path: Path) -> None:
    def fill(taps: dict[tuple[str, str], WireTap]) -> None:
        keep(taps, "torso", "can0", [Sent(number * MS, 0x100 + number, b"a") for number in range(10)])
        keep(taps, "torso", "can1", [Sent(0, 0x7FF, b"b")])
        keep(taps, "other", "can0", [Sent(0, 0x7FE, b"c")])

    write_recording(path, fill)


@pytest.mark.parametrize(
    ("options", "identifiers"),
    [
        ("?bus=can1", [0x7FF]),
        ("?bus=can0&driver=other", [0x7FE]),
        ("?bus=can0&driver=torso&start=0.0025&end=0.0045", [0x103, 0x104]),
        ("?bus=can0&driver=torso&speed=4", list(range(0x100, 0x10A))),
    ],
)
def test_one_bus_of_several_and_part_of_the_time(tmp_path: Path, options: str, identifiers: list[int]) -> None:
    path = tmp_path / "walk.mcap"
    two_wires(path)
    bus, batch = make_bus(f"replay:{path}{options}"), FrameBatch(100)
    bus.open()
    try:
        wait_until(lambda: bus.receive(batch, 3) >= 0 and len(batch) >= len(identifiers))
        rows = batch.wire[batch.start : batch.stop]
        assert rows["identifier"].tolist() == identifiers
        if "speed=4" in options:
            assert set(np.diff(batch.time_ns[batch.start : batch.stop]).tolist()) == {MS // 4}
    finally:
        bus.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("", "which bus? there are: bus=can0&driver=other, bus=can0&driver=torso, bus=can1&driver=torso"),
        ("?bus=can0", "which bus? there are"),
        ("?bus=can7", "no bus can7; there are"),
        ("?speed=1e-300", "speed"),
        ("?start=1e300", "start"),
        ("?sped=2", "sped"),
    ],
)
def test_what_is_not_clear_is_refused(tmp_path: Path, options: str, words: str) -> None:
    path = tmp_path / "walk.mcap"
    two_wires(path)
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        make_bus(f"replay:{path}{options}")


def test_files_that_cannot_be_replayed(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        make_bus(f"replay:{tmp_path}/nothing.mcap")
    (tmp_path / "text").write_text("text")
    with pytest.raises(ConfigurationError, match=r"no log of a CAN bus: .* are read, recordings too"):
        make_bus(f"replay:{tmp_path}/text")
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP" + bytes(100))
    with pytest.raises(BadRecording, match="not a recording"):
        make_bus(f"replay:{tmp_path}/bad.mcap")
    write_recording(tmp_path / "without.mcap", lambda taps: None)
    with pytest.raises(ConfigurationError, match="no wire was recorded: skin-record --wire records them"):
        make_bus(f"replay:{tmp_path}/without.mcap")


def test_two_recorded_buses_are_two_places() -> None:
    places = [
        BusName.of(f"replay:walk.mcap?bus={bus}&speed={speed}").place for bus in ("can0", "can1") for speed in (1, 2)
    ]
    assert places[0] == places[1] != places[2] == places[3]


@pytest.mark.thorough
def test_skin_driver_runs_on_a_recording(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    kind = load_driver("roboskin")
    before = record(path, kind(kind.Options()), make_bus("virtual", driver="roboskin"), 40)
    with running("skin-driver", "--driver", "roboskin", "--bus", f"replay:{path}?speed=0.5") as driver:
        driver.wait_for("ready")
        with DriverReader("roboskin") as reader:
            assert reader.structure.sensor_uid.tolist() == before.structure.sensor_uid.tolist()
        driver.stop()
        assert driver.process.returncode == 0
    refused = run("skin-driver", "--driver", "roboskin", "--bus", f"replay:{path}?bus=can9")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert refused.stderr == f"skin-driver: {path}: no bus can9; there are: bus=bus0&driver=skin\n"
