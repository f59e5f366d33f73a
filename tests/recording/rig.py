"""Recorders in threads, and what was published beside what was recorded."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import skinware.recording
from skinware import Sample, ServiceReader, ServiceWriter
from skinware.recording.files import Files, Target
from skinware.recording.recorder import Recorder
from skinware.recording.replaying import Replayer
from skinware_drivers.testing.waiting import wait_until
from tests.cli.fake_skin import FakeSkin, fake_structure

Contents = dict[tuple[int, int], dict[str, bytes]]
"""Bytes of the columns of frames, by position."""


@contextmanager
def recording(path: Path, target: Target | None = None, **options: Any) -> Iterator[Recorder]:
    """A recorder that has begun; at the end of the block the file is complete."""
    recorder = Recorder(target or Files(path), **options)
    thread = threading.Thread(target=recorder.run)
    thread.start()
    try:
        wait_until(path.exists if target is None else lambda: True)
        yield recorder
    finally:
        recorder.stop()
        thread.join()


@contextmanager
def replaying(file: Path, **options: Any) -> Iterator[Replayer]:
    """A replay in a thread."""
    with skinware.recording.open(file) as opened:
        replayer = Replayer(opened, **options)
        thread = threading.Thread(target=replayer.run)
        thread.start()
        try:
            yield replayer
        finally:
            replayer.stop()
            thread.join()
            replayer.close()


def has(recorder: Recorder, service: str) -> None:
    """Wait until a recorder has found a service."""
    wait_until(lambda: service in recorder.services)


def publish(skin: FakeSkin, count: int, period_s: float = 0.004) -> Contents:
    """Publish frames; what was in them."""
    contents: Contents = {}
    for _ in range(count):
        skin.publish()
        with ServiceReader[Sample](skin.writer.name, announce=False) as reader:
            frame = reader.read()
            contents[frame.position] = contents_of(frame)
        time.sleep(period_s)
    return contents


def contents_of(frame: Sample) -> dict[str, bytes]:
    """The bytes of every column, and the times."""
    columns = {name: frame.column(name).tobytes() for name in frame._columns}
    return columns | {"times": np.array([frame.acquired_ns, frame.published_ns, frame.flags]).tobytes()}


def pose_service(**options: Any) -> ServiceWriter:
    """A service that is no driver: numbers with a shape, structures, floats."""
    columns: dict[str, Any] = {
        "angle": ("<f4", (2, 3)),
        "joint": ([("name", "S5"), ("at", "<f8")], (4,)),
        "count": ("<i8", ()),
    }
    return ServiceWriter("pose", columns, {"names": np.array([b"a", b"b"])}, **options)


def publish_pose(writer: ServiceWriter, number: int) -> None:
    """A frame full of a number."""
    columns = writer.begin()
    columns["angle"][:] = number + np.arange(6).reshape(2, 3) / 7
    columns["joint"]["name"], columns["joint"]["at"] = b"j%d" % (number % 10), number / 3
    columns["count"][()] = -number
    writer.commit(time.monotonic_ns(), flags=number)


def two_drivers_and_a_service(file: Path) -> None:
    """Record 75 frames of a driver, and 25 each of another and of a service."""
    with (
        FakeSkin("arm", fake_structure(2, dtype="<i4")) as arm,
        FakeSkin("torso") as torso,
        pose_service(slots=64) as pose,
        recording(file) as recorder,
    ):
        arm.publish()
        torso.publish()
        publish_pose(pose, 1)
        for name in ("arm", "torso", "pose"):
            has(recorder, name)
        torso.break_some()
        for number in range(2, 76):
            torso.publish()
            if number % 3 == 0:
                arm.publish()
                publish_pose(pose, number)
            if number == 50:  # or a recorder that is held up misses some
                wait_until(lambda: recorder.messages.get("/skin/torso/frame") == 50)
            time.sleep(0.015)
        wait_until(lambda: recorder.messages.get("/skin/torso/frame") == 75)
