"""The fixtures of the plug-in, as somebody else's tests use them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import PatchState, Status
from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers.adapter import AnyAdapter
from skinware_drivers.description import Module, Patch, taxels
from skinware_drivers.fields import Identifier
from skinware_drivers.layout import Frame, Layout, Values
from skinware_drivers.options import NoOptions
from skinware_drivers.serial.adapter import SerialAdapter
from skinware_drivers.serial.delimited import COBS, Delimited
from skinware_drivers.serial.openpatch import OpenPatchDriver
from skinware_drivers.testing import lab
from skinware_drivers.testing.conformance import DriverConformance
from skinware_drivers.testing.driving import EmulatedSkin
from skinware_drivers.testing.waiting import read_until
from skinware_drivers.virtual import CanFrame, Device, Emulator, EmulatorOptions, on_a_grid
from skinware_drivers.virtual.devices.openpatch import EmulatedOpenPatch
from tests.testing.fingertips import EmulatedFingertips, Fingertips


class TapeDriver(SerialAdapter[NoOptions]):
    """Eight taxels on a serial line, sent without being asked."""

    framing = Delimited(COBS, maximum_body=32)
    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("tape", [Module(taxels(8))]),)
    layout = Layout([Frame("tape", [Identifier(0)], [16], Values(0, "<u2", 8))])


class EmulatedTape(Emulator[EmulatorOptions]):
    """It sends zero-free bodies, so that its stuffing is only a number in front."""

    full_scale = 0x7FFF
    swing = 1000
    numbers = (0,)
    period_s = 0.02
    identifiers = frozenset((0,))

    def places(self) -> npt.NDArray[np.float64]:
        return on_a_grid(8, 4)

    def boot(self, device: Device, now_ns: int) -> None:
        self.start(device, now_ns)

    def frames(self, device: Device, values: Sequence[int]) -> Sequence[CanFrame]:
        body = b"".join(value.to_bytes(2, "little") for value in values)
        stuffed = b"".join(bytes([len(part) + 1]) + part for part in body.split(b"\0"))
        return [(0, stuffed + b"\0")]


class TestTape(DriverConformance):
    """A serial driver passes, too."""

    driver = TapeDriver
    emulator = EmulatedTape


def test_a_driver_on_emulated_devices_and_a_reader(emulated_skin: Callable[..., EmulatedSkin]) -> None:
    skin = emulated_skin("xela", pattern="cycle")
    frame = read_until(skin.reader, lambda frame: not frame.status.any())
    assert len(set(frame.values.tolist())) == 1
    skin.driver.do(skin.bus.vanish)  # type: ignore[attr-defined]
    read_until(skin.reader, lambda frame: bool((frame.status & Status.STALE).all()))
    skin.driver.do(skin.bus.come_back)  # type: ignore[attr-defined]
    read_until(skin.reader, lambda frame: frame.patch_state[0] == PatchState.LIVE and not frame.status.any())


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"pattern": "cylce"}, "options of EmulatedXela: Invalid enum value 'cylce'"),
        ({"driver_options": {"period": 3}}, "options of XelaDriver: Object contains unknown field `period`"),
    ],
)
def test_wrong_options_are_named(emulated_skin: Callable[..., EmulatedSkin], given: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigurationError, match=why):
        emulated_skin("xela", **given)


@pytest.mark.parametrize(("driver", "emulator"), [(TapeDriver, EmulatedTape), (OpenPatchDriver, EmulatedOpenPatch)])
def test_serial_drivers_get_a_pseudo_terminal(
    emulated_skin: Callable[..., EmulatedSkin], driver: type[AnyAdapter], emulator: object
) -> None:
    skin = emulated_skin(driver, emulator, pattern="cycle")
    frame = read_until(skin.reader, lambda frame: not frame.status.any())
    assert len(set(frame.values.tolist())) == 1


def test_emulated_devices_on_a_pseudo_terminal(
    emulated_skin: Callable[..., EmulatedSkin], pty_patch: Callable[..., str]
) -> None:
    skin = emulated_skin(TapeDriver, bus=pty_patch(EmulatedTape, pattern="cycle"))
    frame = read_until(skin.reader, lambda frame: not frame.status.any())
    assert len(set(frame.values.tolist())) == 1


def test_devices_are_brought_to_a_can_interface(
    emulated_skin: Callable[..., EmulatedSkin], vcan: Callable[[], str]
) -> None:
    skin = emulated_skin(Fingertips, EmulatedFingertips, bus=vcan(), pattern="cycle")
    frame = read_until(skin.reader, lambda frame: not frame.status.any())
    assert skin.hardware is None
    assert len(frame.values) == 12


@pytest.mark.thorough
@pytest.mark.parametrize("fixture", ["vcan", "can_pair"])
@pytest.mark.skipif(os.path.exists("/sys/module/can"), reason="this kernel has CAN")
def test_without_can_tests_are_skipped_and_say_how_to_get_it(fixture: str, tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(f"def test_it({fixture}):\n    pass\n")
    out = pytest_in(tmp_path, "-rs")
    assert "1 skipped" in out
    assert "--skin-can-lab" in out
    assert "1 deselected" in pytest_in(tmp_path, "-m", "not can")


def test_asking_for_the_lab_where_there_is_none_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text("def test_it(vcan):\n    pass\n")
    if not lab.missing("plain") or os.path.exists("/sys/module/can"):
        pytest.skip("the lab can run here")
    assert "the CAN lab cannot run here" in pytest_in(tmp_path, "--skin-can-lab")


@pytest.mark.thorough
def test_what_a_test_leaves_behind_fails_it(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "import threading, time\n"
        "def test_it(namespace):\n"
        "    threading.Thread(target=time.sleep, args=(100,), name='mine', daemon=True).start()\n"
    )
    assert "the test left behind: thread 'mine'" in pytest_in(tmp_path)


@pytest.mark.thorough
def test_a_test_that_failed_is_not_said_to_leave_anything_behind(tmp_path: Path) -> None:
    """The report of its failure keeps the reader, and with it the file that this has mapped."""
    (tmp_path / "test_it.py").write_text(
        "import skinware\n"
        "def test_it(namespace):\n"
        "    with skinware.ServiceWriter('x', {'values': ('<u8', 4)}), skinware.ServiceReader('x') as reader:\n"
        "        assert reader.alive is None\n"
    )
    told = pytest_in(tmp_path)
    assert "1 failed" in told
    assert "1 error" not in told
    assert "left behind" not in told


@pytest.mark.thorough
def test_loading_the_plug_in_imports_nothing_of_skinware() -> None:
    code = "import sys, skinware_drivers.testing.plugin; print([m for m in sys.modules if m in ('skinware', 'numpy')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def pytest_in(folder: Path, *arguments: str) -> str:
    """What pytest says of the tests in a folder."""
    plugin = ("-p", "skinware_drivers.testing.plugin", "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", "-c", "/dev/null", "--rootdir", str(folder), *plugin, *arguments]
    done = subprocess.run([*command, str(folder)], capture_output=True, text=True, cwd=folder, timeout=100)
    return done.stdout + done.stderr


@pytest.mark.parametrize("module", ["testing.conformance", "testing.driving", "testing.plugin", "learning"])
def test_no_packages_for_recordings_are_needed(module: str) -> None:
    """A driver of somebody else is tested with the extra ``testing`` alone."""
    if module == "learning":
        pytest.importorskip("gymnasium", reason="needs the extra mujoco")
        pytest.importorskip("mujoco", reason="needs the extra mujoco")
    code = f"import sys; sys.modules |= dict.fromkeys(['mcap', 'zstandard'])\nimport skinware_drivers.{module}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
