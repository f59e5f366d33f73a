from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
from itertools import islice
from typing import Any

import numpy as np
import pytest

from skinware import BusReason, BusState, Column, DriverReader, Namespace, ServiceWriter
from skinware import state as health
from skinware.cli._command import exit_status
from skinware.cli._terminal import shown
from skinware.cli.info import as_text, command
from skinware.memory.announcement import MOST_ANNOUNCEMENTS
from skinware.realtime import now_ns
from skinware.service import Columns
from skinware.status import LOAD_FILTERED, LOAD_UNKNOWN, DataPath, Unused
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill
from tests.commands import BIN, PATIENCE_S

UNTOLD: dict[str, Any] = {"reason": None, "state_age_s": None, "load": None, "load_unknown": "bit_rate", "samples": []}
UNTOLD |= {"data_path": "not_told"}
"""What a driver need not tell of a bus."""


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert exit_status(command, [*arguments, "--json"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    return json.loads(printed.out)


def text(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert exit_status(command, list(arguments)) == 0
    return capsys.readouterr().out


def test_json_contract(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("torso", fake_structure(2, 4, buses=2), slots=8) as skin, DriverReader("torso") as reader:
        skin.break_some()
        skin.publish(8)
        reader.read()
        report = told(capsys)
    assert report["namespace"] == namespace.name
    assert (report["services"], report["problems"]) == ([], [])
    (driver,) = report["drivers"]
    assert driver["name"] == "torso"
    assert driver["alive"] is True
    assert driver["pid"] == os.getpid()
    assert (driver["sensors"], driver["modules"], driver["patches"]) == (96, 8, 2)
    assert driver["types"] == [
        {"name": "pressure", "sensors": 80, "unit": "counts"},
        {"name": "temperature", "sensors": 16, "unit": "degC"},
    ]
    assert driver["sequence"] == 8
    assert driver["age_ms"] >= 0
    assert driver["rate_hz"] > 0
    assert driver["buses"] == [
        {"name": "can0", "state": "live", **UNTOLD, "frames": 5156, "dropped": 2, "errors": 0, "unknown": 7},
        {"name": "can1", "state": "live", **UNTOLD, "frames": 0, "dropped": 0, "errors": 0, "unknown": 0},
    ]
    (record,) = driver["readers"]
    assert (record["service"], record["pid"]) == ("torso", os.getpid())
    counts = {"frames", "missed", "overruns", "missed_periods", "rate_hz", "age_ms"}
    assert record.keys() == {"service", "pid", "program", "kind", "wall", "cpu", "age", "lateness"} | counts
    assert driver["statistics"]["wall"]["count"] == 8
    assert driver["statistics"]["wall"]["worst_ns"] >= driver["statistics"]["wall"]["mean_ns"] > 0
    assert sum(driver["statistics"]["age"]["counts"]) == 8
    assert driver["statistics"]["lateness"]["p99_ns"] is None  # it is not periodic
    assert (driver["state"], driver["driver_type"], driver["dtype"]) == ("live", "fake", "uint8")
    assert (driver["paused"], driver["missed_periods"]) == (False, 0)
    first, second = driver["patch_list"]
    for times in (first.pop("interval"), first.pop("age")):
        assert times == {"p50_ns": None, "p99_ns": None, "counts": [0] * 32}  # this driver does not tell
    assert first.pop("age_ms") >= 0
    assert first == {
        "name": "board 7",
        "bus": "can0",
        "state": "live",
        "modules": 4,
        "sensors": 48,
        "fresh": 41,
        "untouched": 0,
        "orphans": 3,
        "updates": 640,
    }
    assert (second["bus"], second["state"], second["fresh"]) == ("can1", "stale", 0)


def test_why_a_bus_is_so_and_since_when(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    down_ns = now_ns()
    monkeypatch.setattr("skinware.cli._report.now_ns", lambda: down_ns + 12_340_000_000)
    with FakeSkin("torso", fake_structure(2, 4, buses=2)) as skin:
        skin.bus_state[:] = BusState.DOWN, BusState.LIVE
        skin.bus_reason[:] = BusReason.BUS_OFF, 99  # 99: of a later version
        skin.bus_since_ns[:] = down_ns, 0
        skin.publish()
        first, second = told(capsys)["drivers"][0]["buses"]
        out = text(capsys)
    assert (first["state"], first["reason"], second["reason"], second["state_age_s"]) == ("down", "bus_off", "99", None)
    assert first["state_age_s"] == 12.34
    assert re.search(r"^  bus   state  reason +for  frames", out, re.MULTILINE)
    assert re.search(r"^  can0  down   bus-off  12\.3 s ", out, re.MULTILINE)
    assert re.search(r"^  can1  live   99 +-  ", out, re.MULTILINE)


def test_frames_that_were_not_used_are_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("torso", fake_structure(2, 4, buses=2)) as skin:
        skin.publish()
        assert told(capsys)["drivers"][0]["buses"][0]["samples"] == []
        assert "not used" not in text(capsys)
        skin.bus_samples[1][0] = (0x98DA00F1, 8, Unused.UNKNOWN, 0, range(1, 9))
        skin.bus_samples[1][3] = (0x12, 64, Unused.BAD_LENGTH, 0, range(8))
        skin.bus_samples[1][6] = (0x12, 64, 77, 0, range(8))  # of a later version
        skin.publish()
        none, some = told(capsys)["drivers"][0]["buses"]
        out = text(capsys)
    assert none["samples"] == []
    assert some["samples"] == [
        {"why": "unknown", "identifier": 0x18DA00F1, "extended": True, "length": 8, "data": "0102030405060708"},
        {"why": "bad_length", "identifier": 0x12, "extended": False, "length": 64, "data": "0001020304050607"},
    ]
    assert re.search(r"^  can1  unknown +18DA00F1 \[8\] 01 02 03 04 05 06 07 08$", out, re.MULTILINE)
    assert re.search(r"^  can1  bad length +012 \[64\] 00 01 02 03 04 05 06 07 \.\.\.$", out, re.MULTILINE)


def test_how_much_of_a_bus_is_in_use_or_why_that_is_not_known(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("torso", fake_structure(3, 4, buses=3)) as skin:
        skin.bus_load[:] = 873, LOAD_FILTERED, LOAD_UNKNOWN
        skin.publish()
        buses = told(capsys)["drivers"][0]["buses"]
        out = text(capsys)
    assert [bus["load"] for bus in buses] == [0.873, None, None]
    assert [bus["load_unknown"] for bus in buses] == [None, "filter", "bit_rate"]
    assert re.search(r"^  bus   state +load +frames", out, re.MULTILINE)
    assert re.search(r"^  can0  live +87 % ", out, re.MULTILINE)
    assert re.search(r"^  can1  live +unknown \(filter\) ", out, re.MULTILINE)
    assert re.search(r"^  can2  live +-  ", out, re.MULTILINE)


def test_how_regular_patches_are_is_shown_where_it_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("torso", fake_structure(2, 4)) as skin:
        skin.interval_counts[0, 25] = skin.age_counts[:, 21] = 100  # 16.8 to 33.6 ms; 1.05 to 2.1 ms
        skin.publish()
        first, second = told(capsys)["drivers"][0]["patch_list"]
        out = text(capsys)
    assert (first["interval"]["p99_ns"], first["age"]["p50_ns"]) == (2**25 - 1, 2**21 - 1)
    assert second["interval"]["p99_ns"] is None
    assert first["interval"]["counts"][25] == 100
    assert re.search(r"age  interval 99 %  delay 99 %.*(?s:.*)\n  99 %: 99th percentile", out)
    assert re.search(r"board 7 .*ms +34 ms +2.1 ms", out)
    assert re.search(r"board 8 .*ms +- +2.1 ms", out)


@pytest.mark.parametrize(
    ("own", "of_buses", "path", "line"),
    [
        (DataPath.NATIVE, [DataPath.NATIVE, DataPath.NATIVE], "native", ""),
        (DataPath.NATIVE, [DataPath.PYTHON, DataPath.PYTHON], "python", "Python receives the frames of can0, can1"),
        (
            DataPath.NATIVE,
            [DataPath.NATIVE, DataPath.PYTHON],
            "mixed",
            "Python receives the frames of can1",
        ),
        (DataPath.NATIVE, [DataPath.NOT_TOLD, DataPath.NOT_TOLD], "native", ""),  # of an older version
        (DataPath.NOT_TOLD, [DataPath.NOT_TOLD, DataPath.NOT_TOLD], "not_told", ""),
    ],
)
def test_buses_that_python_reads_are_shown(
    own: DataPath, of_buses: list[DataPath], path: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with FakeSkin("torso", fake_structure(2, 1, buses=2)) as skin:
        skin.data_path, skin.bus_data_path[:] = own, of_buses
        skin.publish()
        (driver,) = told(capsys)["drivers"]
        out = text(capsys)
    assert (driver["data_path"], [bus["data_path"] for bus in driver["buses"]]) == (
        path,
        [way.name.lower() for way in of_buses],
    )
    assert [text.strip() for text in out.splitlines() if "Python receives" in text] == [line] * bool(line)


def test_nothing_runs(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    empty = {"namespace": namespace.name, "drivers": [], "services": [], "problems": []}
    assert told(capsys) == empty
    out = text(capsys)
    assert "0 drivers, 0 services" in out
    assert "Nothing runs here yet" in out
    assert "skin-driver --bus virtual" in out


def test_the_rate_is_that_of_the_frames_in_the_ring(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", slots=8) as skin, DriverReader("a", announce=False) as reader:
        assert told(capsys)["drivers"][0]["rate_hz"] == 0.0
        skin.publish()
        assert told(capsys)["drivers"][0]["rate_hz"] is None  # one frame makes no rate
        frames = reader.in_order()
        first = next(frames)
        skin.publish(6)
        *_, last = islice(frames, 6)
        rate_hz = 6 * 1e9 / (last.published_ns - first.published_ns)
        assert told(capsys)["drivers"][0]["rate_hz"] == pytest.approx(rate_hz, abs=0.001)


def test_a_driver_that_has_published_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 1)):
        (driver,) = told(capsys)["drivers"]
        assert (driver["state"], driver["alive"], driver["sequence"], driver["age_ms"]) == ("starting", True, 0, None)
        assert driver["buses"] == [{"name": "can0", "state": None}]
        (patch,) = driver["patch_list"]
        assert (patch["state"], patch["age_ms"], patch["sensors"], patch["fresh"]) == (None, None, 12, 0)
        assert "driver a: starting, nothing published yet" in text(capsys)


@pytest.mark.thorough
def test_a_dead_driver_stays_to_be_seen(capsys: pytest.CaptureFixture[str]) -> None:
    with fake_process("a", "--patches", "1", "--modules", "2") as process:
        kill(process)
        (driver,) = told(capsys)["drivers"]
        assert (driver["alive"], driver["state"], driver["rate_hz"]) == (False, "dead", 0.0)
        assert driver["pid"] == process.pid
        assert driver["patch_list"][0]["fresh"] == 0
        out = text(capsys)
        assert "driver a: dead, its last data is " in out
        assert re.search(r"board 7 +can0 +was live +0 of 24", out)


def test_a_stopped_driver_is_silent(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    with FakeSkin("a") as skin:
        skin.publish(3)
        monkeypatch.setattr(health, "now_ns", lambda: now_ns() + 10**16)
        (driver,) = told(capsys)["drivers"]
        assert (driver["alive"], driver["state"], driver["rate_hz"]) == (True, "silent", 0.0)
        assert "driver a: silent, its process runs but publishes nothing" in text(capsys)


def test_other_services_are_shown_beside_drivers(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"), ServiceWriter("contacts", {"force": ("f4", 3)}) as contacts:
        contacts.begin()
        contacts.commit(0)
        report = told(capsys)
        (service,) = report["services"]
        assert [driver["name"] for driver in report["drivers"]] == ["a"]
        assert (service["name"], service["alive"], service["sequence"], service["kind"]) == (
            "contacts",
            True,
            1,
            "data",
        )
        assert service["age_ms"] > 0
        assert service["readers"] == []
        assert "service contacts: live" in text(capsys)


def test_a_service_says_what_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    pose = np.dtype([("position", "<f8", (3,)), ("valid", "u1")])
    columns: Columns = {"force": Column(np.dtype("f4"), (2, 3), unit="N"), "pose": (pose, 1)}
    with ServiceWriter("arm", columns, description="forces at the arm's two ends"):
        (service,) = told(capsys)["services"]
        assert service["description"] == "forces at the arm's two ends"
        assert service["columns"] == [
            {"name": "force", "dtype": "<f4", "shape": [2, 3], "unit": "N", "description": ""},
            {
                "name": "pose",
                "dtype": [["position", "<f8", [3]], ["valid", "|u1"]],
                "shape": [1],
                "unit": "",
                "description": "",
            },
        ]
        lines = text(capsys).splitlines()
        assert "  forces at the arm's two ends" in lines
        assert "  force   float32                            2x3    N" in lines
        assert "  pose    {position: float64, valid: uint8}  1" in lines


def test_a_name_narrows_it_down(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"), FakeSkin("b"), ServiceWriter("contacts", {"force": ("f4", 3)}):
        assert [driver["name"] for driver in told(capsys, "b")["drivers"]] == ["b"]
        report = told(capsys, "contacts")
        assert report["drivers"] == []
        assert [service["name"] for service in report["services"]] == ["contacts"]


def test_refused_files_are_problems_and_no_crash(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"):
        strange = [namespace.ring_path("broken"), namespace.ring_path("not a name"), namespace.ring_path("pipe")]
        strange[0].write_bytes(b"no ring at all")
        strange[1].write_bytes(b"")
        os.mkfifo(strange[2])
        try:
            report = told(capsys)
            assert [driver["name"] for driver in report["drivers"]] == ["a"]
            assert len(report["problems"]) == 3
            assert all(any(str(path) in problem for problem in report["problems"]) for path in strange)
            assert text(capsys).count("problem: ") == 3
            assert told(capsys, "broken")["problems"] == [report["problems"][0]]
        finally:
            for path in strange:
                path.unlink()


def test_announcements_that_are_too_many_are_told(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"):
        for number in range(2 * MOST_ANNOUNCEMENTS + 1):
            (namespace.readers_path / f"x.{number}.fake").touch()
        assert told(capsys)["problems"] == []  # those of the dead are removed
        junk = [namespace.readers_path / f"x.{number}.folder" for number in range(MOST_ANNOUNCEMENTS + 1)]
        for folder in junk:
            folder.mkdir()
        (problem,) = told(capsys)["problems"]
        assert problem.startswith(f"{namespace.readers_path}: more than 1000 files; ")
        for folder in junk:
            folder.rmdir()


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["nobody"], 1, "no service 'nobody'"),
        (["a/b"], 2, "service name 'a/b'"),
        (["walk.mcap"], 2, "walk.mcap is a recording, and runs nowhere: skin-view walk.mcap shows it"),
        (["--namespace", "a b"], 2, "namespace name 'a b'"),
        (["--sensors"], 2, "give its NAME"),
        (["nobody", "--sensors"], 1, "no service 'nobody'"),
        (["one", "two"], 2, "unexpected extra argument"),
    ],
)
def test_mistakes(arguments: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command, arguments) == status
    assert words in capsys.readouterr().err


def test_a_namespace_that_others_can_write_is_refused(namespace: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a"):
        namespace.path.chmod(0o777)
        assert exit_status(command, []) == 1
        assert "can be written by others" in capsys.readouterr().err
        namespace.path.chmod(0o2750)


def test_sensors_in_the_order_of_the_frame(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(2, 1)):
        rows = told(capsys, "a", "--sensors")
        assert len(rows) == 24
        assert rows[0] == {"name": "board 7, taxel 0", "uid": 1000, "type": "pressure", "module": 0, "patch": 0}
        last = {"name": "board 8, temperature 11", "uid": 1023, "type": "temperature", "module": 1, "patch": 1}
        assert rows[23] == last
        lines = text(capsys, "a", "--sensors").splitlines()
        assert lines[0].split() == ["position", "name", "type", "uid"]
        assert lines[24].split() == ["23", "board", "8,", "temperature", "11", "temperature", "0x3ff"]


def test_the_namespace_option(capsys: pytest.CaptureFixture[str], namespace: Namespace) -> None:
    with FakeSkin("a"):
        assert told(capsys, "--namespace", namespace.name)["drivers"]
        assert told(capsys, "--namespace", f"{namespace.name}x") == {
            "namespace": f"{namespace.name}x",
            "drivers": [],
            "services": [],
            "problems": [],
        }


def test_people_see_aligned_tables_with_units(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("torso", fake_structure(2, 4, buses=2), slots=8) as skin, DriverReader("torso") as reader:
        skin.break_some()
        skin.publish(8)
        reader.read()
        out = text(capsys)
    lines = out.splitlines()
    assert re.fullmatch(r"namespace \S+: 1 driver, 0 services", lines[0])
    assert re.fullmatch(r"driver torso: live, [\d.]+ Hz, newest data [\d.]+ ms old, sample 8, pid \d+", lines[2])
    assert lines[3:5] == [
        "  fake driver: 2 patches, 8 modules, 96 sensors (uint8)",
        "  sensors: 80 pressure in counts, 16 temperature in degC",
    ]
    assert lines[6:9] == [
        "  bus   state  frames  dropped  unknown",  # no errors: not shown
        "  can0  live    5,156        2        7",
        "  can1  live        0        0        0",
    ]
    assert lines[10].split() == ["patch", "bus", "state", "fresh", "sensors", "age", "orphans", "updates"]
    assert re.fullmatch(r"  board 7  can0  live +41 of 48 +[\d.]+ ms +3 +640", lines[11])
    assert re.fullmatch(r"  board 8  can1  stale +0 of 48 +[\d.]+ ms +0 +0", lines[12])
    figure = r"[\d.]+ [mu]s"
    takes = rf"  a sample takes {figure} to fill \(worst {figure}\); with all else {figure} of processor time"
    assert re.fullmatch(takes, lines[14])
    assert re.fullmatch(r"  99 % of its samples are published at most [\d.]+ [a-z]+ after their newest data", lines[15])
    assert lines[16].split()[:3] == ["reader", "how", "pid"]
    assert "on demand" in lines[17]
    assert max(map(len, lines)) <= 100
    assert "\x1b" not in out  # no colours without a terminal


def test_colours_are_there_for_terminals_only(namespace: Namespace) -> None:
    report = {"namespace": "x", "drivers": [], "services": [], "problems": ["refused"]}
    assert "\x1b[31mproblem: \x1b[0mrefused" in map(shown, as_text(report))


@pytest.mark.thorough
def test_watch_prints_blocks_without_a_terminal_until_interrupted() -> None:
    with FakeSkin("a", fake_structure(1, 1)) as skin:
        skin.publish()
        for arguments, wanted in (["--watch"], "driver a: "), (["--watch", "--json"], '"drivers":[{"name":"a"'):
            watch = subprocess.Popen([BIN / "skin-info", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
            assert watch.stdout is not None
            seen = 0
            for line in watch.stdout:
                seen += wanted in line.decode()
                if seen == 2:
                    break
            watch.send_signal(signal.SIGINT)
            _, errors = watch.communicate(timeout=PATIENCE_S)
            assert (watch.returncode, errors) == (0, b"")


@pytest.mark.thorough
def test_watch_redraws_a_terminal_and_waits_for_who_is_not_there_yet() -> None:
    ours, theirs = pty.openpty()
    watch = subprocess.Popen([BIN / "skin-info", "late", "--watch"], stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    try:
        screen = read_until(ours, b"no service 'late'")
        assert screen.startswith(b"\x1b[H")
        with FakeSkin("late") as skin:
            skin.publish()
            assert b"\x1b[K" in read_until(ours, b"driver \x1b[1mlate")
    finally:
        watch.terminate()
        assert watch.wait(PATIENCE_S) == 0
        os.close(ours)


def read_until(descriptor: int, wanted: bytes) -> bytes:
    """What a terminal shows until something wanted is there (pytest's timeout ends a wait in vain)."""
    seen = b""
    while wanted not in seen:
        seen += os.read(descriptor, 65536)
    return seen
