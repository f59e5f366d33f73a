"""Follows a page of the documentation as a reader would: what it says to run is run, what it says to write is written.

Blocks, in the order of the page:

* ``console``: run by bash, in the folder where the block before left off. It must succeed.
* ``text`` behind it: what it printed; ``...`` stands for anything, and lines may be left out.
* ``diff``: an edit. The lines without ``+`` must be in the file as they are shown, and once.
* ``python``, ``toml`` ...: what a file holds, or a part of it.

A comment in front of a block, which readers do not see, says what the page says in words:

* ``<!-- terminal -->``: the commands run in a terminal of their own, until the next ``<!-- close terminals -->``;
  ``<!-- terminal, once there is FILE -->``: what the reader started before takes a moment to make it.
* ``<!-- fails -->``: the commands must fail.
* ``<!-- edit: FILE -->``, ``<!-- write: FILE -->``, ``<!-- part of: FILE -->``: for the kinds above.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from skinware_drivers.testing.waiting import wait_until

PATIENCE_S = 300.0
_CLOSE = "<!-- close terminals -->"
_STEP = re.compile(
    r"^(?:<!-- (?P<how>terminal(?:, once there is \S+)?|fails|(?:edit|write|part of): \S+) -->\n)?"
    rf"```(?P<kind>\w+)\n(?P<text>.*?)^```$|^{_CLOSE}$",
    re.MULTILINE | re.DOTALL,
)


class Step(NamedTuple):
    """A block of a page."""

    line: int
    kind: str
    """As written, or ``close``."""
    how: str
    text: str


def steps(page: str) -> Iterator[Step]:
    """The blocks of a page, in order."""
    for match in _STEP.finditer(page):
        line = page.count("\n", 0, match.start()) + 1
        yield Step(line, match["kind"] or "close", match["how"] or "", match["text"] or "")


class Walkthrough:
    """Somebody who follows a page.

    Args:
        home: folder to begin in.
        environ: environment of the commands.
    """

    def __init__(self, home: Path, environ: Mapping[str, str]) -> None:
        self._folder = home
        self._environ = dict(environ)
        self._terminals: list[tuple[Step, subprocess.Popen[str]]] = []
        self._told = ""

    def follow(self, page: str) -> int:
        """Do everything that a page says; gives the number of steps."""
        count = 0
        try:
            for step in steps(page):
                self._do(step)
                count += 1
        finally:
            self._close_terminals()
        return count

    def _do(self, step: Step) -> None:
        if step.kind == "close":
            self._close_terminals()
        elif step.kind == "console" and step.how.startswith("terminal"):
            _, _, needed = step.how.partition(", once there is ")
            wait_until((self._folder / needed).exists)
            self._terminals.append((step, self._start(step.text)))
        elif step.kind == "console":
            self._run(step)
        elif step.kind == "text":
            self._compare(step)
        elif step.kind == "diff":
            self._edit(step)
        else:
            verb, _, name = step.how.partition(": ")
            assert verb in ("write", "part of"), f"line {step.line}: what is to be done with this block?"
            if verb == "write":
                (self._folder / name).write_text(step.text)
            else:
                assert step.text in (self._folder / name).read_text(), f"line {step.line}: not in {name}"

    def _start(self, script: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["bash", "-ec", script],
            cwd=self._folder,
            env=self._environ,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def _run(self, step: Step) -> None:
        with tempfile.NamedTemporaryFile("r") as left_in:
            process = self._start(f"trap 'pwd > {left_in.name}' EXIT\n{step.text}")
            try:
                self._told, _ = process.communicate(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                raise
            assert (process.returncode != 0) == (step.how == "fails"), (
                f"line {step.line}: status {process.returncode}\n{step.text}\n{self._told}"
            )
            self._folder = Path(left_in.read().strip())

    def _compare(self, step: Step) -> None:
        rest = self._told
        for number, shown in enumerate(step.text.splitlines(), step.line + 1):
            pattern = ".*".join(re.escape(part.strip()) for part in re.split(r"\.\.\.", shown))
            match = re.search(pattern.replace(r"\ ", r"\s+"), rest)
            assert match, f"line {number}: {shown!r} was not printed, or not in this order:\n{self._told}"
            rest = rest[match.end() :]

    def _edit(self, step: Step) -> None:
        verb, _, name = step.how.partition(": ")
        assert verb == "edit", f"line {step.line}: of which file?"
        lines = step.text.splitlines(keepends=True)
        before = "".join(line[1:] or "\n" for line in lines if not line.startswith("+"))
        after = "".join(line[1:] or "\n" for line in lines if not line.startswith("-"))
        path = self._folder / name
        text = path.read_text()
        assert text.count(before) == 1, f"line {step.line}: {text.count(before)} times in {name}:\n{before}"
        path.write_text(text.replace(before, after))

    def _close_terminals(self) -> None:
        terminals, self._terminals = self._terminals, []
        failures = []
        for step, process in reversed(terminals):
            os.killpg(process.pid, signal.SIGINT)
            told, _ = process.communicate(timeout=PATIENCE_S)
            if process.returncode not in (0, -signal.SIGINT):
                failures.append(f"line {step.line}: {step.text}\n{told}")
        assert not failures, "\n".join(failures)
