"""The how-to of iCubs, and what the page on configuration says of boards: each example does what it says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from skinware import DriverReader
from skinware.cli._command import exit_status
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.cli.import_ import command
from skinware_drivers.testing.waiting import read_until
from tests.commands import running
from tests.icub.conftest import WRAPPER, Made, configuration, device
from tests.icub.test_positions import TRIANGLE, positions

DOCS = Path(__file__).parents[2] / "docs"


def test_the_example_of_a_configuration_is_one() -> None:
    (text,) = re.findall(r"^```toml\n(.*?)^```", (DOCS / "configuration.md").read_text(), re.MULTILINE | re.DOTALL)
    text, found = re.subn(r"^cpus = .*\n", "", text, flags=re.MULTILINE)  # of a larger machine, perhaps
    assert found == 1
    example = configuration(text)
    options = example.options_of_bus(RoboskinOptions, example.settings.bus[0].name)
    assert options.special_boards[0].skin_type == 1
    assert options.modules[0].kind == "palm"


def test_the_snippet_of_the_how_to_finds_the_load(
    made: Made, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made.write("torso_skin.xml", device())
    made.write("wrapper.xml", WRAPPER)
    made.write("torso.txt", positions([TRIANGLE] * 32))
    arguments = ["--bus", "1=virtual?boards=7,8", "-o", str(made.folder / "skin")]
    assert exit_status(command, ["icub", str(made.folder), *arguments]) == 0
    capsys.readouterr()
    page = DOCS / "how-to" / "icub.md"
    (snippet,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    monkeypatch.chdir(made.folder)
    with running("skin-driver", "--config", "skin/torso_skin.toml") as driver:
        driver.wait_for("ready")
        with DriverReader("torso_skin") as reader:
            read_until(reader, lambda frame: not frame.status.any())
        exec(compile(snippet, page, "exec"), {"__name__": "how-to"})
    assert re.fullmatch(r"centre of load \[.*\] m in the frame chest\n", capsys.readouterr().out)
