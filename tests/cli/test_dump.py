from __future__ import annotations

import json
import re
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import click
import numpy as np
import pytest

from skinware import DriverReader, Namespace, ServiceWriter, Status
from skinware.cli._command import exit_status, warn
from skinware.errors import ServiceNotFound
from skinware_drivers.cli.dump import _attach, _frames, _reattach, as_line, command
from tests.cli.fake_skin import FakeSkin, fake_process, fake_structure, kill, publishing
from tests.commands import BIN, PATIENCE_S


def dumped(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[dict[str, Any]]:
    assert exit_status(command, [*arguments, "--json"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    return [json.loads(line, parse_constant=pytest.fail) for line in printed.out.splitlines()]


@pytest.fixture
def context() -> Iterator[None]:
    """As within the running command, for warnings."""
    with click.Context(command, info_name="skin-dump"):
        yield


def test_json_contract(capsys: pytest.CaptureFixture[str]) -> None:
    skin = FakeSkin("torso", fake_structure(2, 4))
    skin.status[5] = Status.STALE
    with publishing(skin):
        frames = dumped(capsys, "torso", "-n", "5")
    assert len(frames) == 5
    first = frames[0]["sequence"]
    assert [frame["sequence"] for frame in frames] == list(range(first, first + 5))
    for frame in frames:
        assert frame.keys() == {"driver", "sequence", "acquired_ns", "age_ms", "missed", "values", "status"}
        assert (frame["driver"], frame["missed"]) == ("torso", 0)
        assert len(frame["values"]) == len(frame["status"]) == 96
        assert (frame["status"][4:7], frame["age_ms"] >= 0) == ([0, int(Status.STALE), 0], True)
    times = [frame["acquired_ns"] for frame in frames]
    assert times == sorted(times)


def test_one_type_has_its_uids(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 2)) as skin:
        skin.values = np.arange(24)
        skin.publish()
        (raw,) = dumped(capsys, "-n", "1", "--type", "temperature", "--counts")
        assert raw["values"] == [10, 11, 22, 23]
        assert raw["uids"] == [1010, 1011, 1022, 1023]
        assert raw["status"] == [0] * 4
        (physical,) = dumped(capsys, "-n", "1", "--type", "temperature")
        assert physical["values"] == [5.0, 5.5, 11.0, 11.5]
        (everything,) = dumped(capsys, "-n", "1")
        assert everything["values"][:3] == [255.0, 254.0, 253.0]
        assert everything["values"][10:13] == [5.0, 5.5, 243.0]


def test_json_has_no_nan(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 1, dtype="f4")) as skin:
        skin.values = np.full(12, np.nan)
        skin.publish()
        (frame,) = dumped(capsys, "-n", "1")
        assert frame["values"] == [None] * 12


def test_people_see_a_line_per_frame(capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 1)) as skin:
        skin.values = np.arange(12)
        skin.status[9] = Status.STALE
        skin.status[10:] = Status.NEVER_SEEN
        skin.publish()
        assert exit_status(command, ["-n", "1", "--counts"]) == 0
        line = capsys.readouterr().out
        assert re.fullmatch(
            r"a #1  age [\d.]+ ms  pressure 0 to 8 raw \(mean 4\)  temperature - raw  3 not fresh\n", line
        )
        assert exit_status(command, ["-n", "1", "--type", "pressure"]) == 0
        line = capsys.readouterr().out
        assert re.fullmatch(r"a #1  age [\d.]+ ms  pressure 247 to 255 counts \(mean 251\)  1 not fresh\n", line)


def test_the_last_frame_of_a_driver_that_hangs_is_not_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    with FakeSkin("a", fake_structure(1, 1)) as skin, DriverReader("a") as reader:
        skin.publish()
        frame = reader.read()
        assert as_line(frame, "pressure", False).endswith("  0 not fresh")
        monkeypatch.setattr("skinware.driver_snapshot.now_ns", lambda: frame.acquired_ns + 10**16)
        assert as_line(frame, "pressure", False).endswith("  pressure - counts  10 not fresh")


def test_at_a_rate_only_the_newest_frame_and_each_once(capsys: pytest.CaptureFixture[str]) -> None:
    with publishing(FakeSkin("a", fake_structure(1, 1)), 400.0):
        frames = dumped(capsys, "--rate", "50", "-n", "5")
    sequences = [frame["sequence"] for frame in frames]
    assert sequences == sorted(set(sequences))
    assert frames[-1]["missed"] == sequences[-1] - sequences[0] - 4


def test_without_a_name_the_only_driver_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with ServiceWriter("contacts", {"force": ("f4", 3)}), FakeSkin("a") as skin:
        skin.publish()
        assert dumped(capsys, "-n", "1")[0]["driver"] == "a"
        with FakeSkin("b"):
            assert exit_status(command, ["-n", "1"]) == 2
            assert "has: a, b; give one as NAME" in capsys.readouterr().err


@pytest.mark.thorough
def test_without_a_name_the_living_one_is_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with fake_process("dead") as process:
        kill(process)
        with FakeSkin("living") as skin:
            skin.publish()
            assert dumped(capsys, "-n", "1")[0]["driver"] == "living"
        assert exit_status(command, ["-n", "1"]) == 0
        printed = capsys.readouterr()
        assert printed.out.startswith("dead #")
        assert "driver 'dead' is dead; this is its last snapshot" in printed.err


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        ([], 1, "no driver in namespace"),
        (["nobody"], 1, "no service 'nobody'"),
        (["nobody", "--timeout", "0.01"], 1, "no service 'nobody'"),
        (["--timeout", "0.01"], 1, "start one: skin-driver --bus virtual"),
        (["a/b"], 2, "service name 'a/b'"),
        (["-n", "0"], 2, "-n"),
        (["--rate", "0", "here"], 2, "rate of 0.0 Hz"),
        (["--rate", "nan", "here"], 2, "rate of nan Hz"),
        (["--type", "presure", "here"], 2, "There are: pressure, temperature"),
        (["contacts"], 1, "'contacts' is not a driver"),
    ],
)
def test_mistakes(arguments: list[str], status: int, words: str, capsys: pytest.CaptureFixture[str]) -> None:
    with ServiceWriter("contacts", {"force": ("f4", 3)}):
        if "here" not in arguments:
            assert exit_status(command, arguments) == status
        else:
            with FakeSkin("here") as skin:
                skin.publish()
                assert exit_status(command, arguments) == status
    printed = capsys.readouterr()
    assert printed.out == ""
    assert words in printed.err
    assert "Traceback" not in printed.err


@pytest.mark.parametrize("arguments", [["--timeout", "60"], ["late", "--timeout", "60"]])
def test_waits_for_the_driver_to_appear(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[FakeSkin] = []
    sleep = time.sleep

    def start_the_driver_meanwhile(duration_s: float) -> None:
        if not started:
            started.append(FakeSkin("late"))
            started[0].publish()
        sleep(duration_s)

    monkeypatch.setattr(time, "sleep", start_the_driver_meanwhile)
    assert dumped(capsys, *arguments, "-n", "1")[0]["driver"] == "late"
    started.pop().close()


@pytest.mark.thorough
@pytest.mark.parametrize("more", [[], ["--rate", "100"]])
def test_silence_fails_after_the_timeout(more: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a") as skin:
        skin.publish()
        assert exit_status(command, ["a", "--timeout", "0.05", *more]) == 1
        printed = capsys.readouterr()
        assert printed.out.count("\n") == 1
        assert printed.err == (
            "skin-dump: no newer sample of 'a': its writer is running, but is silent (hung, stopped or waiting)\n"
        )
    with fake_process("b") as process:
        kill(process)
        assert exit_status(command, ["b", "--timeout", "0.05", *more]) == 1
        assert "its writer is dead" in capsys.readouterr().err


@pytest.mark.parametrize("rate_hz", [None, 1000.0])
@pytest.mark.usefixtures("context")
def test_a_restarted_driver_is_followed(rate_hz: float | None, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 2)) as skin:
        skin.publish()
        reader = _attach(Namespace(), "a", None)
        frames = _frames(reader, rate_hz, 30.0)
        first = next(frames)
    with closing(reader), FakeSkin("a", fake_structure(1, 2)) as again:
        again.publish()
        second = next(frames)
        assert (second.sequence, second.generation != first.generation) == (1, True)
        assert capsys.readouterr().err == "skin-dump: driver 'a' was started again\n"


@pytest.mark.parametrize("rate_hz", [None, 1000.0])
@pytest.mark.usefixtures("context")
def test_a_driver_that_came_back_changed_is_followed(rate_hz: float | None, capsys: pytest.CaptureFixture[str]) -> None:
    with FakeSkin("a", fake_structure(1, 2)) as skin:
        skin.publish()
        reader = _attach(Namespace(), "a", None)
        frames = _frames(reader, rate_hz, 30.0)
        assert next(frames).structure.n_sensors == 24
    with closing(reader), FakeSkin("a", fake_structure(1, 3)) as again:
        again.publish()
        assert next(frames).structure.n_sensors == 36
        assert capsys.readouterr().err == ("skin-dump: driver 'a' came back with another structure: 36 sensors now\n")
        again.publish()
        assert next(frames).sequence == 2


def test_a_driver_that_changed_and_went_again_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    skin = FakeSkin("a", fake_structure(1, 2))
    skin.publish()
    with DriverReader("a") as reader:
        skin.close()
        monkeypatch.setattr("skinware_drivers.cli.dump._LOOK_EVERY_S", 0.001)
        with pytest.raises(ServiceNotFound):
            _reattach(reader, 0.01)


@pytest.mark.parametrize("limits", [(None, None), (1000.0, None), (None, 60.0)])
@pytest.mark.usefixtures("context")
def test_a_silence_is_reported_once_and_its_end_followed(
    limits: tuple[float | None, float | None], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skinware_drivers.cli.dump._SILENCE_S", 0.01)
    with FakeSkin("a", fake_structure(1, 2)) as skin, closing(_attach(Namespace(), "a", None)) as reader:
        skin.publish()
        frames = _frames(reader, *limits)
        assert next(frames).sequence == 1

        def end_it(text: str) -> None:
            warn(text)
            skin.publish()

        with monkeypatch.context() as patched:
            patched.setattr("skinware_drivers.cli.dump.cli.warn", end_it)
            for sequence in (2, 3):
                assert next(frames).sequence == sequence
                assert re.fullmatch("skin-dump: no newer sample of 'a': .* is silent .*\n", capsys.readouterr().err)


@pytest.mark.parametrize("form", ["--json", pytest.param("--counts", marks=pytest.mark.thorough)])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_it_in_good_order(form: str, number: int, namespace: Namespace) -> None:
    with publishing(FakeSkin("a", fake_structure(1, 1))):
        process = subprocess.Popen([BIN / "skin-dump", form], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(number)
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, errors) == (0, b"")
        assert list(namespace.reader_files()) == []  # it took its announcement back


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["--json", "--counts"])
def test_a_reader_of_our_output_may_go_away(form: str) -> None:
    with publishing(FakeSkin("a", fake_structure(1, 1))):
        process = subprocess.Popen([BIN / "skin-dump", form], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr.read() == b""
        process.stderr.close()


@pytest.mark.thorough
def test_a_full_disk_is_said_in_one_line() -> None:
    with publishing(FakeSkin("a", fake_structure(1, 1))), open("/dev/full", "w", encoding="ascii") as full:
        result = subprocess.run([BIN / "skin-dump"], stdout=full, stderr=subprocess.PIPE, timeout=PATIENCE_S)
    assert (result.returncode, result.stderr) == (
        1,
        b"skin-dump: its output cannot be written: No space left on device\n",
    )
