from __future__ import annotations

from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.finding.guess import Traffic
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


def test_nothing_heard_is_no_class() -> None:
    traffic = Traffic()
    assert (traffic.frames, traffic.classes()) == (0, [])
