"""``skin-find`` where the kernel has CAN: real interfaces, real frames."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import Any

import pytest

from skinware.cli._command import exit_status
from skinware_drivers.cli.find import command, look
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip
from tests.commands import running

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]


def interface(found: dict[str, Any], name: str) -> dict[str, Any]:
    (one,) = [one for one in found["can"]["interfaces"] if one["name"] == name]
    return dict(one)


def test_emulated_boards_on_vcan_are_heard_and_asked(vcan: Callable[[], str]) -> None:
    name = vcan()
    one: dict[str, Any] = {}

    def is_whole() -> bool:
        one.update(interface(asyncio.run(look((name,), 2.0, probe=True)), name))
        found = [*(patch for guess in one["heard"].guesses for patch in guess.patches), *one["probe"].answers]
        return {"board 7", "board 8", "roboskin"} <= set(found)

    with running("skin-emulate", "--bus", name, "--boards", "7,8", "--streaming") as emulator:
        emulator.wait_for("ready")
        wait_until(is_whole, 120)  # a starved emulator is not heard, or answers too late
    assert (one["kind"], one["up"], one["bit_rate"], one["state"], one["advice"]) == ("vcan", True, None, "", [])
    assert [(guess.driver, guess.patches) for guess in one["heard"].guesses] == [("roboskin", ("board 7", "board 8"))]
    assert one["heard"].load is None  # a virtual interface has no bit rate
    assert "board 7 (mtb4 1.25.0)" in one["probe"].answers["roboskin"]
    assert one["statistics"]["rx_packets"] > 0


def test_an_interface_that_is_down_is_told_with_what_to_do(
    vcan: Callable[[], str], capsys: pytest.CaptureFixture[str]
) -> None:
    name = vcan()
    ip("link", "set", name, "down")
    one = interface(asyncio.run(look((name,), 0.1)), name)
    assert (one["up"], one["heard"]) == (False, None)
    assert one["advice"] == [f"down: sudo ip link set {name} up"]
    assert exit_status(command, [name, "-T", "0.1"]) == 0
    assert f"      sudo ip link set {name} up" in capsys.readouterr().out


def test_controllers_are_told_with_bit_rate_state_and_load(can_pair: tuple[str, str]) -> None:
    first, second = can_pair

    async def hear() -> dict[str, Any]:
        looking = asyncio.create_task(look((first,), 2.0))
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as out:
            out.bind((second,))
            while not looking.done():
                out.send(bytes.fromhex("7304000008000000 40F0F0F0F0F0F0F0"))
                await asyncio.sleep(0.01)
        return await looking

    one = interface(asyncio.run(hear()), first)
    assert (one["kind"], one["bit_rate"], one["state"], one["up"]) == ("can", 1_000_000, "ERROR-ACTIVE", True)
    assert one["driver"] == "kvaser_pci"
    assert one["sample_point"] is not None
    assert one["heard"].frames > 0
    assert 0 < one["heard"].load < 0.1
    assert [(group.name, group.first) for group in one["heard"].classes] == [("4xx", 0x473)]


def test_a_controller_that_is_down_keeps_its_bit_rate(can_pair: tuple[str, str]) -> None:
    name = can_pair[0]
    ip("link", "set", name, "down")
    one = interface(asyncio.run(look((name,), 0.1)), name)
    assert one["advice"] == [f"down: sudo ip link set {name} up"]  # the bit rate stays
    assert one["state"] == "STOPPED"
