"""What the ROBOSKIN driver makes of frames that are late, lost, doubled, cut or foreign. Frames in, updates out."""

from __future__ import annotations

import pytest

from skinware import Status
from tests.sdk.test_roboskin_wire import MS, Rig, Wire, halves

US = 1_000


def delayed(frames: list[Wire], delay_ns: int) -> list[Wire]:
    """Head and tail with another time between them."""
    head, tail = frames
    return [head, (head[0] + delay_ns, *tail[1:])]


# The pairing rule: a tail belongs to the very frame before it from its board, within half a period, or to none


@pytest.mark.parametrize("period_ms", [20, 50])
def test_a_tail_must_follow_its_head_within_half_a_period(period_ms: int) -> None:
    half_ns = period_ms * MS // 2
    assert Rig(period_ms=period_ms).feed(delayed(halves(3, 5), half_ns)) == [3]
    rig = Rig(period_ms=period_ms)
    assert rig.feed(delayed(halves(3, 5), half_ns + 1)) == []
    assert rig.status(3) == [int(Status.NEVER_SEEN)] * 12
    assert (rig.count("orphans"), rig.count("late")) == (2, 1)


@pytest.mark.parametrize(
    ("order", "paired", "orphans"),
    [
        ("T H", 0, 1),  # the head may still find its tail
        ("T H T", 1, 1),
        ("H H T", 1, 1),
        ("H T T", 1, 1),
        ("H T H T", 2, 0),
        ("T T", 0, 2),
    ],
)
@pytest.mark.parametrize("one_by_one", [False, True], ids=["at once", "one by one"])
def test_only_a_head_right_before_its_tail_makes_an_update(
    order: str, paired: int, orphans: int, one_by_one: bool
) -> None:
    rig = Rig()
    head, tail = halves(3, 5)
    frames = [(MS + n * 100 * US, *(head if half == "H" else tail)[1:]) for n, half in enumerate(order.split())]
    batches = [[frame] for frame in frames] if one_by_one else [frames]
    assert [module for batch in batches for module in rig.feed(batch)] == [3] * paired
    assert rig.count("orphans") == orphans


def test_halves_of_different_triangles_are_no_pair() -> None:
    rig = Rig()
    assert rig.feed([halves(3, 5)[0], halves(4, 5)[1]]) == []
    assert rig.count("orphans") == 2


def test_halves_of_different_buses_are_no_pair_and_do_not_disturb_each_other() -> None:
    rig = Rig(n_buses=2)
    head, tail = halves(3, 5)
    assert rig.feed([head], bus=0) == []
    assert rig.feed([tail], bus=1) == []
    assert rig.feed([tail], bus=0) == [3]
    assert rig.status(16 + 3) == [int(Status.NEVER_SEEN)] * 12
    assert [rig.count("orphans", patch) for patch in (0, 1)] == [0, 1]


def test_a_half_pair_leaves_what_was_shown_before_as_it_was() -> None:
    rig = Rig()
    rig.feed(halves(3, 5))
    before_ns = rig.decoder.state.module_time_ns[3]
    assert rig.feed([halves(3, 9, time_ns=51 * MS)[0], *halves(4, 9, time_ns=52 * MS)]) == [4]
    assert rig.values(3) == [5] * 12
    assert rig.decoder.state.module_time_ns[3] == before_ns


# Lengths


@pytest.mark.parametrize(
    ("head_length", "tail_length", "is_shown"),
    [(8, 8, True), (8, 6, True), (8, 7, False), (8, 5, False), (8, 0, False), (7, 8, False), (6, 8, False)],
)
def test_only_frames_of_the_right_length_are_used(head_length: int, tail_length: int, is_shown: bool) -> None:
    rig = Rig()
    (time_ns, identifier, head), (later_ns, _, tail) = halves(3, 5)
    shown = rig.feed([(time_ns, identifier, head[:head_length]), (later_ns, identifier, tail[:tail_length])])
    assert shown == ([3] if is_shown else [])
    assert rig.count("bad_length") == (not is_shown)
    assert rig.count("bad_content") == rig.count("unknown") == 0


def test_what_lies_behind_the_end_of_a_payload_means_nothing() -> None:
    rig = Rig()
    rig.feed(halves(3, 5, tail="FFF3"))
    rig.feed(halves(3, 5, time_ns=51 * MS))  # the rows of the batch are used again
    rig.feed(halves(3, 6, time_ns=101 * MS, tail="FFF3"))
    rig.decoder.put_back(rig.batch)
    rig.batch.wire["payload"] = 0xFF
    assert rig.feed(halves(3, 7, time_ns=151 * MS, tail="")) == [3]
    assert rig.values(3) == [7] * 12
    assert rig.status(3) == [0] * 12


# Flags


@pytest.mark.parametrize("first", ["FFF0", "0001", "0002", "0003"])
@pytest.mark.parametrize("second", ["0000", ""], ids=["clear", "short"])
def test_a_flag_goes_with_its_cause(first: str, second: str) -> None:
    rig = Rig()
    rig.feed(halves(3, 5, tail=first))
    assert all(rig.status(3))
    rig.feed(halves(3, 5, time_ns=51 * MS, tail=second))
    assert rig.status(3) == [0] * 12


@pytest.mark.parametrize("channel", range(12))
def test_every_channel_has_its_out_of_range_flag(channel: int) -> None:
    rig = Rig()
    rig.feed(halves(3, 5, tail=f"{1 << 4 + channel:04X}"))
    expected = [0] * 12
    expected[channel] = int(Status.OUT_OF_RANGE)
    assert rig.status(3) == expected
    assert not any(rig.status(2)[c] & Status.OUT_OF_RANGE for c in range(12))


# Foreign frames


@pytest.mark.parametrize(
    "identifier",
    [0x073, 0x273, 0x373, 0x573, 0x673, 0x773, 0x403, 0x483, 0x8000_0473, 0x8004_0473, 0x8000_0873],
)
def test_frames_of_others_are_counted_and_break_no_pair(identifier: int) -> None:
    rig = Rig()
    head, tail = halves(3, 5)
    assert rig.feed([head, (MS + US, identifier, b"\x40" + bytes(7)), tail]) == [3]
    assert (rig.count("unknown"), rig.count("bad_length"), rig.count("bad_content")) == (1, 0, 0)
    assert rig.values(3) == [5] * 12


def test_foreign_and_damaged_frames_are_counted_for_their_own_bus() -> None:
    rig = Rig(n_buses=2)
    rig.feed([(MS, 0x123, bytes(8)), (MS, 0x473, b"\x40"), (MS, 0x473, b"\x41" + bytes(7))], bus=1)
    names = ("unknown", "bad_length", "bad_content")
    assert [[rig.count(name, bus) for name in names] for bus in (0, 1)] == [[0, 0, 0], [1, 1, 1]]
