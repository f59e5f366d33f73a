"""What a driver leaves alone: frames that it does not want, and the wire when it only listens."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from skinware import BusState, DriverReader, PatchState
from skinware_drivers.bus import EXTENDED_FLAG
from skinware_drivers.testing.waiting import wait_until
from tests.can.conftest import ip
from tests.can.rig import TIP_IDENTIFIER, can_frame, sender, skin
from tests.commands import running
from tests.sdk.driving import read_until

pytestmark = [pytest.mark.can, pytest.mark.timeout(300)]

FOREIGN = (0x000, 0x472, 0x7FF, EXTENDED_FLAG | TIP_IDENTIFIER, EXTENDED_FLAG | 0x1FFF_FFFF)


@pytest.mark.quick
def test_the_kernel_leaves_out_what_the_layout_does_not_know(vcan: Callable[[], str]) -> None:
    name = vcan()
    with skin(name, options={"filter": "on"}) as (driver, _), DriverReader("tip") as reader:
        start = read_until(reader, lambda f: not f.status.any())
        for _ in range(2):
            before = driver.status()["buses"][0]
            with sender(name) as out:
                for identifier in FOREIGN:
                    out.send(can_frame(identifier, bytes(8)))
                out.send(can_frame(TIP_IDENTIFIER, bytes(3)))  # of a wrong length, but ours
                wait_until(lambda n=before["bad_length"]: driver.status()["buses"][0]["bad_length"] > n)  # type: ignore[misc]
            assert driver.status()["buses"][0]["unknown"] == before["unknown"]
            ip("link", "del", name)  # the next socket has the same filter
            read_until(reader, lambda f: f.bus_state[0] == BusState.GONE)
            ip("link", "add", "dev", name, "type", "vcan")
            ip("link", "set", name, "up")
            read_until(reader, lambda f: f.bus_state[0] == BusState.LIVE and not f.status.any())
        assert read_until(reader, lambda f: not f.status.any()).generation == start.generation


def test_without_a_filter_what_is_foreign_is_counted(vcan: Callable[[], str]) -> None:
    name = vcan()
    with skin(name) as (driver, _), sender(name) as out:
        before = driver.status()["buses"][0]["unknown"]
        for identifier in FOREIGN:
            out.send(can_frame(identifier, bytes(8)))
        wait_until(lambda: driver.status()["buses"][0]["unknown"] == before + len(FOREIGN))


@pytest.mark.quick
def test_a_listener_says_nothing_at_all(vcan: Callable[[], str]) -> None:
    """From its start to its end."""
    name = vcan()
    with sender(name) as witness:
        witness.settimeout(0.2)
        boards = ("--boards", "7,8", "--streaming")
        with running("skin-driver", "--bus", name, "--listen-only") as driver:
            with running("skin-emulate", "--bus", name, *boards) as emulator:
                emulator.wait_for("ready")
                driver.wait_for("ready")
                with DriverReader("roboskin") as reader:
                    live = read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.LIVE] * 2)
                    emulator.stop()  # boards that fall silent are asked for by a driver that may
                    read_until(reader, lambda f: f.patch_state.tolist() == [PatchState.STALE] * 2)
                    read_until(reader, lambda f: f.sequence > live.sequence + 20)
            stopped = driver.stop()
        heard = set()
        try:
            while True:
                heard.add(int.from_bytes(witness.recv(16)[:4], "little"))
        except TimeoutError:
            pass
    assert heard
    assert {identifier >> 4 for identifier in heard} <= {0x47, 0x48}  # data of boards 7 and 8
    assert stopped["buses"][0]["sent"] == 0
