"""What boards that differ are told, in which order, and which triangles are on afterwards: as the firmware sees it."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import DriverReader, PatchState
from skinware.errors import ConfigurationError
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import Kind, RoboskinOptions, SpecialBoards
from skinware_drivers.can.roboskin_setup import BoardSetUp
from skinware_drivers.virtual.hardware import Event
from skinware_drivers.virtual.roboskin.boards import EmulatedBoard
from tests.sdk.driving import commands, driving, emulated, hardware_of, read_until
from tests.virtual.rig import Rig

MS = 1_000_000

ARM: dict[str, Any] = {
    "boards": (13, 14),
    "enabled": False,
    "special_boards": (SpecialBoards((14,), period_ms=50, skin_type=1, no_load=0xF0),),
    "modules": (
        Kind(14, tuple(range(7)), enabled=True, shift=0, cdc_offset=0x2000),
        Kind(14, (8, 9, 10, 11), kind="palm", enabled=True, shift=2, cdc_offset=0x2200),
        Kind(14, (11,), kind="palm", thermal=(7,)),
        Kind(13, tuple(range(16)), enabled=True),
    ),
}
"""The hand and a forearm board of a real arm (robotology/robots-configuration, iCubGenova02)."""


def sent(set_up: BoardSetUp) -> list[bytes]:
    return [*set_up.first, *set_up.special_board, *set_up.special_triangles]


@pytest.mark.usefixtures("hurry")
def test_an_arm_is_set_up_in_the_real_order_and_all_that_was_enabled_is_live() -> None:
    log: list[Event] = []
    with driving(emulated(log, boards=(13, 14)), **ARM), DriverReader("roboskin") as reader:
        structure = reader.structure
        assert structure.n_modules == 16 + 11
        assert [bytes(kind) for kind in structure.module_kind[16:]] == [b"fingertip"] * 7 + [b"palm"] * 4
        read_until(reader, lambda f: not f.status.any())
        assert not any(counters["unknown"] for counters in reader.bus_counters(reader.read()))
    first_ns: dict[tuple[int, str], int] = {}  # a busy machine takes a board for restarted and tells it again
    for time_ns, identifier, payload in commands(log):
        if payload != "1c0200":
            first_ns.setdefault((identifier, payload), time_ns)
    assert list(first_ns) == [
        (0x20D, "4d0032f0"),
        (0x20E, "4d0032f0"),
        (0x20D, "50000f02000022"),
        (0x20E, "50000f02000022"),
        (0x20E, "4d0132f0"),
        (0x20D, "50000f02010022"),
        (0x20E, "50000600010020"),
        (0x20E, "50080b02010022"),
        (0x20D, "0700"),
        (0x20E, "0700"),
        (0x20D, "0701"),
        (0x20E, "0701"),
    ]
    times = list(first_ns.values())
    assert times[4] - times[3] >= 60 * MS, "the wait after the first configuration"
    assert min(times[5] - times[4], times[8] - times[7]) >= 10 * MS


def test_a_restarted_special_board_gets_its_own_set_up_again(hurry: None) -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(13, 14), boot_s=0.1, pattern="idle")
    with driving(bus, **ARM) as running, DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        running.do(lambda: hardware_of(bus).restart(14, bus._clock()))
        read_until(reader, lambda f: f.patch_state[1] != PatchState.LIVE)
        read_until(reader, lambda f: not f.status.any())
        again = [(i, payload) for _, i, payload in commands(log)[before:] if payload != "1c0200"]
    expected = ["4d0032f0", "50000f02000022", "4d0132f0", "50000600010020", "50080b02010022", "0700"]
    assert [payload for i, payload in again if i == 0x20E][: len(expected)] == expected


@pytest.mark.usefixtures("hurry")
def test_triangles_that_a_special_configuration_switched_off_are_left_out_and_named(
    caplog: pytest.LogCaptureFixture,
) -> None:
    special = (SpecialBoards((8, 9), skin_type=1),)
    modules = (Kind(9, (4, 5), enabled=True), Kind(9, (15,), enabled=False))
    options: dict[str, Any] = {"special_boards": special, "modules": modules}
    bus = emulated(boards=(7, 8, 9))
    with (
        caplog.at_level(logging.INFO),
        driving(bus, boards=(7, 8, 9), **options),
        DriverReader("roboskin") as reader,
    ):
        assert [bytes(name).decode() for name in reader.structure.patch_name] == ["board 7", "board 9"]
        assert reader.structure.n_modules == 16 + 2
        read_until(reader, lambda f: not f.status.any())
    why = "are off: its special configuration switched them off, and nothing switches them on again"
    assert f"board 8: triangles 0-15 {why}" in caplog.text
    assert f"board 9: triangles 0-3, 6-14 {why}" in caplog.text
    assert "board 9: triangles 15 are off, as configured" in caplog.text
    assert "board 7: triangles" not in caplog.text


def test_boards_of_different_periods_all_stay_fresh(hurry: None) -> None:
    special = (SpecialBoards((8,), period_ms=20),)
    modules = (Kind(8, tuple(range(16)), enabled=True),)
    bus = emulated(boards=(7, 8), pattern="idle")
    with driving(bus, period_ms=100, special_boards=special, modules=modules), DriverReader("roboskin") as reader:
        first = last = read_until(reader, lambda f: not f.status.any())
        fresh = 0
        while fresh < 40:  # in a row: four periods of the slow board and more
            last = read_until(reader, lambda _: True)
            fresh = 0 if last.status.any() else fresh + 1
            assert last.sequence < first.sequence + 2000
        updates = [
            counters["updates"] - before["updates"]
            for counters, before in zip(reader.patch_counters(last), reader.patch_counters(first), strict=True)
        ]
        assert updates[1] > 3 * updates[0] > 0


def test_a_rate_for_all_holds_for_special_boards_too(hurry: None) -> None:
    log: list[Event] = []
    special = (SpecialBoards((8,), period_ms=100, skin_type=2),)
    modules = (Kind(8, tuple(range(16)), enabled=True),)
    bus = emulated(log, boards=(7, 8), pattern="idle")
    with driving(bus, special_boards=special, modules=modules), DriverReader("roboskin") as reader:
        read_until(reader, lambda f: not f.status.any())
        before = len(commands(log))
        assert reader.call("rate", hz=50) == {"bus0": 50.0}
        again = [(i, payload) for _, i, payload in commands(log)[before:] if payload.startswith("4d")]
        read_until(reader, lambda f: not f.status.any())
    assert again[:3] == [(0x207, "4d0014f0"), (0x208, "4d0014f0"), (0x208, "4d0214f0")]


def test_a_listener_shows_what_it_hears_and_takes_only_kinds_from_the_configuration() -> None:
    bus = emulated(boards=(7,), streaming=True, listen_only=True)
    modules = (Kind(7, (1,), kind="palm", enabled=True), Kind(7, (2,), enabled=False))
    options: dict[str, Any] = {"boards": (7,), "enabled": False, "modules": modules}
    with driving(bus, listen_only=True, learn_s=0.3, **options), DriverReader("roboskin") as reader:
        assert [bytes(kind) for kind in reader.structure.module_kind] == [b"triangle", b"palm"] + [b"triangle"] * 14
        read_until(reader, lambda f: not f.status.any())


def test_a_kind_alone_tells_the_board_nothing() -> None:
    set_up = BoardSetUp(RoboskinOptions(modules=(Kind(7, (1, 2), kind="palm"),)), 7)
    assert sent(set_up) == [bytes.fromhex("4D0032F0"), bytes.fromhex("50000F02010022")]
    assert set_up.enabled == set(range(16))


def test_a_setting_alone_leaves_triangles_as_they_are() -> None:
    modules = (Kind(7, (0, 1), enabled=False), Kind(7, (1, 2), shift=5))
    set_up = BoardSetUp(RoboskinOptions(modules=modules), 7)
    assert [payload.hex() for payload in set_up.special_triangles] == [
        "50000102000022",
        "50020205010022",
        "50010105000022",
    ]
    assert set_up.enabled == set(range(2, 16))


triangles = st.lists(st.integers(0, 15), max_size=8).map(tuple)
optional_bool = st.sampled_from([None, True, False])
modules = st.builds(
    Kind,
    board=st.just(7),
    triangles=triangles,
    enabled=optional_bool,
    shift=st.none() | st.integers(0, 8),
    cdc_offset=st.none() | st.integers(0, 0xFFFF),
)
specials = st.builds(
    SpecialBoards,
    boards=st.sampled_from([(7,), (8,)]),
    period_ms=st.none() | st.integers(1, 200),
    skin_type=st.none() | st.integers(0, 3),
    no_load=st.none() | st.integers(0, 255),
)


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(
    modules=st.lists(modules, max_size=4).map(tuple),
    specials=st.lists(specials, max_size=3).map(tuple),
    enabled=st.booleans(),
    is_mtb3=st.booleans(),
)
def test_what_the_driver_believes_to_be_on_is_on_in_the_firmware(
    modules: tuple[Kind, ...], specials: tuple[SpecialBoards, ...], enabled: bool, is_mtb3: bool
) -> None:
    options = RoboskinOptions(boards=(7,), modules=modules, special_boards=specials, enabled=enabled)
    set_up = BoardSetUp(options, 7)
    rig = Rig(boards=(7,), mtb3=(7,) if is_mtb3 else ())
    for payload in sent(set_up):
        rig.send(0x207, payload.hex())
    (board,) = rig.hardware.devices.values()
    assert isinstance(board, EmulatedBoard)
    assert set_up.enabled == {t for t in range(16) if board._active[t]}
    assert board._period_ns == set_up.period_ms * MS
    assert not set_up.wiped & set_up.enabled
    if not any(special.sets_board and 7 in special.boards for special in specials):
        assert not set_up.wiped


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"boards": (7, 8), "enabled": False}, "boards 7, 8: the configuration leaves all triangles switched off"),
        ({"special_boards": (SpecialBoards((0,)),)}, "board address 0"),
        ({"modules": (Kind(7, (1,), thermal=(12,)),)}, "thermal channels .12,. are not all 0 to 11"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        RoboskinDriver(RoboskinOptions(**options))
