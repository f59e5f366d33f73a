"""skin-replay --wire: what went over a bus, sent on another one."""

from __future__ import annotations

import difflib
import json
import signal
import time
from collections.abc import Callable
from pathlib import Path

import can
import pytest

from skinware.cli._command import exit_status
from skinware_drivers.bus import ERROR_FLAG, EXTENDED_FLAG
from skinware_drivers.cli.replay import command
from skinware_drivers.registry import load_driver, make_bus
from skinware_drivers.wire_tap import WireTap
from tests.commands import run, running
from tests.recording.test_wire_export import ON_VCAN1, Sent, keep, write_recording
from tests.recording.test_wire_replay import record, updates_of

MS = 1_000_000
FRAMES = [
    Sent(0, 0x473, b"ABC"),
    Sent(1 * MS, 0x321, b"ask", is_sent=True),
    Sent(20 * MS, EXTENDED_FLAG | 0x1234567, b"x"),
    Sent(30 * MS, ERROR_FLAG | 4, bytes(8)),
    Sent(60 * MS, 0x100, b"end"),
]
HEARD = [0x473, 0x1234567, 0x100]


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)

    def fill(taps: dict[tuple[str, str], WireTap]) -> None:
        keep(taps, "torso", "can0", FRAMES)
        keep(taps, "torso", "can1", ON_VCAN1)

    write_recording(Path("walk.mcap"), fill)
    return Path("walk.mcap")


def hear(channel: str, act: Callable[[], None]) -> list[can.Message]:
    with can.Bus(interface="virtual", channel=channel) as bus:
        act()
        found: list[can.Message] = []
        while (message := bus.recv(0)) is not None:
            found.append(message)
        return found


def test_frames_that_were_received_are_sent_again(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def replay() -> None:
        arguments = [str(file), "--wire", "--bus", "can0=can+virtual:again", "--json"]
        assert exit_status(command, arguments) == 0

    messages = hear("again", replay)
    assert [message.arbitration_id for message in messages] == HEARD
    assert [bytes(message.data) for message in messages] == [b"ABC", b"x", b"end"]
    assert [message.is_extended_id for message in messages] == [False, True, False]
    ready, stopped = map(json.loads, capsys.readouterr().out.splitlines())
    assert (ready["event"], ready["buses"]) == ("ready", {"can0": "again"})
    assert stopped == {"event": "stopped", "frames": {"can0": 3}, "failed": 0}


def test_speed_part_and_for_people(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def replay() -> None:
        part = ["--start", "0.01", "--speed", "50"]
        assert exit_status(command, [str(file), "--wire", "--bus", "can0=can+virtual:part", *part]) == 0

    assert [message.arbitration_id for message in hear("part", replay)] == HEARD[1:]
    assert capsys.readouterr().out.splitlines() == ["walk.mcap: can0 on part (Ctrl-C ends)", "2 frames sent"]


def test_several_buses_in_their_time(file: Path) -> None:
    def replay() -> None:
        buses = ["--bus", "can0=can+virtual:both", "--bus", "can1=can+virtual:both"]
        assert exit_status(command, [str(file), "--wire", *buses]) == 0

    found = [message.arbitration_id for message in hear("both", replay)]
    assert found == [0x473, 0x7FF, 0x7FE, 0x1234567, 0x100]


@pytest.mark.thorough
def test_it_loops_until_it_is_interrupted(file: Path) -> None:
    with running("skin-replay", str(file), "--wire", "--loop", "--bus", "can0=can+virtual:loop") as replay:
        replay.wait_for("ready")
        time.sleep(0.5)
        stopped = replay.stop(signal.SIGTERM)
        assert replay.process.returncode == 0
    assert stopped["frames"]["can0"] > 3


@pytest.mark.thorough
def test_bytes_of_a_line_come_out_of_a_pseudo_terminal(tmp_path: Path) -> None:
    """A driver reads what was recorded as from its device; so does any program."""
    kind = load_driver("agni")
    path, link, again = tmp_path / "walk.mcap", tmp_path / "port", tmp_path / "again.mcap"
    adapter = kind(kind.Options())
    before = record(path, adapter, make_bus("virtual", payload_size=adapter.payload_size, driver="agni"), 40)
    with running("skin-replay", str(path), "--wire", "--loop", "--bus", f"pty:{link}") as replay:
        replay.wait_for("ready")
        adapter = kind(kind.Options())
        after = record(again, adapter, make_bus(str(link), payload_size=adapter.payload_size), 15, updates=20)
        replay.stop()
    assert after.structure.sensor_uid.tolist() == before.structure.sensor_uid.tolist()
    for old, new in zip(updates_of(before), updates_of(after), strict=True):
        matcher = difflib.SequenceMatcher(None, [one for _, one in old], [one for _, one in new], autojunk=False)
        assert sum(block.size for block in matcher.get_matching_blocks()) >= 0.8 * min(len(old), len(new)) > 8


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--wire"], "--wire needs a --bus, as vcan0; for a driver without one: skin-driver --bus replay:walk.mcap"),
        (["--bus", "vcan0"], "--bus needs --wire"),
        (["--wire", "--bus", "x", "--paused"], "--wire goes without --paused"),
        (["--wire", "--bus", "x", "--times", "recorded"], "--wire goes without --times"),
        (["--wire", "--bus", "vcan0"], "walk.mcap: which bus? there are: bus=can0&driver=torso, bus=can1&driver=torso"),
        (["--wire", "--bus", "can0=a", "--bus", "can0=b"], "--bus can0=b: can0 is sent already"),
    ],
)
def test_what_makes_no_sense_is_refused(
    file: Path, arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(command, [str(file), *arguments]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


@pytest.mark.thorough
def test_a_recording_without_wires_and_a_bus_that_is_not_there(file: Path) -> None:
    write_recording(Path("without.mcap"), lambda taps: None)
    nothing = run("skin-replay", "without.mcap", "--wire", "--bus", "vcan0")
    assert (nothing.returncode, nothing.stdout) == (2, "")
    assert nothing.stderr == "skin-replay: without.mcap: no wire was recorded: skin-record --wire records them\n"
    away = run("skin-replay", str(file), "--wire", "--bus", "can0=nocan7")
    assert (away.returncode, away.stdout, away.stderr.count("\n")) == (1, "", 1)
