"""Frames that are out of order, cut off, unknown or at a limit: numpy and C treat them as promised."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from skinware import Status
from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import Filter
from skinware_drivers.decoding.decoder import BUS_COUNTERS, PATCH_COUNTERS
from skinware_drivers.description import Module, Patch, SkinTables, assemble, taxels
from skinware_drivers.fields import Bits, DeviceTime, Flag, Identifier, SequenceNumber, StatusBytes
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.decoding import SpecifiedDecoder

MS = 1_000_000
PERIOD_NS = 1000 * MS


def skin(modules: Sequence[Module], n_buses: int = 1, dtype: str = "u1") -> SkinTables:
    patches = [(f"b{bus}", [Patch(f"p{bus}", modules)]) for bus in range(n_buses)]
    return assemble(patches, [PRESSURE.measured(unit="counts")], dtype)


@contextmanager
def decoding(layout: Layout, tables: SkinTables, payload_size: int = 0) -> Iterator[tuple[Pair, int]]:
    """Both paths, and when they begin."""
    buses = tables.structure.buses
    with (
        hand_clock() as clock,
        Pair(clock, [layout] * len(buses), tables, [1.0] * len(buses), payload_size=payload_size) as pair,
    ):
        yield pair, clock.now_ns


def counted(pair: Pair, patch: int = 0) -> dict[str, int]:
    """The counters of a patch that are not 0."""
    row = pair.native.decoder.state.patch_counters[patch].tolist()
    return {name: count for name, count in zip(PATCH_COUNTERS, row, strict=True) if count}


def one_frame(values: Values, **more: object) -> Layout:
    return Layout([Frame("data", [Identifier(0x100, mask=0x7F0)], [8], values, **more)])  # type: ignore[arg-type]


# -- values and flags ----------------------------------------------------------------------------------------------


def test_values_of_channels_that_a_module_does_not_have_go_nowhere() -> None:
    with decoding(one_frame(Values(0, "u1", 4, to=(1, 0, 7, 2))), skin([Module(taxels(2))])) as (pair, begin_ns):
        pair.feed([(0, begin_ns, 0x100, bytes((5, 6, 7, 8, 0, 0, 0, 0)))])
        assert pair.native.decoder.state.values.tolist() == [6, 5]


def test_flags_that_no_row_of_a_batch_can_hold_are_not_set() -> None:
    flags = [
        Flag(Status.NO_ACK, 8, "<u2", mask=0xFFFF),
        Flag(Status.SUSPECT, 7, "<u2", mask=0xFFFF, each=[(0, 0)]),
        StatusBytes(7, mask=Status.MASKED),
        Flag(Status.NOT_CONNECTED, 7, "u1", mask=1),
    ]
    layout = one_frame(Values(0, "u1", 2), flags=flags)
    with decoding(layout, skin([Module(taxels(2))]), payload_size=8) as (pair, begin_ns):
        pair.feed([(0, begin_ns, 0x100, bytes([255] * 8))])
        assert pair.native.decoder.state.status.tolist() == [Status.NOT_CONNECTED] * 2


# -- times ---------------------------------------------------------------------------------------------------------


def test_stamps_from_before_the_machine_began_are_its_beginning_and_are_counted() -> None:
    layout = one_frame(Values(0, "u1", 1), module=0)
    with decoding(layout, skin([Module(taxels(1))], n_buses=2)) as (pair, _):
        pair.feed([(bus, time_ns, 0x100, bytes(8)) for bus in (0, 1, 1) for time_ns in (-5, 0, 1, 2)])
        early = pair.native.decoder.state.bus_counters[:, BUS_COUNTERS.index("before_boot")]
        assert early.tolist() == [2, 4]


def test_half_a_cycle_from_before_the_machine_began_is_counted_once() -> None:
    frames = [Frame(name, [Identifier(at)], [8], Values(0, "u1", 1)) for name, at in (("a", 0x100), ("b", 0x101))]
    layout = Layout(frames, Cycle(["a", "b"], maximum_age_s=0.1))
    with decoding(layout, skin([Module(taxels(1))])) as (pair, _):
        pair.feed([(0, 0, 0x100, bytes(8))])
        pair.feed([(0, 5, 0x101, bytes(8))])
        early = pair.native.decoder.state.bus_counters[0, BUS_COUNTERS.index("before_boot")]
        assert (early, counted(pair)) == (1, {"updates": 1})


def test_updates_are_shown_in_the_order_of_their_times_however_they_come() -> None:
    """The last value in time stays; of those of one time, the last that came."""
    dice = random.Random(7)
    layout = one_frame(Values(0, "<u2", 1), module=0)
    with decoding(layout, skin([Module(taxels(1))], dtype="<u2")) as (pair, begin_ns):
        number = 0
        for count in [*range(1, 20), 31, 32, 33, 64, 100]:
            for is_shuffled in (False, True):
                times_ns = [begin_ns + dice.randrange(count) for _ in range(count)]
                begin_ns += count
                frames = []
                for time_ns in times_ns if is_shuffled else sorted(times_ns):
                    number += 1
                    frames.append((0, time_ns, 0x100, number.to_bytes(2, "little") + bytes(6)))
                pair.feed(frames)
                latest = max(frames, key=lambda frame: (frame[1], frame[3][:2][::-1]))
                assert pair.native.decoder.state.values.tolist() == [int.from_bytes(latest[3][:2], "little")]


def test_a_device_that_says_0_says_its_time() -> None:
    layout = one_frame(Values(0, "u1", 1), module=0, time=DeviceTime(4, "<u2", 1e-3))
    with decoding(layout, skin([Module(taxels(1))])) as (pair, begin_ns):
        for stamp_ms, late_ms in ((65516, 0), (65526, 3), (0, 3), (10, 0), (20, 2)):
            time_ns = begin_ns + (stamp_ms - 65516) % 65536 * MS
            payload = bytes(4) + stamp_ms.to_bytes(2, "little") + bytes(2)
            pair.feed([(0, time_ns + late_ms * MS, 0x100, payload)])
            assert pair.native.decoder.state.patch_time_ns.tolist() == [time_ns]


@pytest.mark.parametrize(("longer_ns", "is_prompt"), [(-1, True), (0, True), (1, False)])
def test_frames_wait_for_groups_of_up_to_one_and_a_half_periods(longer_ns: int, is_prompt: bool) -> None:
    tables = skin([Module(taxels(1), period_s=0.03 + longer_ns / 1e9)])
    state = SpecifiedDecoder([one_frame(Values(0, "u1", 1))], tables).state
    state.settle_pace(20 * MS)
    assert state.is_prompt.tolist() == [is_prompt]


# -- sequence numbers ----------------------------------------------------------------------------------------------


def test_sequence_numbers_are_compared_for_each_module_whatever_comes_between() -> None:
    layout = one_frame(Values(1, "u1", 1), module=Bits(0, 4), sequence=SequenceNumber(0, "u1"))
    modules = [Module(taxels(1, first_uid=key), key=key) for key in range(4)]
    # of the last: 12 was overtaken, and came twice; 3 is of a device that begins again
    sent = {0: [0, 1, 2, 5], 1: [250, 251, 251, 3], 2: [7, 6, 7], 3: [10, 11, 13, 12, 12, 14, 3, 4, 6]}
    with decoding(layout, skin(modules)) as (pair, begin_ns):
        for at in range(9):
            pair.feed(
                [
                    (0, begin_ns + at, 0x100 | key, bytes([numbers[at]] * 8))
                    for key, numbers in sent.items()
                    if at < len(numbers)
                ]
            )
        assert counted(pair) == {
            "updates": 10 + 6,
            "sequence_lost": 2 + 7 + 1,
            "sequence_repeated": 2,
            "sequence_back": 1 + 4,
        }
        decoder = pair.native.decoder
        assert decoder.last_sequence[:, 0].tolist() == decoder.state.values.tolist() == [5, 3, 7, 6]


# -- cycles --------------------------------------------------------------------------------------------------------


def halves(counters: Sequence[SequenceNumber] | None = None) -> Layout:
    frames = [
        Frame(
            f"half {place}",
            [Identifier(0x100 | place << 4, mask=0x7F0)],
            [8],
            Values(6, "u1", 1, to=[place]),
            module=Bits(0, 4),
        )
        for place in range(2)
    ]
    return Layout(frames, Cycle([frame.name for frame in frames], maximum_age_s=0.1, counter=counters))


def test_each_member_of_a_cycle_may_have_its_counter_in_another_place() -> None:
    layout = halves([SequenceNumber(0, "u1"), SequenceNumber(3, "<u2", modulo=256)])
    modules = [Module(taxels(2, first_uid=2 * key), key=key) for key in range(2)]

    def payload(place: int, number: int) -> bytes:
        wrong = (number + 77) % 256
        return bytes([wrong, 1, 2, number, 0, 9, number, 0] if place else [number, 1, 2, wrong, 1, 9, number, 0])

    with decoding(layout, skin(modules)) as (pair, begin_ns):
        frames = [(place, key, number) for number in (253, 254, 255, 0) for key in range(2) for place in range(2)]
        frames[5] = (1, 0, 3)  # in the place of the second half of 254, of module 0
        pair.feed(
            [
                (0, begin_ns + at, 0x100 | place << 4 | key, payload(place, number))
                for at, (place, key, number) in enumerate(frames)
            ]
        )
        found = counted(pair)
        assert (found["updates"], found["orphans"]) == (7, 2)
        assert pair.native.decoder.state.values.tolist() == [0] * 4


@pytest.mark.parametrize("order", ["any", "ends_with"])
def test_a_frame_of_another_kind_stands_for_no_member_of_a_cycle(order: str) -> None:
    """Of 32 members, the most that a cycle can have in an order that is not given."""
    frames = [Frame(f"f{at}", [Identifier(0x100 + at)], [8], Values(0, "u1", 1, to=[at])) for at in range(33)]
    cycle = Cycle([frame.name for frame in frames[:32]], maximum_age_s=0.1, order=order)  # type: ignore[arg-type]
    with decoding(Layout(frames, cycle), skin([Module(taxels(33))])) as (pair, begin_ns):
        for missing in (None, 0, None, None, 1, None, None):  # what follows a loss is not trusted
            sent = [32 if at == missing else at for at in range(32)]
            pair.feed([(0, begin_ns + at, 0x100 + which, bytes(8)) for at, which in enumerate(sent)])
            pair.feed([(0, begin_ns + 50, 0x100 + 32, bytes(8))])
            begin_ns += PERIOD_NS
        assert counted(pair) == {"updates": 3 + 2 + 7, "orphans": 2 * (31 + 32)}


def test_half_a_cycle_waits_unless_frames_of_its_bus_were_lost() -> None:
    with decoding(halves(), skin([Module(taxels(2), key=0)], n_buses=3)) as (pair, begin_ns):
        pair.feed([(bus, begin_ns, 0x100, bytes(8)) for bus in range(3)])
        pair.feed([(bus, begin_ns + 1, 0x110, bytes(8)) for bus in range(3)], interrupted=[1])
        assert [counted(pair, patch) for patch in range(3)] == [{"updates": 1}, {"orphans": 2}, {"updates": 1}]
        begin_ns += PERIOD_NS
        pair.feed([(bus, begin_ns, 0x100, bytes(8)) for bus in range(3)], interrupted=[1])
        pair.feed([(bus, begin_ns + 1, 0x110, bytes(8)) for bus in range(3)])
        assert [counted(pair, patch) for patch in range(3)] == [
            {"updates": 2},
            {"updates": 1, "orphans": 2},
            {"updates": 2},
        ]


def test_a_cycle_that_takes_the_maximum_age_is_shown_and_one_that_takes_longer_is_late() -> None:
    with decoding(halves(), skin([Module(taxels(2), key=0)])) as (pair, begin_ns):
        for longer_ns, expected in ((0, {"updates": 1}), (1, {"updates": 1, "orphans": 2, "late": 1})):
            pair.feed([(0, begin_ns, 0x100, bytes(8)), (0, begin_ns + 100 * MS + longer_ns, 0x110, bytes(8))])
            assert counted(pair) == expected
            begin_ns += PERIOD_NS


def test_a_patch_that_begins_again_is_neither_out_of_time_nor_has_it_lost_anything() -> None:
    layout = halves()
    layout = Layout([replace(frame, sequence=SequenceNumber(0, "u1")) for frame in layout.frames], layout.cycles[0])
    with decoding(layout, skin([Module(taxels(2), key=0)], n_buses=2)) as (pair, begin_ns):
        for number in (200, 0):
            rows = [(bus, place) for bus in range(2) for place in range(2)]
            pair.feed([(bus, begin_ns + place, 0x100 | place << 4, bytes([number] * 8)) for bus, place in rows])
            begin_ns += 7 * PERIOD_NS // 2
            pair.do(lambda way: way.decoder.forget(1))
        assert [counted(pair, patch) for patch in range(2)] == [{"updates": 1, "orphans": 2, "late": 1}, {"updates": 2}]


def test_what_can_be_part_of_no_cycle_any_more_is_an_orphan_at_once() -> None:
    frames = [Frame(f"f{at}", [Identifier(0x100 + at)], [8], Values(0, "u1", 1, to=[at])) for at in range(3)]
    sent: dict[str, list[tuple[list[int], int]]] = {
        "given": [([0], 0), ([0], 1), ([1], 1), ([1], 4), ([0, 1], 4), ([2], 4), ([2], 5), ([0, 2], 7)],
        "any": [([2], 0), ([2], 1), ([1], 1), ([1], 3), ([0, 1], 4), ([0], 5), ([2], 5), ([0, 0], 6)],
        "ends_with": [([1], 0), ([1], 1), ([0], 1), ([2], 1), ([0], 1), ([2], 1), ([1], 2)],
    }
    counter = SequenceNumber(7, "u1", modulo=16)
    for order, steps in sent.items():
        cycle = Cycle([frame.name for frame in frames], 0.1, order=order, counter=counter)  # type: ignore[arg-type]
        with decoding(Layout(frames, cycle), skin([Module(taxels(3))])) as (pair, begin_ns):
            found = []
            for step, (places, _) in enumerate(steps):
                pair.feed([(0, begin_ns + step * 2 + at, 0x100 + place, bytes(8)) for at, place in enumerate(places)])
                found.append((places, counted(pair).get("orphans", 0)))
            assert found == steps, order


def test_frames_that_could_not_be_used_are_kept_for_the_bus_that_they_came_on() -> None:
    with decoding(one_frame(Values(0, "u1", 1)), skin([Module(taxels(1))], n_buses=2)) as (pair, begin_ns):
        pair.feed([(1, begin_ns, 0x333, bytes([7] * 8)), (0, begin_ns, 0x100, bytes(8))])
        kept = [np.flatnonzero(samples.rows["identifier"]).tolist() for samples in pair.native.decoder.samples]
        assert not kept[0]
        assert [pair.native.decoder.samples[1].rows["identifier"][at] for at in kept[1]] == [0x333]


def test_the_numbers_of_foreign_frames_are_counted_by_identifier() -> None:
    with decoding(one_frame(Values(0, "u1", 1)), skin([Module(taxels(1))])) as (pair, begin_ns):
        pair.feed([(0, begin_ns, identifier, bytes(8)) for identifier in (0x7FF, 0, 0x7FF, 0x100)])
        decoder = pair.native.decoder
        assert decoder.state.bus_counters[0].tolist() == [3, 0, 0, 0]
        unknown = decoder.unknown_identifiers[0]
        assert {at: int(unknown[at]) for at in unknown.nonzero()[0]} == {0: 1, 0x7FF: 2}


def test_all_updates_of_a_batch_are_kept_however_many_they_are() -> None:
    layout = one_frame(Values(0, "<u2", 1), module=Bits(0, 4))
    modules = [Module(taxels(1, first_uid=key), key=key) for key in range(16)]
    with decoding(layout, skin(modules, dtype="<u2")) as (pair, begin_ns):
        for count in (1000, 17, 1000):
            frames = [(0, begin_ns + at, 0x100 | at % 16, at.to_bytes(2, "little") + bytes(6)) for at in range(count)]
            pair.feed(frames)
            assert pair.native.decoder.state.values.tolist() == [
                (count - 1 - key) // 16 * 16 + key for key in range(16)
            ]
            begin_ns += PERIOD_NS
        assert counted(pair) == {"updates": 2017}


def test_frames_of_no_module_are_offered_to_those_who_wait_for_such() -> None:
    layout = one_frame(Values(0, "u1", 1), module=0)
    with decoding(layout, skin([Module(taxels(1))])) as (pair, begin_ns):
        path, offered, heard = pair.native._path, list[int](), list[int]()

        def offer(rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
            offered.extend(pair.native.batch.wire["identifier"][rows].tolist())
            return rows

        path.listeners.offer = offer
        path.listeners.hear = lambda rows: heard.append(len(rows))
        for expects_data, awaited, expected in (
            (False, [], []),
            (False, [Filter(0x333, 0x7FF)], [0x333, 0x333]),
            (True, [Filter(0x777, 0x7FF), Filter(0x330, 0x7F0)], [0x333, 0x334, 0x333]),
            (True, [Filter(0x100, 0x7FF)], []),
        ):
            offered.clear()
            path.announce_waits(expects_data, awaited)
            identifiers = (0x333, 0x100, 0x334, 0x444, 0x333)
            pair.feed([(0, begin_ns + at, identifier, bytes(8)) for at, identifier in enumerate(identifiers)])
            assert offered == expected
            begin_ns += PERIOD_NS
        assert heard == [5, 5]
        assert pair.native.decoder.state.bus_counters[0, BUS_COUNTERS.index("unknown")] == 16
