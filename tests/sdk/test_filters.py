"""Kernel filters: exactly what the layout knows, and whatever somebody waits for while he waits."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skinware.errors import BusNotAvailable
from skinware_drivers.bus import EXTENDED_FLAG, REMOTE_FLAG, Bus, Filter, FrameBatch
from skinware_drivers.can import socketcan
from skinware_drivers.can.socketcan import MOST_FILTERS, SocketCanBus
from skinware_drivers.decoding.addresses import fewest, filters_of
from skinware_drivers.fields import Byte, Condition, Identifier, Match
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.link import Link

EVERY_STANDARD = np.arange(2048, dtype=np.int64)


def frame(name: str, *when: Condition) -> Frame:
    return Frame(name, when, length=(8,), values=Values(0, "u1", 8))


def passes(filters: Sequence[Filter], identifier: int) -> bool:
    """What can_rcv_filter of the kernel does."""
    return any(identifier & mask == value & mask for value, mask in filters)


def passing(filters: Sequence[Filter]) -> list[int]:
    return [identifier for identifier in EVERY_STANDARD.tolist() if passes(filters, identifier)]


def test_frames_of_the_layout_pass_and_no_others() -> None:
    layout = Layout(
        [
            frame("a", Identifier(0x470, 0x7F0), Byte(0, 0x40)),
            frame("b", Identifier(0x470, 0x7F0), Byte(0, 0xC0)),
            frame("c", Identifier(0x480, 0x7F0)),
            frame("d", Identifier(0x123)),
            frame("e", Identifier(EXTENDED_FLAG | 0x18FF_0042)),
            frame("f", Identifier(0x500, 0x700), Identifier(0x007, 0x00F)),
            frame("never", Identifier(0x500, 0x700), Identifier(0x600, 0x700)),
        ]
    )
    filters = filters_of(layout)
    wanted = [*range(0x470, 0x490), 0x123, *range(0x507, 0x600, 0x10)]
    assert passing(filters) == sorted(wanted)
    assert passes(filters, EXTENDED_FLAG | 0x18FF_0042)
    for other in (EXTENDED_FLAG | 0x123, 0x042, EXTENDED_FLAG | 0x18FF_0043, REMOTE_FLAG | 0x123):
        assert not passes(filters, other)
    assert len(filters) == 5  # those of a and b are one


def test_a_layout_without_identifiers_lets_all_pass() -> None:
    assert passing(filters_of(Layout([frame("any", Byte(0, 1))]))) == EVERY_STANDARD.tolist()


small = st.builds(Filter, st.integers(0, 0x3F), st.integers(0, 0x3F))


@given(st.lists(small, max_size=12))
def test_fewer_filters_let_the_same_through(filters: list[Filter]) -> None:
    less = fewest(filters)
    assert len(less) <= len({Filter(f.value & f.mask, f.mask) for f in filters}) or not filters
    for identifier in range(0x80):
        assert passes(less, identifier) == passes(filters, identifier)
    assert fewest(less) == less


@pytest.mark.thorough
def test_neighbours_become_one() -> None:
    assert fewest(Filter(identifier, 0x7FF) for identifier in range(0x400, 0x480)) == [Filter(0x400, 0x780)]


# -- what a link does with them -----------------------------------------------------------------------------------


class Filtering(Bus):
    """A bus that filters."""

    def __init__(self) -> None:
        super().__init__("filtering")
        self.narrows = True
        self.filters: Sequence[Filter] = ()
        self.while_sending: list[Sequence[Filter]] = []

    def open(self) -> None:
        """Nothing to do."""

    def fileno(self) -> int:
        """None."""
        return -1

    def receive(self, batch: FrameBatch, ordinal: int) -> int:
        """Never anything."""
        raise BusNotAvailable(f"{batch} {ordinal}")

    def send(self, identifier: int, payload: bytes) -> None:
        """Note what would pass."""
        assert identifier
        assert payload is not None
        self.while_sending.append(self.filters)

    def close(self) -> None:
        """Nothing to do."""

    def narrow(self, filters: Sequence[Filter]) -> None:
        self.filters = filters


def test_no_filter_hides_an_answer_and_a_listener_hears_all() -> None:
    bus = Filtering()
    link = Link(bus)
    layout = Layout([frame("a", Identifier(0x470, 0x7F0))])

    async def talk() -> None:
        with link.follow(Match(0x111)):  # begun before anybody knew the layout
            assert bus.filters == ()
            link.narrow(layout)
            assert passing(bus.filters) == [0x111, *range(0x470, 0x480)]
        assert passing(bus.filters) == [*range(0x470, 0x480)]
        await link.collect(0x70F, b"\xff", Match(0x700, 0x70F, b"\xff"), duration_s=0)
        assert passing(bus.while_sending[0]) == [*range(0x470, 0x480), *range(0x700, 0x800, 0x10)]
        with pytest.raises(TimeoutError):
            await link.request(0x207, b"", Match(EXTENDED_FLAG | 0x99), timeout_s=0)
        assert passes(bus.while_sending[1], EXTENDED_FLAG | 0x99)
        listening = asyncio.create_task(link.listen(0.001))
        await asyncio.sleep(0)
        assert bus.filters == ()
        with link.follow(Match(0x111)):
            assert bus.filters == ()
        await listening
        assert passing(bus.filters) == [*range(0x470, 0x480)]

    asyncio.run(talk())


def test_a_bus_that_does_not_filter_is_not_asked_to() -> None:
    bus = Filtering()
    bus.narrows = False
    link = Link(bus)
    link.narrow(Layout([frame("a", Identifier(0x470, 0x7F0))]))
    assert bus.filters == ()


def test_more_filters_than_the_kernel_takes_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []
    monkeypatch.setattr(socketcan, "_set_filters", lambda _sock, filters: told.append(len(filters)))
    bus = SocketCanBus("can0", {"filter": "on"})
    assert bus.narrows
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        bus.adopt(sock)
        many = [Filter(number, 0x7FF) for number in range(MOST_FILTERS + 1)]
        bus.narrow(many[:-1])
        bus.narrow(many[:-1])
        bus.narrow(many)
        assert told == [MOST_FILTERS, 0]
    assert not SocketCanBus("can0").narrows
