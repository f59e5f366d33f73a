from __future__ import annotations

import pytest

from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.finding.traffic import Traffic
from skinware_drivers.link import Heard
from tests.finding.fakes import SKIN, traffic_of


def test_identifiers_are_sorted_into_classes() -> None:
    traffic = traffic_of(*SKIN, (0x48F, "40"), (0x101, ""), (EXTENDED_FLAG | 0x12345678, "01"), times=3)
    assert [(c.name, c.first, c.last, c.identifiers, c.frames) for c in traffic.classes()] == [
        ("1xx", 0x101, 0x101, 1, 3),
        ("4xx", 0x473, 0x48F, 2, 9),
        ("29-bit", 0x12345678, 0x12345678, 1, 3),
    ]
    assert traffic.frames == 15


def test_what_listeners_tell_apart_is_counted() -> None:
    assert traffic_of(*SKIN, times=2).heard() == {Heard(0x473, 0x40, 8): 2, Heard(0x473, 0xC0, 8): 2}


def test_nothing_heard_is_no_load_and_no_class() -> None:
    traffic = Traffic()
    assert (traffic.frames, traffic.classes(), traffic.load(1_000_000, 1.0)) == (0, [], 0.0)


@pytest.mark.parametrize(
    ("frame", "least_bits", "most_bits"),
    # without and with all stuff bits that there can be, and the three bits between frames: ISO 11898-1
    [((0x473, "40" * 8), 111, 135), ((0x473, ""), 47, 55), ((EXTENDED_FLAG | 1, "40" * 8), 131, 160)],
)
def test_the_load_lies_between_no_and_all_stuff_bits(frame: tuple[int, str], least_bits: int, most_bits: int) -> None:
    load = traffic_of(frame, times=1000).load(1_000_000, 2.0)
    assert load is not None
    assert 1000 * least_bits / 2e6 < load < 1000 * most_bits / 2e6


def test_the_load_of_fd_frames_is_not_known() -> None:
    assert traffic_of((0x100, "00" * 12)).load(1_000_000, 1.0) is None
