from __future__ import annotations

import errno
import json
import queue
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

import click
import pytest

from skinware.cli._command import examples, exit_status, seconds, signals_end, warn
from skinware.cli._terminal import print_json
from skinware.errors import BadServiceFile, BusNotAvailable, BusSendError, ConfigurationError, ServiceNotFound
from tests.commands import PATIENCE_S


def command_that(raises: BaseException | None = None) -> click.Command:
    @click.command("skin-try", epilog=examples("skin-try      one", "skin-try -x   two"))
    @click.option("-T", "timeout_s", type=seconds)
    def command(timeout_s: float | None) -> None:
        click.echo(f"timeout {timeout_s}")
        if raises is not None:
            raise raises

    return command


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (None, 0),
        (KeyboardInterrupt(), 0),
        (click.exceptions.Exit(7), 7),
        (ServiceNotFound("no such skin"), 1),
        (BadServiceFile("no such skin"), 1),
        (BusSendError("no such skin"), 1),
        (ConfigurationError("no such skin"), 2),
        (click.UsageError("no such skin"), 2),
        (BusNotAvailable("no such skin"), 1),
        (OSError(errno.ENOSPC, "no such skin"), 1),
        (BrokenPipeError(errno.EPIPE, "nobody reads"), 0),
    ],
)
def test_every_end_has_its_exit_status(
    error: BaseException | None, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_status(command_that(error), []) == status
    printed = capsys.readouterr()
    assert printed.out == "timeout None\n"
    assert ("no such skin" in printed.err) == (status not in (0, 7))
    assert "Traceback" not in printed.err


def test_an_error_is_one_line_under_the_name_of_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    exit_status(command_that(ServiceNotFound("no such skin")), [])
    assert capsys.readouterr().err == "skin-try: no such skin\n"


@pytest.mark.parametrize(("value", "color"), [(None, None), ("", None), ("1", False)])
def test_no_color_takes_the_colours_away(
    value: str | None, color: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    if value is not None:
        monkeypatch.setenv("NO_COLOR", value)
    seen: list[bool | None] = []
    command = click.Command("skin-try", callback=lambda: seen.append(click.get_current_context().color))
    assert exit_status(command, []) == 0
    assert seen == [color]


def test_an_error_that_nobody_expects_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError):
        exit_status(command_that(ZeroDivisionError()), [])


@pytest.mark.parametrize("text", ["nan", "inf", "-1", "soon", "1e300", ""])
def test_a_time_must_be_a_time(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command_that(), ["-T", text]) == 2
    assert "is not a number of seconds" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "number"), [("0", 0.0), ("2", 2.0), ("0.5", 0.5), ("1e3", 1000.0)])
def test_times_are_understood(text: str, number: float, capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command_that(), ["-T", text]) == 0
    assert capsys.readouterr().out == f"timeout {number}\n"


def test_examples_keep_their_lines(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_status(command_that(), ["--help"]) == 0
    assert "    skin-try      one\n    skin-try -x   two\n" in capsys.readouterr().out


def test_json_is_one_line_that_every_program_can_read(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"values": [1.5, float("nan"), float("inf")], "uid": 2**64 - 1, "name": "Füße"})
    line = capsys.readouterr().out
    assert line.count("\n") == 1
    assert json.loads(line, parse_constant=pytest.fail) == {
        "values": [1.5, None, None],
        "uid": 2**64 - 1,
        "name": "Füße",
    }


def test_warnings_name_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/bin/skin-try"])
    with click.Context(command_that(), info_name="skin-try"), ThreadPoolExecutor() as pool:
        warn("it came back")
        pool.submit(warn, "in a thread").result()
    assert capsys.readouterr() == ("", "skin-try: it came back\nskin-try: in a thread\n")


def test_a_signal_that_interrupts_the_holder_of_a_lock_ends_the_command() -> None:
    lock, taken = threading.Lock(), queue.SimpleQueue[bool]()

    def stop() -> None:  # as that of an Event, which the main thread may be about to wait for
        taken.put(lock.acquire(timeout=1))

    with signals_end(stop):
        with lock:
            signal.raise_signal(signal.SIGTERM)
        assert taken.get(timeout=PATIENCE_S)
