"""Prepare the snippets of pages: start the drivers and make the recording that they read. Only tests use it."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import skinware
from skinware import DriverWriter, Namespace, ServiceWriter, Structure
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from skinware.sensor_types import PRESSURE

PATIENCE_S = 60.0


def start(name: str, *options: str | Path) -> subprocess.Popen[bytes]:
    """Start ``skin-driver`` under a name, and wait for its first snapshot. It ends with this process."""
    command = [Path(sys.executable).with_name("skin-driver"), "--name", name, *options]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    atexit.register(process.wait)
    atexit.register(process.terminate)
    with skinware.DriverReader(name, timeout_s=PATIENCE_S) as reader:
        reader.read(timeout_s=PATIENCE_S)
    return process


def stop(process: subprocess.Popen[bytes]) -> None:
    """Interrupt a driver, which then ends in good order.

    Raises:
        RuntimeError: it ended with another status than 0.
    """
    process.send_signal(signal.SIGINT)
    if status := process.wait(PATIENCE_S):
        raise RuntimeError(f"skin-driver ended with {status}")


def record() -> None:
    """Write ``walk.mcap`` in a new folder, and go there: 2.5 s of a driver ``torso`` and of a service ``contacts``."""
    os.environ["SKINWARE_NAMESPACE"] = f"docs-{os.getpid()}"
    os.chdir(tempfile.mkdtemp())
    structure = Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["can0"],
        patch_name=["board 7"],
        patch_bus=[0],
        module_patch=[0],
        module_kind=["triangle"],
        sensor_uid=np.arange(12),
        sensor_type=[PRESSURE.id] * 12,
        sensor_module=[0] * 12,
        dtype="u2",
    )
    recorder = Recorder(Files(Path("walk.mcap")))
    thread = threading.Thread(target=recorder.run)
    thread.start()
    torso, contacts = DriverWriter("torso", structure, rate_hz=100), ServiceWriter("contacts", {"force": ("f4", 3)})
    with torso, contacts:
        for _ in range(250):
            for writer in (torso, contacts):
                columns = writer.begin()
                for column in columns.values():
                    column[:] = 0
                columns.get("module_time_ns", np.zeros(1, "i8"))[:] = time.monotonic_ns()
                writer.commit(time.monotonic_ns())
            time.sleep(0.01)
    recorder.stop()
    thread.join()
    shutil.rmtree(Namespace().path)
