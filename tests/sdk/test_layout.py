"""The layout vocabulary beyond what one driver uses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest

from skinware import Status
from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers.bus import FrameBatch
from skinware_drivers.decoding.decoder import PATCH_COUNTERS
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.fields import Above, Bits, Byte, Flag, Identifier, Packed, Sentinel, SequenceNumber, StatusBytes
from skinware_drivers.layout import Cycle, Expand, Frame, Layout, Values
from skinware_drivers.native.compiling import check_values
from tests.specification.both_paths import Pair, hand_clock, require_same
from tests.specification.decoding import SpecifiedDecoder

TYPES = [PRESSURE.measured(unit="counts")]
ORDER = (11, 15, 14, 12, 9, 13, 8, 10, 6, 7, 4, 5, 2, 0, 3, 1)


def decode(
    layout: Layout, modules: Sequence[Module], dtype: str, frames: Sequence[tuple[int, bytes]], gap_ns: int = 1000
) -> SpecifiedDecoder:
    decoder = SpecifiedDecoder([layout], assemble([("bus", [Patch("patch", modules)])], TYPES, dtype))
    batch = FrameBatch(256, layout.payload_size, decoder.compiled.headroom)
    decoder.put_back(batch)
    for number, (identifier, payload) in enumerate(frames):
        batch.append(0, 1 + number * gap_ns, identifier, payload)
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    with hand_clock() as clock, Pair(clock, [layout], decoder.tables, [1.0]) as pair:
        pair.feed([(0, 1 + number * gap_ns, *frame) for number, frame in enumerate(frames)])
    return decoder


def one(values: Values | Sequence[Values] | Expand, length: int = 8, **more: Any) -> Layout:
    return Layout([Frame("data", [Identifier(0x100)], (length,), values, **more)])


def fingertip(order: Literal["given", "any", "ends_with"] = "given") -> Layout:
    """Sixteen taxels in four frames, permuted, as the CPM finger sends them."""
    frames = [
        Frame(f"q{i}", [Identifier(0x405 + 2 * i)], (8,), Values(0, "<u2", 4, ORDER[4 * i : 4 * i + 4]))
        for i in range(4)
    ]
    return Layout(frames, Cycle([f.name for f in frames], maximum_age_s=0.02, order=order))


def quarters(base: int) -> list[tuple[int, bytes]]:
    raw = [base + channel for channel in ORDER]
    return [(0x405 + 2 * i, np.array(raw[4 * i : 4 * i + 4], "<u2").tobytes()) for i in range(4)]


def test_a_permuted_fingertip_of_four_frames() -> None:
    decoder = decode(fingertip(), [Module(taxels(16))], "<u2", quarters(1000))
    assert decoder.state.values.tolist() == list(range(1000, 1016))
    assert not decoder.state.status.any()


@pytest.mark.parametrize(
    ("order", "sent", "shown"),
    [
        ("given", (0, 1, 2, 3), True),
        ("given", (0, 2, 1, 3), False),
        ("any", (3, 1, 0, 2), True),
        ("any", (3, 1, 1, 2), False),
        ("ends_with", (2, 0, 1, 3), True),
        ("ends_with", (3, 0, 1, 2), False),
    ],
)
def test_orders_of_a_cycle(order: Literal["given", "any", "ends_with"], sent: tuple[int, ...], shown: bool) -> None:
    frames = quarters(0)
    decoder = decode(fingertip(order), [Module(taxels(16))], "<u2", [frames[i] for i in sent])
    assert bool(decoder.state.updated[0]) is shown
    assert (decoder.state.status[0] == Status.NEVER_SEEN) is not shown


def test_any_order_takes_each_frame_once() -> None:
    frames = quarters(0)
    decoder = decode(fingertip("any"), [Module(taxels(16))], "<u2", [*frames, *frames, *frames[:2]])
    assert decoder.state.patch_counters[0, PATCH_COUNTERS.index("updates")] == 2


def rows(module: int, count: int) -> tuple[list[Frame], Cycle]:
    """A matrix of one column: a frame for each row, which the second byte numbers."""
    frames = [
        Frame(
            f"module {module}, row {row}",
            [Identifier(0x300), Byte(0, module), Byte(1, row)],
            [3],
            Values(2, "u1", 1, [row]),
            module=Bits(0, 8, byte=0),
        )
        for row in range(count)
    ]
    return frames, Cycle([frame.name for frame in frames], maximum_age_s=0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("lost", [None, 0, 50, 120])
def test_modules_whose_cycles_are_of_other_frames_and_long(lost: int | None) -> None:
    (short, first), (long, second) = rows(1, 3), rows(2, 100)
    layout = Layout([*short, *long], first, [second])
    sent = [(0x300, bytes([1 + module, row, row])) for module, count in ((0, 3), (1, 100)) for row in range(count)]
    mixed = [frame for pair in zip(sent[:3], sent[3:6], strict=True) for frame in pair] + sent[6:]
    if lost is not None:
        del mixed[min(lost, len(mixed) - 1)]
    modules = [Module(taxels(3), key=1), Module(taxels(100, first_uid=3), key=2)]
    decoder = decode(layout, modules, "u1", mixed, gap_ns=100_000)
    whole = [lost != 0, lost in (None, 0)]
    assert decoder.state.updated.tolist() == whole
    shown = decoder.state.status == 0
    assert shown.tolist() == [whole[0]] * 3 + [whole[1]] * 100
    assert (decoder.state.values[3:][shown[3:]] == np.arange(100)[shown[3:]]).all()
    require_same(layout, decoder.tables, 1.0, 8, [(at * 100_000, *frame) for at, frame in enumerate(mixed, 1)])


@pytest.mark.parametrize(
    ("dtype", "payload", "expected"),
    [
        ("<i2", "ff7f0080ffff0000", [32767, -32768, -1, 0]),
        (">i2", "7fff8000ffff0000", [32767, -32768, -1, 0]),
        (Packed(12), "abc123fff0000000", [0xABC, 0x123, 0xFFF, 0x000]),
        (Packed(12, order="little"), "bc3a12ff0f000000", [0xABC, 0x123, 0xFFF, 0x000]),
        (Packed(12, signed=True), "8007ffffF0000000", [-2048, 2047, -1, 0]),
        (Packed(1), "a000000000000000", [1, 0, 1, 0]),
        (Packed(12, skip=4), "3abc123def456789", [0xABC, 0x123, 0xDEF, 0x456, 0x789]),
        (Packed(3, order="little", skip=2), "a4d1000000000000", [1, 5, 1, 2, 3]),
    ],
)
def test_values_at_their_extremes(dtype: str | Packed, payload: str, expected: list[int]) -> None:
    n = len(expected)
    decoder = decode(one(Values(0, dtype, n)), [Module(taxels(n))], "<i4", [(0x100, bytes.fromhex(payload))])
    assert decoder.state.values.tolist() == expected


def test_several_runs_of_values_in_one_frame() -> None:
    runs = (Values(0, "<i2", 2, to=(3, None)), Values(4, "u1", 2, to=(0, 1)), Values(6, ">u2", 1, to=(2,)))
    layout = Layout([Frame("data", [Identifier(0x100)], (8,), runs)])
    frame = bytes.fromhex("feff 0900 07 08 0102".replace(" ", ""))
    decoder = decode(layout, [Module(taxels(4))], "<i4", [(0x100, frame)])
    assert decoder.state.values.tolist() == [7, 8, 0x102, -2]
    assert decoder.state.status.tolist() == [0] * 4


def test_integers_beside_floats_are_compared_as_numbers() -> None:
    runs = Values(0, "<f4", 2, to=(3, 0)), Values(8, ">u4", 2, to=(2, 1)), Values(16, Packed(4), 2, to=(4, 5))
    flags = [Sentinel(Status.MASKED, 7), Above(Status.SUSPECT, 99.5), Sentinel(Status.NO_ACK, float("nan"))]
    payload = bytes.fromhex("0000e040 0100a07f 00000064 00000007 78")  # the second is a signaling NaN
    decoder = decode(one(runs, 17, flags=flags), [Module(taxels(6))], "<f4", [(0x100, payload)])
    assert decoder.state.values[1:].tolist() == [7, 100, 7, 7, 8]
    nan, seven, above = Status.NO_ACK, Status.MASKED, Status.SUSPECT
    assert decoder.state.status.tolist() == [nan, seven, above, seven, seven, 0]


def test_frames_of_one_patch_and_one_module_alone() -> None:
    layout = Layout(
        [
            Frame(f"{patch} {module}", [Identifier(identifier)], (1,), Values(0, "u1", 1), patch=patch, module=module)
            for identifier, patch, module in ((0x181, 1, 5), (0x345, 1, 6), (0x7FF, 2, 5))
        ]
    )
    patches = [
        Patch("first", [Module(taxels(1, first_uid=key), key=key) for key in (5, 6)], key=1),
        Patch("second", [Module(taxels(1, first_uid=7), key=5)], key=2),
    ]
    decoder = SpecifiedDecoder([layout], assemble([("bus", patches)], TYPES, "u1"))
    batch = FrameBatch(8, 8, decoder.compiled.headroom)
    for identifier, value in ((0x345, 20), (0x7FF, 30), (0x181, 10), (0x182, 99)):
        batch.append(0, 1, identifier, bytes([value]))
    updates, foreign = decoder.decode(batch)
    decoder.state.show(updates)
    assert decoder.state.values.tolist() == [10, 20, 30]
    assert foreign.tolist() == [3]


def test_dropped_values_go_nowhere() -> None:
    layout = one(Values(0, "u1", 8, to=(0, None, 1, None, 2, None, 3, None)))
    decoder = decode(layout, [Module(taxels(4))], "u1", [(0x100, bytes(range(1, 9)))])
    assert decoder.state.values.tolist() == [1, 3, 5, 7]


def test_a_module_named_in_the_payload() -> None:
    layout = one(Values(1, "u1", 4), module=Bits(shift=4, width=4, byte=0))
    modules = [Module(taxels(4, first_uid=10 * key), key=key) for key in (1, 2)]
    frames = [(0x100, bytes((0x20, 5, 6, 7, 8, 0, 0, 0))), (0x100, bytes((0x30, 9, 9, 9, 9, 0, 0, 0)))]
    decoder = decode(layout, modules, "u1", frames)
    assert decoder.state.values.tolist() == [0, 0, 0, 0, 5, 6, 7, 8]
    assert decoder.state.bus_counters[0, 0] == 1


@pytest.mark.parametrize(
    ("layout", "frame", "counted"),
    [
        (one(Values(0, "u1", 1), length=4, module=Bits(0, 4)), (0x100, bytes(4)), (1, 0, 0)),
        (one(Values(0, "u1", 1), length=4, module=Bits(0, 4)), (0x100, bytes(3)), (1, 0, 0)),
        (one(Values(1, "u1", 1), length=4, module=Bits(0, 8, byte=0)), (0x100, bytes(4)), (1, 0, 0)),
        (one(Values(1, "u1", 1), length=4, module=Bits(0, 8, byte=0)), (0x100, bytes(3)), (1, 0, 0)),
        (one(Values(1, "u1", 1), length=4, module=Bits(0, 8, byte=0)), (0x100, b"\x07\0\0"), (0, 1, 0)),
        (one(Values(1, "u1", 1), length=4, module=Bits(0, 8, byte=0)), (0x100, b""), (0, 1, 0)),
    ],
)
def test_a_frame_of_a_wrong_length_or_an_unknown_module_is_counted_once(
    layout: Layout, frame: tuple[int, bytes], counted: tuple[int, int, int]
) -> None:
    decoder = decode(layout, [Module(taxels(1), key=7)], "u1", [frame])
    assert tuple(decoder.state.bus_counters[0, :3].tolist()) == counted


@pytest.mark.parametrize("when", [[Identifier(0x100)], [Identifier(0x100), Byte(0, 0)]])
def test_frames_that_are_longer_than_all_of_the_layout(when: Sequence[Identifier | Byte]) -> None:
    """Rows can be longer than the layout's frames: a device answers questions over the same line."""
    layout = Layout([Frame("data", when, (20,), Values(0, "u1", 1))])
    decoder = SpecifiedDecoder([layout], assemble([("bus", [Patch("patch", [Module(taxels(1))])])], TYPES, "u1"))
    batch = FrameBatch(10, 1000)
    for identifier in (0x100, 0x101):
        for length in (20, 21, 255, 256, 1000):
            batch.append(0, 1, identifier, bytes(length))
    updates, foreign = decoder.decode(batch)
    assert len(updates) == 1
    assert decoder.state.bus_counters[0].tolist() == [0, 4, 0, 0]
    assert batch.wire["identifier"][foreign].tolist() == [0x101] * 5


def test_sentinels_and_flags() -> None:
    flags = [
        Sentinel(Status.NOT_CONNECTED, 0xFFFF),
        Flag(Status.NO_ACK, 6, "u1", each=[(0, 0), (2, 7)]),
        Flag(Status.OUT_OF_RANGE, 7, "u1", mask=0x10),
    ]
    layout = one(Values(0, "<u2", 3), flags=flags)
    decoder = decode(layout, [Module(taxels(3))], "<u2", [(0x100, bytes.fromhex("0100ffff02008000"))])
    assert decoder.state.status.tolist() == [0, int(Status.NOT_CONNECTED), int(Status.NO_ACK)]
    decoder = decode(layout, [Module(taxels(3))], "<u2", [(0x100, bytes.fromhex("0100010002000010"))])
    assert decoder.state.status.tolist() == [int(Status.OUT_OF_RANGE)] * 3
    nan = one(Values(0, "<f4", 2), flags=[Sentinel(Status.NOT_CONNECTED, float("nan"))])
    payload = np.array([np.nan, 0.5], "<f4").tobytes()
    decoder = decode(nan, [Module(taxels(2))], "<f4", [(0x100, payload)])
    assert decoder.state.status.tolist() == [int(Status.NOT_CONNECTED), 0]


@pytest.mark.parametrize(
    ("dtype", "limit", "values", "flagged"),
    [
        ("<u2", 4096, [4095, 4096, 4097, 65535], [0, 0, 1, 1]),
        ("<u2", 70_000, [0, 65535], [0, 0]),
        ("<u2", -1, [0, 65535], [1, 1]),
        ("<i2", -5, [-6, -5, -4, 0], [0, 0, 1, 1]),
        ("<i2", 1.5, [1, 2], [0, 1]),
        ("<f4", 0.5, [0.5, 0.75, np.nan, np.inf], [0, 1, 0, 1]),
    ],
)
def test_values_above_a_limit(dtype: str, limit: float, values: list[float], flagged: list[int]) -> None:
    n = len(values)
    payload = np.array(values, dtype).tobytes()
    layout = one(Values(0, dtype, n), len(payload), flags=[Above(Status.SUSPECT, limit)])
    decoder = decode(layout, [Module(taxels(n))], dtype, [(0x100, payload)])
    assert decoder.state.status.tolist() == [int(Status.SUSPECT) * one_of for one_of in flagged]


def test_flags_in_the_upper_half_of_a_long_word() -> None:
    flags = [Flag(Status.NO_ACK, 0, "<u8", mask=1 << 63), Flag(Status.MASKED, 0, "<u8", each=[(1, 40)])]
    layout, modules = one(Values(0, "u1", 2), flags=flags), [Module(taxels(2))]
    highest = decode(layout, modules, "u1", [(0x100, (1 << 63).to_bytes(8, "little"))])
    assert highest.state.status.tolist() == [Status.NO_ACK, Status.NO_ACK]
    other = decode(layout, modules, "u1", [(0x100, (1 << 40).to_bytes(8, "little"))])
    assert other.state.status.tolist() == [0, Status.MASKED]


@pytest.mark.parametrize(("word", "flagged"), [(1, [0, 0]), (0, [1, 1]), (3, [1, 1]), (0x101, [0, 2]), (0x100, [1, 3])])
def test_a_word_that_tells_something_where_it_is_not_normal(word: int, flagged: list[int]) -> None:
    flag, other = Status.NO_ACK, Status.MASKED
    flags = [Flag(flag, 2, ">u2", mask=0xFF, normal=1), Flag(other, 2, ">u2", each=[(1, 8)], normal=1)]
    layout = one(Values(0, "u1", 2), 4, flags=flags)
    decoder = decode(layout, [Module(taxels(2))], "u1", [(0x100, b"\0\0" + word.to_bytes(2, "big"))])
    means = [0, flag, other, flag | other]
    assert decoder.state.status.tolist() == [means[one_of] for one_of in flagged]


FINGERS = Flag(Status.NOT_CONNECTED, 0, "<u2", normal=0x0300, each_module=[(key, 8 + key) for key in range(3)])


def test_a_status_frame_flags_other_modules_until_the_next_one() -> None:
    """Bit 8 + key is clear while the finger is connected, but for the third, which says the opposite."""
    finger = Frame("finger", [Identifier(0x100, 0x7F0)], (1,), Values(0, "u1", 1), module=Bits(0, 4))
    status = Frame("status", [Identifier(0x200)], (2, 3), flags=[FINGERS], module=0, period_s=1.0)
    fingers = [(0x100 + key, bytes([7])) for key in range(3)]
    modules = [Module(taxels(1, first_uid=key), key=key) for key in range(3)]

    def after(*frames: tuple[int, bytes]) -> list[int]:
        found: list[int] = decode(Layout([finger, status]), modules, "u1", frames).state.status.tolist()
        return found

    lost = int(Status.NOT_CONNECTED)
    assert after(*fingers, (0x200, b"\0\1")) == [0, 0, 0]  # from their next update on
    assert after((0x200, b"\0\1"), *fingers) == [0, lost, 0]
    assert after((0x200, b"\0\4"), *fingers) == [lost, lost, lost]
    assert after((0x200, b"\0\4"), *fingers, (0x200, b"\0\3"), *fingers[1:]) == [lost, 0, 0]
    assert after((0x200, b"\0"), *fingers) == [0, 0, 0]  # of a wrong length


def test_a_restarted_patch_has_no_flags_of_before() -> None:
    status = Frame("status", [Identifier(0x200)], (2,), flags=[replace(FINGERS, normal=0)], module=0)
    decoder = decode(Layout([status]), [Module(taxels(1))], "u1", [(0x200, b"\0\1")])
    assert decoder.module_flags.tolist() == [int(Status.NOT_CONNECTED)]
    decoder.forget(0)
    assert decoder.module_flags.tolist() == [0]


def test_a_status_byte_for_each_value_that_may_be_absent() -> None:
    mask = Status.NO_ACK | Status.SUSPECT
    frame = Frame("d", [Identifier(0x100)], (2, 4), Values(0, "u1", 2, to=(1, 0)), flags=[StatusBytes(2, mask)])
    modules = [Module(taxels(2))]
    decoder = decode(Layout([frame]), modules, "u1", [(0x100, bytes((5, 6, 0xF7, 0x08)))])
    assert decoder.state.status.tolist() == [int(Status.NO_ACK), int(Status.SUSPECT)]
    assert decoder.state.values.tolist() == [6, 5]
    decoder = decode(Layout([frame]), modules, "u1", [(0x100, bytes((5, 6, 0xF7, 0x08))), (0x100, bytes((7, 8)))])
    assert decoder.state.status.tolist() == [0, 0]


def test_flags_behind_all_payloads_are_never_set() -> None:
    flags = [Flag(Status.NO_ACK, 8, "<u2", mask=0xFFFF), StatusBytes(7, mask=Status.MASKED)]
    decoder = decode(one(Values(0, "u1", 2), flags=flags), [Module(taxels(2))], "u1", [(0x100, bytes([255] * 8))])
    assert decoder.state.values.tolist() == [255, 255]
    assert not decoder.state.status.any()


@pytest.mark.parametrize(
    "sequence", [SequenceNumber(0, "<u8", mask=0xFFFF_FFFF << 32), SequenceNumber(0, "<u8", modulo=1000)]
)
def test_sequence_numbers_in_long_words(sequence: SequenceNumber) -> None:
    sent = [(0x100, (number << sequence.shift).to_bytes(8, "little")) for number in (997, 998, 1, 1)]
    decoder = decode(one(Values(0, "u1", 1), sequence=sequence), [Module(taxels(1))], "u1", sent)
    lost, repeated, back = (
        decoder.state.patch_counters[0, PATCH_COUNTERS.index(f"sequence_{what}")]
        for what in ("lost", "repeated", "back")
    )
    assert (lost, repeated, back) == ((2, 1, 0) if sequence.modulo else (0, 1, 1))


def test_expand_is_the_escape() -> None:
    def run_lengths(
        payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[Any]]:
        rows: list[int] = []
        channels: list[int] = []
        values: list[int] = []
        for row, (data, size) in enumerate(zip(payload, length, strict=True)):
            expanded = np.repeat(data[1:size:2], data[0:size:2])
            rows += [row] * len(expanded)
            channels += range(len(expanded))
            values += expanded.tolist()
        return np.array(rows, np.int64), np.array(channels, np.int64), np.array(values)

    frame = (0x100, bytes((3, 7, 2, 9, 1, 4, 1, 5)))
    decoder = decode(one(Expand(run_lengths)), [Module(taxels(5))], "u1", [frame])
    assert decoder.state.values.tolist() == [7, 7, 7, 9, 9]  # two more than there are channels are dropped


Expanded = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[Any]]


def one_value_below_128(payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8]) -> Expanded:
    rows = np.arange(len(payload))
    if (payload[:, 0] > 127).any():
        raise ValueError("what is this?")
    return rows, np.zeros_like(rows), payload[:, 0].astype(np.int64)


def test_an_expand_that_raises_costs_the_frames_for_which_it_does(caplog: pytest.LogCaptureFixture) -> None:
    layout = Layout(
        [
            Frame("expanded", [Identifier(0x100)], [8], Expand(one_value_below_128), module=0),
            Frame("beside", [Identifier(0x101)], [8], Values(0, "u1", 1), module=1),
        ]
    )
    modules = [Module(taxels(1), key=0), Module(taxels(1, first_uid=1), key=1)]
    sent = [(0x100, bytes([value] + [0] * 7)) for value in (1, 200, 3, 201)] + [(0x101, bytes([255] * 8))]
    decoder = decode(layout, modules, "i2", sent)
    assert decoder.state.values.tolist() == [3, 255]
    assert not decoder.state.status.any()
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 0, 2]
    assert decoder.state.patch_counters[0, PATCH_COUNTERS.index("updates")] == 3
    (told,) = {record.getMessage() for record in caplog.records}  # once of each decoder
    assert "frame 'expanded': its Expand function raised ValueError: what is this? (" in told
    assert "test_layout.py:" in told


def test_an_expand_is_not_asked_about_nothing(caplog: pytest.LogCaptureFixture) -> None:
    """Half a cycle that never became whole leaves no frame to expand."""

    def needs_a_frame(payload: npt.NDArray[np.uint8], length: npt.NDArray[np.uint8]) -> Expanded:
        row = np.arange(len(payload))
        return row, row * 0, payload[:, int(length.max()) - 1]

    layout = Layout(
        [
            Frame("expanded", [Identifier(0x100)], [8], Expand(needs_a_frame)),
            Frame("beside", [Identifier(0x101)], [8], Values(0, "u1", 1, to=[1])),
        ],
        Cycle(["expanded", "beside"], 0.01),
    )
    decoder = decode(layout, [Module(taxels(2))], "u1", [(0x101, bytes(8))])
    assert decoder.state.patch_counters[0, PATCH_COUNTERS.index("orphans")] == 1
    assert not caplog.records


def test_half_a_cycle_that_cannot_be_expanded_shows_nothing() -> None:
    layout = Layout(
        [
            Frame("expanded", [Identifier(0x100)], [8], Expand(one_value_below_128)),
            Frame("plain", [Identifier(0x101)], [8], Values(0, "u1", 1, to=[1])),
        ],
        Cycle(["expanded", "plain"], maximum_age_s=1),
    )
    sent = [(0x100, bytes([5] * 8)), (0x101, bytes([6] * 8)), (0x100, bytes([128] * 8)), (0x101, bytes([7] * 8))]
    decoder = decode(layout, [Module(taxels(2))], "u1", sent)
    assert decoder.state.values.tolist() == [5, 6]
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 0, 1]
    counters = dict(zip(PATCH_COUNTERS, decoder.state.patch_counters[0].tolist(), strict=True))
    assert (counters["updates"], counters["orphans"]) == (1, 1)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (
            lambda payload, length: (np.arange(2), np.zeros(1, np.int64), np.zeros(1)),
            "ValueError: it returned 2 rows, 1 channels, 1 float64 values",
        ),
        (lambda payload, length: (np.array([9]), np.array([0]), np.array([1])), "IndexError: "),
        (
            lambda payload, length: (np.array([0]), np.array([0]), np.array(["one"])),
            "ValueError: it returned 1 rows, 1 channels, 1 <U3 values",
        ),
        (lambda payload, length: None, "TypeError: "),
        (
            lambda payload, length: (np.array([0, 0]), np.array([0, 0]), np.array([255, 256])),
            "ValueError: it returned 256: the driver's dtype uint8 cannot hold it",
        ),
        (
            lambda payload, length: (np.array([0]), np.array([0]), np.array([0.5])),
            "ValueError: it returned 0.5: the driver's dtype uint8 cannot hold it",
        ),
        (lambda payload, length: sys.exit(7), "SystemExit: 7"),
    ],
    ids=["unequal", "no such row", "no number", "nothing", "wider than the dtype", "a fraction", "the end"],
)
def test_what_an_expand_must_not_return_is_counted(wrong: Any, words: str, caplog: pytest.LogCaptureFixture) -> None:
    decoder = decode(one(Expand(wrong)), [Module(taxels(1))], "u1", [(0x100, bytes(8))])
    assert decoder.state.status.tolist() == [Status.NEVER_SEEN]
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 0, 1]
    assert f"frame 'data': its Expand function raised {words}" in caplog.text


def test_a_frame_without_conditions_is_every_frame_of_the_bus() -> None:
    layout = Layout([Frame("any", length=[1], values=Values(0, "u1", 1))])
    decoder = decode(layout, [Module(taxels(1))], "u1", [(0, b"\1"), (0x7FF, b"\2"), (0x123, b"\3"), (5, b"\1\2")])
    assert decoder.state.values.tolist() == [3]
    assert decoder.state.patch_counters[0, PATCH_COUNTERS.index("updates")] == 3
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Layout([Frame("f")]), "'f': say which payload lengths"),
        (lambda: Layout([Frame("f", length=[8])]), "'f': it has no values"),
        (lambda: one(Values(6, "<u2", 2)), "values end at byte 10"),
        (lambda: one(Values(0, "u1", 2, to=(0,))), "`count` is 2, but the length of `to` is 1"),
        (lambda: one(()), "it has no values"),
        (lambda: one((Values(0, "u1", 1), Values(7, "<u2", 1))), "values end at byte 9"),
        (lambda: one(Values(0, Packed(12, skip=8), 1)), "8 bits before the first value"),
        (lambda: one(Values(0, Packed(12, skip=5), 5)), "values end at byte 9"),
        (lambda: check_values(one(Values(0, "<f2", 1)).frames[0]), "'data': values of dtype float16 cannot"),
        (lambda: check_values(one([Values(0, "u8", 1), Values(0, ">i8", 1)]).frames[0]), "integers of another sign"),
        (lambda: check_values(one([Values(0, "uint64", 1), Values(0, "<f4", 1)]).frames[0]), "64-bit integers beside"),
        (lambda: check_values(one([Values(0, "u8", 1), Values(0, Packed(3), 1)]).frames[0]), "with an Expand function"),
        (lambda: Layout([]), "1 to 200 frames"),
        (lambda: Layout(fingertip().frames, Cycle(["q0", "q9"], 1.0)), "at least two different frames"),
        (lambda: Layout(rows(1, 3)[0], rows(1, 3)[1], [rows(1, 3)[1]]), "are members of two cycles"),
        (lambda: Layout(rows(1, 129)[0], rows(1, 129)[1]), "of 129 frames: in the order 'given' give at most 128"),
        (lambda: Layout(rows(1, 33)[0], replace(rows(1, 33)[1], order="any")), "in the order 'any' give at most 32"),
        (lambda: one(Values(0, "u1", 1), patch=Bits(0, 4, byte=0)), "a patch is named by bits of the identifier"),
        (lambda: one(Values(0, "u1", 1), sequence=SequenceNumber(7, "<u2")), "sequence number is not in every"),
        (lambda: Layout([Frame("f", [Byte(9, 1)], (8,), Values(0, "u1", 1))]), "byte 9 is not in every"),
        (lambda: one(Values(0, "u1", 1), sequence=SequenceNumber(0, "<u8")), "to more than 32 bits"),
        (lambda: one(Values(0, "u1", 1), flags=[Flag(Status.NO_ACK, 0, "u1", mask=0x100)]), "bits of an unsigned word"),
        (lambda: one(Values(0, "u1", 1), flags=[Flag(Status.NO_ACK, 0, "u1", each=[(0, 8)])]), "bits of an unsigned"),
        (lambda: one(Values(0, "u1", 1), flags=[Flag(Status.NO_ACK, 0, "<i2", mask=1)]), "unsigned word, not of '<i2'"),
        (lambda: one(Values(0, "u1", 1), flags=[Flag(Status.NO_ACK, 0, "u1", 1, normal=256)]), "bits of an unsigned"),
        (lambda: one((), flags=[Flag(Status.NO_ACK, 0, "u1", each_module=[(0, 8)])]), "bits of an unsigned word"),
        (lambda: one((), flags=[Flag(Status.NO_ACK, 0, "u1", each_module=[(0, 1), (0, 2)])]), "there are several"),
        (
            lambda: Layout([replace(rows(1, 2)[0][0], flags=[FINGERS]), rows(1, 2)[0][1]], rows(1, 2)[1]),
            "is shown by itself",
        ),
    ],
)
def test_layouts_that_cannot_be_decoded_are_refused(make: Any, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        make()
