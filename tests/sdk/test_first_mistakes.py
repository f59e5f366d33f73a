"""What goes wrong in the first hour with a driver of one's own gets an answer that says what to do."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware.cli._command import exit_status
from skinware.errors import ConfigurationError
from skinware.sensor_types import PRESSURE
from skinware_drivers import (
    Bits,
    Cycle,
    Frame,
    Identifier,
    Layout,
    Module,
    NoOptions,
    Patch,
    SequenceNumber,
    Values,
    taxels,
)
from skinware_drivers.bus_names import parse_bus_name
from skinware_drivers.can import CanAdapter
from skinware_drivers.cli import emulate
from skinware_drivers.cli.driver import command
from skinware_drivers.registry import load_driver


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["xela", "--bus", "virtual"], "'xela' is not an option; name a driver with --driver"),
        (["--bus", "virtual", "--bus", "virtual"], "bus virtual is named twice"),
        (["--bus", "can0", "--bus", "can0"], "bus can0 is named twice; name each"),
        (
            ["--bus", "can0", "--bus", "socketcan:can0?x=1"],
            r"bus socketcan:can0\?x=1 is named twice, also as can0; name each",
        ),
        (["--bus", "virtual", "--driver", "xelo"], r"did you mean 'xela'\?.*pip install -e \."),
        (["--bus", "virtual", "--driver", "xela", "--boards", "a"], r"boards=a: give a whole number \(number 1"),
        (["--bus", "virtual&lose=0.1"], r"options begin with a question mark, as in virtual\?lose"),
        (["--bus", "port", "--driver", "anyskin"], r"port is a CAN bus; AnySkinDriver needs a serial line.*\./port"),
        (
            ["--bus", "virtual:xela", "--driver", "anyskin"],
            r"bus virtual:xela is a CAN bus; AnySkinDriver needs a serial line; emulators that fit:.* virtual:anyskin,",
        ),
        (
            ["--bus", "virtual:anyskin", "--driver", "xela"],
            r"bus virtual:anyskin is a serial line; XelaDriver needs a CAN bus; emulators that fit:.* virtual:xela$",
        ),
        (
            ["--bus", "./port"],
            r"\./port is a serial line: give its driver with --driver. Without it, that is roboskin",
        ),
        (["--bus", "./port", "--driver", "xela"], r"\./port is a serial line; XelaDriver needs a CAN bus, as vcan0"),
    ],
)
def test_skin_driver_says_what_to_do(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str], namespace: object
) -> None:
    assert exit_status(command, arguments) == 2
    told = capsys.readouterr().err
    assert re.search(words, told), told


def test_an_emulator_on_a_bus_that_nobody_else_can_open_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(emulate.command, ["--bus", "virtual", "--driver", "xela"]) == 2
    assert "no other program can open it; give vcan0 or pty:./port" in capsys.readouterr().err


def test_a_path_may_have_an_equals_sign() -> None:
    assert parse_bus_name("/dev/serial/by-id/a=b").channel == "/dev/serial/by-id/a=b"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import nonsuch", r"ModuleNotFoundError: No module named 'nonsuch' \(.*mine_\w+\.py:1\)"),
        ("x =\n", r"SyntaxError: .*mine_\w+\.py:1\)$"),
        ("1 / 0", r"ZeroDivisionError: division by zero \(.*mine_\w+\.py:1\)"),
        ("from skinware_drivers import Layout\nLayout([])", r"1 to 200 frames.*mine_\w+\.py:2\)"),
        ("from skinware import Namespace\nNamespace('a b')", r"namespace name 'a b'.*mine_\w+\.py:2\)$"),
        ("", r"has no attribute 'Driver'$"),
    ],
)
def test_a_driver_that_cannot_be_imported_says_where(
    text: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = f"mine_{abs(hash(text))}"  # a module is imported once
    (tmp_path / f"{module}.py").write_text(text)
    installed = tmp_path / "mine-1.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Name: mine\nVersion: 1\n")
    (installed / "entry_points.txt").write_text(f"[skinware.drivers]\nmine = {module}:Driver\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigurationError, match=f"driver 'mine' .* cannot be loaded: .*{words}"):
        load_driver("mine")


class Complete(CanAdapter[NoOptions]):
    types = (PRESSURE.measured(unit="counts"),)
    dtype = np.uint16
    patches = (Patch("finger", [Module(taxels(4))]),)
    layout = Layout([Frame("all", [Identifier(0x100)], [8], Values(0, "<u2", 4))])


AB = Cycle(["a", "b"], 0.01)
COUNTER = SequenceNumber(0, "u1", mask=0xF0)
KEYED = Layout([Frame("all", [Identifier(0x100, mask=0x7F0)], [8], Values(0, "<u2", 4), module=Bits(0, 4))])


def halves(maximum_age_s: float, counter: SequenceNumber | None = None, **more: Any) -> Layout:
    frames = [Frame(f"half {i}", [Identifier(0x100 + i)], [8], Values(2, "<u2", 2, [2 * i, 2 * i + 1])) for i in (0, 1)]
    return Layout(frames, Cycle([f.name for f in frames], maximum_age_s, counter=counter, **more))


@pytest.mark.parametrize(
    "changed",
    [
        {"dtype": np.float32},
        {"layout": halves(0.0199)},
        {"layout": halves(0.0099, order="any")},
        {"layout": halves(0.3, COUNTER)},
        {"layout": Layout([Frame("d", [Identifier(1)], [8], Values(0, "<u4", 2, to=[None, None]))])},
    ],
)
def test_what_fits_is_not_refused(changed: dict[str, Any]) -> None:
    right: type[Complete] = type("Right", (Complete,), changed)
    right(NoOptions()).check()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"types": ()}, "Wrong has no `types`"),
        ({"patches": ()}, "Wrong has no `patches`"),
        ({"layout": None}, "Wrong has no `layout`"),
        ({"patches": Complete.patches[0]}, "make no skin: 'Patch' object is not iterable"),
        ({"patches": (Patch("finger", Module(taxels(4))),)}, "make no skin: 'Module' object is not iterable"),  # type: ignore[arg-type]
        ({"patches": (Patch("finger", [Module(taxels(4, "presure"))]),)}, "declares no type 'presure'"),
        ({"dtype": np.uint64}, "values of dtype uint64: choose one of"),
        ({"dtype": np.uint8}, "frame 'all': values of dtype '<u2' do not fit the driver's dtype uint8; .* = uint16"),
        ({"dtype": np.int16}, "do not fit the driver's dtype int16; give it `dtype` = uint16"),
        (
            {"patches": (Patch("finger", [Module(taxels(3))]),)},
            "channel 3, and a module of 'finger' has 3",
        ),
        (
            {"patches": (Patch("f", [Module(taxels(4)), Module(taxels(2, first_uid=9), key=1)]),), "layout": KEYED},
            "has 2",
        ),
        (
            {"layout": Layout([Frame(n, [Identifier(i)], [8], Values(0, "u1", 4)) for i, n in enumerate("ab")], AB)},
            "frames 'a' and 'b' of a cycle both have a value for channel 0: a value lies in one frame",
        ),
        ({"layout": halves(0.02)}, "two cycles fit into maximum_age_s = 0.02.*`period_s` is 0.02 s.*or say where"),
        ({"layout": halves(0.01, order="any")}, "make it shorter than half of that"),
        ({"layout": halves(0.32, COUNTER)}, "its counter has 16 values"),
    ],
)
def test_what_a_driver_forgot_is_found_before_it_runs(changed: dict[str, Any], words: str) -> None:
    Complete(NoOptions()).check()
    wrong: type[Complete] = type("Wrong", (Complete,), changed)
    with pytest.raises(ConfigurationError, match=words):
        wrong(NoOptions()).check()
