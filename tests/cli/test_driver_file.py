"""``--driver ./my_skin.py``: a driver in a file, without a package."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest

from skinware import DriverReader
from skinware.cli._command import exit_status
from skinware_drivers.cli import config, driver, emulate, find
from skinware_drivers.cli.driver_setup import ConfigFile, DriverSetup
from skinware_drivers.registry import load_driver
from skinware_drivers.virtual.hardware import load_emulator
from tests.commands import running
from tests.finding.fakes import see_only
from tests.sdk.driving import follow

FINGER = (Path(__file__).parents[2] / "examples/finger.py").read_text()
EMULATOR = FINGER.index("class EmulatedFinger")
Write = Callable[[str, str], str]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    """Writes a file into a folder, and gives its path; what is imported of it meanwhile is forgotten afterwards."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    known = set(sys.modules)

    def write(name: str, text: str) -> str:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return str(path)

    yield write
    for name in set(sys.modules) - known:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def told(capsys: pytest.CaptureFixture[str], command: click.Command, *arguments: str, status: int = 0) -> str:
    assert exit_status(command, arguments) == status
    output = capsys.readouterr()
    assert "Traceback" not in output.err
    return output.err if status else output.out


@pytest.mark.thorough
def test_it_runs_from_a_file_that_a_configuration_names(write: Write, tmp_path: Path) -> None:
    write("robot/finger.py", FINGER)
    file = Path(write("robot/hand.toml", 'driver = "./finger.py"\n[[bus]]\nname = "virtual"\n'))
    with running("skin-driver", "--config", str(file)) as process:
        process.wait_for("ready")
        with DriverReader("finger") as reader:
            assert reader.driver_type == "finger"
            with file.open("a") as more:
                more.write('[[bus]]\nname = "virtual?seed=1"\n')
            process.process.send_signal(signal.SIGHUP)
            both = follow(reader, lambda f: f.structure.n_patches == 2)
            assert both.structure.buses == ("virtual", "virtual?seed=1")


def test_what_a_configuration_names_is_a_path_from_there_on(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(write("robot/finger.py", FINGER))
    file = Path(write("hand.toml", 'driver = "robot/finger.py"\n'))
    assert ConfigFile(file).settings.driver == str(path)
    monkeypatch.chdir(file.parent)
    assert ConfigFile(Path("hand.toml")).settings.driver == "robot/finger.py"
    file.write_text(f'driver = "{path}"\n')
    assert ConfigFile(file).settings.driver == str(path)


def test_help_shows_the_options_of_the_file(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    own = 'class Options(NoOptions, frozen=True):\n    """Of it."""\n\n    gain: int = 1\n\n\nclass Finger'
    with_own = FINGER.replace("class Finger", own).replace("CanAdapter[NoOptions]", "CanAdapter[Options]")
    path = write("finger.py", with_own)
    text = told(capsys, driver.command, "--driver", path, "--help")
    assert re.search(r"Options of finger:\n  --gain INTEGER", text)
    assert "Options of emulated finger:" in told(capsys, emulate.command, f"--driver={path}", "--help")


@pytest.mark.parametrize("name", ["revo2", "revo3", "inspire"])
def test_the_number_of_a_hand_is_an_option(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """It was hidden by an option of the command."""
    assert "--unit INTEGER" in told(capsys, driver.command, "--driver", name, "--help")


def test_an_emulator_that_is_no_class_of_ours_is_refused_an_option_that_the_command_has(
    write: Write, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "import msgspec\nclass Options(msgspec.Struct):\n    log: int = 1\n\nclass Emulated:\n    Options = Options\n"
    )
    methods = "".join(
        f"    def {name}(self, *_): ...\n" for name in ("receive", "next_due_ns", "emit", "skip", "totals")
    )
    path = write("emulated.py", f"{text}{methods}")
    assert exit_status(emulate.command, ["--driver", path, "--bus", "vcan0"]) == 2
    assert "option 'log' would be hidden by --log of skin-emulate" in capsys.readouterr().err


def test_all_who_name_it_mean_the_same_class(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(write("finger.py", FINGER + "\n\nDriver = Finger\n"))
    monkeypatch.chdir(path.parent)
    assert load_driver(str(path)) is load_driver("finger.py") is load_driver("./finger.py")
    assert load_driver("finger.py").__module__ == load_emulator("./finger.py").__module__ == "finger"


def test_what_lies_beside_it_can_be_imported_but_hides_nothing(write: Write) -> None:
    write("beside_finger.py", "from finger_4 import Finger\nSIZE = 4")
    write("colorsys.py", "1 / 0")
    text = "import colorsys\nimport beside_finger\nassert colorsys.rgb_to_hsv\nassert beside_finger.Finger is Finger\n"
    assert load_driver(write("finger_4.py", f"{FINGER}\n\n{text}")).__name__ == "Finger"


def test_emulated_from_a_file(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    strip = (
        "from skinware_drivers.virtual import SerialEmulator, SerialEmulatorOptions, on_a_grid\n"
        "class Strip(SerialEmulator[SerialEmulatorOptions]):\n"
        "    full_scale, rest, swing, period_s = 200, 10, 100, 0.01\n"
        "    def places(self):\n        return on_a_grid(2, columns=2)\n"
        "    def messages(self, device, values):\n        return [bytes(values)]\n"
    )
    bus = f"pty:{tmp_path}/port"
    arguments = ("--driver", write("strip.py", strip), "--bus", bus, "-T", "0.1")
    assert f"emulating strip on {bus}" in told(capsys, emulate.command, *arguments)
    wrong = told(capsys, emulate.command, "--driver", write("finger.py", FINGER), "--bus", bus, status=2)
    assert "devices of finger are attached to a CAN bus; give vcan0 or can0" in wrong


@pytest.mark.usefixtures("only_here")
def test_found_by_a_file(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    path = write("finger.py", FINGER)
    bus = f"virtual:{path}"
    text = told(capsys, find.command, bus, "--driver", path, "-T", "0.2")
    assert "looks like finger: finger (all frames)" in text
    text = told(capsys, find.command, bus, "--driver", f"{path}.py", status=2)
    assert f"driver {path}.py: there is no such file" in text


@pytest.mark.usefixtures("only_here")
def test_set_up_by_a_file(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    mine = "from skinware_drivers.can.roboskin import RoboskinDriver\nclass Mine(RoboskinDriver):\n    pass\n"
    text = told(capsys, config.command, "virtual:roboskin", "--driver", write("mine.py", mine))
    assert "rebaseline:" in text


@pytest.fixture
def only_here(namespace: object, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers of other tests are not seen."""
    see_only(namespace, tmp_path_factory.mktemp("shm"), monkeypatch)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a1.py", "x = 1", r"a1\.py has no driver: it defines no subclass of CanAdapter or its like"),
        ("a2.py", "from skinware_drivers.can.xela import XelaDriver", r"has no driver.*imported ones do not count"),
        ("a3.py", FINGER + "class B(Finger): pass", r"has 2 drivers: Finger, B; leave one of them in it"),
        ("a4.py", "import numpy\n\n1 / 0", r"driver .*a4\.py cannot be loaded: ZeroDivisionError: .* \(.*/a4\.py:3\)$"),
        ("a5.py", "x = 1\nx =", r"a5\.py cannot be loaded: SyntaxError: invalid syntax \(.*/a5\.py:2\)$"),
        ("a6.py", "import json\njson.loads('{')", r"JSONDecodeError: .* \(.*/a6\.py:2\)$"),
        ("a7.py", "from skinware_drivers import Layout\nLayout([])", r"1 to 200 frames .* \(.*/a7\.py:2\)$"),
        ("a8.py", "import nonsuch_x", r"ModuleNotFoundError: No module named 'nonsuch_x' \(.*/a8\.py:1\)$"),
        ("a9.py", "raise SystemExit(3)", r"cannot be loaded: SystemExit: 3 \(.*/a9\.py:1\)$"),
        (
            "can.py",
            FINGER,
            r"there is another Python module 'can' already \(.*/can/__init__\.py\); give the file anoth",
        ),
        ("my skin.py", FINGER, r"my skin\.py: driver name 'my skin': give 1 to 47 letters, digits"),
        ("a10.py", FINGER[:EMULATOR], r"a10\.py has no emulator:.*; without one, its driver needs the real devices"),
    ],
)
def test_what_is_wrong_with_a_file_is_said(
    name: str, text: str, words: str, write: Write, capsys: pytest.CaptureFixture[str], namespace: object
) -> None:
    message = told(capsys, driver.command, "--driver", write(name, text), "--bus", "virtual", status=2)
    assert re.search(words, message.rstrip()), message


def test_a_file_of_the_name_of_another_is_refused(write: Write, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = write("left/finger.py", FINGER), write("right/finger.py", FINGER)
    text = told(capsys, find.command, "virtual", "--driver", left, "--driver", right, status=2)
    assert f"{right}: there is another Python module 'finger' already ({left}); give the file another name" in text


def test_a_name_that_is_not_known_may_be_meant_as_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    text = told(capsys, driver.command, "--driver", "my_skin", "--bus", "virtual", status=2)
    assert "there is no driver 'my_skin'" in text
    assert "One of yours: give its file, as ./my_skin.py, or install its package" in text


def test_the_command_line_comes_before_the_file(tmp_path: Path) -> None:
    file = tmp_path / "arm.toml"
    file.write_text('name = "arm"\nslots = 4\nlatency_ms = 3\ngroup = "lab"\n[[bus]]\nname = "virtual"\n')
    given = {"slots": 8, "latency_ms": 0.0, "group": None, "listen_only": False}
    setup = DriverSetup(given, buses=(), hardware={}, config=file, namespace=None)
    settings = setup._settings
    assert (setup.name, settings.slots, settings.latency_ms, settings.group) == ("arm", 8, 0.0, "lab")
