"""skin-calibrate: from touches of a running skin to a geometry file, and what it says of a wrong one."""

from __future__ import annotations

import functools
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware import Column, DriverReader, Namespace, ServiceWriter, Structure
from skinware.cli._command import exit_status
from skinware.cli.calibrate import command
from skinware.geometry import Geometry, geometry_to_toml, read_geometry
from skinware.sensor_types import PRESSURE
from skinware.tactile.calibration.state import ForceSession, PressSession, StrokeSession, save_session
from skinware.tactile.calibration.topology import ENOUGH_FRAMES, StrokeSums
from skinware.tactile.curves import read_curves
from skinware.tactile.testing import Surface, triangles
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, publishing
from tests.cli.probe import Probe
from tests.commands import run, running
from tests.tactile.calibrating import off_m, presses, stroked

MODULES = 12
TIP_M = np.array([0.0, 0.01, 0.1])
BUS = "virtual?boards=7&pattern=idle"


@functools.cache
def strokes() -> tuple[Surface, StrokeSums]:
    surface = triangles(MODULES, patches=2)
    return surface, stroked(surface, 1, 1.5)


def structure_of(surface: Surface) -> Structure:
    """A calmed driver of these taxels, with their places."""
    n = len(surface)
    uid = np.arange(n, dtype=np.uint64) + 100
    places = Geometry.unknown(["pressure"] * n, uid)
    places.position_m[:], places.normal[:], places.frame[:] = surface.position_m, surface.normal, "strip"
    return Structure(
        types=[PRESSURE.measured(unit="counts", maximum=255.0)],
        buses=["x"],
        patch_name=[f"board {7 + number}" for number in range(surface.n_patches)],
        patch_bus=[0] * surface.n_patches,
        module_patch=np.arange(surface.n_modules) * surface.n_patches // surface.n_modules,
        module_kind=["triangle"] * surface.n_modules,
        sensor_uid=uid,
        sensor_type=[PRESSURE.id] * n,
        sensor_module=surface.module,
        dtype="<f4",
    ).placed(places)


def calm_skin(surface: Surface) -> FakeSkin:
    skin = FakeSkin("strip", structure_of(surface), driver_type="calm")
    skin.values = np.zeros(len(surface))
    return skin


def gathered(file: Path, session: PressSession | StrokeSession | ForceSession, structure: Structure) -> None:
    """Write a state file, as an interrupted command leaves it."""
    save_session(file.with_name(f"{file.name}.state.npz"), session, "pressure", structure.sensor_uid)


def stroked_state(file: Path, structure: Structure) -> None:
    session = StrokeSession(structure.n_sensors)
    session.sums = strokes()[1]
    gathered(file, session, structure)


@contextmanager
def finger_presses(file: Path, surface: Surface) -> Iterator[list[str]]:
    """Arguments of ``finger`` for presses that were gathered; skin and poses are there."""
    structure = structure_of(surface)
    random, given = np.random.default_rng(1), presses(surface, 1)
    session = PressSession(len(surface), pose_shape=(4, 4))
    for number in range(0, len(given), 2):
        mine = given.press == number
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(random.standard_normal((3, 3)))[0]
        pose[:3, :3] *= np.linalg.det(pose[:3, :3])
        pose[:3, 3] = given.pose[number] - pose[:3, :3] @ TIP_M
        load = np.zeros(len(surface))
        load[given.taxel[mine]] = given.load[mine]
        for step in range(12):
            session.take(step * 20_000_000, load, pose)
        session.take(12 * 20_000_000, np.zeros(len(surface)), None)
    gathered(file, session, structure)
    layout = file.with_name("cad.toml")
    assert structure.geometry is not None
    layout.write_text(geometry_to_toml(structure.geometry.to_groups()))
    with publishing(calm_skin(surface)), ServiceWriter("hand", {"pose": Column(np.dtype("<f8"), (4, 4))}):
        yield ["finger", "--poses", "hand", "--layout", str(layout), "-o", str(file), "-T", "0", "--json"]


def lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


@contextmanager
def probing(probe: Probe) -> Iterator[None]:
    """The probe publishes as long as the block lasts."""
    stopping = threading.Event()
    thread = threading.Thread(target=probe.run, args=(stopping,))
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join()


@pytest.mark.thorough
def test_a_probe_a_driver_and_the_truth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Driver, probe, skin-calibrate touch: interrupted, gone on with, and compared with where the taxels are."""
    file, layout = tmp_path / "skin.toml", tmp_path / "cad.toml"
    with running("skin-driver", "--bus", BUS) as driver:
        driver.wait_for("ready")
        with DriverReader("roboskin") as reader:
            structure = reader.structure
        assert structure.geometry is not None
        truth = structure.geometry.of(structure, "pressure")
        layout.write_text(geometry_to_toml(structure.geometry.to_groups()))
        probe = Probe("roboskin", noise_m=0.0005)
        touch = ["touch", "--poses", "probe", "--touches", "2", "-o", str(file)]
        pressed = np.array([20, 22, 24, 26, 28, 21, 29])  # of one triangle
        with probing(probe):
            wait_until(lambda: "probe" in Namespace().services())
            with running("skin-calibrate", *touch) as calibrating:
                ready = calibrating.wait_for("ready")
                assert (ready["driver"], ready["type"], ready["restored"]) == ("roboskin", "pressure", False)
                probe.press(np.tile(truth.position_m[pressed], (20, 1)))  # some are lost on a busy machine
                progress = calibrating.wait_for("progress", lambda told: told["covered"] >= 9)
                assert progress["patches"].keys() == {"board 7"}
                interrupted = calibrating.stop()
            assert interrupted["event"] == "interrupted"
            assert interrupted["presses"] >= progress["presses"] >= 3
            assert calibrating.process.returncode == 0
            assert not file.exists()
            for also, off_mm in (([], 4.0), (["--layout", str(layout)], 2.5)):
                assert exit_status(command, [*touch, *also, "-T", "0", "--json"]) == 0
                ready, done = lines(capsys.readouterr().out)
                assert (ready["event"], ready["restored"]) == ("ready", True)
                assert (done["event"], done["placed"] >= 9) == ("done", True)
                found = read_geometry(file).of(structure, "pressure")
                error_mm = 1e3 * np.linalg.norm(found.position_m - truth.position_m, axis=1)
                assert np.nanmean(error_mm[20:30]) < off_mm
                assert set(found.frame[found.known]) == {"probe"}
                assert (found.confidence[found.known] > 0).all()
            assert found.known[20:30].all()
            assert (found.normal * truth.normal).sum(axis=1)[20:30].min() > 0.9


@pytest.mark.thorough
def test_topology_from_strokes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "map.toml"
    surface, sums = strokes()
    covered, known = sums.active >= ENOUGH_FRAMES, sums.known
    assert covered.mean() > 0.95
    with publishing(calm_skin(surface)) as skin:
        stroked_state(file, skin.structure)
        assert exit_status(command, ["topology", "-o", str(file), "-T", "0"]) == 0
        told = capsys.readouterr().out
        assert f"board 7  ████████████████████  {covered[:60].sum()} of 60" in told
        assert f"{known.sum()} sensors in 1 piece," in told
        assert told.count("█") > 120  # a picture, too
    found = read_geometry(file).of(skin.structure, "pressure")
    assert found.known.tolist() == known.tolist()
    assert set(found.frame[covered]) == {"piece 1"}
    true_m, found_m = (
        np.linalg.norm(places[covered, None] - places[covered], axis=2)
        for places in (surface.position_m, found.position_m)
    )
    near = (true_m > 0) & (true_m < 0.03)
    assert np.median(abs(found_m[near] / true_m[near] - 1)) < 0.1
    assert f"Pieces: 1, of {known.sum()} sensors; not known: {(~known).sum()}" in file.read_text()


@pytest.mark.thorough
def test_strokes_of_a_running_skin_end_it(tmp_path: Path) -> None:
    file = tmp_path / "map.toml"
    surface = triangles(2)
    with publishing(calm_skin(surface)) as skin:
        with running("skin-calibrate", "topology", "-o", str(file), "--share", "1") as calibrating:
            assert calibrating.wait_for("ready")["restored"] is False
            values = skin.values
            while calibrating.process.poll() is None:
                for taxel in range(len(surface)):
                    away_m = np.linalg.norm(surface.position_m - surface.position_m[taxel], axis=1)
                    skin.values = 80 * np.exp(-0.5 * (away_m / 0.004) ** 2) * (away_m < 0.009)
                    if calibrating.process.poll() is not None:
                        break
                    threading.Event().wait(0.05)
            skin.values = values
            done = calibrating.wait_for("done")
            calibrating.stop()
    assert (done["placed"], done["pieces"]) == (20, [20])


def test_check_names_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surface, _ = strokes()
    with publishing(calm_skin(surface)) as skin:
        right = skin.structure.geometry
        assert right is not None
        file = tmp_path / "skin.toml"
        file.write_text(geometry_to_toml(right.to_groups()))
        stroked_state(file, skin.structure)
        check = ["check", str(file), "-T", "0"]
        assert exit_status(command, check) == 0
        assert capsys.readouterr().out.endswith("skin.toml: nothing found\n")
        one, other, mirrored = (surface.module == number for number in (2, 8, 5))
        right.position_m[one], right.position_m[other] = right.position_m[other].copy(), right.position_m[one].copy()
        right.position_m[mirrored, 0] = 2 * right.position_m[mirrored, 0].mean() - right.position_m[mirrored, 0]
        right.position_m[101] = right.position_m[103]
        file.write_text(geometry_to_toml(right.to_groups()))
        assert exit_status(command, check) == 1
        told = capsys.readouterr().out.splitlines()
        assert told[-4:] == [
            "shared: 2 sensors of board 8, triangle 4 at places of others",
            "swapped: board 7, triangle 2 and board 8, triangle 2 are at each other's places: exchanged connectors?",
            "mirrored: board 7, triangle 5: its mirror image would fit",
            f"{file}: 3 found",
        ]
        assert exit_status(command, [*check, "--json"]) == 1
        _, *findings, done = lines(capsys.readouterr().out)
        assert [finding["kind"] for finding in findings] == ["shared", "swapped", "mirrored"]
        assert findings[1]["modules"] == ["board 7, triangle 2", "board 8, triangle 2"]
        assert findings[0]["uid"] == [201, 203]
        assert done == {"event": "done", "file": str(file), "findings": 3, "compared": True}


@pytest.mark.thorough
def test_finger_from_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    surface = triangles(MODULES, patches=2)
    file = tmp_path / "skin.toml"
    with finger_presses(file, surface) as arguments:
        assert exit_status(command, arguments) == 0
        found = read_geometry(file).of(structure_of(surface), "pressure")
        assert exit_status(command, [*arguments, "--offset", "0.01"]) == 0
    done = lines(capsys.readouterr().out)[-1]
    assert np.allclose(done["tip_m"], TIP_M, atol=0.002)
    assert off_m(surface, found.position_m).mean() < 0.002
    below = read_geometry(file).of(structure_of(surface), "pressure")
    assert np.allclose(below.position_m, found.position_m - 0.01 * found.normal, atol=1e-5)


@pytest.mark.thorough
def test_what_cannot_be_done_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "skin.toml"
    touch = ["touch", "--poses", "robot", "-o", str(file), "-T", "0"]
    done = run("skin-calibrate", "topology", "-o", str(file))
    assert (done.returncode, "no driver runs in namespace" in done.stderr) == (1, True)
    surface = triangles(2)
    with publishing(calm_skin(surface)) as skin:

        def refused(arguments: list[str], status: int, why: str) -> None:
            assert exit_status(command, arguments) == status
            assert why in capsys.readouterr().err
            assert not file.exists()

        with ServiceWriter("robot", {"point": ("<f8", 3), "point_m": ("<f8", 2), "count": ("<i8", 3)}):
            refused(touch, 2, "'point_m' of 'robot' is (2,); give (3,)")
            refused([*touch, "--column", "nose"], 2, "no column 'nose'; there are: point, point_m, count")
            refused([*touch, "--column", "count"], 2, "of floats")
            touch += ["--column", "point"]
            refused([*touch, "--offset", "0.01"], 2, "--offset needs --layout")
            refused(touch, 1, "no sensor was pressed often enough; nothing is written")
            refused([*touch, "--layout", str(tmp_path / "none.toml")], 2, "No such file")
            empty = tmp_path / "empty.toml"
            empty.write_text(geometry_to_toml([]))
            refused([*touch, "--layout", str(empty)], 2, "no whole module")
            refused([*touch, "--type", "force_x"], 1, "no sensor type 'force_x'")
            gathered(file, PressSession(20, pose_shape=(4, 4)), skin.structure)
            refused(touch, 2, "has poses of a skin, not points")
        refused(["check", str(tmp_path / "none.toml")], 2, "No such file")
        refused(["topology", "-o", str(file), "--share", "2"], 2, "0<=x<=1")


def force_session(n: int, *, follows: bool = True) -> ForceSession:
    """Two minutes of presses on four of n taxels, which the reference follows or not."""
    session = ForceSession(n)
    for number in range(2400):
        force_n = max(0.0, 3 * np.sin(number / 20) * (1 + number % 3))
        load = np.zeros(n)
        load[number // 126 % 4] = round(40 * force_n)
        session.take(number * 50_000_000, load, np.array([force_n if follows else number % 7, np.nan]))
    return session


def test_forces_from_gathered_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, surface = tmp_path / "curves.toml", triangles(1)
    with publishing(calm_skin(surface)) as skin:
        gathered(file, force_session(len(surface)), skin.structure)
        assert exit_status(command, ["force", "-o", str(file)]) == 2
        capsys.readouterr()
        assert exit_status(command, ["force", "-o", str(file), "-T", "0", "--json"]) == 0
        *_, done = lines(capsys.readouterr().out)
    assert (done["event"], done["curves"], done["doubts"]) == ("done", 4, [])
    assert done["residual_n"] < 0.05
    general, *own = read_curves(file)
    assert (general.unit, general.uid, len(own)) == ("N", None, 4)
    assert np.interp(40, general.x, general.y) == pytest.approx(1, rel=0.1)


def test_a_weight_that_no_sensor_feels_does_not_count(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with publishing(calm_skin(triangles(1))):
        weights = ["force", "-o", str(tmp_path / "curves.toml"), "--newtons", "1", "--weight-s", "0.5"]
        assert exit_status(command, weights) == 2
    said = capsys.readouterr().err
    assert said.index("lay 1 N on the skin") < said.index("no sensor felt 1 N") < said.index("0 frames with a load")
