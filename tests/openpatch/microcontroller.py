"""The microcontroller: a C program around openpatch.h on the other end of a pseudo terminal."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import tty
from pathlib import Path
from types import TracebackType

import pytest

import skinware_drivers
from skinware_drivers.serial.bus import SerialBus
from skinware_drivers.serial.openpatch import OpenPatchDriver, OpenPatchOptions
from tests.compiling import compiled

HERE = Path(__file__).parent
POWER_UP, WATCHDOG = 1, 3


def program(source: Path, language: str, folder: pytest.TempPathFactory, *options: str) -> Path:
    """A program with openpatch.h, free of warnings."""
    include = f"-I{skinware_drivers.get_include()}"
    return compiled(source, language, folder, ["-Wconversion", "-Wshadow", include, *options])


class Microcontroller:
    """A patch that can be reset, also with other firmware, while its port stays where it is (a USB bridge).

    Attributes:
        path: the port.
        master: the patch's end of it: what is written to it reaches the host as if the patch had sent it.
        slave: the host's end: what is written to it reaches the patch.
    """

    def __init__(self, firmware: Path, model: str, serial_number: str = "1", running: bool = True) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self._firmware, self._model, self._serial_number = firmware, model, serial_number
        self._process: subprocess.Popen[bytes] | None = None
        if running:
            self.run()

    def run(self, reset: int = POWER_UP, model: str | None = None, first_us: int | None = None) -> None:
        """Begin after a reset."""
        self._model = model or self._model
        command = [str(self._firmware), self._model, self._serial_number, str(reset)]
        if first_us is not None:
            command.append(str(first_us))
        self._process = subprocess.Popen(command, stdin=self.master)

    def kill(self) -> None:
        """Stop it wherever it is, also in the middle of a frame."""
        assert self._process is not None
        if self._process.poll() is None:
            self._process.kill()
        assert self._process.wait(30) == -signal.SIGKILL, "the firmware ended by itself"
        self._process = None

    def signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)

    def line(self, **options: float) -> tuple[OpenPatchDriver, SerialBus]:
        """A driver for it."""
        driver = OpenPatchDriver(OpenPatchOptions(**options))
        return driver, SerialBus(self.path, {"low_latency": "false"}, payload_size=driver.payload_size)

    def says(self, timeout_s: float) -> bytes:
        """What it sends while no driver listens; empty if nothing within a time."""
        ready, _, _ = select.select([self.slave], [], [], timeout_s)
        return os.read(self.slave, 65536) if ready else b""

    def __enter__(self) -> Microcontroller:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if self._process is not None:
                self.kill()
        finally:
            os.close(self.master)
            os.close(self.slave)
