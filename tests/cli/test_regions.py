"""skin-regions: what is stroked becomes a region, and regions are listed with what the skin has of them."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import Structure
from skinware.cli._command import exit_status
from skinware.cli.regions import command
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE
from skinware.tactile.regions import Region, put_region, read_regions
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.commands import BIN, PATIENCE_S, run
from tests.tactile.skins import triangles

TAXELS = 40


def placed_structure() -> Structure:
    """Four triangles of ten taxels, which lie in five rows of eight."""
    structure = fake_structure(1, 4)
    uid = structure.sensor_uid[structure.index("pressure")]
    geometry = Geometry.unknown(["pressure"] * TAXELS, uid)
    geometry.position_m[:], geometry.frame[:] = triangles(5, 8), "palm"
    return structure.placed(geometry)


def idle(structure: Structure) -> Any:
    return np.where(structure.sensor_type == PRESSURE.id, 240, 50)


class Painting:
    """``skin-regions paint``, in a terminal of its own, telling JSON."""

    def __init__(self, *arguments: str) -> None:
        self._keyboard, terminal = pty.openpty()
        self.process = subprocess.Popen(
            [BIN / "skin-regions", "paint", *arguments, "--json"],
            stdin=terminal,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        os.close(terminal)

    def wait_for(self, event: str, **wanted: int) -> dict[str, Any]:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            told: dict[str, Any] = json.loads(line)
            if told["event"] == event and wanted.items() <= told.items():
                return told
        raise AssertionError(f"no {event}: {self.process.stderr.read() if self.process.stderr else ''}")

    def press_enter(self) -> None:
        os.write(self._keyboard, b"\n")

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate(timeout=PATIENCE_S)
        os.close(self._keyboard)


@contextmanager
def painting(*arguments: str) -> Iterator[Painting]:
    made = Painting(*arguments)
    try:
        yield made
    finally:
        made.close()


def pressed(structure: Structure, taxels: list[int]) -> Any:
    """Values of a frame with some of the taxels pressed, counted among the taxels."""
    values = idle(structure)
    values[np.arange(structure.n_sensors)[structure.index("pressure")][taxels]] = 150
    return values


BLOCK = [row * 8 + column for row in range(1, 5) for column in range(1, 7)]
HOLE = 2 * 8 + 3
LEFT, RIGHT = ([taxel for taxel in BLOCK if (taxel % 8 < 4) == is_left and taxel != HOLE] for is_left in (True, False))


@pytest.mark.thorough
def test_what_is_stroked_becomes_a_region_without_holes(tmp_path: Path) -> None:
    file = tmp_path / "regions.toml"
    file.write_text('format = "skinware-regions"\nversion = 1\n# by hand\n')
    skin = FakeSkin("torso", placed_structure())
    skin.values = idle(skin.structure)
    with publishing(skin), painting("palm", "-o", str(file)) as paint:
        ready = paint.wait_for("ready", touched=0)
        assert (ready["driver"], ready["type"]) == ("torso", "pressure")
        skin.values = pressed(skin.structure, LEFT)
        paint.wait_for("painting", touched=len(LEFT))
        skin.values = pressed(skin.structure, RIGHT)
        paint.wait_for("painting", touched=len(LEFT) + len(RIGHT))
        paint.press_enter()
        done = paint.wait_for("done")
        assert paint.process.wait(PATIENCE_S) == 0
    (region,) = read_regions(file)
    assert (region.name, region.type, region.driver) == ("palm", "pressure", ("torso",))
    uid = skin.structure.sensor_uid[skin.structure.index("pressure")]
    assert np.flatnonzero(np.isin(uid, region.uid)).tolist() == BLOCK
    assert done == {
        "event": "done",
        "region": "palm",
        "file": str(file),
        "touched": len(BLOCK) - 1,
        "sensors": len(BLOCK),
    }
    assert "# by hand" in file.read_text()


@pytest.mark.thorough
def test_a_calmed_driver_is_painted_too(tmp_path: Path) -> None:
    """Its values are 0 at rest, without any noise."""
    file = tmp_path / "regions.toml"
    structure = placed_structure()
    types = [PRESSURE.measured(unit="counts"), structure.type("temperature")]
    skin = FakeSkin("torso", structure.replace(types=types, dtype="<f4"))
    skin.values = np.zeros(skin.structure.n_sensors)
    with publishing(skin), painting("palm", "-o", str(file), "--type", "pressure") as paint:
        paint.wait_for("ready")
        values = skin.values.copy()
        values[:3] = 0.1, 5.0, 0.0
        skin.values = values
        paint.wait_for("painting", touched=2)
        paint.press_enter()
        paint.wait_for("done")
    assert read_regions(file).of(skin.structure, "pressure")["palm"] == slice(0, 2)


@pytest.mark.thorough
def test_ctrl_c_writes_nothing(tmp_path: Path) -> None:
    file = tmp_path / "regions.toml"
    skin = FakeSkin("torso", placed_structure())
    skin.values = idle(skin.structure)
    with publishing(skin), painting("palm", "-o", str(file)) as paint:
        paint.wait_for("ready")
        skin.values = pressed(skin.structure, BLOCK)
        paint.wait_for("painting", touched=len(BLOCK))
        paint.process.send_signal(signal.SIGINT)
        assert paint.process.wait(PATIENCE_S) == 0
    assert not file.exists()


@pytest.mark.thorough
def test_what_cannot_be_painted_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "regions.toml"
    here = ["paint", "palm", "-o", str(file), "-T", "0.1"]
    for arguments, status, why in (
        (here, 1, "no driver runs in namespace"),
        ([*here, "arm"], 1, "no service 'arm'"),
        (here[:-2], 2, "without a terminal there is no Enter: give -T SECONDS"),
    ):
        done = run("skin-regions", *arguments)
        assert (done.returncode, why in done.stderr) == (status, True), done.stderr
    quiet, other = FakeSkin("torso", placed_structure()), FakeSkin("arm", placed_structure())
    quiet.values = other.values = idle(quiet.structure)
    with publishing(quiet):
        with publishing(other):
            assert exit_status(command, here) == 2
            assert "choose one with skin-regions paint NAME DRIVER: arm, torso" in capsys.readouterr().err
        assert exit_status(command, [*here, "--type", "shear_x"]) == 1
        assert "no sensor type 'shear_x'" in capsys.readouterr().err
        assert exit_status(command, here) == 1
        assert "nothing was touched; nothing is written" in capsys.readouterr().err
        assert not file.exists()
        put_region(file, Region("palm", uid=(1,)))
        assert exit_status(command, here) == 2
        assert "there is a region 'palm' already; --force replaces it" in capsys.readouterr().err


def test_regions_are_listed_with_what_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "regions.toml"
    put_region(file, Region("board", patch=("board 7",)))
    put_region(file, Region("elsewhere", driver=("arm",), frame=("palm",)))
    put_region(file, Region("both", type="pressure", regions=("board", "elsewhere")))
    assert exit_status(command, ["list", str(file)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{name}: nothing in the drivers that run" for name in ("board", "elsewhere", "both")
    ]
    with publishing(FakeSkin("torso", placed_structure())):
        assert exit_status(command, ["list", str(file)]) == 0
        assert capsys.readouterr().out.splitlines() == [
            "board: 40 pressure sensors, 8 temperature sensors",
            "elsewhere: nothing in the drivers that run",
            "both: 40 pressure sensors",
        ]
        assert exit_status(command, ["list", str(file), "--json"]) == 0
        lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert lines[0] == {"region": "board", "sensors": {"pressure": 40, "temperature": 8}}
        assert lines[2] == {"region": "both", "sensors": {"pressure": 40}}
    assert exit_status(command, ["list", str(tmp_path / "none.toml")]) == 2
    assert "none.toml: No such file" in capsys.readouterr().err
