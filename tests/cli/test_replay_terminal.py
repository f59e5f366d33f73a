"""skin-replay in a terminal: its keys, its line, and what it leaves of the terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import termios
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import skinware.recording
from skinware import Namespace, Sample, ServiceReader
from skinware.cli.replay import clock
from skinware.errors import ServiceError
from skinware_drivers.testing.waiting import wait_until
from tests.commands import BIN, PATIENCE_S
from tests.recording.rig import two_drivers_and_a_service

FOREGROUND = 'skin-replay "$0" --loop --speed 0.5'


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A second of two drivers and a service."""
    path = tmp_path / "walk.mcap"
    two_drivers_and_a_service(path)
    return path


class Screen:
    """A terminal with a shell that runs a command in it, and what the command wrote."""

    def __init__(self, command: str, file: Path) -> None:
        self.ours, theirs = os.openpty()
        self.before = termios.tcgetattr(theirs)
        self.shell = subprocess.Popen(
            ["setsid", "--ctty", "bash", "-c", command, file],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", "COLUMNS": "80"},
        )
        self.theirs = theirs  # kept, so that its settings can be looked at in the end
        self._written = bytearray()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    @property
    def text(self) -> str:
        return self._written.decode()

    @property
    def last_line(self) -> str:
        return self.text.rpartition("\r")[2].partition("\x1b[K")[0]

    def press(self, keys: str) -> None:
        os.write(self.ours, keys.encode())

    def close(self) -> None:
        if self.shell.poll() is None:
            self.shell.send_signal(signal.SIGHUP)
        self.shell.wait(PATIENCE_S)
        os.close(self.theirs)
        self._thread.join()
        os.close(self.ours)

    def _read(self) -> None:
        try:
            while data := os.read(self.ours, 4096):
                self._written += data
        except OSError:
            pass  # nobody has it open any more


@contextmanager
def in_terminal(command: str, file: Path) -> Iterator[Screen]:
    screen = Screen(command, file)
    try:
        yield screen
    finally:
        screen.close()


def told() -> dict[str, Any]:
    """What a replay tells programs; nothing while there is none."""
    try:
        with ServiceReader[Sample]("torso", announce=False) as reader:
            found: dict[str, Any] = reader.call("replay", timeout_s=10)
            return found
    except ServiceError:
        return {}


def times_of_first_frames(file: Path) -> list[float]:
    with skinware.recording.open(file) as recording:
        timeline = recording.timeline()
        return [moment.time_s for _ in range(3) if (moment := timeline.next())]


@pytest.mark.thorough
def test_keys_do_what_the_first_line_says(file: Path, namespace: Namespace) -> None:
    times_s = times_of_first_frames(file)
    with in_terminal(f"exec {FOREGROUND}", file) as screen:
        wait_until(lambda: "q: end" in screen.text and bool(told()))
        assert told()["loop"]
        screen.press(" ")
        wait_until(lambda: told()["paused"])
        wait_until(lambda: "  paused  loop" in screen.last_line)
        screen.press("0..")
        wait_until(lambda: told()["time_s"] in times_s[1:])  # the first may be at 0, where the key 0 shows it
        at_s = told()["time_s"]
        screen.press(".")
        wait_until(lambda: told()["time_s"] > at_s)
        screen.press(",,x\x1b")  # and keys that mean nothing
        wait_until(lambda: told()["time_s"] < at_s)
        screen.press("++l")
        wait_until(lambda: told()["speed"] == 2 and not told()["loop"])
        wait_until(lambda: "x2  paused" in screen.last_line)
        screen.press("-1-")
        wait_until(lambda: told()["speed"] == 0.5)
        screen.press("\x1b[C")
        wait_until(lambda: told()["time_s"] == told()["duration_s"])
        screen.press("\x1bOD")  # as some terminals have it
        wait_until(lambda: told()["time_s"] == 0)
        screen.press("\x1b[A\x1b[B ")
        wait_until(lambda: not told().get("paused", False))
        screen.press("q")
        assert screen.shell.wait(PATIENCE_S) == 0
        assert termios.tcgetattr(screen.theirs) == screen.before
        assert screen.text.splitlines()[-1].endswith("late") or "frames published" in screen.text.splitlines()[-1]
    assert namespace.services() == []


@pytest.mark.thorough
def test_ctrl_c_ends_it_and_the_terminal_is_as_it_was(file: Path, namespace: Namespace) -> None:
    with in_terminal(f"exec {FOREGROUND}", file) as screen:
        wait_until(lambda: "x0.5" in screen.text)
        screen.press("\x03")
        assert screen.shell.wait(PATIENCE_S) == 0
        assert termios.tcgetattr(screen.theirs) == screen.before
    assert namespace.services() == []


@pytest.mark.thorough
def test_in_the_background_of_a_terminal_it_goes_on_without_keys(file: Path) -> None:
    with in_terminal(f"set -m; {FOREGROUND} & trap 'kill $!' EXIT; wait", file) as screen:
        wait_until(lambda: told().get("time_s", 0) > 0)
        screen.press(" ")
        before = told()["time_s"]
        wait_until(lambda: told()["time_s"] != before)
        assert not told()["paused"]
        assert "space:" not in screen.text
        with ServiceReader[Sample]("torso", announce=False) as reader:
            os.kill(reader.writer_pid, signal.SIGTERM)
        screen.shell.wait(PATIENCE_S)


@pytest.mark.parametrize(
    ("time_s", "text"),
    [(0, "0:00.0"), (59.96, "1:00.0"), (62.34, "1:02.3"), (3599.99, "1:00:00.0"), (7384, "2:03:04.0")],
)
def test_times_as_people_write_them(time_s: float, text: str) -> None:
    assert clock(time_s) == text
