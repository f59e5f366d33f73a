"""Commands whose work goes on while nobody reads what they print."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import subprocess
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import skinware.recording
from skinware import DriverReader
from skinware.cli._terminal import PatientStream, patient_output
from skinware_drivers.testing.waiting import wait_until
from tests.commands import BIN, PATIENCE_S

_SMALLEST_PIPE = 4096


@contextmanager
def unread_pipe() -> Iterator[tuple[int, int]]:
    """(end that nobody reads, end to write)"""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, _SMALLEST_PIPE)
    try:
        yield reading, writing
    finally:
        for fd in (reading, writing):
            os.close(fd)


def fill(fd: int) -> None:
    """A pipe, to its last byte."""
    flags = fcntl.fcntl(fd, fcntl.F_GETFL)
    fcntl.fcntl(fd, fcntl.F_SETFL, flags | os.O_NONBLOCK)
    try:
        while True:
            os.write(fd, b"\n" * 512)
    except BlockingIOError:
        pass
    finally:
        fcntl.fcntl(fd, fcntl.F_SETFL, flags)


def drained(fd: int) -> bytes:
    """All that waits in a pipe."""
    os.set_blocking(fd, False)
    parts = []
    try:
        while part := os.read(fd, 1 << 16):
            parts.append(part)
    except BlockingIOError:
        pass
    return b"".join(parts)


@contextmanager
def started(*command: str, stdout: int, stderr: int | None = None) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([BIN / command[0], *command[1:]], stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr)
    try:
        yield process
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()


@pytest.mark.thorough
@pytest.mark.parametrize("errors_too", [False, True])
def test_a_driver_whose_output_nobody_reads_publishes_and_ends(namespace: object, errors_too: bool) -> None:
    with unread_pipe() as (_, writing):
        fill(writing)
        stderr = writing if errors_too else None
        with started("skin-driver", "--bus", "virtual", "--name", "arm", "--json", stdout=writing, stderr=stderr):
            with DriverReader("arm", timeout_s=PATIENCE_S) as reader:
                begin = reader.read(timeout_s=PATIENCE_S).sequence
                wait_until(lambda: reader.read().sequence >= begin + 40)  # two seconds: two lines that nobody takes


@pytest.mark.thorough
def test_a_recorder_whose_output_nobody_reads_loses_nothing(namespace: object, tmp_path: Path) -> None:
    file = tmp_path / "long.mcap"
    with unread_pipe() as (_, writing), unread_pipe() as (_, other):
        fill(writing)
        fill(other)
        with started("skin-driver", "--bus", "virtual", "--name", "arm", "--json", stdout=other):
            with DriverReader("arm", timeout_s=PATIENCE_S) as reader:
                with started("skin-record", "-o", str(file), "--json", stdout=writing):
                    wait_until(lambda: any(tmp_path.iterdir()))
                    begin = reader.read(timeout_s=PATIENCE_S).sequence
                    wait_until(lambda: reader.read().sequence >= begin + 60)
    with skinware.recording.open(file) as recording:
        sequence = recording["arm"].read().sequence
        assert len(sequence) >= 50
        assert (np.diff(sequence) == 1).all()


def test_a_terminal_that_was_stopped_holds_nothing_up() -> None:
    master, slave = pty.openpty()
    try:
        termios.tcflow(slave, termios.TCOOFF)  # what Ctrl-S does
        with os.fdopen(os.dup(slave), "w") as terminal:
            stream = PatientStream(terminal)
            for number in range(1000):
                stream.write(f"line {number}\n")
            termios.tcflow(slave, termios.TCOON)
            taken = b""
            while b"line 999\r\n" not in taken:
                stream.flush()
                taken += os.read(master, 1 << 16)
            stream.end()
        assert taken == b"".join(b"line %d\r\n" % number for number in range(1000))
    finally:
        os.close(master)
        os.close(slave)


def test_what_waits_comes_in_order_and_whole_when_it_is_read() -> None:
    with unread_pipe() as (reading, writing), os.fdopen(os.dup(writing), "w") as pipe:
        stream = PatientStream(pipe)
        lines = [f"{number} {'x' * (number % 300)}\n" for number in range(300)]
        for line in lines:
            stream.write(line)
        taken = b""
        while len(taken) < sum(map(len, lines)):
            taken += drained(reading)
            stream.flush()
        stream.end()
        assert taken.decode() == "".join(lines)
        assert stream.left_out == 0


def test_too_much_is_left_out_in_whole_lines_and_counted() -> None:
    with unread_pipe() as (reading, writing), os.fdopen(os.dup(writing), "w") as pipe:
        stream = PatientStream(pipe)
        line = "y" * 9999 + "\n"
        for _ in range(300):
            stream.write(line)
        assert stream.left_out > 100
        taken = b""
        while len(taken) < len(line) * (300 - stream.left_out):
            taken += drained(reading)
            stream.flush()
        stream.end()
        assert set(taken.decode().splitlines()) == {line.rstrip()}


def test_who_hangs_up_is_noticed() -> None:
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as pipe:
        stream = PatientStream(pipe)
        stream.write("to somebody\n")
        os.close(reading)
        with pytest.raises(BrokenPipeError):
            stream.write("to nobody\n")
        stream.end()


def test_streams_that_have_no_file_stay_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    with patient_output():
        print("as ever")
    assert capsys.readouterr().out == "as ever\n"


def test_a_terminal_that_is_gone_takes_all_lines() -> None:
    controller, terminal = pty.openpty()
    with open(terminal, "w", encoding="utf-8") as shown:
        patient = PatientStream(shown)
        os.close(controller)
        assert patient.write("a line\n") == 7
        patient.end()
