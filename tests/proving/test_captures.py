"""Captures are decoded again: equal values, and the first difference."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skinware.errors import BadRecording
from skinware_drivers.bus import Bus
from skinware_drivers.options import NoOptions
from skinware_drivers.proving.captures import check_capture, decoded_then, expected_of
from skinware_drivers.proving.updates import Comparison, Decoding, Difference, ModuleUpdates, compare, load, save
from skinware_drivers.registry import load_driver
from skinware_drivers.testing.driving import driving_lines
from skinware_drivers.testing.waiting import wait_until
from tests.can.rig import TIP_IDENTIFIER, Tip
from tests.commands import refused, run
from tests.recording.rig import recording
from tests.sdk.cable import Cable
from tests.sdk.test_flow import EndOfCable

MS = 1_000_000
MISTAKEN = """
from skinware_drivers.layout import Frame, Identifier, Layout, Values
from tests.can.rig import TIP_IDENTIFIER, Tip


class Mistaken(Tip):
    \"\"\"Its last two taxels are exchanged.\"\"\"

    values = Values(0, "u1", 8, to=(0, 1, 2, 3, 4, 5, 7, 6))
    layout = Layout([Frame("all", [Identifier(TIP_IDENTIFIER)], length=(8,), values=values)])
"""


def decoding(times_ms: Sequence[float], values: Sequence[Sequence[float]], uids: Sequence[int] = (0, 1)) -> Decoding:
    names = tuple(f"tip, taxel {uid}" for uid in uids)
    return {tuple(uids): ModuleUpdates(names, np.array([round(ms * MS) for ms in times_ms]), np.array(values, float))}


THEN = decoding([0, 10, 20, 31], [[1, 2], [3, 4], [5, np.nan], [7, 8]])


@pytest.mark.parametrize(
    ("now", "told"),
    [
        (THEN, Comparison(4, 4, 4, None)),
        (decoding([10, 20, 31], [[3, 4], [5, np.nan], [7, 8]]), Comparison(3, 4, 3, None)),
        (decoding([0.1, 9.9, 20, 31.2], [[1, 2], [3, 4], [5, np.nan], [7, 8]]), Comparison(4, 4, 4, None)),
        (decoding([0, 10, 15, 20, 31, 41], [[1, 2], [3, 4], [0, 0], [5, np.nan], [7, 8], [9, 9]]), (4, 4, 6)),
        (decoding([0, 10, 20, 31], [[1, 2], [3, 4], [5, 6], [7, 9]]), "at 0.0200 s, tip, taxel 1: nan then, 6 now"),
        (decoding([0, 20, 31], [[1, 2], [5, np.nan], [7, 8]]), "at 0.0100 s, tip, taxel 0: 3 then, no update now"),
        (decoding([3, 12, 23, 34], [[1, 2], [3, 4], [5, np.nan], [7, 8]]), Comparison(4, 4, 4, None)),
        (decoding([100, 110], [[1, 2], [3, 4]]), "at 0.0000 s, tip, taxel 0: 1 then, no update now"),
        (decoding([0], [[1, 2]], [5, 6]), "at 0.0000 s, tip, taxel 0: 1 then, no update now"),
        ({**THEN, **decoding([7], [[1, 2]], [5, 6])}, "at 0.0070 s, tip, taxel 5: no update then, 1 now"),
        ({}, "at 0.0000 s, tip, taxel 0: 1 then, no update now"),
    ],
)
def test_the_first_difference(now: Decoding, told: Comparison | str | tuple[int, int, int]) -> None:
    found = compare(THEN, now)
    if isinstance(told, str):
        assert str(found.difference) == told
    else:
        assert found == (told if isinstance(told, Comparison) else Comparison(*told, None))


def test_random_values_that_are_changed_anywhere_are_found() -> None:
    numbers = np.random.default_rng(2)
    for _ in range(50):
        times_ms = np.cumsum(numbers.uniform(8, 12, 30)).tolist()
        values = numbers.integers(0, 100, (30, 2)).astype(float)
        changed = values.copy()
        row, sensor = int(numbers.integers(30)), int(numbers.integers(2))
        changed[row, sensor] += 1
        found = compare(decoding(times_ms, values.tolist()), decoding(times_ms, changed.tolist())).difference
        expected = (round(times_ms[row] * MS) / 1e9, f"tip, taxel {sensor}", values[row, sensor], changed[row, sensor])
        assert found == Difference(*expected)


def test_what_is_saved_is_read_again(tmp_path: Path) -> None:
    file = tmp_path / "hand.npz"
    save(THEN, file)
    assert compare(load(file), THEN) == Comparison(4, 4, 4, None)
    for content in (b"", b"text", b"PK\3\4"):
        file.write_bytes(content)
        with pytest.raises(BadRecording, match=r"hand\.npz"):
            load(file)


@pytest.fixture(scope="session")  # a process imports a module name from one file only
def mistaken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a driver with a mistake."""
    file = tmp_path_factory.mktemp("driver") / "mistaken.py"
    file.write_text(MISTAKEN)
    return file


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """What a tip felt: its taxels all something else."""
    file, numbers, cable = tmp_path / "tip.mcap", np.random.default_rng(5), Cable()
    bus: Bus = EndOfCable(cable.end)
    with (
        recording(file, with_wires=True) as recorder,
        driving_lines([(Tip(NoOptions()), bus)], "tip", wait=False) as driver,
    ):
        for _ in range(30):
            cable.put(TIP_IDENTIFIER, numbers.permutation(8).astype("u1").tobytes())
            time.sleep(0.01)
        driver.wait()
        wait_until(lambda: recorder.messages.get("/skin/tip/frame", 0) > 15)
    cable.close()
    return file


def test_a_decoder_with_a_mistake_is_found(capture: Path, mistaken: Path) -> None:
    right, _ = check_capture(capture, Tip)
    assert right.difference is None
    assert right.compared >= 10
    wrong, now = check_capture(capture, load_driver(str(mistaken)))
    assert wrong.difference is not None
    assert wrong.difference.sensor.endswith("taxel 6")
    (then,) = decoded_then(capture).values()
    (found,) = now.values()
    first = found.values[np.flatnonzero(found.time_ns / 1e9 == wrong.difference.time_s)[0]]
    assert (wrong.difference.then, wrong.difference.now) == (first[7], first[6])
    assert len(then) > 15


def test_the_command_tells_the_first_difference_and_keeps_what_is_right(capture: Path, mistaken: Path) -> None:
    again = ("skin-prove", "--captured", str(capture), "--json", "--", "--driver")
    wrong = refused(*again, str(mistaken))
    told: dict[str, Any] = json.loads(wrong.stdout)
    assert (wrong.returncode, told["event"], told["equal"]) == (1, "compared", False)
    assert told["difference"].keys() == {"time_s", "sensor", "then", "now"}
    assert not expected_of(capture).exists()
    saved = refused("skin-prove", "--captured", str(capture), "--save", "--", "--driver", str(mistaken))
    assert saved.returncode == 0
    assert saved.stdout.endswith("equal\n")
    assert refused(*again, str(mistaken)).returncode == 0
    assert check_capture(capture, Tip)[0].difference is not None


def test_what_cannot_be_compared(capture: Path, tmp_path: Path, mistaken: Path) -> None:
    nothing = refused("skin-prove", "--captured", str(tmp_path / "nothing.mcap"))
    assert (nothing.returncode, "No such file" in nothing.stderr) == (2, True)
    unnamed = refused("skin-prove", "--captured", str(capture))  # a program has run this driver, of no name
    assert (unnamed.returncode, "tip" in unnamed.stderr) == (2, True)
    for more, words in (
        (["--tare"], "goes without --tare"),
        (["hand"], "goes without NAME"),
        (["--", "--driver", str(mistaken), "--listen-only"], "--listen-only is not about decoding"),
    ):
        told = refused("skin-prove", "--captured", str(capture), *more)
        assert (told.returncode, words in told.stderr) == (2, True), told.stderr
    alone = refused("skin-prove", "--save")
    assert (alone.returncode, "--save needs --captured" in alone.stderr) == (2, True)


@pytest.mark.thorough
def test_a_folder_of_captures_is_a_test_for_each(capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "captures"
    folder.mkdir()
    for name in ("one", "other"):
        (folder / f"{name}.mcap").write_bytes(capture.read_bytes())
    then = decoded_then(capture)
    save(
        {uids: ModuleUpdates(of.sensors, of.time_ns, of.values + 1) for uids, of in then.items()}, folder / "other.npz"
    )
    tests = tmp_path / "test_tip.py"
    tests.write_text(
        "import sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[2])!r})\n"
        "from pathlib import Path\n"
        "from skinware_drivers.testing.captures import CaptureTests\n"
        "from tests.can.rig import Tip\n"
        "class TestCaptures(CaptureTests):\n"
        "    driver = Tip\n"
        "    folder = Path(__file__).parent / 'captures'\n"
    )
    done = run("pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null", "--rootdir", str(tmp_path), str(tests))
    assert "1 failed, 1 passed" in done.stdout, done.stdout + done.stderr
    assert "[other.mcap]" in done.stdout
