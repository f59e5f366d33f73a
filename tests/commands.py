"""Our commands as processes of their own, as a person or a script would run them."""

from __future__ import annotations

import io
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import click

from skinware.cli._command import exit_status
from skinware_drivers.cli import skin

COMMANDS = {f"skin-{name}": tool.module for name, tool in skin.COMMANDS.items()}
BIN = Path(sys.executable).parent
PATIENCE_S = 120.0
"""How long a command may take for its next line: the CAN lab's processor is emulated."""


def run(command: str, *arguments: str, timeout_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    """Run a command to its end."""
    return subprocess.run(
        [BIN / command, *arguments], capture_output=True, text=True, timeout=timeout_s, stdin=subprocess.DEVNULL
    )


def parse(command: str, *arguments: str) -> None:
    """Have a command take its arguments, also those of its subcommands, and do nothing with them.

    Raises:
        click.UsageError: it does not take them.
    """
    module = import_module(COMMANDS[command])
    with suppress(click.exceptions.Exit):  # --help and the like
        _parse(vars(module).get("command") or module.emulate, command, list(arguments), None)


def _parse(command: click.Command, name: str | None, arguments: list[str], parent: click.Context | None) -> None:
    with command.make_context(name, arguments, parent=parent) as context:
        if isinstance(command, click.Group):
            name, subcommand, rest = command.resolve_command(context, [*context._protected_args, *context.args])
            if subcommand is not None:
                _parse(subcommand, name, rest, context)


def refused(command: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command that is to refuse its arguments, in this process: a new one costs a hundred times as much.

    Its exit status and output are those of ``run``. An exception that it does not expect is raised here.
    """
    out, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(errors):
        status = exit_status(import_module(COMMANDS[command]).command, arguments)
    return subprocess.CompletedProcess([command, *arguments], status, out.getvalue(), errors.getvalue())


class Running:
    """A command that runs, with its JSON lines."""

    def __init__(self, command: str, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [BIN / command, *arguments, "--json"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._events: queue.Queue[dict[str, Any]] = queue.Queue()
        self._errors: list[str] = []
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self._threads = [
            threading.Thread(target=self._read_events, args=(self.process.stdout,)),
            threading.Thread(target=self._read_errors, args=(self.process.stderr,)),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def errors(self) -> str:
        """What it has written to stderr so far."""
        return "".join(self._errors)

    def wait_for(self, event: str, condition: Callable[[dict[str, Any]], bool] = lambda _found: True) -> dict[str, Any]:
        """The next event of a kind that fulfils a condition."""
        others, end = 0, time.monotonic() + PATIENCE_S
        while (left_s := end - time.monotonic()) > 0:
            try:
                found = self._events.get(timeout=left_s)
            except queue.Empty:
                break
            if found["event"] == event and condition(found):
                return found
            others += 1
        raise AssertionError(f"no event {event!r} as {condition} wants it, of {others}; stderr: {self.errors}")

    def stop(self, number: int = signal.SIGINT) -> dict[str, Any]:
        """Interrupt it; its last event, if it had the time to say one."""
        if self.process.poll() is None:
            os.kill(self.process.pid, number)
        self.process.wait(PATIENCE_S)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        last: dict[str, Any] = {}
        while not self._events.empty():
            last = self._events.get()
        return last

    def _read_events(self, stream: IO[str]) -> None:
        for line in stream:
            if line.endswith("\n"):  # one that was killed may leave half a line
                self._events.put(json.loads(line))

    def _read_errors(self, stream: IO[str]) -> None:
        self._errors.extend(stream)


def children_of(pid: int) -> set[int]:
    """Processes that a process has started, and theirs."""
    found: set[int] = set()
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in map(int, task.read_text().split()):
            found |= {child, *children_of(child)}
    return found


def is_there(pid: int) -> bool:
    with suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


@contextmanager
def running(command: str, *arguments: str) -> Iterator[Running]:
    """A command that is interrupted at the end, whatever happens."""
    started = Running(command, *arguments)
    try:
        yield started
    finally:
        if started.process.returncode is None:
            started.stop()
