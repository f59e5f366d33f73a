"""What commands do to an MTB3 only, or other than to an MTB4.

Source: the application of the MTB3 in icub-firmware.
"""

from __future__ import annotations

import pytest

from .rig import ENABLE_ALL, Rig, constant_source, cycles


def test_discovery_silences_streaming_mtb3s_but_not_mtb4s() -> None:
    rig = Rig(boards=(7, 8), mtb3=(8,))
    for board in (7, 8):
        rig.configure(board)
    rig.run_ms(300)
    rig.send(0x70F, "FF")
    rig.run_ms(10)
    assert not rig.streams(8)
    assert rig.streams(7)
    assert [event.board for event in rig.events("board_silenced")] == [8]


@pytest.mark.parametrize(
    ("payload", "data"),
    [
        ("07 00", True),
        ("50 00 0F 02 01 00 22", True),
        ("4E 02 00 F0 08 FF FF 0A", True),
        ("4C 01 01 00 00 22 00 00", True),
        ("4D 00 32 F0", False),  # the timer runs again, but no triangle is enabled
        ("1C 02 00", False),
        ("4F 00 00", False),
    ],
)
def test_what_wakes_an_mtb3_that_discovery_silenced(payload: str, data: bool) -> None:
    rig = Rig(mtb3=(7,))
    rig.configure()
    rig.run_ms(300)
    rig.send(0x70F, "FF")
    rig.send(0x207, payload)
    rig.run_ms(10)
    assert rig.streams() is data
    rig.send(0x207, ENABLE_ALL)
    assert rig.streams()


def test_mtb3_goes_on_streaming_three_periods_after_set_triang_cfg() -> None:
    rig = Rig(mtb3=(7,))
    rig.configure(period_ms=20)
    rig.run_ms(500)
    rig.run_ms(10)
    sent_ns = rig.now_ns
    rig.send(0x207, "50 04 04 02 01 00 22")
    rig.run_ms(5)
    later = rig.run_ms(200)
    assert later[0].time_ns == sent_ns + 60_000_000
    assert len(cycles(later)) == 8


def test_mtb3_stays_silent_after_set_triang_cfg_if_it_was_silent() -> None:
    rig = Rig(mtb3=(7,))
    rig.configure(start=False)
    assert not rig.streams()


def test_mtb3_stays_stopped_after_a_stop() -> None:
    rig = Rig(mtb3=(7,))
    rig.configure()
    assert rig.streams()
    rig.send(0x207, "07 01")
    rig.configure(start=False)
    rig.run_ms(10)
    assert not rig.streams()


def test_mtb3_set_up_the_old_way_sends_class_3() -> None:
    rig = Rig(mtb3=(7,), source=constant_source(0xF0))
    rig.send(0x207, "4E 02 22 F0 08 03 80 0A")
    assert not rig.streams()
    rig.send(0x207, "4C 01 01 03 00 22 35 30")  # 12341 timer ticks of 3.2 us: 39.5 ms
    frames = rig.run_ms(1000)
    assert {frame.identifier for frame in frames} == {0x370, 0x371, 0x37F}
    assert frames[0].payload == bytes.fromhex("40 F0 F0 F0 F0 F0 F0 F0")
    assert frames[1].payload == bytes.fromhex("C0 F0 F0 F0 F0 F0 00 00")
    bursts = cycles(frames)
    assert bursts[1][0].time_ns - bursts[0][0].time_ns == 12341 * 3200


def test_mtb3_old_set_up_takes_shift_and_no_load() -> None:
    rig = Rig(mtb3=(7,), not_connected=("7/0",))
    rig.send(0x207, "4C 01 01 00 00 22 00 00")
    rig.send(0x207, "4E 03 00 EB 08 FF FF 0A")
    assert rig.run_ms(300)[0].payload == bytes.fromhex("40 EB EB EB EB EB EB EB")


def test_mtb3_old_set_up_takes_the_shift() -> None:
    def deepest(shift: int) -> int:
        rig = Rig(mtb3=(7,), seed=3)
        rig.send(0x207, "4C 01 01 00 00 22 00 00")
        rig.send(0x207, f"4E {shift:02X} 00 F0 08 FF FF 0A")
        return min(min(frame.payload[1:6]) for frame in rig.run_ms(5000))

    assert deepest(2) < deepest(3) < deepest(4)


def test_mtb3_old_averaging_modes_are_not_emulated() -> None:
    rig = Rig(mtb3=(7,))
    rig.send(0x207, "4C 11 01 00 00 22 00 00")
    assert not rig.streams()


def test_mtb3_leaves_class_3_once_set_up_the_new_way() -> None:
    rig = Rig(mtb3=(7,))
    rig.send(0x207, "4C 01 01 00 00 22 00 00")
    assert rig.run_ms(300)[0].identifier == 0x370
    rig.send(0x207, "07 00")
    assert rig.run_ms(100)[-1].identifier == 0x47F
