"""Prepare the snippets of pages: start the drivers and make the recording that they read. Only tests use it."""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
from onnx import TensorProto, helper, numpy_helper

import skinware
import skinware.recording
from skinware import DriverWriter, Namespace, ServiceReader, ServiceWriter, SkinLayout, Structure
from skinware.errors import RequestRefused
from skinware.geometry import Geometry
from skinware.memory import namespace
from skinware.realtime import Periodic
from skinware.recording.files import Files
from skinware.recording.recorder import Recorder
from skinware.recording.replaying import Replayer
from skinware.sensor_types import PRESSURE, SensorType
from skinware.tactile.contacts import Contacts
from skinware.tactile.contacts_service import ContactsWriter
from skinware.tactile.health import HealthKind, HealthReport
from skinware.tactile.health_service import HealthWriter
from skinware.tactile.motion import MotionWriter
from skinware.tactile.regions import Region, Regions
from skinware.tactile.tracking import TrackingSettings
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


def write_encoder() -> None:
    """Write ``encoder.onnx``: 16 multiples of the mean of any number of taxels."""
    values = helper.make_tensor_value_info("values", TensorProto.FLOAT, [1, 8, "taxels"])
    code = helper.make_tensor_value_info("code", TensorProto.FLOAT, [1, 16])
    nodes = [
        helper.make_node("ReduceMean", ["values"], ["mean"], axes=[1, 2], keepdims=1),
        helper.make_node("MatMul", ["mean", "mixture"], ["mixed"]),
        helper.make_node("ReduceMean", ["mixed"], ["code"], axes=[1], keepdims=0),
    ]
    mixture = numpy_helper.from_array(np.random.default_rng(0).normal(size=(1, 16)).astype(np.float32), "mixture")
    graph = helper.make_graph(nodes, "encoder", [values], [code], [mixture])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    Path("encoder.onnx").write_bytes(model.SerializeToString())


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


_programs: list[multiprocessing.context.ForkProcess] = []


def start_program(program: Callable[[], None]) -> None:
    """Run a function of a page in a process of its own."""

    def run() -> None:
        with contextlib.suppress(KeyboardInterrupt):
            program()

    process = multiprocessing.get_context("fork").Process(target=run, daemon=True)
    process.start()
    _programs.append(process)


def wait_for_requests(name: str) -> None:
    """Wait until a service takes requests, which its loop does."""
    deadline = time.monotonic() + PATIENCE_S
    with ServiceReader(name, timeout_s=PATIENCE_S, announce=False) as reader:
        while True:
            try:
                reader.request()
            except RequestRefused:
                assert time.monotonic() < deadline
            else:
                return


def end_programs() -> None:
    """Interrupt all programs, which then end in good order."""
    for process in _programs:
        assert process.pid is not None
        os.kill(process.pid, signal.SIGINT)
    for process in _programs:
        process.join()
        assert process.exitcode == 0


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


def _assembled(patches: Sequence[Patch], of_type: SensorType, dtype: str, bus: str = "x") -> Structure:
    return assemble([(bus, patches)], [of_type], dtype).structure


def record() -> None:
    """Write ``walk.mcap`` in a new folder, and go there: 2.5 s of a driver ``torso`` and of a service ``contacts``."""
    os.environ["SKINWARE_NAMESPACE"] = f"docs-{os.getpid()}"
    os.chdir(tempfile.mkdtemp())
    board = Patch("board 7", [Module(taxels(12), kind="triangle")])
    structure = _assembled([board], PRESSURE.measured(unit="counts"), "u2", bus="can0")
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


def own_namespaces() -> None:
    """Let the names of this process' namespaces be its own; their files go with it."""
    namespace.ROOT = Path(tempfile.mkdtemp(dir="/dev/shm"))
    atexit.register(shutil.rmtree, namespace.ROOT)


def flat_arm() -> tuple[Structure, Geometry]:
    """Return the structure and the places of a flat arm of 8 x 8 taxels."""
    structure = _assembled([Patch("p", [Module(taxels(64), kind="m")])], PRESSURE.measured(), "<f4")
    arm = Geometry.unknown(["pressure"] * 64, np.arange(64, dtype=np.uint64))
    arm.position_m[:] = np.column_stack([np.arange(64) % 8, np.arange(64) // 8, np.zeros(64)]) * 0.005
    arm.normal[:], arm.frame[:] = (0, 0, 1), "arm"
    return structure.placed(arm), arm


def press_an_arm() -> Structure:
    """Publish the contacts of a flat arm on which four taxels are pressed; return its structure."""
    structure, _ = flat_arm()
    writer = ContactsWriter(structure, namespace="calm", rate_hz=50)
    value = np.zeros(64)
    value[[9, 10, 17, 18]] = 1000, 1000, 2000, 2000
    _repeat(lambda _: writer.publish(value, value > 0, time.monotonic_ns()), writer)
    return structure


def publish_a_stuck_taxel(position: int) -> HealthWriter:
    """Publish the health of four taxels of the driver ``torso`` in the namespace ``calm``; one of them is stuck."""
    structure = _assembled([Patch("p", [Module(taxels(4))])], PRESSURE.measured(), "<f4")
    known = HealthReport.unknown(4)
    known.kind[position] = HealthKind.STUCK
    writer = HealthWriter(structure, "torso", namespace="calm")
    writer.publish({"pressure": known}, 1)
    return writer


def stroke_an_arm() -> tuple[Structure, Regions, Contacts]:
    """Publish the motion of a finger that strokes a flat arm; return its structure, its region and its contacts."""
    structure, arm = flat_arm()
    contacts = Contacts.of(structure, "pressure", tracking=TrackingSettings(frames=1))
    regions = Regions([Region("palm", patch=("p",))])
    writer = MotionWriter(structure, "pressure", regions, contacts.frames, namespace="calm", rate_hz=50)

    def publish(frame: int) -> None:
        away_m = np.hypot(arm.position_m[:, 0] - 0.001 * (frame % 35), arm.position_m[:, 1] - 0.02)
        value = 10 * np.exp(-((away_m / 0.006) ** 2))
        now_ns = time.monotonic_ns()
        writer.publish(contacts.update(value, value > 0.1, now_ns), value, now_ns)

    _repeat(publish, writer)
    return structure, regions, Contacts.of(structure, "pressure", tracking=TrackingSettings(frames=1))


def _repeat(publish: Callable[[int], object], writer: ContactsWriter | MotionWriter) -> None:
    """Publish at 50 Hz until this process ends; the number of the frame goes up from 1."""
    stopping = threading.Event()

    def run() -> None:
        frame = 0
        while not stopping.wait(0.02):
            frame += 1
            publish(frame)

    thread = threading.Thread(target=run, daemon=True)  # others are waited for before what is registered runs
    thread.start()
    atexit.register(writer.close)
    atexit.register(thread.join)
    atexit.register(stopping.set)


def touch_a_hand(stopped: Sequence[int]) -> Callable[[], None]:
    """Publish the driver ``hand`` at 200 Hz, whose index tip is touched twice a second, until there is a stop.

    Return a function that waits for its end.
    """
    tips = [
        Module(taxels(9, first_uid=9 * key), key=key, kind="3x3", name=f"{name} tip")
        for key, name in enumerate(("thumb", "index"))
    ]
    structure = _assembled([Patch("hand", tips)], PRESSURE.measured(unit="counts"), "<f4")
    writer = DriverWriter("hand", structure, rate_hz=200)

    def run() -> None:
        for number, _ in enumerate(Periodic(200)):
            if stopped or number > 6000:
                break
            columns = writer.begin()
            columns["values"][:], columns["status"][:] = 10.0, 0
            columns["values"][12] = 60.0 if number % 100 > 90 else 10.0
            columns["module_time_ns"][:] = time.monotonic_ns()
            writer.commit(time.monotonic_ns())

    thread = threading.Thread(target=run)
    thread.start()

    def end() -> None:
        thread.join()
        writer.close()

    return end


def images() -> Iterator[tuple[npt.NDArray[np.uint8], int]]:
    """Yield ten images of a camera, each with the time at which it was taken, CLOCK_MONOTONIC ns."""
    for number in range(10):
        time.sleep(1 / 30)
        yield np.full((48, 64, 3), number, np.uint8), time.monotonic_ns() - 12_000_000


def make_grasp_trials() -> None:
    """Go to a new folder and write files like those of the iCub Grasp Dataset into its folder ``trials``."""
    os.chdir(tempfile.mkdtemp())
    Path("trials").mkdir()
    noise = np.random.default_rng(1)
    for name, count in [("none_1", 12), ("none_2", 12), ("full_vitamin_water_3", 18)]:
        text = " -10000\n"
        for step in range(count):
            rows = 243 + noise.integers(-1, 2, (5, 12)).astype(float)
            rows[1, 3:6] -= (20 + 4 * step) * name.startswith("full")
            text += "1.0 " * 9 + "\n" + "14.0 " * 5 + "\n" + "".join(" ".join(map(str, row)) + "\n" for row in rows)
        Path(f"trials/{name}.txt").write_text(text)


def skin_convert(*arguments: str) -> str:
    """Run the command; return what it prints."""
    command = Path(sys.executable).with_name("skin-convert")
    return subprocess.run([command, *arguments], check=True, capture_output=True, text=True).stdout


def hand_with_regions(page: str) -> SimpleNamespace:
    """Go to a new folder with the regions file of a page; return a hand's snapshot, as far as the page reads it."""
    (text,) = re.findall(r"^```toml\n(.*?)^```", Path(page).read_text(), re.MULTILINE | re.DOTALL)[:1]
    os.chdir(tempfile.mkdtemp())
    Path("regions.toml").write_text(text)
    hand = Structure(
        types=[PRESSURE.measured(unit="counts")],
        buses=["x"],
        patch_name=["board 14", "board 15"],
        patch_bus=[0, 0],
        module_patch=[0, 1],
        module_kind=["palm", "fingertip"],
        module_name=["", "fingertip 4"],
        sensor_uid=[0x0E0000 + n for n in range(12)] + [0x0F0500 + n for n in range(12)],
        sensor_type=[PRESSURE.id] * 24,
        sensor_module=[0] * 12 + [1] * 12,
        dtype="u1",
    )
    return SimpleNamespace(layout=SkinLayout(("left_hand",), (hand,)), physical=lambda _type_name: np.arange(24.0))
