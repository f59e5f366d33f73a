"""``skin-doctor`` where the kernel has CAN: real interfaces, and what goes wrong with them.

A wrong bit rate cannot be had here: neither vcan nor the wire between the emulated controllers has one.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from skinware import Namespace
from skinware_drivers.doctor.evidence import Evidence
from skinware_drivers.doctor.examining import examine
from skinware_drivers.doctor.looking import look
from skinware_drivers.doctor.rules import Finding, Severity
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip
from tests.commands import running

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]


def found(seen: Evidence, where: str) -> dict[str, Finding]:
    """Findings about an interface, or a bus of that name, by what they say."""
    return {one.what: one for one in examine(seen).findings if one.where.split()[-1] == where}


def told_until(is_told: Callable[[dict[str, Finding]], bool], where: str, seconds: float = 0.5) -> dict[str, Finding]:
    """The findings about an interface or bus, as soon as they are as a test wants them."""
    told: dict[str, Finding] = {}

    def look_again() -> bool:
        told.clear()
        told.update(found(look(Namespace(), seconds), where))
        return is_told(told)

    wait_until(look_again)
    return told


def test_a_controller_is_told_with_bit_rate_and_load_and_goes_down(can_pair: tuple[str, str]) -> None:
    first, second = can_pair
    with (
        running("skin-emulate", "--bus", second, "--boards", "7", "--streaming") as emulator,
        running("skin-driver", "--bus", first, "--listen-only") as driver,
    ):
        emulator.wait_for("ready")
        driver.wait_for("ready")
        looked: dict[str, str] = {}

        def is_known() -> bool:
            looked.update({one.what: one.seen for one in examine(look(Namespace(), 1.5)).looked})
            return "load" in looked.get(f"roboskin: {first}", "")

        wait_until(is_known)
        assert looked[first].startswith("up, can, 1000 kbit/s, error-active, restart-ms 0, queue ")
        ip("link", "set", first, "down")
        told = told_until(lambda told: "its interface is down" in told, first)
    assert told["the interface is down"].severity == Severity.ERROR
    assert "driver 'roboskin'" in told["the interface is down"].evidence
    assert f"sudo ip link set {first} up" in told["its interface is down"].commands


def test_a_send_queue_that_is_full(vcan: Callable[[], str], full_queue: Callable[[str], None]) -> None:
    name = vcan()
    with (
        running("skin-emulate", "--bus", name, "--boards", "7") as emulator,
        running("skin-driver", "--bus", name, "--period-ms", "200") as driver,
    ):
        emulator.wait_for("ready")
        driver.wait_for("ready")
        full_queue(name)  # the board is not heard any more, and the driver asks in vain
        told = told_until(lambda told: "the interface did not take frames to send" in told, name, seconds=3.0)
    assert f"sudo ip link set {name} txqueuelen 100" in told["the interface did not take frames to send"].commands


def test_an_interface_that_nobody_uses(can_pair: tuple[str, str]) -> None:
    _, second = can_pair
    ip("link", "set", second, "down")
    down = found(look(Namespace(), 0.1), second)["the interface is down"]
    assert (down.severity, down.commands) == (Severity.NOTE, (f"sudo ip link set {second} up",))
