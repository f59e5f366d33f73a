"""The bytes of skin data, held against vectors written out by hand.

Sources: icub-firmware embot_prot_can_skin_periodic.cpp (HEAD, TAIL, diagnostics), embot_prot_can.cpp (identifiers).
"""

from __future__ import annotations

from .rig import Rig, constant_source, cycles

IDLE_HEAD = bytes.fromhex("40 F0 F0 F0 F0 F0 F0 F0")
IDLE_TAIL = bytes.fromhex("C0 F0 F0 F0 F0 F0 00 00")


def test_idle_triangle_3_of_board_7() -> None:
    rig = Rig(source=constant_source(0xF0))
    rig.configure()
    burst = cycles(rig.run_ms(60))[0]
    assert len(burst) == 32
    assert (burst[6].identifier, burst[6].payload) == (0x473, IDLE_HEAD)
    assert (burst[7].identifier, burst[7].payload) == (0x473, IDLE_TAIL)


def test_a_burst_is_head_and_tail_of_each_active_triangle_in_order() -> None:
    rig = Rig()
    rig.send(0x207, "4D 00 32 F0")
    rig.send(0x207, "50 02 03 02 01 00 22")
    rig.send(0x207, "50 09 09 02 01 00 22")
    rig.send(0x207, "07 00")
    burst = cycles(rig.run_ms(60))[0]
    assert [(frame.identifier, frame.payload[0]) for frame in burst] == [
        (0x472, 0x40),
        (0x472, 0xC0),
        (0x473, 0x40),
        (0x473, 0xC0),
        (0x479, 0x40),
        (0x479, 0xC0),
    ]


def test_values_are_taxels_0_to_6_and_7_to_11() -> None:
    rig = Rig(source=lambda board, triangle, cycle, time_ns: range(100, 112))
    rig.configure()
    head, tail = rig.run_ms(60)[:2]
    assert head.payload == bytes.fromhex("40 64 65 66 67 68 69 6A")
    assert tail.payload == bytes.fromhex("C0 6B 6C 6D 6E 6F 00 00")


def test_taxels_0_and_11_out_of_range() -> None:
    rig = Rig(out_of_range=("7/3/0", "7/3/11"), pattern="idle")
    rig.configure()
    head, tail = cycles(rig.run_ms(60))[0][6:8]
    assert tail.payload[6:] == bytes.fromhex("80 10")
    assert (head.payload[1], tail.payload[5]) == (0, 0)


def test_every_out_of_range_bit_has_its_taxel() -> None:
    masks = []
    for taxel in range(12):
        rig = Rig(out_of_range=(f"7/0/{taxel}",), pattern="idle")
        rig.configure(skin_type=2)
        masks.append(rig.run_ms(60)[1].payload[6:].hex())
    assert masks == ["0010", "0020", "0040", "0080", "0100", "0200", "0400", "0800", "1000", "2000", "4000", "8000"]


def test_a_broken_thermal_pad_takes_a_compensated_triangle_with_it() -> None:
    rig = Rig(out_of_range=("7/0/6",), pattern="idle")
    rig.configure(skin_type=0)
    head, tail = rig.run_ms(60)[:2]
    assert head.payload == bytes.fromhex("40 FF FF FF FF FF FF 00")
    assert tail.payload[1:4] == b"\xff" * 3
    assert tail.payload[6:] == bytes.fromhex("BF F0")  # all but channel 10, which has no gain


def test_a_triangle_never_connected_reads_exactly_its_idle_value_and_is_flagged() -> None:
    rig = Rig(not_connected=("7/3",))
    rig.configure()
    head, tail = cycles(rig.run_ms(60))[0][6:8]
    assert head.payload == IDLE_HEAD
    assert tail.payload == bytes.fromhex("C0 F0 F0 F0 F0 F0 00 02")


def test_a_triangle_never_connected_is_flagged_alike_by_the_older_board() -> None:
    rig = Rig(not_connected=("7/3",), mtb3=(7,))
    rig.configure()
    head, tail = cycles(rig.run_ms(260))[0][6:8]
    assert (head.payload, tail.payload) == (IDLE_HEAD, bytes.fromhex("C0 F0 F0 F0 F0 F0 00 02"))


def test_old_firmware_leaves_the_diagnostics_out() -> None:
    rig = Rig(source=constant_source(0xF0), short_tail=True)
    rig.configure()
    head, tail = rig.run_ms(60)[:2]
    assert head.payload == IDLE_HEAD
    assert tail.payload == bytes.fromhex("C0 F0 F0 F0 F0 F0")


def test_raw_test_mode_has_no_error_bits() -> None:
    rig = Rig(not_connected=("7/0",), out_of_range=("7/1/4",))
    rig.configure(skin_type=7)
    burst = cycles(rig.run_ms(60))[0]
    assert burst[0].payload == bytes.fromhex("40 FF FF FF FF FF FF FF")
    assert burst[1].payload == bytes.fromhex("C0 FF FF FF FF FF 00 00")
    assert burst[3].payload[6:] == b"\0\0"
    assert len({frame.payload[1] for frame in burst if frame.payload[0] == 0x40}) > 8  # low bytes, not values
