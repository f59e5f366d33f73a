"""skin-convert as people and scripts use it."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skinware.cli._command import exit_status
from skinware.cli.convert import _FORMATS, _LEARNING_FORMATS, _WIRE_FORMATS
from skinware.cli.convert import command as convert
from skinware.conversion import FORMATS, WIRE_FORMATS
from skinware.conversion.learning import LEARNING_FORMATS
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import fake_structure
from tests.commands import BIN, PATIENCE_S
from tests.recording.made import made_recording
from tests.unprivileged import without_rights_to_all_files


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording of a driver, in the present folder."""
    monkeypatch.chdir(tmp_path)
    made_recording(Path("walk.mcap"), fake_structure(2, 2), 100)
    return Path("walk.mcap")


def test_for_people_and_programs(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(convert, [str(file), "--to", "npz"]) == 0
    assert capsys.readouterr().out == "walk.npz: 100 samples of torso\n"
    assert exit_status(convert, [str(file), "--to", "csv", "--start", "0.2", "--end", "0.5", "--json"]) == 0
    out, err = capsys.readouterr()
    note = "walk-csv: counters, histograms and events are left out: csv does not hold them"
    assert err == f"skin-convert: {note}\n"
    told = {"event": "converted", "file": "walk-csv", "format": "csv", "frames": {"torso": 30}, "notes": [note]}
    assert json.loads(out) == told
    assert exit_status(convert, ["walk.mcap", "--to", "mcap", "-o", "again.mcap"]) == 0
    regions = 'format = "skinware-regions"\nversion = 1\n\n[[region]]\nname = "palm"\nuid = [1000, 1002, 1010]\n'
    Path("regions.toml").write_text(regions)
    options = ["--region", "palm", "--type", "pressure", "-o", "palm.npz"]
    assert exit_status(convert, ["again.mcap", "torso", "--to", "npz", *options]) == 0
    with np.load("palm.npz") as arrays:
        assert arrays["torso/sensors/uid"].tolist() == [1000, 1002]
    assert [entry.name for entry in sorted(tmp_path.iterdir())] == [
        *("again.mcap", "palm.npz", "regions.toml", "walk-csv", "walk.mcap", "walk.npz")
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nothing.mcap", "--to", "npz"], 2, "nothing.mcap: No such file or directory"),
        (["walk.mcap", "--to", "xls"], 2, "'xls' is not one of"),
        (["walk.mcap", "--to", "npz", "-o", "walk.mcap"], 2, "walk.mcap: exists already: give another name"),
        (["walk.mcap", "--to", "npz", "-o", "nowhere/x.npz"], 2, "skin-convert: there is no folder nowhere"),
        (["walk.mcap", "--to", "npz", "-o", "/proc/x.npz"], 2, "No such file or directory"),
        (["walk.mcap", "--to", "npz", "--start", "2", "--end", "1"], 2, "--end 1 is not after --start 2"),
        (["walk.mcap", "leg", "--to", "npz"], 2, "no service 'leg'; there are: torso"),
        (["walk.mcap", "--to", "npz", "--region", "palm"], 2, "regions.toml"),
        (["walk.mcap", "--to", "npz", "--regions", "r.toml"], 2, "choose regions with --region"),
        (["walk.mcap", "--to", "npz", "--start", "9"], 2, "no sample of the selection was recorded in that time"),
        (["walk.mcap", "--to", "npz", "--fps", "30"], 2, "--fps is for --to lerobot"),
        (["walk.mcap", "--to", "npz", "--video"], 2, "--video is for --to lerobot"),
        (["walk.mcap", "--to", "lerobot", "--fps", "0"], 2, "0 is not in the range"),
        (["walk.mcap", "--to", "lerobot", "--window", "0"], 2, "'0' is not a number of samples, nor all"),
        (["walk.mcap", "--to", "lerobot", "--episode", "2..1"], 2, "is not START..END in seconds"),
        (["walk.mcap", "--to", "lerobot", "--episode", "7..8"], 2, "no time in the episode 7..8 has all the data"),
        (["walk.mcap", "--to", "lerobot", "--episodes", "no.csv"], 2, "no.csv: No such file or directory"),
        (["walk.mcap", "--to", "lerobot", "--join", "action=no.csv"], 2, "no.csv: No such file or directory"),
        (["walk.mcap", "--to", "lerobot", "--also", "no.mcap"], 2, "no.mcap: No such file or directory"),
        (["walk.mcap", "--to", "lerobot", "--size", "9"], 2, "'9' is not WIDTHxHEIGHT, as in 96x48"),
        (["walk.mcap", "--to", "lerobot", "--range", "9..1"], 2, "'9..1' is not LOWEST..HIGHEST, as in 0..4095"),
        (["walk.mcap", "--to", "lerobot", "--marks"], 2, "no mark in it begins an episode"),
        (["walk.mcap", "--to", "lerobot", "--as", "images"], 2, "temperature has no range of values of its own"),
        (["walk.mcap", "--to", "lerobot", "--start", "9"], 2, "no frames of a driver are in it"),
        (["walk.mcap", "--to", "lerobot", "-o", "walk.mcap"], 2, "walk.mcap: exists already: give another name"),
    ],
)
def test_mistakes_are_one_line(
    file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    words: str,
) -> None:
    before = file.read_bytes()
    assert exit_status(convert, arguments) == code
    errors = capsys.readouterr().err
    assert words in errors.splitlines()[-1]
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == [tmp_path / "walk.mcap"]
    assert file.read_bytes() == before


@pytest.mark.thorough
@pytest.mark.parametrize("format_name", ["csv", "npz", "lerobot"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_one_leaves_nothing(tmp_path: Path, format_name: str, number: int) -> None:
    file, out = tmp_path / "long.mcap", tmp_path / "out"
    made_recording(file, fake_structure(4, 16), 2000)
    command = [str(BIN / "skin-convert"), str(file), "--to", format_name, "-o", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
        process.send_signal(number)
        printed = process.communicate(timeout=PATIENCE_S)
    assert printed == ("", "")
    assert process.returncode == 0
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.thorough
@pytest.mark.parametrize("format_name", sorted([*FORMATS, *LEARNING_FORMATS]))
def test_no_room_is_one_line_and_leaves_nothing(
    file: Path, tmp_path: Path, format_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # or the limit cuts off the bytecode of what is imported
    done = subprocess.run(
        [BIN / "skin-convert", file, "--to", format_name, "-o", "out"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, 2_000)),
    )
    assert done.returncode == 1
    assert done.stderr.startswith("skin-convert: ")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "walk.mcap"]


@pytest.mark.thorough
def test_no_permission_is_one_line(file: Path, tmp_path: Path) -> None:
    closed, unreadable = tmp_path / "closed", tmp_path / "unreadable.mcap"
    closed.mkdir(mode=0o500)
    unreadable.write_bytes(file.read_bytes())
    unreadable.chmod(0)
    for arguments, where in (
        ([str(file), "-o", str(closed / "x.npz")], str(closed)),
        ([str(unreadable), "-o", "x.npz"], "unreadable.mcap"),
    ):
        done = subprocess.run(
            [BIN / "skin-convert", *arguments, "--to", "npz"],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            preexec_fn=without_rights_to_all_files,
        )
        assert done.returncode == 1, done.stderr
        assert where in done.stderr
        assert done.stderr.endswith(": Permission denied\n")
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.thorough
@pytest.mark.parametrize(("package", "format_name"), [("h5py", "hdf5"), ("pyarrow", "parquet"), ("pyarrow", "lerobot")])
def test_without_a_package_it_says_which_extra_is_needed(file: Path, package: str, format_name: str) -> None:
    code = f"import sys; sys.modules[{package!r}] = None\nfrom skinware.cli.convert import main; main()"
    command = [sys.executable, "-c", code, str(file), "--to", format_name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert done.returncode == 1
    assert "pip install 'skinware[convert]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_learning_set_for_people_and_programs(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episodes = ["--episode", "0..0.5", "--episode", "0.6..0.8"]
    assert exit_status(convert, [str(file), "--to", "lerobot", "--fps", "10", *episodes]) == 0
    assert capsys.readouterr().out == "walk-lerobot: 7 rows of torso in 2 episodes\n"
    assert json.loads(Path("walk-lerobot/meta/info.json").read_text())["fps"] == 10
    Path("joints.csv").write_text("time_s,hip,knee\n" + "".join(f"{n / 10},{n},{-n}\n" for n in range(10)))
    options = ["--window", "all", "--task", "walk", "--join", "action=joints.csv:knee", "--match", "nearest"]
    assert exit_status(convert, [str(file), "--to", "lerobot", "-o", "set", "--fps", "10", "--json", *options]) == 0
    told = {"file": "set", "format": "lerobot", "frames": {"torso": 10}, "episodes": 1, "notes": []}
    assert json.loads(capsys.readouterr().out) == {"event": "converted", **told}
    info = json.loads(Path("set/meta/info.json").read_text())
    assert info["features"]["observation.tactile.torso.pressure"]["shape"] == [10, 40]
    assert info["features"]["action"] == {"dtype": "float32", "shape": [1], "names": ["knee"]}


def test_it_offers_what_there_is() -> None:
    assert set(_LEARNING_FORMATS) == set(LEARNING_FORMATS)
    assert set(_FORMATS) == set(FORMATS)
    assert set(_WIRE_FORMATS) == set(WIRE_FORMATS)


def test_data_of_other_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("skinware.cli.convert._PROGRESS_S", 0)
    rows = "".join(f"{number / 100},{number},{2 * number}\n" for number in range(30))
    Path("data.csv").write_text(f"time,taxel_0,taxel_1\n{rows}")
    assert exit_status(convert, ["data.csv", "--guess"]) == 0
    Path("map.toml").write_text(capsys.readouterr().out)
    assert exit_status(convert, ["data.csv", "--map", "map.toml", "--to", "mcap", "-o", "made.mcap", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["frames"] == {"data": 30}
    assert err == "skin-convert: data.csv: 100%\n"
    assert exit_status(convert, ["data.csv", "--map", "map.toml", "--to", "npz"]) == 0
    with np.load("data.npz") as arrays:
        assert arrays["data/columns/values"].tolist() == [[number, 2 * number] for number in range(30)]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "Missing option '--to'"),
        (["--guess", "--to", "mcap"], "--guess goes without --to"),
        (["--map", "map.toml", "--to", "mcap", "--start", "3"], "--map goes without --start"),
        (["--map", "map.toml", "--to", "lerobot"], "then convert the recording to lerobot"),
        (["--map", "map.toml", "--to", "mcap"], "data.csv: No such file or directory"),
    ],
)
def test_mistakes_with_data_of_other_programs(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert exit_status(convert, ["data.csv", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_touch_as_images_of_a_size_and_range(file: Path) -> None:
    options = ["--as", "images", "--type", "temperature", "--range", "0..100", "--size", "40x20", "--colours", "log"]
    assert exit_status(convert, [str(file), "--to", "lerobot", *options]) == 0
    features = json.loads(Path("walk-lerobot/meta/info.json").read_text())["features"]
    assert features["observation.images.touch"]["shape"] == [20, 40, 3]
