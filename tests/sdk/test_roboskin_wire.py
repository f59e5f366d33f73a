"""The ROBOSKIN driver against literal bytes (made from the protocol's description: there is no public dump)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import Status
from skinware.errors import ConfigurationError
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import Kind, RoboskinOptions
from skinware_drivers.decoding.decoder import BUS_COUNTERS, PATCH_COUNTERS
from skinware_drivers.description import assemble
from tests.specification.decoding import SpecifiedDecoder

Wire = tuple[int, int, bytes]  # time_ns, identifier, payload
MS = 1_000_000


class Rig:
    """A decoder for boards, and frames by hand."""

    def __init__(self, boards: Sequence[int] = (7,), n_buses: int = 1, **options: object) -> None:
        self.driver = RoboskinDriver(RoboskinOptions(**options))  # type: ignore[arg-type]
        patches = self.driver.patches_set_up(boards)
        buses = [(f"bus{i}", patches) for i in range(n_buses)]
        self.decoder = SpecifiedDecoder(
            [self.driver.layout] * len(buses), assemble(buses, self.driver.types, self.driver.dtype)
        )
        self.batch = FrameBatch(4096, 8, self.decoder.compiled.headroom)

    def feed(self, frames: Sequence[Wire], bus: int = 0) -> list[int]:
        """Decode frames as one batch; returns the modules that were updated, in order."""
        self.decoder.put_back(self.batch)
        for time_ns, identifier, payload in frames:
            self.batch.append(bus, time_ns, identifier, payload)
        updates, foreign = self.decoder.decode(self.batch)
        self.decoder.count_unknown(self.batch, foreign)
        self.decoder.state.show(updates)
        return list(updates.module[updates.whole].tolist())

    def values(self, module: int) -> list[int]:
        return list(self.decoder.state.values[module * 12 : module * 12 + 12].tolist())

    def status(self, module: int) -> list[int]:
        return list(self.decoder.state.status[module * 12 : module * 12 + 12].tolist())

    def count(self, name: str, row: int = 0) -> int:
        state = self.decoder.state
        if name in BUS_COUNTERS:
            return int(state.bus_counters[row, BUS_COUNTERS.index(name)])
        return int(state.patch_counters[row, PATCH_COUNTERS.index(name)])


def halves(triangle: int, value: int, time_ns: int = MS, board: int = 7, tail: str = "0000") -> list[Wire]:
    identifier = 0x400 | board << 4 | triangle
    head = bytes([0x40]) + bytes([value]) * 7
    return [
        (time_ns, identifier, head),
        (time_ns + 130_000, identifier, bytes([0xC0]) + bytes([value]) * 5 + bytes.fromhex(tail)),
    ]


def test_idle_triangle_as_on_the_wire() -> None:
    rig = Rig()
    head, tail = bytes.fromhex("40F0F0F0F0F0F0F0"), bytes.fromhex("C0F0F0F0F0F00000")
    assert rig.feed([(MS, 0x473, head), (2 * MS, 0x473, tail)]) == [3]
    assert rig.values(3) == [0xF0] * 12
    assert rig.status(3) == [0] * 12
    assert rig.decoder.state.module_time_ns[3] == MS
    assert rig.decoder.state.newest_ns == 2 * MS
    assert rig.status(2) == [int(Status.NEVER_SEEN)] * 12


def test_every_channel_has_its_place() -> None:
    rig = Rig()
    rig.feed([(MS, 0x47F, bytes.fromhex("4000010203040506")), (MS + 1, 0x47F, bytes.fromhex("C00708090A0B0000"))])
    assert rig.values(15) == list(range(12))
    structure = rig.decoder.tables.structure
    assert structure.sensor_uid[15 * 12 + 4] == 7 << 16 | 15 << 8 | 4
    assert np.all(np.diff(structure.sensor_uid.astype(np.int64)) > 0)


@pytest.mark.parametrize(
    ("diagnostics", "expected"),
    [
        ("8010", {0: Status.OUT_OF_RANGE, 11: Status.OUT_OF_RANGE}),
        ("0080", {3: Status.OUT_OF_RANGE}),
        ("0100", {4: Status.OUT_OF_RANGE}),
        ("0001", dict.fromkeys(range(12), Status.NO_ACK)),
        ("0002", dict.fromkeys(range(12), Status.NOT_CONNECTED)),  # MTB3: one or the other
        ("0003", dict.fromkeys(range(12), Status.NO_ACK | Status.NOT_CONNECTED)),  # MTB4: bits
        ("", {}),  # old firmware: a tail of six bytes
    ],
)
def test_diagnostics(diagnostics: str, expected: dict[int, Status]) -> None:
    rig = Rig()
    rig.feed(halves(0, 240, tail=diagnostics))
    assert rig.status(0) == [int(expected.get(channel, Status(0))) for channel in range(12)]


def test_head_and_tail_of_different_cycles_are_not_one_triangle() -> None:
    rig = Rig()
    first, second = halves(3, 1, time_ns=MS), halves(3, 2, time_ns=51 * MS)
    assert rig.feed([first[0], second[1]]) == []  # the tail and the next head got lost
    assert rig.status(3) == [int(Status.NEVER_SEEN)] * 12
    assert rig.count("late") == 1
    assert rig.count("orphans") == 2


def test_another_frame_of_the_board_in_between_breaks_a_pair() -> None:
    rig = Rig(boards=(7, 8))
    a, b = halves(3, 1), halves(4, 2)
    assert rig.feed([a[0], b[0], a[1], b[1]]) == []
    assert rig.count("orphans") == 4
    other = halves(4, 2, board=8)
    assert sorted(rig.feed([a[0], other[0], a[1], other[1]])) == [3, 16 + 4]  # another board's does not
    stray = (MS, 0x473, bytes.fromhex("40F0F0"))
    assert rig.feed([a[0], stray, a[1]]) == []  # neither half may be trusted around damage
    assert rig.count("bad_length") == 1


def test_lost_halves_are_orphans_one_for_one() -> None:
    rig = Rig()
    frames = [frame for t in range(16) for frame in halves(t, 5, time_ns=MS + t * 300_000)]
    dropped = {1, 6, 7 + 6, 28}
    kept = [frame for position, frame in enumerate(frames) if position not in dropped]
    updated = rig.feed([*kept, *halves(15, 9, time_ns=90 * MS)])
    lost_modules = {position // 2 for position in dropped}
    assert set(updated) == set(range(16)) - lost_modules | {15}
    assert rig.count("orphans") == len(dropped)


def test_wrong_lengths_contents_and_identifiers_are_counted_and_not_shown() -> None:
    rig = Rig()
    good = halves(3, 5)
    assert rig.feed(
        [
            (MS, 0x473, b""),
            (MS, 0x473, bytes.fromhex("C0F0F0")),
            (MS, 0x473, bytes.fromhex("41F0F0F0F0F0F0F0")),
            (MS, 0x523, bytes(8)),
            (MS, 0x8000_0473, bytes(8)),
            (MS, 0x1FFF_FFFF, bytes(8)),
            *good,
        ]
    ) == [3]
    assert rig.count("bad_length") == 2
    assert rig.count("bad_content") == 1
    assert rig.count("unknown") == 3
    assert rig.decoder.unknown_identifiers[0, 0x523] == 1


def test_boards_of_one_address_on_two_buses_stay_apart() -> None:
    rig = Rig(n_buses=2)
    rig.feed(halves(0, 1), bus=0)
    rig.feed(halves(0, 2), bus=1)
    assert rig.values(0) == [1] * 12
    assert rig.values(16) == [2] * 12
    assert rig.decoder.tables.structure.sensor_uid[192] == 1 << 32 | 7 << 16


wire_frames = st.tuples(
    st.sampled_from([0x470, 0x471, 0x480, 0x47F, 0x123, 0x707]),
    st.sampled_from([0x40, 0xC0, 0x41]),
    st.integers(0, 255),
    st.sampled_from([8, 8, 8, 6, 3, 0]),
    st.sampled_from([130_000, 300_000, 24 * MS, 26 * MS]),
)


@pytest.mark.thorough
@settings(max_examples=200, deadline=None)
@given(frames=st.lists(wire_frames, max_size=60), cuts=st.lists(st.integers(0, 60), max_size=6))
def test_how_frames_are_cut_into_batches_changes_nothing(
    frames: list[tuple[int, int, int, int, int]], cuts: list[int]
) -> None:
    time_ns, wire = 1_000, list[Wire]()
    for identifier, first, value, length, gap_ns in frames:
        time_ns += gap_ns
        wire.append((time_ns, identifier, (bytes([first]) + bytes([value]) * 7)[:length]))
    whole, pieces = Rig(boards=(7, 8)), Rig(boards=(7, 8))
    whole.feed(wire)
    bounds = [0, *sorted(min(cut, len(wire)) for cut in cuts), len(wire)]
    for begin, end in itertools.pairwise(bounds):
        pieces.feed(wire[begin:end])
    for name in ("values", "status", "module_time_ns", "bus_counters", "patch_counters", "patch_time_ns"):
        assert np.array_equal(getattr(whole.decoder.state, name), getattr(pieces.decoder.state, name)), name
    pairs = reference_pairs(wire)
    assert whole.decoder.state.patch_counters[:, 0].sum() == len(pairs)
    for identifier, value in pairs:
        module = ((identifier >> 4 & 0xF) - 7) * 16 + (identifier & 0xF)
        assert not whole.status(module)[0] & Status.NEVER_SEEN, (identifier, value)


def reference_pairs(wire: Sequence[Wire]) -> list[tuple[int, int]]:
    """The rule in plain words: a tail pairs with the frame just before it of the same board, if that is its head."""
    before: dict[int, Wire] = {}
    pairs = []
    for frame in wire:
        time_ns, identifier, payload = frame
        if identifier >> 8 != 4:
            continue
        board = identifier >> 4 & 0xF
        last = before.get(board)
        if payload[:1] == b"\xc0" and len(payload) in (6, 8) and last is not None:
            is_head = last[1] == identifier and last[2][:1] == b"\x40" and len(last[2]) == 8
            if is_head and time_ns - last[0] <= 25 * MS:
                pairs.append((identifier, payload[1]))
        before[board] = frame
    return pairs


@pytest.mark.thorough
@settings(max_examples=200, deadline=None)
@given(
    frames=st.lists(st.tuples(st.integers(0, 2**32 - 1), st.binary(max_size=8), st.integers(0, 10**12)), max_size=40)
)
def test_no_bytes_raise(frames: list[tuple[int, bytes, int]]) -> None:
    Rig(boards=(1, 14)).feed([(time_ns, identifier, payload) for identifier, payload, time_ns in frames])


def test_kinds_and_their_non_tactile_channels() -> None:
    special = (
        Kind(board=7, triangles=(0, 1), kind="fingertip"),
        Kind(board=7, triangles=(2,), kind="palm"),
        Kind(board=7, triangles=(3,), kind="palm", thermal=(7,)),
        Kind(board=7, triangles=(5,), enabled=False),
    )
    structure = Rig(modules=special).decoder.tables.structure
    thermal = structure.sensor_uid[structure.index("temperature")]
    by_triangle = {t: [int(u) & 0xFF for u in thermal if int(u) >> 8 & 0xFF == t] for t in range(16)}
    assert [by_triangle[t] for t in range(6)] == [[], [], [11], [7], [6, 10], []]
    assert structure.n_modules == 15
    assert [bytes(kind) for kind in structure.module_kind[:3]] == [b"fingertip", b"fingertip", b"palm"]
    assert set(Rig(skin_type=1).decoder.tables.structure.module_kind.tolist()) == {b"fingertip"}


def test_pressure_is_255_minus_the_value() -> None:
    rig = Rig()
    rig.feed(halves(0, 240))
    structure = rig.decoder.tables.structure
    assert structure.physical(rig.decoder.state.values, "pressure")[0] == 15.0
    assert structure.physical(rig.decoder.state.values, "temperature")[0] == 240.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"boards": (0,)}, "board address 0"),
        ({"boards": (15,)}, "board address 15"),
        ({"boards": (7, 7)}, "twice"),
        ({"kind": "toe"}, "choose one of triangle, fingertip, palm"),
        ({"modules": (Kind(board=7, triangles=(16,)),)}, "not all 0 to 15"),
    ],
)
def test_bad_options_are_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        RoboskinOptions(**options)  # type: ignore[arg-type]


def test_silent_recalibration_makes_a_board_suspect_until_it_is_set_up() -> None:
    rig = Rig(boards=(7, 8))
    watch = rig.driver.watch(rig.decoder.tables)
    for cycle in range(5):
        assert not watch.module_status.any()
        rig.decoder.put_back(rig.batch)
        for frame in halves(3, 240, time_ns=cycle * 50 * MS + MS, tail="0001"):
            rig.batch.append(0, *frame)
        watch.look(rig.decoder.decode(rig.batch)[0])
    assert set(watch.module_status[:16].tolist()) == {int(Status.SUSPECT)}
    assert not watch.module_status[16:].any()
    watch.forget(0)
    assert not watch.module_status.any()
