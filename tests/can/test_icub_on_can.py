"""An iCub's files to live data over SocketCAN: the driver sets emulated boards of that part up, in another process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from skinware import DriverReader, PatchState
from skinware.cli._command import exit_status
from skinware_drivers.cli.import_ import command
from tests.commands import running
from tests.icub.conftest import DEFAULTS, WRAPPER, board_sets, device, triangle_sets
from tests.sdk.driving import read_until

pytestmark = [pytest.mark.can, pytest.mark.timeout(400)]


@pytest.mark.parametrize("inertial", [False, True], ids=["skin", "with inertial sensors"])
def test_an_imported_part_lives_on_can(vcan: Callable[[], str], tmp_path: Path, inertial: bool) -> None:
    sets = board_sets("1 8 8 100 1 0xf0") + triangle_sets("1 8 0 3 1 2 0x2200", "1 7 15 15 0 2 0x2200")
    (tmp_path / "skin.xml").write_text(device(DEFAULTS + sets))
    (tmp_path / "wrapper.xml").write_text(WRAPPER)
    bus, out = vcan(), tmp_path / "out"
    assert exit_status(command, ["icub", str(tmp_path), "-o", str(out), "--bus", f"1={bus}"]) == 0
    more = ["--inertial", "accelerometer,gyroscope"] if inertial else []
    with running("skin-emulate", "--bus", bus, "--boards", "7,8", "--pattern", "idle") as emulator:
        emulator.wait_for("ready")
        with running("skin-driver", "--config", str(out / "torso_skin.toml"), *more) as driver:
            ready = driver.wait_for("ready")
            assert ready["modules"] == 15 + 4 + (4 if inertial else 0)
            with DriverReader("torso_skin") as reader:
                frame = read_until(reader, lambda f: not f.status.any())
                assert set(frame.patch_state.tolist()) == {PatchState.LIVE}
                assert reader.bus_counters(frame)[0]["unknown"] == 0
