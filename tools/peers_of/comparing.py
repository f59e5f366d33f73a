"""Compares what a maker's program says with what ours say: a line for each comparison; may keep the exchange."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import patch

import serial

SKIN_EMULATE = ("skin-emulate", "-T", "60")


class Comparison:
    """Comparisons with one program of a maker.

    Args:
        program: name of its package.
    """

    def __init__(self, program: str) -> None:
        self.program, self.version = program, version(program)
        self._differs = False
        print(f"program: {program} {self.version}", flush=True)

    def agree(self, what: str, ours: Any, theirs: Any) -> None:
        """Compare what we say with what the program says."""
        if ours == theirs:
            print(f"agreed: {what}", flush=True)
        else:
            self._differs = True
            print(f"differs: {what}: ours {_short(ours)}, theirs {_short(theirs)}", flush=True)

    def keep(self, name: str, **more: Any) -> None:
        """Write an exchange for tests, where PEERS_KEEP names a folder."""
        if folder := os.environ.get("PEERS_KEEP"):
            of = {"program": self.program, "version": self.version, "date": datetime.now(UTC).date().isoformat()}
            Path(folder, f"{name}.json").write_text(json.dumps({**of, **more}) + "\n")

    def end(self) -> None:
        """Exit: 1 if anything differs."""
        sys.exit(int(self._differs))


@contextmanager
def emulated(driver: str, bus: str, *options: str) -> Iterator[None]:
    """Run skin-emulate until the block ends; it is ready when the block begins."""
    process = subprocess.Popen(
        [*SKIN_EMULATE, "--driver", driver, "--bus", bus, "--json", *options], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.readline()
    drain = threading.Thread(target=process.stdout.read, daemon=True)
    drain.start()
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(10)
        drain.join()


@contextmanager
def tapped(port: str) -> Iterator[tuple[str, bytearray]]:
    """Carry bytes from a serial port to a new one; its path, and all bytes that came there."""
    device = os.open(port, os.O_RDONLY | os.O_NOCTTY)
    master, slave = os.openpty()
    for each in (device, slave):
        tty.setraw(each)
    ended, heard = threading.Event(), bytearray()

    def carry() -> None:
        while not ended.is_set():
            if select.select([device], [], [], 0.1)[0]:
                heard.extend(data := os.read(device, 4096))
                os.write(master, data)

    thread = threading.Thread(target=carry)
    thread.start()
    try:
        yield os.ttyname(slave), heard
    finally:
        ended.set()
        thread.join()
        for each in (device, master, slave):
            os.close(each)


@contextmanager
def heard_by_pyserial() -> Iterator[bytearray]:
    """Keep the bytes that this process reads with pyserial."""
    heard, original = bytearray(), serial.Serial.read

    def read(line: serial.Serial, size: int = 1) -> bytes:
        data: bytes = original(line, size)
        heard.extend(data)
        return data

    with patch.object(serial.Serial, "read", read):
        yield heard


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."
