"""Mistakes in configuration files are told with the line in which they stand."""

from __future__ import annotations

from pathlib import Path

import pytest

from skinware.errors import ConfigurationError
from skinware.toml_text import Keys, TomlText, line_of
from skinware_drivers.can.roboskin_layout import RoboskinOptions
from skinware_drivers.cli.driver_setup import ConfigFile

TEXT = """\
driver = "roboskin"

[options]  # of every bus
period_ms = 50
boards = [
    7,
]

[[bus]]
name = "can0"

[[ bus ]]
name = "can1"
options.period_ms = 20
[[bus.options.modules]]
board = 7
[[bus.options.modules]]
"board" = 8
triangles = [1]

[[bus]]
name = "can2"
options = { boards = [9] }
[bus.options2]
x = 1
"""


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        (("driver",), 1),
        (("options",), 3),
        (("options", "period_ms"), 4),
        (("options", "boards", 0), 5),
        (("bus", 0), 9),
        (("bus", 1, "name"), 13),
        (("bus", 1, "options", "period_ms"), 14),
        (("bus", 1, "options", "modules", 1, "board"), 18),
        (("bus", 1, "options", "modules", 1, "kind"), 17),
        (("bus", 2, "options", "boards"), 23),
        (("bus", 2, "options2", "x"), 25),
        (("nothing",), 1),
        ((), 1),
    ],
)
def test_the_line_of_a_value(keys: Keys, line: int) -> None:
    assert line_of(TEXT, keys) == line


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("\nname = 3", "{file}:2: Expected str, got int - at $.name"),
        ('\n[[bus]]\nname = ""', "{file}:2: a bus has no name yet"),
        ("\n\ncpus = [1,\n-1]", "{file}:1: "),
        ("[[bus]]\nnam = 1", "{file}:2: bus 1: unknown key 'nam'; did you mean 'name'"),
        ("bus = 3", "{file}:1: each bus is a table: a line [[bus]], and below it a line such as name = "),
        ("wait = true\nbus = ['can0']", "{file}:2: each bus is a table"),
        ("x = =", "{file}:1: not TOML: Invalid value"),
    ],
)
def test_a_mistake_in_a_file(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "torso.toml"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as raised:
        ConfigFile(file)
    assert str(raised.value).startswith(message.format(file=file))


def test_an_option_of_the_driver_outside_its_table(tmp_path: Path) -> None:
    file = tmp_path / "torso.toml"
    file.write_text("boards = [7]")
    with pytest.raises(ConfigurationError, match=r"torso.toml:1: unknown key 'boards'.* belong below \[options\]"):
        ConfigFile(file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[options]\nperiod_ms = 0", "{file}:2: options of can0: "),
        ("[options]\nperiod_ms = 20\n[[bus]]\nname = 'can0'\noptions.period_ms = 0", "{file}:5: options of can0: "),
        ("[options]\nx = 1\n[[bus]]\nname = 'can0'", "{file}:2: options of can0: unknown key 'x'"),
        ("[[bus]]\nname = 'can0'\n[bus.options]\nboards = [7, 7]", "{file}:"),
    ],
)
def test_a_mistake_in_options(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "torso.toml"
    file.write_text(text)
    with pytest.raises(ConfigurationError) as raised:
        ConfigFile(file).options_of_bus(RoboskinOptions, "can0")
    assert str(raised.value).startswith(message.format(file=file))


def test_a_mistake_that_is_not_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "torso.toml"
    file.write_text("[options]\nno_load = 240")
    with pytest.raises(ConfigurationError, match=r"^board address 77: "):
        ConfigFile(file).options_of_bus(RoboskinOptions, "can0", {"boards": "77"})


def test_a_file_without_an_end_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="/dev/zero: it has more than 16000000 bytes"):
        TomlText(Path("/dev/zero"))
