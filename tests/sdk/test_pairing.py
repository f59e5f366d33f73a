"""Which frames are joined to cycles, against an oracle that looks at one frame after the other."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import PATCH_COUNTERS
from skinware_drivers.description import Module, Patch, SkinTables, assemble, taxels
from skinware_drivers.fields import Bits, Identifier, SequenceNumber
from skinware_drivers.layout import Cycle, Frame, Layout, Values
from tests.specification.both_paths import Pair, hand_clock
from tests.specification.decoding import SpecifiedDecoder

MS = 1_000_000
PERIOD_NS = 20 * MS + 1  # odd: half of it is no whole number
USUAL_NS = 26 * MS
"""The device is slower than it should be."""
MODULES = 2
Order = Literal["given", "any", "ends_with"]


class Sent(NamedTuple):
    """A frame on the wire."""

    time_ns: int
    module: int
    place: int
    cycle: int
    serial: int


@dataclass(frozen=True)
class Device:
    """One patch of two modules; its payloads: counter in the upper half of byte 1, serial number of the frame."""

    members: int
    order: Order
    within: Literal["patch", "module"]
    modulo: int  # 1: no counter
    maximum_age_ns: int

    @property
    def skin(self) -> tuple[Layout, SkinTables]:
        frames = [
            Frame(
                f"part {place}",
                [Identifier(0x100 | place << 4, mask=0x7F0)],
                [8],
                Values(2, "<u4", 1, to=[place]),
                module=Bits(0, 4),
            )
            for place in range(self.members)
        ]
        counter = SequenceNumber(1, "u1", self.modulo, mask=0xF0) if self.modulo > 1 else None
        cycle = Cycle([f.name for f in frames], self.maximum_age_ns / 1e9, self.within, self.order, counter)
        modules = [Module(taxels(self.members, first_uid=10 * key), key=key) for key in range(MODULES)]
        types = [PRESSURE.measured(unit="counts")]
        return Layout(frames, cycle), assemble([("bus", [Patch("p", modules)])], types, "i4")

    @property
    def decoder(self) -> SpecifiedDecoder:
        layout, tables = self.skin
        return SpecifiedDecoder([layout], tables, [PERIOD_NS / 1e9])

    def wire(self, frame: Sent) -> tuple[int, bytes]:
        """Identifier and payload."""
        payload = bytes([0xAA, frame.cycle % self.modulo << 4 | 5]) + frame.serial.to_bytes(4, "little") + bytes(2)
        return 0x100 | frame.place << 4 | frame.module, payload

    def join_in_c(self, sent: Sequence[Sent], cuts: Sequence[int] = ()) -> None:
        """Fail unless C does the same as numpy."""
        layout, tables = self.skin
        with hand_clock() as clock, Pair(clock, [layout], tables, [PERIOD_NS / 1e9]) as pair:
            begin_ns = clock.now_ns
            for begin, end in zip([0, *cuts], [*cuts, len(sent)], strict=True):
                frames = [(0, begin_ns + frame.time_ns, *self.wire(frame)) for frame in sent[begin:end]]
                clock.now_ns = max([clock.now_ns, *(time_ns for _, time_ns, *_ in frames)])
                pair.feed(frames)

    def joined(self, sent: Sequence[Sent], cuts: Sequence[int] = ()) -> tuple[list[list[int]], dict[str, int]]:
        """Serial numbers of the frames of each update, in the order of their places; and the patch's counters.

        Args:
            sent: what comes, in order.
            cuts: after how many frames each batch ends.
        """
        decoder, found = self.decoder, list[list[int]]()
        batch = FrameBatch(len(sent) + 1, 8, decoder.compiled.headroom)
        for begin, end in zip([0, *cuts], [*cuts, len(sent)], strict=True):
            decoder.put_back(batch)
            for frame in sent[begin:end]:
                batch.append(0, frame.time_ns, *self.wire(frame))
            updates, _ = decoder.decode(batch)
            found += updates.values[updates.whole].tolist()
        return sorted(found), dict(zip(PATCH_COUNTERS, decoder.state.patch_counters[0].tolist(), strict=True))


def oracle(device: Device, sent: Sequence[Sent]) -> tuple[list[list[int]], int]:
    """What is to be joined, and how many frames will never be; one frame after the other, one group after the other."""
    soon, late, odd = set[int](), set[int](), set[int]()
    history: dict[tuple[int, int], tuple[int, int]] = {}  # time of the last of its kind, and its distance
    reach_ns = device.maximum_age_ns * (2 if device.order == "any" else 1)
    for frame in sent:
        before = history.get((frame.module, frame.place))
        distance = PERIOD_NS if before is None else frame.time_ns - before[0]
        usual = max(PERIOD_NS, 0 if before is None else before[1])
        margin_ns = (PERIOD_NS - reach_ns) // 8
        if distance <= device.maximum_age_ns + margin_ns:
            soon.add(frame.serial)
        if distance - usual >= usual - reach_ns - margin_ns:
            late.add(frame.serial)
            if min(abs(distance - many * PERIOD_NS) for many in range(100)) >= (PERIOD_NS - reach_ns) / 2:
                odd.add(frame.serial)
        history[frame.module, frame.place] = (frame.time_ns, distance)
    found, orphans = [], 0
    for group in range(1 if device.within == "patch" else MODULES):
        line = [frame for frame in sent if device.within == "patch" or frame.module == group]
        at, taken = 0, 0
        while at + device.members <= len(line):
            if _is_cycle(device, line[at : at + device.members], soon, late, odd):
                found.append([f.serial for f in sorted(line[at : at + device.members], key=lambda f: f.place)])
                orphans += at - taken
                at = taken = at + device.members
            else:
                at += 1
        orphans += len(line) - taken - _waiting(device, line[taken:])
    return sorted(found), orphans


def _is_cycle(device: Device, frames: Sequence[Sent], soon: set[int], late: set[int], odd: set[int]) -> bool:
    places = [frame.place for frame in frames]
    if sorted(places) != list(range(device.members)) or len({frame.module for frame in frames}) > 1:
        return False
    if device.order == "given" and places != sorted(places):
        return False
    if device.order == "ends_with" and places[-1] != device.members - 1:
        return False
    if frames[-1].time_ns - frames[0].time_ns > device.maximum_age_ns:
        return False
    if device.modulo > 1:
        return len({frame.cycle % device.modulo for frame in frames}) == 1
    serials = {frame.serial for frame in frames}
    if device.order == "given":
        return not serials & (soon | odd) and bool(serials - late)
    return not serials & (soon | late)


def _waiting(device: Device, rest: Sequence[Sent]) -> int:
    """How many of the last frames may still find partners."""
    for count in range(min(device.members - 1, len(rest)), 0, -1):
        frames = rest[-count:]
        places = [frame.place for frame in frames]
        one_cycle = len({(frame.module, frame.cycle % device.modulo) for frame in frames}) == 1
        right = places == list(range(count)) if device.order == "given" else len(set(places)) == count
        if one_cycle and right:
            return count
    return 0


@st.composite
def devices(draw: st.DrawFn, modulos: Sequence[int]) -> Device:
    order: Order = draw(st.sampled_from(("given", "any", "ends_with")))
    modulo = draw(st.sampled_from(modulos))
    share = draw(st.sampled_from((0.2, 0.45))) if order == "any" else draw(st.sampled_from((0.2, 0.5, 0.9)))
    within: Literal["patch", "module"] = draw(st.sampled_from(("patch", "module")))
    return Device(draw(st.integers(2, 4)), order, within, modulo, round(share * PERIOD_NS))


@st.composite
def streams(draw: st.DrawFn, device: Device, cycles: int) -> tuple[list[Sent], list[int]]:
    """Cycles of a device with losses, repeats, delays and senders that catch up; and where batches end."""
    sent = []
    gap_ns = draw(st.sampled_from((MS // 10, MS // 2)))
    random = draw(st.randoms(use_true_random=False))
    for cycle in range(cycles):
        for module in range(MODULES):
            places = list(range(device.members))
            if device.order == "any":
                random.shuffle(places)
            if device.order == "ends_with":
                places[:-1] = random.sample(places[:-1], device.members - 1)
            for step, place in enumerate(places):
                time_ns = cycle * PERIOD_NS + (module * device.members + step) * gap_ns + MS
                sent.append(Sent(time_ns, module, place, cycle, 0))
    of_cycle = MODULES * device.members
    lost = set[int]()
    for _ in range(draw(st.integers(0, 2))):  # a run is lost, as a rule one that makes a head and a tail neighbours
        first = draw(st.integers(0, (cycles - 1) * of_cycle))
        count = of_cycle * draw(st.integers(0, 2)) + draw(st.sampled_from((0, 0, 0, -1, 1, 2)))
        lost |= set(range(first, first + count))
        if draw(st.booleans()):  # while the sender stands still; then it catches up
            begin_ns = sent[first].time_ns - draw(st.sampled_from((0, MS, PERIOD_NS // 2, PERIOD_NS)))
            end_ns = sent[min(first + max(count, 0), len(sent) - 1)].time_ns + draw(st.sampled_from((0, PERIOD_NS)))
            pace_ns = draw(st.sampled_from((0, MS // 10)))
            free_ns = end_ns
            for number, frame in enumerate(sent):
                if frame.time_ns >= begin_ns:
                    sent[number] = frame._replace(time_ns=max(frame.time_ns, free_ns))
                    free_ns = sent[number].time_ns + pace_ns
    sent = [frame for number, frame in enumerate(sent) if number not in lost]
    is_repeated = draw(st.booleans())
    if sent and is_repeated:
        again = draw(st.integers(0, len(sent) - 1))
        sent[again:again] = [sent[again]]
    sent = [frame._replace(serial=number) for number, frame in enumerate(sent)]
    return sent, sorted(draw(st.lists(st.integers(0, len(sent)), max_size=8)))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_cycles_are_those_that_an_oracle_finds_wherever_batches_end(data: st.DataObject) -> None:
    device = data.draw(devices((1, 4, 16)))
    sent, cuts = data.draw(streams(device, 8))
    joined, counters = device.joined(sent, cuts)
    expected, orphans = oracle(device, sent)
    assert joined == expected
    assert counters["orphans"] == orphans
    assert counters["updates"] == len(joined)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_cycles_in_c_are_the_same_wherever_batches_end(data: st.DataObject) -> None:
    device = data.draw(devices((1, 4, 16)))
    device.join_in_c(*data.draw(streams(device, 8)))


def paces(device: Device) -> list[int]:
    """Times between two cycles: each bound of what is in time, and a nanosecond beside it."""
    reach_ns = device.maximum_age_ns * (2 if device.order == "any" else 1)
    margin_ns = (PERIOD_NS - reach_ns) // 8
    beside_ns = (PERIOD_NS - reach_ns) // 2
    bounds = [device.maximum_age_ns + margin_ns, PERIOD_NS]
    bounds += [2 * usual_ns - reach_ns - margin_ns for usual_ns in (PERIOD_NS, USUAL_NS)]
    for count in (2, 3):
        bounds += [count * PERIOD_NS + step for step in (-beside_ns, 0, beside_ns)]
    return [bound + step for bound in bounds for step in (-1, 0, 1)]


def paced(device: Device) -> Iterator[list[Sent]]:
    """Cycles of one module, of which one or one of its frames comes after such a time."""
    for usual_ns, pace_ns, shares in product((PERIOD_NS, USUAL_NS), paces(device), ((1, 1), (1, 0), (0, 1))):
        sent, times_ns = [], [MS, 2 * MS]
        for cycle, spacing_ns in enumerate((0, usual_ns, pace_ns, PERIOD_NS, PERIOD_NS)):
            for place in range(2):
                times_ns[place] += spacing_ns if cycle != 2 or shares[place] else PERIOD_NS
                sent.append(Sent(times_ns[place], 0, place, cycle, 0))
        sent.sort(key=lambda frame: frame.time_ns)
        yield [frame._replace(serial=number) for number, frame in enumerate(sent)]


@pytest.mark.parametrize(("order", "modulo"), [("given", 1), ("given", 16), ("any", 1), ("ends_with", 1)])
def test_a_frame_is_in_time_up_to_the_nanosecond(order: Order, modulo: int) -> None:
    device = Device(2, order, "module", modulo, PERIOD_NS // 4)
    for sent in paced(device):
        joined, counters = device.joined(sent)
        assert (joined, counters["orphans"]) == oracle(device, sent), sent
    device.join_in_c(*one_after_the_other(paced(device)))


def held_up_after_a_loss(device: Device) -> Iterator[list[Sent]]:
    """Cycles of one module: a frame is lost, and the cycle after it comes up to as late or early as can be trusted."""
    beside_ns = (PERIOD_NS - device.maximum_age_ns) // 2
    for lost, side, step_ns in product(range(2), (-1, 1), (-1, 0, 1)):
        after_ns = 3 * PERIOD_NS + side * beside_ns + step_ns
        begins_ns = [0, PERIOD_NS, 2 * PERIOD_NS, after_ns, after_ns + PERIOD_NS]
        parts = [(cycle, place) for cycle in range(5) for place in range(2) if (cycle, place) != (2, lost)]
        yield [
            Sent(begins_ns[cycle] + (1 + place) * MS, 0, place, cycle, serial)
            for serial, (cycle, place) in enumerate(parts)
        ]


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_cycle_after_a_loss_is_trusted_up_to_the_nanosecond(share: float) -> None:
    device = Device(2, "given", "module", 1, round(share * PERIOD_NS))
    shown = set()
    for sent in held_up_after_a_loss(device):
        joined, counters = device.joined(sent)
        assert (joined, counters["orphans"]) == oracle(device, sent), sent
        shown.add(len(joined))
    assert shown == {3, 4}
    device.join_in_c(*one_after_the_other(held_up_after_a_loss(device)))


def one_after_the_other(streams: Iterable[Sequence[Sent]]) -> tuple[list[Sent], list[int]]:
    """Streams in one, each a batch, many periods after the one before."""
    joined, cuts, begin_ns = list[Sent](), [], 0
    for sent in streams:
        joined += [frame._replace(time_ns=frame.time_ns + begin_ns) for frame in sent]
        cuts.append(len(joined))
        begin_ns = joined[-1].time_ns + 50 * PERIOD_NS
    return joined, cuts


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(st.data())
def test_with_a_counter_halves_of_different_cycles_are_never_joined(data: st.DataObject) -> None:
    device = data.draw(devices((16,)))
    sent, cuts = data.draw(streams(device, 12))
    for serials in device.joined(sent, cuts)[0]:
        assert len({sent[serial].cycle for serial in serials}) == 1


def regular(device: Device, cycles: int) -> list[Sent]:
    """A device that sends as it should."""
    return [
        Sent(cycle * PERIOD_NS + (module * device.members + place + 1) * MS // 4, module, place, cycle, 0)
        for cycle in range(cycles)
        for module in range(MODULES)
        for place in range(device.members)
    ]


def torn(device: Device, sent: Sequence[Sent]) -> int:
    """How many joined cycles are of frames of different ones."""
    numbered = [frame._replace(serial=number) for number, frame in enumerate(sent)]
    joined, _ = device.joined(numbered)
    return sum(len({numbered[serial].cycle for serial in serials}) > 1 for serials in joined)


def held_up(sent: Sequence[Sent], begin_ns: int, end_ns: int) -> list[Sent]:
    """The sender stands still from one moment to another, and then catches up."""
    late = [
        frame._replace(time_ns=max(frame.time_ns, end_ns)) if frame.time_ns >= begin_ns else frame for frame in sent
    ]
    return [frame._replace(time_ns=frame.time_ns + number) for number, frame in enumerate(late)]


def test_any_order_recovers_from_one_lost_frame_at_once() -> None:
    device = Device(2, "any", "module", 1, PERIOD_NS // 4)
    sent = [frame._replace(serial=number) for number, frame in enumerate(regular(device, 6))]
    joined, _ = device.joined(sent[1:])
    assert len(joined) >= 2 * 6 - 2


def every_run(device: Device) -> list[tuple[int, int]]:
    """Beginning and end of every run of frames up to two cycles long that begins in the third cycle."""
    of_cycle = MODULES * device.members
    return [(begin, begin + count) for begin in range(2 * of_cycle, 3 * of_cycle) for count in range(2 * of_cycle + 1)]


ORDERS: tuple[Order, ...] = ("given", "ends_with", "any")


@pytest.mark.thorough
def test_without_a_counter_no_lost_run_joins_halves_whether_the_sender_catches_up_or_not() -> None:
    for order in ORDERS:
        device = Device(2, order, "module", 1, PERIOD_NS // (4 if order == "any" else 2))
        sent = regular(device, 7)
        for begin, end in every_run(device):
            for stall_begin, stall_cycles in ((0, 0), (1, 2), (2, 1), (2, 2), (2, 3)):
                held = held_up(sent, stall_begin * PERIOD_NS, (stall_begin + stall_cycles) * PERIOD_NS + MS // 8)
                assert torn(device, held[:begin] + held[end:]) == 0, (order, begin, end, stall_begin, stall_cycles)


def test_a_patch_that_sends_faster_than_it_should_is_told_of_once(caplog: pytest.LogCaptureFixture) -> None:
    device = Device(2, "given", "module", 1, PERIOD_NS // 2)
    sent = [frame._replace(time_ns=frame.time_ns // 4, serial=n) for n, frame in enumerate(regular(device, 200))]
    joined, _ = device.joined(sent, cuts=[100, 400])
    assert len(joined) == MODULES  # the first cycle of each
    (told,) = caplog.records
    assert told.getMessage().startswith("p sends its cycles so fast that several fit into the layout's maximum_age_s")


def test_a_patch_that_is_slower_than_it_should_be_is_shown() -> None:
    device = Device(2, "given", "module", 1, PERIOD_NS // 2)
    sent = [frame._replace(time_ns=frame.time_ns * 3, serial=n) for n, frame in enumerate(regular(device, 20))]
    assert len(device.joined(sent)[0]) >= MODULES * (20 - 2)


# What no program can tell from good data, where there is no counter: docs/explanation/layout.md names each


def two_halves(*cycles: tuple[int, float, float]) -> list[Sent]:
    """Cycles of one module of two members: number, and when its halves come, in periods; NaN: lost."""
    sent = [
        Sent(round(when * PERIOD_NS) + MS, 0, place, cycle, 0)
        for cycle, *times in cycles
        for place, when in enumerate(times)
        if when == when
    ]
    return sorted(sent, key=lambda frame: frame.time_ns)


LOST = float("nan")
UNCOUNTED = Device(2, "given", "module", 1, PERIOD_NS // 2)
COUNTED = Device(2, "given", "module", 16, PERIOD_NS // 2)


@pytest.mark.parametrize(
    "cycles",
    [
        pytest.param([(0, 0.9, LOST), (1, LOST, 1.1)], id="the first cycle that is heard"),
        pytest.param(
            [(0, 0, 0.1), (1, 1.2, 1.3), (2, 2.6, 2.65), (3, 3.95, LOST), (4, LOST, 4.1)],
            id="a sender that falls behind little by little, and loses frames as it catches up",
        ),
        pytest.param(
            [(0, 0, 0.1), (1, LOST, LOST), (2, 2, 2.1), (3, 4.9, LOST), (4, LOST, LOST), (5, LOST, 5.1)],
            id="a sender that stands still in the cycle after one that was lost",
        ),
        pytest.param(
            [(0, 0, 0.1), (1, 1, 1.1), (1, 2, LOST), (2, LOST, 2.1), (3, 3, 3.1)],
            id="a frame repeated a period later, in place of one that was lost",
        ),
        pytest.param(
            [(0, 0, 0.1), (1, 1, 1.1), (1, LOST, 2.05), (2, 2, 2.1), (3, 3, 3.1)],
            id="a frame repeated a period later, just before the one that belongs there",
        ),
    ],
)
def test_without_a_counter_these_cannot_be_told_from_good_data(cycles: list[tuple[int, float, float]]) -> None:
    sent = two_halves(*cycles)
    assert torn(UNCOUNTED, sent) == 1
    assert torn(COUNTED, sent) == 0


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("uncounted", "after"), [(False, 0.9), (False, 0.95), (False, 1.05), (True, 1.05), (True, 1.2), (True, 1.5)]
)
def test_a_frame_repeated_a_period_later_is_not_joined_with_the_other_half(
    uncounted: bool, after: float, order: Order
) -> None:
    """Beside the frame that belongs there; without a counter only if it comes after that one (see above)."""
    device = Device(2, order, "module", 1 if uncounted else 16, PERIOD_NS // 4)
    cycles = [(cycle, cycle, cycle + 0.1) for cycle in range(8)]
    for half in range(2):
        again = (3, 3 + after, LOST) if half == 0 else (3, LOST, 3.1 + after)
        sent = two_halves(*cycles, again)
        assert torn(device, sent) == 0, half
        shown, _ = device.joined([frame._replace(serial=number) for number, frame in enumerate(sent)])
        assert len(shown) >= 6, half  # one cycle is disturbed, and the one after it may be


def test_after_a_cycle_that_was_lost_whole_the_next_is_not_trusted_and_the_one_after_it_is() -> None:
    sent = [frame for frame in two_halves(*((c, c, c + 0.1) for c in range(6))) if frame.cycle != 2]
    numbered = [frame._replace(serial=number) for number, frame in enumerate(sent)]
    shown = [numbered[first].cycle for first, _ in UNCOUNTED.joined(numbered)[0]]
    assert shown == [0, 1, 4, 5]
