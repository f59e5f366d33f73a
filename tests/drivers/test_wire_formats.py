"""The drivers against literal bytes, made by hand from the published descriptions (there are no public dumps)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from skinware import Status
from skinware.errors import ConfigurationError
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.barrett import BarrettDriver, BarrettOptions
from skinware_drivers.can.cyskin_cpm import CyskinCpmDriver, CyskinCpmOptions
from skinware_drivers.can.xela import XelaDriver, XelaOptions
from skinware_drivers.description import assemble
from skinware_drivers.testing.waiting import wait_until
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import WireFrame
from tests.sdk.driving import driving_lines
from tests.specification.decoding import SpecifiedDecoder


def decoded(adapter: AnyAdapter, *frames: tuple[int, str]) -> SpecifiedDecoder:
    decoder = SpecifiedDecoder([adapter.layout], assemble([("bus", adapter.patches)], adapter.types, adapter.dtype))
    batch = FrameBatch(100, 8, decoder.compiled.headroom)
    for number, (identifier, payload) in enumerate(frames):
        batch.append(0, 1 + 130_000 * number, identifier, bytes.fromhex(payload))
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    return decoder


def values(decoder: SpecifiedDecoder, *sensors: int) -> list[int]:
    return [int(decoder.state.values[sensor]) for sensor in sensors]


def seen(decoder: SpecifiedDecoder) -> list[int]:
    return [at for at, status in enumerate(decoder.state.status.tolist()) if status != Status.NEVER_SEEN]


class Ear:
    """Hears what a driver sends, and answers as told."""

    def __init__(self, answers: dict[tuple[int, str], list[tuple[int, str]]]) -> None:
        self.heard: list[tuple[int, str]] = []
        self._answers = answers
        self._frames: list[WireFrame] = []

    def receive(self, identifier: int, payload: bytes, now_ns: int) -> None:
        self.heard.append((identifier, payload.hex()))
        for answer, data in self._answers.get(self.heard[-1], []):
            self._frames.append(WireFrame(now_ns, answer, bytes.fromhex(data)))

    def next_due_ns(self) -> int | None:
        return self._frames[0].time_ns if self._frames else None

    def emit(self, now_ns: int) -> list[WireFrame]:
        frames, self._frames = self._frames, []
        return frames

    def skip(self, now_ns: int) -> int:
        return len(self.emit(now_ns))

    def totals(self) -> dict[str, int]:
        return {}


def sent_by(adapter: AnyAdapter, until: Sequence[tuple[int, str]], **answers: Any) -> list[tuple[int, str]]:
    """Everything that a driver sends, from its start to its end."""
    ear = Ear(answers.get("answers", {}))
    with driving_lines([(adapter, VirtualCanBus("", hardware=ear))], "skin", wait=False):
        wait_until(lambda: set(until) <= set(ear.heard))
    return ear.heard


# XELA


def test_a_uskin_taxel_is_three_big_endian_numbers() -> None:
    decoder = decoded(XelaDriver(XelaOptions()), (0x710, "FF80017EFE901200"), (0x71F, "0000018000FFFF00"))
    assert values(decoder, 0, 1, 2) == [0x8001, 0x7EFE, 0x9012]
    assert values(decoder, 45, 46, 47) == [0x0001, 0x8000, 0xFFFF]
    assert seen(decoder) == [0, 1, 2, 45, 46, 47]
    structure = decoder.tables.structure
    assert structure.sensor_uid[45:].tolist() == [1 << 16 | 15] * 3
    assert [t.name for t in structure.types] == ["shear_x", "shear_y", "pressure"]


@pytest.mark.parametrize(("identifier", "taxel"), [(0x100, 0), (0x110, 1), (0x130, 3), (0x101, 4), (0x135, 23)])
def test_a_uskin_whose_identifiers_are_row_and_column(identifier: int, taxel: int) -> None:
    options = XelaOptions(ids="row_column", first_id=(0x100,), rows=4, columns=6)
    decoder = decoded(XelaDriver(options), (identifier, "0000010002000300"))
    assert values(decoder, 3 * taxel, 3 * taxel + 1, 3 * taxel + 2) == [1, 2, 3]
    assert len(seen(decoder)) == 3


@pytest.mark.parametrize("frame", [(0x720, "00" * 8), (0x70F, "00" * 8), (0x510, "00" * 8), (0x8000_0710, "00" * 8)])
def test_what_is_no_taxel_is_unknown(frame: tuple[int, str]) -> None:
    decoder = decoded(XelaDriver(XelaOptions()), frame)
    assert decoder.state.bus_counters[:, :3].tolist() == [[1, 0, 0]]
    assert seen(decoder) == []


def test_a_uskin_frame_of_another_length_is_not_shown() -> None:
    decoder = decoded(XelaDriver(XelaOptions()), (0x710, "00" * 7), (0x711, ""))
    assert decoder.state.bus_counters[:, :3].tolist() == [[0, 2, 0]]
    assert seen(decoder) == []


def test_uskin_boards_are_started_and_stopped_by_their_numbers() -> None:
    adapter = XelaDriver(XelaOptions(boards=(1, 2), first_id=(0x710, 0x730)))
    heard = sent_by(adapter, [(0x201, "0700"), (0x202, "0700")])
    assert heard[:2] == [(0x201, "0700"), (0x202, "0700")]
    assert heard[-2:] == [(0x201, "0701"), (0x202, "0701")]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"boards": (1, 2)}, "2 boards, but first_id has 1"),
        ({"boards": (0,)}, "give different numbers of 1 to 15"),
        ({"boards": (1, 2), "first_id": (0x710, 0x718)}, "board 2: its identifiers from 0x718 on mix with another"),
        ({"first_id": (0x7F8,)}, "board 1: identifiers from 0x7f8 on go beyond 0x7FF"),
        ({"rows": 17}, "option rows=17"),
    ],
)
def test_uskin_options_that_cannot_be(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        XelaOptions(**options)


# CySkin CPM

SET = [
    (0x405, "0100020003000400"),
    (0x407, "0500060007000800"),
    (0x409, "09000A000B000C00"),
    (0x40B, "0D000E000F00FF10"),
]


def test_a_cpm_finger_is_sixteen_little_endian_numbers_in_an_order_of_its_own() -> None:
    decoder = decoded(CyskinCpmDriver(CyskinCpmOptions()), *SET)
    # the first four go to taxels 11, 15, 14, 12, and so on
    expected = [14, 0x10FF, 13, 15, 11, 12, 9, 10, 7, 5, 8, 1, 4, 6, 3, 2]
    assert decoder.state.values.tolist() == expected
    assert decoder.state.module_time_ns.tolist() == [1]


@pytest.mark.parametrize("lost", range(4))
def test_a_cpm_set_with_a_lost_frame_is_not_shown_and_the_next_one_is(lost: int) -> None:
    adapter = CyskinCpmDriver(CyskinCpmOptions())
    rest = [frame for at, frame in enumerate(SET) if at != lost]
    assert seen(decoded(adapter, *rest)) == []
    assert len(seen(decoded(adapter, *rest, *SET))) == 16


# Barrett

FULL = ["0ABC123DEF456789", "1000001002003004", "2FFFFFFFFFFFFFFF", "3111222333444555", "4AAA000BBB001FFF"]


def test_a_barrett_finger_in_full_format() -> None:
    adapter = BarrettDriver(BarrettOptions())
    decoder = decoded(adapter, *((0x400 | 12 << 5 | 9, payload) for payload in FULL))
    assert values(decoder, *range(24, 48)) == [
        0xABC, 0x123, 0xDEF, 0x456, 0x789, 0, 1, 2, 3, 4, *[0xFFF] * 5,
        0x111, 0x222, 0x333, 0x444, 0x555, 0xAAA, 0, 0xBBB, 1,
    ]  # fmt: skip
    assert seen(decoder) == list(range(24, 48))
    structure = decoder.tables.structure
    assert structure.physical(decoder.state.values, "pressure")[34] == pytest.approx(4095 / 256 * 1e4)
    assert structure.sensor_uid[24] == 12 << 8


def test_frames_of_different_fingers_make_no_whole() -> None:
    adapter = BarrettDriver(BarrettOptions())
    nodes = (11, 11, 12, 11, 11)
    frames = [(0x409 | node << 5, payload) for node, payload in zip(nodes, FULL, strict=True)]
    assert seen(decoded(adapter, *frames)) == []


def test_a_barrett_palm_in_the_format_of_the_ten_strongest() -> None:
    adapter = BarrettDriver(BarrettOptions(format="top10"))
    decoder = decoded(adapter, (0x5C8, "C0007F" + "123456789A"))
    assert decoder.state.bus_counters[:, :3].tolist() == [[0, 0, 0]]
    # bits 23, 22 and 6 to 0 of C0007F are nine cells: 0, 1 and 17 to 23
    assert values(decoder, *range(72, 96)) == [1, 2, *[0] * 15, 3, 4, 5, 6, 7, 8, 9]


def test_a_map_of_more_than_ten_cells_gives_values_to_the_first_ten() -> None:
    decoder = decoded(BarrettDriver(BarrettOptions(format="top10")), (0x568, "FFFFFF" + "FEDCBA9876"))
    assert values(decoder, *range(24)) == [15, 14, 13, 12, 11, 10, 9, 8, 7, 6, *[0] * 14]


def test_a_barrett_hand_is_asked_by_group_5() -> None:
    version = {(node, "00"): [(0x406 | node << 5, "8000C900")] for node in (11, 13)}
    adapter = BarrettDriver(BarrettOptions(nodes=(11, 12, 13)))
    heard = sent_by(adapter, [(0x405, "6a")], answers=version)
    told = [(node, "ea0002000000") for node in (11, 12, 13)]
    assert heard[:6] == [*((node, "00") for node in (11, 12, 13)), *told]
    assert heard[6] == (0x405, "6a")


@pytest.mark.parametrize(
    ("options", "words"),
    [({"nodes": (10,)}, "the hand has 11 to 14"), ({"nodes": ()}, "at least one"), ({"period_ms": 1}, "period_ms=1")],
)
def test_barrett_options_that_cannot_be(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        BarrettOptions(**options)
