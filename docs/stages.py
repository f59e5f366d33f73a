"""Prepare the snippets of pages: start the drivers and make the recording that they read. Only tests use it."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import skinware
import skinware.recording
from skinware import DriverWriter, Namespace, ServiceWriter, Structure
from skinware.geometry import Geometry
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from skinware.recording.replaying import Replayer
from skinware.sensor_types import PRESSURE
from skinware.tactile.testing import Surface
from skinware_drivers import Layout
from skinware_drivers.description import Module, Patch, assemble, taxels
from skinware_drivers.testing.vectors import DirectPath

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


def start_torso(page: str) -> Callable[[Structure], None]:
    """Start the driver ``torso`` of a page's file, on emulated boards.

    Return a function that adds a bus, waits for it, and checks that the sensors of a structure keep their uids.
    """
    (text,) = re.findall(r"```toml\n(.*?)```", Path(page).read_text(), re.DOTALL)[:1]
    text = text.replace('"can0"', '"virtual?boards=7,8"').replace('"can1"', '"virtual?boards=7,9"')
    file = Path(tempfile.mkdtemp()) / "torso.toml"
    file.write_text(text)
    process = start("torso", "--config", file)

    def join_a_bus(before: Structure) -> None:
        assert before.n_patches == 4
        file.write_text(text + '[[bus]]\nname = "virtual?boards=3"\n')
        process.send_signal(signal.SIGHUP)
        until = time.monotonic() + 2 * PATIENCE_S
        while (now := _structure("torso")).n_patches < 5:
            assert time.monotonic() < until
            time.sleep(0.1)
        assert now.sensor_uid[: before.n_sensors].tolist() == before.sensor_uid.tolist()

    return join_a_bus


def _structure(name: str) -> Structure:
    with skinware.DriverReader(name) as reader:
        return reader.structure


def stop(process: subprocess.Popen[bytes]) -> None:
    """Interrupt a driver, which then ends in good order.

    Raises:
        RuntimeError: it ended with another status than 0.
    """
    process.send_signal(signal.SIGINT)
    if status := process.wait(PATIENCE_S):
        raise RuntimeError(f"skin-driver ended with {status}")


def structure_of(surface: Surface, places: Geometry) -> Structure:
    """Return the structure of a driver of pressure whose sensors have the places of a board's surface."""
    n = len(places)
    return Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["x"],
        patch_name=["board 7"],
        patch_bus=[0],
        module_patch=[0] * 16,
        module_kind=["triangle"] * 16,
        sensor_uid=np.arange(n),
        sensor_type=[PRESSURE.id] * n,
        sensor_module=surface.module,
        dtype="<f4",
    ).placed(places)


def decode_a_triangle(layout: Layout) -> None:
    """Check that two frames of a triangle become the values and status of the picture of layouts.

    Raises:
        AssertionError: they do not.
    """
    patches = [Patch("board 7", [Module(taxels(12), key=3)], key=0x47)]
    path = DirectPath(layout, assemble([("can0", patches)], [PRESSURE.measured(unit="counts")], "u1"), 8)
    for text in ("40F0EEC1F0F1EFF0", "C0F09AF0F2F00010"):
        path.feed(1, 0x473, bytes.fromhex(text))
    state = path.decoder.state
    path.close()
    assert state.values.tolist() == [240, 238, 193, 240, 241, 239, 240, 240, 154, 240, 242, 240]
    assert state.status.tolist() == [4] + [0] * 11


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


def replay(file: str) -> Callable[[], None]:
    """Publish a recording in the namespace of the environment, again and again. Return a function that ends it."""
    recording = skinware.recording.open(file)
    replayer = Replayer(recording, namespace=os.environ["SKINWARE_NAMESPACE"], loop=True)
    thread = threading.Thread(target=replayer.run)
    thread.start()

    def end() -> None:
        replayer.stop()
        thread.join()
        replayer.close()
        recording.close()
        shutil.rmtree(Namespace().path)

    return end
