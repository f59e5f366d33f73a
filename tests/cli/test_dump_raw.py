"""``skin-dump --raw``: lines that the programs for candump's format read."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import can
import numpy as np
import pytest

from skinware.cli._command import exit_status
from skinware.wire import candump_line, channel_name
from skinware_drivers.bus import EXTENDED_FLAG, FrameBatch
from skinware_drivers.cli.dump import command, frames_of
from skinware_drivers.finding import running
from skinware_drivers.finding.running import RunningDriver
from tests.cli.fake_skin import FakeSkin, fake_structure, publishing
from tests.sdk.driving import troubled

STREAMING = "virtual?boards=7&streaming=yes"
LINE = re.compile(r"\((\d+\.\d{6})\) ([\w.-]{1,15}) ([0-9A-F]{3}|[0-9A-F]{8})#(?:#[0-9A-F])?((?:[0-9A-F]{2})*)")


def batch_of(*frames: tuple[int, bytes, int]) -> FrameBatch:
    batch = FrameBatch(len(frames), 64)
    for number, (identifier, payload, flags) in enumerate(frames):
        batch.append(0, 1_500 * number, identifier, payload)
        batch.wire["flags"][number] = flags
    return batch


def read_back(path: Path, lines: list[str]) -> list[can.Message]:
    path.write_text("".join(f"{line}\n" for line in lines))
    with can.LogReader(path) as reader:
        return list(reader)


def test_python_can_reads_all_kinds_of_frames_back(tmp_path: Path) -> None:
    frames = [
        (0x473, b"\x40" + b"\xf0" * 7, 0),
        (0x001, b"", 0),
        (EXTENDED_FLAG | 0x12, b"\x01\x02", 0),
        (0x123, bytes(range(64)), 0x01),
        (EXTENDED_FLAG | 0x1FFFFFFF, b"\xff", 0x04 | 0x03),
    ]
    found = frames_of(batch_of(*frames), 1_700_000_000_123_456_789)
    lines = [candump_line(at_us, "vcan0", who, flags, data) for at_us, who, flags, data in found]
    assert lines[0] == "(1700000000.123456) vcan0 473#40F0F0F0F0F0F0F0"
    assert lines[2:4] == [
        "(1700000000.123459) vcan0 00000012#0102",
        f"(1700000000.123461) vcan0 123##1{bytes(range(64)).hex().upper()}",
    ]
    assert all(LINE.fullmatch(line) for line in lines)
    messages = read_back(tmp_path / "can.log", lines)
    assert [(m.arbitration_id | m.is_extended_id << 31, bytes(m.data)) for m in messages] == [f[:2] for f in frames]
    assert [m.is_fd for m in messages] == [False, False, False, True, True]
    assert [(m.bitrate_switch, m.error_state_indicator) for m in messages[3:]] == [(True, False), (True, True)]
    assert {m.channel for m in messages} == {"vcan0"}
    assert messages[1].timestamp == pytest.approx(1_700_000_000.123458, abs=1e-6)


def test_only_the_valid_part_of_a_batch_and_of_a_payload_is_shown() -> None:
    batch = batch_of((1, b"\x01", 0), (2, b"\x02\x03", 0))
    batch.wire["payload"][:] = 0xEE
    batch.wire["payload"][1, :2] = (2, 3)
    batch.start = 1
    assert list(frames_of(batch, 0)) == [(1, 2, None, b"\x02\x03")]
    assert np.array_equal(batch.wire["payload"][1, 2:], np.full(62, 0xEE))


@pytest.mark.parametrize(
    ("interface", "channel", "name"),
    [
        ("socketcan", "can0", "can0"),
        ("slcan", "/dev/ttyACM0", "ttyACM0"),
        ("virtual", "", "virtual"),
        ("udp_multicast", "ff15:7079:7468:6f6e:6465", "ff15_7079_7468_"),
        ("pcan", "a b", "a_b"),
    ],
)
def test_channels_have_names_that_interfaces_could_have(interface: str, channel: str, name: str) -> None:
    assert channel_name(interface, channel) == name


def test_a_bus_is_dumped_and_read_back(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    before_s = time.time() - 1
    assert exit_status(command, ["--raw", STREAMING, "-n", "100"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    messages = read_back(tmp_path / "can.log", printed.out.splitlines())
    assert len(messages) == 100
    assert {m.arbitration_id & ~0xF for m in messages} == {0x470}
    assert {m.data[0] for m in messages} == {0x40, 0xC0}
    stamps = [m.timestamp for m in messages]
    assert stamps == sorted(stamps)
    assert before_s < stamps[0] <= stamps[-1] <= time.time()


def test_json_has_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, ["--raw", STREAMING, "-n", "3", "--json"]) == 0
    frames = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(frames) == 3
    assert frames[0].keys() == {"bus", "time", "identifier", "extended", "fd", "data"}
    assert (frames[0]["bus"], frames[0]["extended"], frames[0]["fd"]) == ("virtual", False, False)
    assert frames[0]["identifier"] >> 4 == 0x47
    assert frames[0]["data"].startswith("40")


@pytest.mark.thorough
def test_the_log_plays_on_a_bus_of_python_can(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert exit_status(command, ["--raw", STREAMING, "-n", "4"]) == 0
    path = tmp_path / "can.log"
    path.write_text(capsys.readouterr().out)
    player = [sys.executable, "-m", "can.player", "-i", "virtual", "-c", "x", "--ignore-timestamps", str(path)]
    done = subprocess.run(player, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_what_is_not_shown_is_said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    bus = troubled(boards=(7,), streaming=True)
    bus.counters.dropped, bus.counters.errors = 5, 2
    monkeypatch.setattr("skinware_drivers.registry.make_bus", lambda *_, **__: bus)
    assert exit_status(command, ["--raw", "virtual", "-n", "1"]) == 0
    assert capsys.readouterr().err == "skin-dump: 5 dropped, 2 error frames, not shown\n"
    assert bus.fileno() == -1


def test_frames_of_drivers_are_dumped_as_before(capsys: pytest.CaptureFixture[str]) -> None:
    with publishing(FakeSkin("torso", fake_structure(2, 4))):
        assert exit_status(command, ["torso", "-n", "2", "--json"]) == 0
    assert [json.loads(line)["driver"] for line in capsys.readouterr().out.splitlines()] == ["torso"] * 2


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["--raw", "virtual", "--timeout", "0.05"], 1, "virtual: no frame for 0.05 s"),
        (["--raw", "no-such-can0"], 1, "CAN"),
        (["--raw", "/dev/ttyUSB0"], 2, "a serial line has one owner"),
        (["--raw", "serial:/dev/ttyUSB0"], 2, "a serial line has one owner"),
        (["--raw", "virtual", "--type", "pressure"], 2, "--raw goes without --type"),
        (["torso", "--raw", "virtual"], 2, "--raw goes without NAME"),
        (["--raw", "virtual?board=7"], 2, "did you mean 'boards'"),
    ],
)
def test_mistakes_get_one_clear_line_and_the_right_exit_code(
    capsys: pytest.CaptureFixture[str], arguments: list[str], status: int, words: str
) -> None:
    assert exit_status(command, arguments) == status
    printed = capsys.readouterr()
    assert words in printed.err
    assert printed.out == ""


def test_an_adapter_that_a_driver_has_is_left_to_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = RunningDriver("torso", "default", "roboskin", 1, ("slcan:/dev/ttyACM0?bitrate=1000000",))
    monkeypatch.setattr(running, "running_drivers", lambda: [owner])
    assert exit_status(command, ["--raw", "slcan:/dev/ttyACM0"]) == 2
    assert "driver 'torso' (namespace default, pid 1) uses it" in capsys.readouterr().err
