"""Whose frame is it: 29-bit identifiers, buses with different layouts, long frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.errors import ConfigurationError, StructureError
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch, wire_dtype
from skinware_drivers.decoding.addresses import Addresses
from skinware_drivers.decoding.decoder import PATCH_COUNTERS
from skinware_drivers.description import Module, Patch, SkinTables, assemble, join_types, taxels
from skinware_drivers.fields import Bits, Byte, Identifier
from skinware_drivers.layout import MOST_FRAMES, Cycle, Frame, Layout, Values
from tests.specification.decoding import SpecifiedDecoder, slots_of

TYPES = [PRESSURE.measured(unit="counts")]
NODE = Bits(shift=8, width=8)
PART = Bits(shift=0, width=4)
EXTENDED = Frame(
    "extended",
    when=(Identifier(EXTENDED_FLAG | 0x14F0_0000, mask=0x1FFF_0000),),
    length=(8,),
    values=Values(0, "<u2", 2),
    patch=NODE,
    module=PART,
)
"""Bits 4 to 7 of its identifiers mean nothing."""


def patches(*keys: int, modules: Sequence[int] = (0, 1)) -> list[Patch]:
    return [
        Patch(f"node {key}", [Module(taxels(2, first_uid=key << 16 | m << 8), key=m) for m in modules], key=key)
        for key in keys
    ]


def tables_of(*buses: list[Patch], dtype: str = "<u2") -> SkinTables:
    return assemble([(f"bus{number}", found) for number, found in enumerate(buses)], TYPES, dtype)


def run(decoder: SpecifiedDecoder, frames: Sequence[tuple[int, int, bytes]], payload_size: int = 8) -> list[int]:
    """Shows frames (bus, identifier, payload), all in one batch; the rows that were nobody's."""
    batch = FrameBatch(64 + len(frames), payload_size, decoder.compiled.headroom)
    decoder.put_back(batch)
    for number, (bus, identifier, payload) in enumerate(frames):
        batch.append(bus, 1 + number, identifier, payload)
    updates, foreign = decoder.decode(batch)
    decoder.count_unknown(batch, foreign)
    decoder.state.show(updates)
    rows: list[int] = (foreign - batch.headroom).tolist()
    return rows


def numbers(*values: int) -> bytes:
    return np.array(values, "<u2").tobytes().ljust(8, b"\0")


def extended(node: int, part: int, noise: int = 0) -> int:
    return EXTENDED_FLAG | 0x14F0_0000 | node << 8 | noise << 4 | part


def test_29_bit_identifiers_name_patch_and_module() -> None:
    decoder = SpecifiedDecoder([Layout([EXTENDED])], tables_of(patches(3, 0xC8)))
    foreign = run(
        decoder,
        [
            (0, extended(0xC8, 1), numbers(7, 8)),
            (0, extended(3, 0, noise=9), numbers(1, 2)),
            (0, extended(4, 0), numbers(9, 9)),  # no such node
            (0, extended(3, 2), numbers(9, 9)),  # no such part of it
            (0, extended(3, 0) ^ 0x0800_0000, numbers(9, 9)),  # another message
            (0, (extended(3, 0) & 0x7FF), numbers(9, 9)),  # 11 bits that look alike
            (0, extended(3, 0) & ~EXTENDED_FLAG, numbers(9, 9)),  # cannot be on a wire
        ],
    )
    assert decoder.state.values.tolist() == [1, 2, 0, 0, 0, 0, 7, 8]
    assert foreign == [2, 3, 4, 5, 6]
    assert decoder.state.bus_counters[0, :3].tolist() == [5, 0, 0]


def test_29_and_11_bits_side_by_side() -> None:
    standard = Frame("standard", (Identifier(0x100, mask=0x7F0),), (8,), Values(0, "<u2", 2), module=PART)
    layout = Layout([EXTENDED, standard])
    decoder = SpecifiedDecoder([layout], tables_of(patches(0)))
    run(decoder, [(0, 0x100, numbers(1, 2)), (0, extended(0, 1), numbers(3, 4)), (0, extended(0, 0), numbers(5, 6))])
    assert decoder.state.values.tolist() == [5, 6, 3, 4]


def test_29_bits_are_one_kind_or_another_by_a_byte_and_lengths_are_checked() -> None:
    when = EXTENDED.when
    head = Frame("head", (*when, Byte(0, 1)), (5,), Values(1, "<u2", 1, to=(0,)), NODE, PART)
    tail = Frame("tail", (*when, Byte(0, 2)), (5,), Values(1, "<u2", 1, to=(1,)), NODE, PART)
    layout = Layout([head, tail], Cycle(["head", "tail"], maximum_age_s=1.0))
    decoder = SpecifiedDecoder([layout], tables_of(patches(5)))
    at = extended(5, 1)
    run(
        decoder,
        [
            (0, at, b"\1\7\0\0\0"),
            (0, at, b"\2\x08\0\0\0"),
            (0, at, b"\1\1\0\0"),
            (0, at, b"\3\1\0\0\0"),
        ],
    )
    assert decoder.state.values.tolist() == [0, 0, 7, 8]
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 1, 1]


@pytest.mark.thorough
@given(st.lists(st.integers(0, 255), min_size=1, max_size=8, unique=True), st.data())
def test_29_bit_look_up_is_what_the_fields_say(keys: list[int], data: st.DataObject) -> None:
    tables = tables_of(patches(*keys, modules=(0, 5, 15)))
    addresses = Addresses([EXTENDED], [[0]], tables)
    wire = data.draw(
        st.lists(
            st.one_of(
                st.builds(extended, st.sampled_from(keys), st.integers(0, 15), st.integers(0, 15)),
                st.integers(0, 0xFFFF_FFFF),
            ),
            min_size=1,
            max_size=30,
        )
    )
    slots = slots_of(addresses, np.zeros(len(wire), np.uint16), np.array(wire, np.uint32))
    for identifier, slot in zip(wire, slots.tolist(), strict=True):
        patch = keys.index(identifier >> 8 & 0xFF) if (identifier >> 8 & 0xFF) in keys else None
        if not identifier & EXTENDED_FLAG or identifier & 0x1FFF_0000 != 0x14F0_0000 or patch is None:
            expected = tables.structure.n_modules + tables.structure.n_patches
        else:
            expected = tables.module_key.get((patch, identifier & 0xF), tables.structure.n_modules + patch)
        assert addresses.entry[slot] == expected


def test_every_bus_has_its_own_layout() -> None:
    def of(first: int, order: Sequence[int]) -> Layout:
        return Layout([Frame("data", (Identifier(first),), (8,), Values(0, "<u2", 2, to=order))])

    layouts = [of(0x100, (0, 1)), of(0x100, (1, 0)), of(0x200, (0, 1)), None, of(0x100, (0, 1))]
    found = [patches(0, modules=(0,)) for _ in range(5)]
    found[3] = []
    decoder = SpecifiedDecoder(layouts, tables_of(*found))
    foreign = run(
        decoder,
        [(bus, identifier, numbers(bus, identifier)) for bus in range(5) for identifier in (0x100, 0x200)],
    )
    assert decoder.state.values.tolist() == [0, 0x100, 0x100, 1, 2, 0x200, 4, 0x100]
    assert foreign == [1, 3, 4, 6, 7, 9]


def test_cycles_of_two_layouts_wait_for_the_next_batch_side_by_side() -> None:
    def of(first: int) -> Layout:
        frames = [Frame(f"f{i}", (Identifier(first + i),), (8,), Values(0, "<u2", 1, to=(i,))) for i in range(2)]
        return Layout(frames, Cycle(["f0", "f1"], maximum_age_s=1.0))

    decoder = SpecifiedDecoder([of(0x100), of(0x200)], tables_of(patches(0, modules=(0,)), patches(0, modules=(0,))))
    run(decoder, [(1, 0x200, numbers(1)), (0, 0x100, numbers(2))])
    assert decoder.state.values.tolist() == [0, 0, 0, 0]
    run(decoder, [(0, 0x101, numbers(3)), (1, 0x201, numbers(4))])
    assert decoder.state.values.tolist() == [2, 3, 1, 4]
    assert not decoder.state.patch_counters[:, PATCH_COUNTERS.index("orphans")].any()


def test_frames_of_three_kilobytes() -> None:
    count = 1540
    layout = Layout([Frame("data", (), (2 * count,), Values(0, "<u2", count))])
    assert layout.payload_size >= 2 * count
    assert wire_dtype(layout.payload_size)["length"].itemsize == 4
    decoder = SpecifiedDecoder([layout], tables_of([Patch("p", [Module(taxels(count))])]))
    values = np.arange(count, dtype="<u2")
    foreign = run(decoder, [(0, 0, values.tobytes()), (0, 0, values[:-1].tobytes())], layout.payload_size)
    assert foreign == []
    assert (decoder.state.values == values).all()
    assert decoder.state.bus_counters[0, :3].tolist() == [0, 1, 0]


def test_types_of_several_buses_are_put_together() -> None:
    counts, celsius = PRESSURE.measured(unit="counts"), TEMPERATURE.measured(unit="degC")
    assert join_types([[counts], [celsius, counts]]) == [counts, celsius]
    with pytest.raises(StructureError, match="the buses disagree on the type 'pressure'"):
        join_types([[counts], [PRESSURE.measured(unit="N")]])


def test_identifiers_that_cannot_be_matched_are_refused() -> None:
    values = Values(0, "u1", 1)
    with pytest.raises(ConfigurationError, match="either 11 bits or 29"):
        Layout([Frame("f", (Identifier(1), Identifier(EXTENDED_FLAG | 2)), (8,), values)])
    with pytest.raises(ConfigurationError, match="0x7FF has bits outside its mask 0xF0: none matches"):
        Layout([Frame("f", (Identifier(0x7FF, 0xF0),), (8,), values)])
    layouts = [
        Layout([Frame(f"f{i}", (Identifier(i),), (8,), values) for i in range(bus, MOST_FRAMES // 2 + 1)])
        for bus in range(2)
    ]
    with pytest.raises(ConfigurationError, match="a driver takes 200: run several"):
        SpecifiedDecoder(layouts, tables_of(patches(0), patches(0)))


def test_a_wide_key_of_a_module_is_not_taken_for_one_of_the_next_patch() -> None:
    patch, module = Bits(shift=20, width=8), Bits(shift=0, width=20)
    frame = Frame("f", (Identifier(EXTENDED_FLAG, mask=0),), (8,), Values(0, "<u2", 2), patch=patch, module=module)
    decoder = SpecifiedDecoder([Layout([frame])], tables_of(patches(0, 1, modules=(1,))))
    foreign = run(
        decoder, [(0, EXTENDED_FLAG | 0x1_0001, numbers(9, 9)), (0, EXTENDED_FLAG | 1 << 20 | 1, numbers(1, 2))]
    )
    assert foreign == [0]
    assert decoder.state.values.tolist() == [0, 0, 1, 2]


@pytest.mark.parametrize("bits", [Bits(0, 0), Bits(-1, 4), Bits(16, 16), Bits(0, 30)])
def test_a_key_that_no_identifier_has_room_for_is_refused(bits: Bits) -> None:
    with pytest.raises(ConfigurationError, match="an identifier has at most 29 bits"):
        Layout([Frame("f", (), (8,), Values(0, "u1", 1), module=bits)])
