"""Programs of skinware.h that tests talk with, and the drivers that they read."""

from __future__ import annotations

import json
import select
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from skinware import DriverWriter, Namespace, Structure
from skinware.sensor_types import PRESSURE, TEMPERATURE, SensorType
from skinware_drivers.testing.waiting import wait_until
from tests.core.workers import PROCESSES, running

SOURCE = Path(__file__).with_name("c_reader.c")
STRAIN = 77 << 12 | 5
Event = dict[str, Any]


def structure(n_modules: int = 6, dtype: str = "<u2") -> Structure:
    """Per module: three pressure sensors, one temperature sensor and one of a type of our own, in this order."""
    types = (
        PRESSURE.measured(scale=0.5, offset=-3.0, minimum=0, maximum=32767.5),
        TEMPERATURE.measured(scale=0.01),
        SensorType("strain", STRAIN, "µm/m", scale=2.0),
    )
    ids = [types[0].id] * 3 + [types[1].id, types[2].id]
    return Structure(
        types=types,
        buses=["can0", "can1"],
        patch_name=["left", "right"],
        patch_bus=[0, 1],
        module_patch=np.arange(n_modules) % 2,
        module_kind=["triangle"] * n_modules,
        sensor_uid=np.arange(5 * n_modules) + (1 << 40),
        sensor_type=ids * n_modules,
        sensor_module=np.repeat(np.arange(n_modules), 5),
        dtype=dtype,
    )


def fill(writer: DriverWriter, number: int) -> None:
    """Publish a frame whose every element is ``number``, cut to the element's size."""
    for column in writer.begin().values():
        column[...] = np.array(number, "u8").astype(column.dtype)
    assert writer.commit(number) == number


def write_flat_out(slots: int, n_modules: int, stop: Any) -> None:
    with DriverWriter("x", structure(n_modules), slots=slots) as writer:
        while not stop.is_set():
            for _ in range(100):
                fill(writer, writer.sequence + 1)


def write_until_killed(n_modules: int, value: int, published: Any) -> None:
    writer = DriverWriter("x", structure(n_modules))
    writer.begin()["values"][:] = value
    writer.commit(1)
    writer.begin()["values"][:] = 9  # killed in the middle of filling
    published.set()
    while True:
        time.sleep(1)


@contextmanager
def lone_writer(n_modules: int = 6, value: int = 5) -> Iterator[Any]:
    """A driver in a process of its own that has published one frame and is filling the next."""
    published = PROCESSES.Event()
    with running(write_until_killed, n_modules, value, published) as process:
        assert published.wait(60)
        yield process


class Talk:
    """A running C program that prints one JSON object per line."""

    def __init__(self, words: Sequence[str]) -> None:
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def tell(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def end_input(self) -> None:
        """Ask it to leave."""
        assert self.process.stdin is not None
        self.process.stdin.close()

    def wait(self) -> int:
        """Its exit status; signals get it out of long waits until it leaves."""
        for _ in range(1200):
            try:
                return self.process.wait(0.05)
            except subprocess.TimeoutExpired:
                self.process.send_signal(signal.SIGUSR1)
        raise AssertionError("it did not leave within a minute")

    def interrupt(self) -> Event:
        """Signals until it says something: one that comes before it waits interrupts nothing."""
        assert self.process.stdout is not None
        while not select.select([self.process.stdout], [], [], 0.05)[0]:
            self.process.send_signal(signal.SIGUSR1)
        return self.next()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGSTOP)
        wait_until(lambda: ") T " in Path(f"/proc/{self.process.pid}/stat").read_text())

    def next(self) -> Event:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, f"it ended with {self.process.wait()}"
        return json.loads(line)  # type: ignore[no-any-return]

    def until(self, *names: str) -> Event:
        """The next event of one of these names; the others before it are passed over."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            event = self.next()
            if event["event"] in names:
                return event
        raise AssertionError(f"no {names} within a minute")


@contextmanager
def ended(talk: Talk, by: int = 0) -> Iterator[Talk]:
    """Ends well: the program must leave by itself when its input ends, and without a complaint of the sanitizers."""
    try:
        yield talk
        talk.end_input()
        assert talk.wait() == -by
    finally:
        if talk.process.poll() is None:
            talk.process.kill()
            talk.process.wait()
        for pipe in (talk.process.stdin, talk.process.stdout):
            assert pipe is not None
            pipe.close()


def talking(*words: object) -> AbstractContextManager[Talk]:
    """A C program to talk with; it must end well."""
    return ended(Talk([str(word) for word in words]))


def run(*words: object) -> Event:
    """The one line that a C program prints."""
    result = subprocess.run([str(word) for word in words], capture_output=True, text=True, timeout=110)
    assert result.returncode == 0, result.stderr
    assert not result.stderr
    return json.loads(result.stdout)  # type: ignore[no-any-return]


def ring_file(namespace: Namespace) -> bytes:
    with DriverWriter("x", structure(), slots=2) as writer:
        for value in (1, 2, 3):
            fill(writer, value)
        return namespace.ring_path("x").read_bytes()
