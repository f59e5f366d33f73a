"""Operations on a bus that no driver has, on emulated boards."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import pytest

from skinware.errors import BusError, BusSendError, ConfigurationError, HandshakeTimeout
from skinware_drivers.can import roboskin, roboskin_setup
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.description import Patch
from skinware_drivers.finding import without_driver
from skinware_drivers.finding.without_driver import carry_out
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import Event
from tests.sdk.driving import Chatter, commands, emulated, troubled

MTB4 = {"type": "mtb4", "runs": "application", "firmware": "1.25.0", "protocol": "2.0"}


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roboskin, "_AFTER_CONFIGURATION_S", 0.05)
    monkeypatch.setattr(roboskin_setup, "_DISCOVERY_S", 0.1)
    monkeypatch.setattr(roboskin_setup, "_BETWEEN_CHECKS_S", 0.01)
    monkeypatch.setattr(roboskin_setup, "_ADDRESS_CHECKS", 2)
    monkeypatch.setattr(without_driver, "_LISTEN_S", 0.15)


def done(bus: VirtualCanBus, operation: str, how: dict[str, Any] | None = None, **arguments: Any) -> Any:
    adapter = RoboskinDriver(RoboskinOptions())
    return asyncio.run(carry_out(bus, "bus", adapter, operation, arguments, **how or {}))


def told(log: list[Event]) -> list[tuple[int, str]]:
    return [(identifier, payload.upper()) for _, identifier, payload in commands(log)]


def test_versions_of_a_silent_bus() -> None:
    assert done(emulated(boards=(3, 7)), "versions") == {"3": MTB4, "7": MTB4}


def test_versions_of_a_live_bus_disturb_nobody() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7, 8), mtb3=(8,), streaming=True)
    found = done(bus, "versions")
    assert found["7"] == MTB4
    assert (found["8"]["type"], found["8"]["firmware"]) == ("mtb", "2.10.14")
    assert {payload for _, payload in told(log)} == {"1C0200"}
    assert done(bus, "versions", patch="board 8") == {"8": found["8"]}


def test_nobody_there_has_no_versions() -> None:
    assert done(VirtualCanBus("", hardware=Chatter()), "versions") == {}


def test_an_address_is_moved_and_checked() -> None:
    log: list[Event] = []
    agreed: list[Sequence[Patch]] = []
    bus = emulated(log, boards=(7, 8))
    moved = done(bus, "set_address", {"agree": agreed.append}, address=9, patch="board 7")
    assert moved == {"was": 7, "is": 9, **MTB4}
    assert [patch.name for patch in agreed[0]] == ["board 7"]
    assert told(log) == [(0x70F, "FF"), (0x207, "1C0200"), (0x207, "3209"), (0x209, "1C0200")]
    assert done(bus, "versions").keys() == {"8", "9"}


def test_the_only_board_need_not_be_named() -> None:
    assert done(emulated(boards=(5,)), "set_address", address=6)["is"] == 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"address": 8, "patch": "board 7"}, "address 8 is taken by board 8"),
        ({"address": 7, "patch": "board 7"}, "has that address already"),
        ({"address": 15, "patch": "board 7"}, "boards have 1 to 14"),
        ({"address": 0, "patch": "board 7"}, "boards have 1 to 14"),
        ({"address": 9}, "boards 7, 8: say which one"),
        ({"address": 9, "patch": "board 6"}, "no patch 'board 6'; did you mean 'board 8'"),
        ({"patch": "board 7"}, "it takes: bus, patch, address"),
        ({"address": "x", "patch": "board 7"}, "boards have 1 to 14"),
    ],
)
def test_addresses_that_cannot_be_are_refused_before_anything_is_told(arguments: dict[str, Any], words: str) -> None:
    log: list[Event] = []
    with pytest.raises(ConfigurationError, match=words):
        done(emulated(log, boards=(7, 8)), "set_address", **arguments)
    assert not [payload for _, payload in told(log) if payload.startswith("32")]


class Deaf(VirtualCanBus):
    """Loses every command of one kind."""

    lost = b"\x32"

    def send(self, identifier: int, payload: bytes) -> None:
        if not payload.startswith(self.lost):
            super().send(identifier, payload)


def test_a_board_that_did_not_take_its_address_is_a_failure() -> None:
    deaf = Deaf("", hardware=emulated(boards=(7,)).hardware)
    with pytest.raises(HandshakeTimeout, match="board 7 got the address 9, but no board answers there"):
        done(deaf, "set_address", address=9)


def test_two_boards_of_one_address_are_a_failure() -> None:
    twin = Chatter((0x270, b"\x1c\x0b\x01\x19\x00\x02\x00\x01"))  # always answers as board 7
    bus = emulated(boards=(7,))

    class Both(Deaf):
        lost = b"nothing"

        def send(self, identifier: int, payload: bytes) -> None:
            super().send(identifier, payload)
            if (identifier, payload[0]) == (0x207, 0x1C):
                self._pending += twin.emit(self._clock())
                self._wake_when_due()

    with pytest.raises(BusError, match="board 7 and board 9 both answer"):
        done(Both("", hardware=bus.hardware), "set_address", address=9)


def test_a_board_without_skin_keeps_its_address() -> None:
    strain = Chatter((0x2D0, b"\x1c\x0c\x01\x00\x00\x02\x00\x01"), (0x7D0, b"\xff\x0c\x01\x00\x00"))
    with pytest.raises(HandshakeTimeout, match="no device of this driver answers"):  # that a stranger does is no answer
        done(VirtualCanBus("", hardware=strain), "set_address", {"force": True}, address=9)
    assert [payload for _, payload in strain.heard if payload[0] == 0x32] == []


def test_what_was_silent_is_silent_again() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7,))
    assert done(bus, "rebaseline") is None
    assert [payload for _, payload in told(log)] == ["FF", "4D0032F0", "50000F02010022", "0700", "0701"]


def test_a_bus_on_which_boards_send_is_not_touched_without_force() -> None:
    log: list[Event] = []
    bus = emulated(log, boards=(7,), streaming=True)
    with pytest.raises(ConfigurationError, match="another program may be using the bus"):
        done(bus, "rebaseline")
    assert told(log) == []
    done(bus, "rebaseline", {"force": True})
    assert (0x207, "0701") not in told(log)


def test_who_does_not_agree_changes_nothing() -> None:
    def refuse(_patches: object) -> None:
        raise BusError("never mind")

    log: list[Event] = []
    with pytest.raises(BusError, match="never mind"):
        done(emulated(log, boards=(7,)), "rebaseline", {"agree": refuse})
    assert [payload for _, payload in told(log)] == ["FF"]


def test_mistakes_are_told_before_the_bus_is_opened() -> None:
    bus = troubled()
    with pytest.raises(ConfigurationError, match="did you mean 'rebaseline'"):
        done(bus, "rebasline")
    with pytest.raises(ConfigurationError, match="missing a required argument: 'hz'"):
        done(bus, "rate")
    assert bus.opened_at_s == []
    with pytest.raises(ConfigurationError, match="rate: "):
        done(emulated(boards=(7,)), "rate", hz="fast")
    with pytest.raises(HandshakeTimeout, match="bus: no device of this driver answers"):
        done(VirtualCanBus("", hardware=Chatter()), "rebaseline")


def test_a_bus_that_fails_at_the_end_is_told() -> None:
    bus = troubled(boards=(7,))

    def fail(_identifier: int, payload: bytes) -> None:
        if payload == b"\x07\x01":
            bus.down = True

    bus.before_send = fail
    with pytest.raises(BusError, match="devices may be sending now") as caught:
        done(bus, "rebaseline")
    assert not isinstance(caught.value, BusSendError)
