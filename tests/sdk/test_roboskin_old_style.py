"""Boards set up the old way: commands 4C and 4E, skin data in message class 3."""

from __future__ import annotations

from typing import Any

import pytest

from skinware import DriverReader, PatchState
from skinware.errors import ConfigurationError, RequestFailed
from skinware_drivers.can.roboskin_layout import Kind, RoboskinOptions, SpecialBoards
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.hardware import Event
from tests.sdk.driving import commands, driving, emulated, hardware_of, read_until
from tests.sdk.test_roboskin_wire import MS, Rig, halves


def test_class_3_is_skin_only_where_it_was_said() -> None:
    frames = [(time_ns, identifier - 0x100, payload) for time_ns, identifier, payload in halves(3, 5)]
    usual, old = Rig(), Rig(old_style=True, boards=(7,))
    assert usual.feed(frames) == []
    assert usual.count("unknown") == 2
    assert old.feed(frames) == [3]
    assert old.values(3) == [5] * 12
    assert old.feed(halves(3, 6)) == []  # the new class, which a board set up the old way does not send
    assert old.count("unknown") == 2


def test_an_idle_triangle_as_on_the_wire() -> None:
    rig = Rig(old_style=True)
    head, tail = bytes.fromhex("40F0F0F0F0F0F0F0"), bytes.fromhex("C0F0F0F0F0F08010")
    assert rig.feed([(MS, 0x37F, head), (2 * MS, 0x37F, tail)]) == [15]
    assert [bool(status) for status in rig.status(15)] == [k in (0, 11) for k in range(12)]


@pytest.mark.usefixtures("hurry")
def test_old_boards_are_told_4c_and_4e_and_stream() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(7, 8), pattern="idle", boot_s=0.1)
    modules = (Kind(8, tuple(range(4, 16)), enabled=False),)
    options: dict[str, Any] = {
        "old_style": True,
        "period_ms": 40,
        "boards": (7, 8),
        "skin_type": 1,
        "kind": "fingertip",
    }
    with driving(bus, modules=modules, **options) as running, DriverReader("roboskin") as reader:
        assert reader.structure.n_modules == 16 + 4
        read_until(reader, lambda f: not f.status.any())
        assert reader.bus_counters(reader.read())[0]["unknown"] == 0
        before = len(commands(log))
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        read_until(reader, lambda f: f.patch_state[1] != PatchState.LIVE)
        read_until(reader, lambda f: not f.status.any())
        again = [(i, p) for _, i, p in commands(log)[before:] if p != "1c0200"]
    messages = list(dict.fromkeys((i, p) for _, i, p in commands(log)[:before] if p != "1c0200"))
    of_8 = [(0x208, "4c01010300 22 d430".replace(" ", "")), (0x208, "4e0222f0090f000a")]
    assert messages == [
        (0x207, "4c0101030022d430"),
        of_8[0],
        (0x207, "4e0222f009ffff0a"),
        of_8[1],
    ]
    assert [message for message in again if message[0] == 0x208][:2] == of_8
    assert [(i, p) for _, i, p in commands(log)][-2:] == [(0x207, "0701"), (0x208, "0701")]


@pytest.mark.usefixtures("hurry")
def test_an_mtb4_set_up_the_old_way_sends_everything_every_40_ms_in_class_4() -> None:
    bus = emulated(boards=(7, 8), mtb3=(7,), pattern="idle")
    modules = tuple(Kind(board, (0, 1), enabled=False) for board in (7, 8))
    with driving(bus, old_style=True, modules=modules), DriverReader("roboskin") as reader:
        assert reader.structure.n_modules == 14 + 16
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.patch_state.tolist() == [PatchState.LIVE] * 2
        with pytest.raises(RequestFailed, match="board 8 is an MTB4: configured the old way, it sends every 40 ms"):
            reader.call("rate", hz=10)


@pytest.mark.usefixtures("hurry")
def test_old_boards_are_silenced_and_woken() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(7, 8), pattern="idle")
    with driving(bus, old_style=True), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))

        def told() -> list[str]:
            return [p[:4] for _, i, p in commands(log)[before:] if i == 0x207 and p != "1c0200"]

        reader.call("enable", patch="board 7", on=False)
        read_until(reader, lambda f: f.patch_state[0] == PatchState.STALE)
        reader.call("rebaseline")
        frame = read_until(reader, lambda f: f.patch_state[1] == PatchState.LIVE)
        read_until(reader, lambda f: f.sequence > frame.sequence + 10 and f.patch_state[0] == PatchState.STALE)
        assert told() == ["0701", "4c01", "4e02", "0701"]
        reader.call("enable", patch="board 7")
        read_until(reader, lambda f: not f.status.any())
        assert told()[4:6] == ["4c01", "4e02"]


def test_a_listener_hears_old_boards() -> None:
    bus = emulated(boards=(7, 8), mtb3=(7,), listen_only=True)
    for board in (7, 8):
        for payload in ("4C 01 01 01 00 22 00 00", "4E 02 22 F0 08 03 00 0A"):
            bus.hardware.receive(0x200 | board, bytes.fromhex(payload), bus._clock())
    with driving(bus, listen_only=True, old_style=True, learn_s=0.3), DriverReader("roboskin") as reader:
        assert reader.structure.n_modules == 2 + 16
        read_until(reader, lambda f: not f.status.any())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"period_ms": 210}, "a period of 210 ms, the most is 209"),
        ({"special_boards": (SpecialBoards((7,), period_ms=255),)}, "a period of 255 ms"),
        ({"skin_type": 8}, "skin type 8 needs the new commands"),
        ({"modules": (Kind(7, (1,), shift=3),)}, "board 7: the old set-up has no shift"),
    ],
)
def test_what_the_old_way_cannot_do_is_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        RoboskinOptions(old_style=True, **options)


@pytest.mark.parametrize("last", ["4c", "4e"])
def test_boards_are_silenced_when_the_driver_ends_in_the_middle_of_the_set_up(last: str) -> None:
    """Set up the old way, a board sends from the first command on."""
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(7, 8))
    with driving(bus, wait=False, boards=(7, 8), old_style=True, period_ms=209) as running:
        wait_until(lambda: any(payload.startswith(last) for _, _, payload in commands(log)))
        assert running.runner is not None
        assert not running.runner.ready
    assert [(i, p) for _, i, p in commands(log)][-2:] == [(0x207, "0701"), (0x208, "0701")]
