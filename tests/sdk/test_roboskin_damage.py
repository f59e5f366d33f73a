"""What the ROBOSKIN driver makes of frames that are late, lost, doubled, cut or foreign. Frames in, updates out."""

from __future__ import annotations

import pytest

from skinware import Status
from skinware_drivers.bus import FrameBatch
from skinware_drivers.can.roboskin_layout import Kind
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
def test_only_a_head_right_before_its_tail_makes_an_update(order: str, paired: int, orphans: int) -> None:
    head, tail = halves(3, 5)
    frames = [(MS + n * 100 * US, *(head if half == "H" else tail)[1:]) for n, half in enumerate(order.split())]
    for batches in ([frames], [[frame] for frame in frames]):  # at once, and one by one
        rig = Rig()
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


class DirtyBatch(FrameBatch):
    """A batch whose rows hold something behind the end of a payload, as memory that is used again does."""

    def append(self, bus: int, time_ns: int, identifier: int, payload: bytes) -> None:
        """Add one frame."""
        super().append(bus, time_ns, identifier, payload)
        self.wire[self.stop - 1]["payload"][len(payload) :] = 0xFF


def test_what_lies_behind_the_end_of_a_payload_means_nothing() -> None:
    rig = Rig()
    rig.batch = DirtyBatch(100, 8, rig.decoder.compiled.headroom)
    assert rig.feed(halves(3, 7, tail="")) == [3]
    assert rig.values(3) == [7] * 12
    assert rig.status(3) == [0] * 12


def test_triangles_that_are_switched_off_are_unknown_to_all() -> None:
    rig = Rig(modules=(Kind(board=7, triangles=(3,), enabled=False),))
    assert rig.feed([*halves(3, 5), *halves(4, 6)]) == [3]  # the fourth module is now triangle 4
    assert rig.values(3) == [6] * 12
    assert rig.count("unknown") == 2


# Flags


@pytest.mark.parametrize("clear", ["0000", ""], ids=["with flags", "short"])
def test_a_flag_goes_with_its_cause(clear: str) -> None:
    rig = Rig()
    for diagnostics in ("FFF0", "0001", "0002", "0003"):
        rig.feed(halves(3, 5, tail=diagnostics))
        assert all(rig.status(3))
        rig.feed(halves(3, 5, time_ns=51 * MS, tail=clear))
        assert rig.status(3) == [0] * 12


def test_every_channel_has_its_out_of_range_flag() -> None:
    rig = Rig()
    for channel in range(12):
        rig.feed(halves(3, 5, time_ns=(1 + 50 * channel) * MS, tail=f"{1 << 4 + channel:04X}"))
        assert rig.status(3) == [int(Status.OUT_OF_RANGE) * (c == channel) for c in range(12)]


# Foreign frames


OTHERS = (0x073, 0x273, 0x373, 0x573, 0x673, 0x773, 0x403, 0x483, 0x8000_0473, 0x8004_0473, 0x8000_0873)


def test_frames_of_others_are_counted_and_break_no_pair() -> None:
    rig = Rig()
    head, tail = halves(3, 5)
    for count, identifier in enumerate(OTHERS, 1):
        stranger = (MS + US, identifier, b"\x40" + bytes(7))
        assert rig.feed([head, stranger, tail]) == [3], f"{identifier:X}"
        assert (rig.count("unknown"), rig.count("bad_length"), rig.count("bad_content")) == (count, 0, 0)
    assert rig.values(3) == [5] * 12


def test_foreign_and_damaged_frames_are_counted_for_their_own_bus() -> None:
    rig = Rig(n_buses=2)
    rig.feed([(MS, 0x123, bytes(8)), (MS, 0x473, b"\x40"), (MS, 0x473, b"\x41" + bytes(7))], bus=1)
    names = ("unknown", "bad_length", "bad_content")
    assert [[rig.count(name, bus) for name in names] for bus in (0, 1)] == [[0, 0, 0], [1, 1, 1]]
