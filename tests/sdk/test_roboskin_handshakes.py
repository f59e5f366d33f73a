"""What the ROBOSKIN driver sends to boards, when, and what it takes for an answer: emulated boards obey and log it."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from skinware import DriverReader, PatchState, Status
from skinware_drivers.can import roboskin, roboskin_setup
from skinware_drivers.can.roboskin_layout import Kind
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import Event
from skinware_drivers.virtual.roboskin.skin import EmulatedRoboskin
from skinware_drivers.virtual.roboskin.touch import EmulatedRoboskinOptions as EmulatorOptions
from tests.sdk.conftest import HURRIED_WAIT_S
from tests.sdk.driving import (
    Chatter,
    LateBoards,
    Together,
    commands,
    driving,
    emulated,
    hardware_of,
    read_until,
)

pytestmark = pytest.mark.usefixtures("hurry")
MS = 1_000_000


def sent(log: list[Event]) -> list[tuple[int, str]]:
    return [(identifier, payload) for _, identifier, payload in commands(log)]


def patches_of(reader: DriverReader) -> list[str]:
    return [bytes(name).decode() for name in reader.structure.patch_name]


# Who is there


def test_named_boards_are_asked_one_by_one_which_the_older_kind_answers() -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(7, 8), mtb3=(7, 8)), boards=(7, 8)), DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.patch_state.tolist() == [PatchState.LIVE] * 2
    assert sent(log)[:2] == [(0x207, "1c0200"), (0x208, "1c0200")]
    assert 0x70F not in {identifier for identifier, _ in sent(log)}


def test_a_join_request_sends_nothing_to_boards_that_are_streaming() -> None:
    """Discovery would silence every MTB3 on the bus."""
    log: list[Event] = []
    with driving(emulated(log, boards=(7, 8), mtb3=(7, 8))) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        assert running.runner is not None
        running.do(running.runner.join)
        later = read_until(reader, lambda f: f.sequence >= frame.sequence + 10 and not (f.status & Status.STALE).any())
        assert later.generation == frame.generation
        assert len(commands(log)) == before
    assert not [event for event in log if event.event == "board_silenced"]


def test_only_applications_of_possible_addresses_are_boards() -> None:
    strangers = Chatter(
        (0x780, bytes.fromhex("FF0B0119")),  # four bytes: a boot loader
        (0x790, bytes.fromhex("FE0B011900")),
        (0x700, bytes.fromhex("FF0B011900")),
        (0x7F0, bytes.fromhex("FF0B011900")),
        (0x7A1, bytes.fromhex("FF0B011900")),  # an answer to another host
    )
    both = Together(EmulatedRoboskin(EmulatorOptions(boards=(7,))), strangers)
    with driving(VirtualCanBus("", hardware=both)), DriverReader("roboskin") as reader:
        assert patches_of(reader) == ["board 7"]


def test_boards_without_skin_are_left_alone_unless_they_are_named(caplog: pytest.LogCaptureFixture) -> None:
    strain2 = Chatter((0x790, bytes.fromhex("FF0C010200")))
    both = Together(EmulatedRoboskin(EmulatorOptions(boards=(7, 8), mtb3=(8,))), strain2)
    with driving(VirtualCanBus("", hardware=both)), DriverReader("roboskin") as reader:
        assert patches_of(reader) == ["board 7", "board 8"]
        read_until(reader, lambda f: not f.status.any())
    assert {identifier for identifier, _ in strain2.heard} == {0x70F, 0x207, 0x208}
    assert "board 9 is of type 12, which is not known to have skin: left alone" in caplog.text


def test_boards_named_in_any_order_are_sorted_by_address() -> None:
    with driving(emulated(boards=(9, 7)), boards=(9, 7)), DriverReader("roboskin") as reader:
        assert patches_of(reader) == ["board 7", "board 9"]
        assert np.all(np.diff(reader.structure.sensor_uid.astype(np.int64)) > 0)
        read_until(reader, lambda f: not f.status.any())


def test_every_bus_has_its_own_conversation() -> None:
    with driving(emulated(boards=(7,)), emulated(boards=(8, 9))), DriverReader("roboskin") as reader:
        assert patches_of(reader) == ["board 7", "board 8", "board 9"]
        assert reader.structure.patch_bus.tolist() == [0, 1, 1]
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.structure.sensor_uid[[0, 192]].tolist() == [7 << 16, 1 << 32 | 8 << 16]


def test_a_named_board_that_sends_no_data_is_named_and_set_up_when_it_appears(
    caplog: pytest.LogCaptureFixture,
) -> None:
    log: list[Event] = []
    late_log: list[Event] = []
    present = EmulatedRoboskin(EmulatorOptions(boards=(7,)), log=log)
    late = LateBoards(EmulatedRoboskin(EmulatorOptions(boards=(8,)), log=late_log))
    bus = VirtualCanBus("", hardware=Together(present, late))
    with caplog.at_level(logging.WARNING), driving(bus, boards=(7, 8)) as running, DriverReader("roboskin") as reader:
        wait_until(lambda: "bus0: board 8 sends no data" in caplog.text)
        frame = read_until(reader, lambda f: not f.status[:192].any())
        assert frame.patch_state.tolist() == [PatchState.LIVE, PatchState.EXPECTED]
        assert (frame.status[192:] == Status.NEVER_SEEN).all()
        before = len(commands(log))
        running.do(lambda: setattr(late, "present", True))
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.patch_state.tolist() == [PatchState.LIVE] * 2
        assert len(commands(log)) == before  # the other one is left alone
    assert "board 7 sends no data" not in caplog.text
    assert sent(late_log)[:4] == [(0x208, "1c0200"), (0x208, "4d0032f0"), (0x208, "50000f02010022"), (0x208, "0700")]


def test_named_boards_of_which_none_answers_are_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    late = LateBoards(EmulatedRoboskin(EmulatorOptions(boards=(7, 8))))
    bus = VirtualCanBus("", hardware=late)
    with (
        caplog.at_level(logging.WARNING),
        driving(bus, wait=False, boards=(7, 8)) as running,
    ):
        wait_until(lambda: bus.counters.sent >= 6)
        assert "bus0: none of the boards 7, 8 answers; waiting for one to appear" in caplog.text
        late.present = True
        assert running.ready.wait(30)
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not f.status.any())
    assert caplog.text.count("none of the boards") == 1


@pytest.mark.parametrize("boards", [(), (7,)], ids=["discovered", "named"])
def test_a_bus_without_boards_holds_no_other_up_and_joins_later(
    monkeypatch: pytest.MonkeyPatch, boards: tuple[int, ...]
) -> None:
    monkeypatch.setattr(roboskin_setup, "_REPLY_S", 0.05)
    late = LateBoards(EmulatedRoboskin(EmulatorOptions(boards=(7,), pattern="idle")))
    log: list[Event] = []
    buses = emulated(log, boards=(7,), pattern="idle"), VirtualCanBus("", hardware=late)
    with driving(*buses, boards=boards) as running, DriverReader("roboskin") as reader:
        frame = read_until(reader, lambda f: not f.status.any())
        assert patches_of(reader) == ["board 7"]
        asked = buses[1].counters.sent
        later = read_until(reader, lambda f: buses[1].counters.sent >= asked + 3)
        assert later.generation == frame.generation
        before = len(commands(log))
        running.do(lambda: setattr(late, "present", True))
        wait_until(lambda: reader.refresh() is not None and reader.structure_changed)
        reader.reattach()
        frame = read_until(reader, lambda f: not f.status.any())
        assert frame.structure.sensor_uid[[0, 192]].tolist() == [7 << 16, 1 << 32 | 7 << 16]
        assert len(commands(log)) == before  # to set it up again would move its baseline


# What they are told


def test_every_option_reaches_the_boards() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7,))
    with driving(bus, period_ms=20, skin_type=2, no_load=0xEB, shift=3, cdc_offset=0x2345):
        pass
    assert sent(log) == [
        (0x70F, "ff"),
        (0x207, "4d0214eb"),
        (0x207, "50000f03014523"),
        (0x207, "0700"),
        (0x207, "0701"),
    ]


def test_special_triangles_follow_the_wait_and_go_to_their_board_only() -> None:
    log: list[Event] = []
    modules = (
        Kind(board=7, triangles=(0, 1, 5), kind="fingertip", shift=4, cdc_offset=0x2345),
        Kind(board=8, triangles=(15,), enabled=False),
    )
    bus = emulated(log, boards=(7, 8), pattern="idle", boot_s=0.1)
    with driving(bus, modules=modules) as running, DriverReader("roboskin") as reader:
        set_up = commands(log)
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        read_until(reader, lambda f: f.patch_state[1] != PatchState.LIVE)
        read_until(reader, lambda f: not f.status.any())
        again = commands(log)[len(set_up) :]
    special = [(0x207, "50000104014523"), (0x207, "50050504014523"), (0x208, "500f0f02000022")]
    assert [(i, p) for _, i, p in set_up][-5:] == [*special, (0x207, "0700"), (0x208, "0700")]
    times = {(identifier, payload): time_ns for time_ns, identifier, payload in set_up}
    assert times[special[0]] - times[0x208, "50000f02010022"] >= HURRIED_WAIT_S * 1000 * MS
    assert times[0x207, "0700"] - times[special[-1]] >= 10 * MS
    expected = [(0x208, "4d0032f0"), (0x208, "50000f02010022"), special[-1], (0x208, "0700")]
    assert [(i, p) for _, i, p in again if p != "1c0200"] == [*expected]
    assert {identifier for _, identifier, _ in again} == {0x208}


# Boards that restart


def test_a_restarted_board_of_the_older_kind_is_set_up_while_the_others_stream_on() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(7, 8), pattern="idle", boot_s=0.1)
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).restart(8, bus._clock()))
        read_until(reader, lambda f: f.patch_state[1] != PatchState.LIVE)
        read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE] * 2 and not f.status[:192].any())
    assert not [event for event in log if event.event == "board_silenced"]


def test_boards_of_a_second_bus_are_set_up_again_on_that_bus(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(roboskin, "_AFTER_CONFIGURATION_S", 0.5)  # states are logged four times a second
    first_log: list[Event] = []
    log: list[Event] = []
    first, second = emulated(first_log, boards=(7, 8)), emulated(log, boards=(7, 8), boot_s=0.1, pattern="idle")
    with caplog.at_level(logging.WARNING), driving(first, second) as running:
        wait_until(lambda: len(running.status()["patches"]) == 4)  # a held-up driver finds the last one late
        with DriverReader("roboskin") as reader:
            read_until(reader, lambda f: not (f.status & (Status.NEVER_SEEN | Status.STALE)).any())
            before, first_before = len(commands(log)), len(commands(first_log))
            running.do(lambda: hardware_of(second).restart(8, second._clock()))
            read_until(reader, lambda f: f.patch_state[3] != PatchState.LIVE)
            read_until(reader, lambda f: f.patch_state[3] == PatchState.LIVE)
            assert {identifier for _, identifier, _ in commands(log)[before:]} == {0x208}
            assert len(commands(first_log)) == first_before
            wait_until(lambda: "bus1: board 8 is live again" in caplog.text)
    assert "bus1: board 8 is silent but answers: it has restarted" in caplog.text


def test_a_board_that_moved_its_baseline_is_trusted_again_once_it_was_set_up() -> None:
    bus = emulated(boards=(7, 8), pattern="idle", boot_s=0.1)
    with driving(bus) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        hardware = hardware_of(bus)
        running.do(lambda: hardware.set_triangle(7, 1, "no_ack", bus._clock()))
        read_until(reader, lambda f: bool((f.status[:192] & Status.SUSPECT).all()))
        running.do(lambda: hardware.set_triangle(7, 1, "ack", bus._clock()))
        running.do(lambda: hardware.restart(7, bus._clock()))
        read_until(reader, lambda f: f.patch_state[0] != PatchState.LIVE)
        read_until(reader, lambda f: not f.status.any())
        # one more cycle without acknowledgement is the first one of a new count
        running.do(lambda: hardware.set_triangle(7, 1, "no_ack", bus._clock()))
        frame = read_until(reader, lambda f: bool((f.status[:192] & Status.NO_ACK).any()))
        assert not (frame.status & Status.SUSPECT).any()


# Listeners


def test_a_listener_believes_data_of_skin_only() -> None:
    head = bytes.fromhex("40F0F0F0F0F0F0F0")
    strangers = Chatter(
        (0x403, head),  # addresses that no board has
        (0x4F3, head),
        (0x483, bytes.fromhex("41F0F0F0F0F0F0F0")),
        (0x493, head[:3]),
        (0x8000_04A3, head),
        (0x4000_04B3, head),
        (0x5C3, head),
    )
    streaming = EmulatedRoboskin(EmulatorOptions(boards=(7,), streaming=True))
    bus = VirtualCanBus("", hardware=Together(streaming, strangers), listen_only=True)
    with driving(bus, listen_only=True, learn_s=0.3), DriverReader("roboskin") as reader:
        assert patches_of(reader) == ["board 7"]
        frame = read_until(reader, lambda f: reader.bus_counters(f)[0]["unknown"] >= 70)
        assert reader.bus_counters(frame)[0]["sent"] == 0


def test_a_listener_learns_for_as_long_as_it_was_told() -> None:
    early = EmulatedRoboskin(EmulatorOptions(boards=(9,), streaming=True))
    late = LateBoards(EmulatedRoboskin(EmulatorOptions(boards=(7,), streaming=True)))
    bus = VirtualCanBus("", hardware=Together(early, late), listen_only=True)
    with driving(bus, listen_only=True, wait=False, learn_s=1.0) as running:
        wait_until(lambda: bus.counters.frames > 0)
        running.do(lambda: setattr(late, "present", True))
        assert running.ready.wait(30)
        with DriverReader("roboskin") as reader:
            assert patches_of(reader) == ["board 7", "board 9"]
            assert np.all(np.diff(reader.structure.sensor_uid.astype(np.int64)) > 0)


def test_a_listener_keeps_silent_beside_a_board_that_died() -> None:
    bus = emulated(boards=(7, 8), streaming=True, listen_only=True, pattern="idle")
    with driving(bus, listen_only=True, boards=(7, 8), learn_s=0.3) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        running.do(lambda: hardware_of(bus).kill(8, bus._clock()))
        frame = read_until(reader, lambda f: f.patch_state[1] == PatchState.STALE)
        assert running.runner is not None
        running.do(running.runner.join)
        read_until(reader, lambda f: f.sequence >= frame.sequence + 10)
        assert patches_of(reader) == ["board 7", "board 8"]  # who is silent now is not forgotten
    assert bus.counters.sent == bus.counters.send_failures == 0
