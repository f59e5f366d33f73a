"""skinware.h against Python drivers: the same values, the same coherency, the same deaths, the same damaged files."""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skinware import DriverReader, DriverWriter, Namespace, ServiceWriter, Structure, get_include
from skinware.errors import BadServiceFile
from skinware.memory import _layout
from skinware.memory.namespace import ROOT
from skinware.sensor_types import PRESSURE, TEMPERATURE, SensorType
from skinware_drivers.testing.waiting import wait_until
from tests.compiling import LANGUAGES, compiled

SPAWN = multiprocessing.get_context("spawn")
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
def running(function: Callable[..., None], *arguments: Any) -> Iterator[Any]:
    """A process that is killed at the end, unless it was before."""
    process = SPAWN.Process(target=function, args=arguments)
    process.start()
    try:
        yield process
    finally:
        kill(process)


def kill(process: Any) -> None:
    if process._closed:
        return
    if process.is_alive():
        os.kill(process.pid, signal.SIGKILL)
    process.join()
    process.close()


@contextmanager
def lone_writer(n_modules: int = 6, value: int = 5) -> Iterator[Any]:
    """A driver in a process of its own that has published one frame and is filling the next."""
    published = SPAWN.Event()
    with running(write_until_killed, n_modules, value, published) as process:
        assert published.wait(60)
        yield process


@pytest.fixture(params=["c99", "c++11", "sanitized"])
def any_program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(SOURCE, request.param, tmp_path_factory)


@pytest.fixture
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(SOURCE, "c99", tmp_path_factory)


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


# -- the header itself --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("standard", ["c99", "c11", "c2x", "gnu17", "c++11", "c++17", "c++20"])
def test_the_header_needs_nothing_and_warns_of_nothing(
    standard: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    language = "c++11" if "++" in standard else "c99"
    compiled(SOURCE, language, tmp_path_factory)  # skips without a compiler
    suffix = ".cc" if "++" in standard else ".c"
    user, implementation = tmp_path / f"user{suffix}", tmp_path / f"skinware{suffix}"
    user.write_text(
        "#include <skinware.h>\n#include <skinware.h>\nint main(void) { return skinware_text(SKINWARE_OK) == NULL; }\n"
    )
    implementation.write_text("#define SKINWARE_IMPLEMENTATION\n#include <skinware.h>\n")
    options = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-Wshadow", "-Wconversion", "-Wcast-align"]
    command = [LANGUAGES[language][0], f"-std={standard}", *options, f"-I{get_include()}"]
    subprocess.run([*command, str(user), str(implementation), "-o", str(tmp_path / "user")], check=True)
    subprocess.run([str(tmp_path / "user")], check=True)


def test_the_header_is_in_the_wheel(tmp_path: Path) -> None:
    project = Path(__file__).parents[2]
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(project / name, tmp_path / name)
    for name in ("skinware", "skinware_drivers"):
        shutil.copytree(project / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    build = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    wheels = tmp_path / "wheels"
    subprocess.run([sys.executable, "-c", build, str(wheels)], cwd=tmp_path, check=True, capture_output=True)
    (wheel,) = wheels.glob("*.whl")
    shutil.unpack_archive(wheel, tmp_path / "installed", "zip")
    header = tmp_path / "installed" / "skinware" / "include" / "skinware.h"
    assert header.read_bytes() == (project / "skinware" / "include" / "skinware.h").read_bytes()


# -- the same values ----------------------------------------------------------------------------------------------


def as_json(array: np.ndarray[Any, Any]) -> list[Any]:
    """Elements as c_reader prints them: numbers as doubles, text up to its NULs."""
    if array.dtype.kind == "S":
        return [element.decode() for element in array.tolist()]
    numbers = [float(element) for element in array.tolist()]
    return [x if math.isfinite(x) else "nan" if math.isnan(x) else "inf" if x > 0 else "-inf" for x in numbers]


@pytest.mark.parametrize("dtype", ["u1", "<i2", "<u2", "<i4", "<f4"])
def test_c_reads_what_python_reads(any_program: Path, dtype: str) -> None:
    made = structure(dtype=dtype)
    with DriverWriter(
        "x", made, driver_type="test", bus_counters=("frames", "lost"), patch_counters=("cycles",), rate_hz=20, slots=5
    ) as writer:
        columns = writer.begin()
        generator = np.random.default_rng(1)
        for column in columns.values():
            column[...] = generator.integers(0, 100, len(column))
        columns["values"][:] = np.arange(made.n_sensors) * (-2 if dtype[1] in "if" else 2)
        columns["module_time_ns"][:] = -(1 << 40)
        writer.commit(123456789)
        seen = run(any_program, "describe", "x")
        with DriverReader("x") as reader:
            frame = reader.read()
            assert seen["kind"] == reader.kind
            assert (seen["generation"], seen["sequence"]) == frame.position
            assert (seen["acquired_ns"], seen["published_ns"]) == (frame.acquired_ns, frame.published_ns)
            assert (seen["stale"], seen["alive"], seen["pid"]) == (0, 1, os.getpid())
            assert (seen["period_ns"], seen["slots"], seen["flags"]) == (50_000_000, 5, 0)
            assert seen["digest"] == bytes(reader._ring.segment.header["digest"]).hex()
            assert set(seen["columns"]) == set(reader.schema.columns)
            for name, column_seen in seen["columns"].items():
                expected = frame.column(name)
                assert (column_seen["kind"], column_seen["itemsize"]) == (expected.dtype.kind, expected.dtype.itemsize)
                assert column_seen["data"] == as_json(expected)
            tables = reader.static()
            assert set(seen["tables"]) == set(tables)
            for name, table_seen in seen["tables"].items():
                assert table_seen["data"] == as_json(tables[name])
            assert set(seen["types"]) == {t.name for t in made.types}
            for sensor_type in made.types:
                type_seen = seen["types"][sensor_type.name]
                positions = np.flatnonzero(made.sensor_type == sensor_type.id)
                assert (type_seen["id"], type_seen["unit"]) == (sensor_type.id, sensor_type.unit)
                assert type_seen["positions"] == positions.tolist()
                assert type_seen["physical"] == frame.physical(sensor_type.name).tolist()
                bounds = np.array([sensor_type.minimum, sensor_type.maximum])
                assert type_seen["range"] == as_json(bounds)


def test_services_that_are_no_drivers_are_read_too(any_program: Path) -> None:
    columns: dict[str, tuple[npt.DTypeLike, int | tuple[int, ...]]] = {
        "pose": ("<f8", (2, 3)),
        "event": (np.dtype([("id", "<u4"), ("x", "<f4")]), 4),
        "label": ("S5", 2),
        "small": ("i1", 3),
        "big": ("<u8", 1),
    }
    with ServiceWriter("x", columns, {"table": np.arange(3, dtype="<i8")}, description="poses") as writer:
        arrays = writer.begin()
        arrays["pose"][:] = [[1, 2, 3], [math.inf, -math.inf, math.nan]]
        arrays["label"][:] = [b"abcde", b"f"]
        arrays["small"][:] = [-1, 0, 1]
        writer.commit(1, flags=42)
        seen = run(any_program, "describe", "x")
    assert (seen["kind"], seen["flags"]) == ("data", 42)
    assert "types" not in seen
    assert seen["columns"]["pose"]["data"] == [1, 2, 3, "inf", "-inf", "nan"]
    assert seen["columns"]["label"]["data"] == ["abcde", "f"]
    assert seen["columns"]["small"]["data"] == [-1, 0, 1]
    assert (seen["columns"]["event"]["kind"], seen["columns"]["event"]["itemsize"]) == ("V", 8)
    assert seen["tables"]["table"]["data"] == [0, 1, 2]
    assert json.loads(bytes(map(int, seen["tables"]["schema"]["data"])))["description"] == "poses"


# -- coherency ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("slots", [2, 3, 8])
@pytest.mark.parametrize("way", ["copy", "view"])
def test_no_torn_frame_from_a_writer_flat_out(program: Path, slots: int, way: str) -> None:
    stop = SPAWN.Event()
    with running(write_flat_out, slots, 100, stop) as process:
        wait_for_service(process)
        seen = run(program, "flood", "x", 20_000, way)
        stop.set()
        process.join(30)
    assert (seen["event"], seen["torn"], seen["checked"]) == ("flooded", 0, 20_000)
    if slots > 2:
        assert seen["overruns"] == 0


def wait_for_service(process: Any) -> None:
    with DriverReader("x", timeout_s=60) as reader:
        reader.read(timeout_s=60)
        assert reader.alive
    assert process.is_alive()


def test_a_writer_that_is_killed_and_restarted_all_the_time(program: Path) -> None:
    generator = random.Random(4)
    with running(write_flat_out, 3, 40, SPAWN.Event()) as process:
        wait_for_service(process)
        flood = Talk([str(program), "flood", "x", "0", "copy"])
        time.sleep(generator.uniform(0.0, 0.05))  # a moment of the writer's life: nothing depends on it
    with ended(flood):
        for _ in range(6):
            flood.until("gone")
            with running(write_flat_out, 3, 40, SPAWN.Event()):
                flood.until("restarted")
                time.sleep(generator.uniform(0.0, 0.05))
        flood.until("gone")
        flood.end_input()
        seen = flood.until("flooded")
    assert seen["torn"] == seen["overruns"] == 0
    assert seen["checked"] > 0
    ServiceWriter("x", {"values": ("u1", 1)}).close()


def test_a_killed_c_reader_is_nothing_to_the_writer(program: Path) -> None:
    stop = SPAWN.Event()
    with running(write_flat_out, 3, 40, stop) as process:
        wait_for_service(process)
        for _ in range(3):
            with ended(Talk([str(program), "flood", "x", "0", "view"]), signal.SIGKILL) as flood:
                flood.process.kill()
        wait_for_service(process)
        stop.set()
        process.join(30)


# -- life and death -----------------------------------------------------------------------------------------------

LONG_MS = 600_000
"""Nothing here may wait that long: what is told in spite of it was noticed, not waited for."""


def test_a_killed_writer_is_noticed_and_a_restart_followed(any_program: Path) -> None:
    with lone_writer() as process, talking(any_program, "follow", "x", LONG_MS) as talk:
        seen = talk.next()
        assert (seen["event"], seen["alive"], seen["stale"], seen["value"]) == ("frame", 1, 0, 5)
        kill(process)
        seen = talk.next()
        assert (seen["event"], seen["alive"], seen["stale"], seen["value"]) == ("gone", 0, 1, 5)
        with lone_writer(value=6) as again:
            assert talk.next()["event"] == "restarted"
            seen = talk.until("frame")
            assert (seen["alive"], seen["stale"], seen["value"], seen["count"]) == (1, 0, 6, 30)
            kill(again)
            assert talk.next()["event"] == "gone"
        with lone_writer(n_modules=2, value=7):
            assert talk.next()["event"] == "structure changed"
            seen = talk.until("frame")
            assert (seen["value"], seen["count"]) == (7, 10)
            talk.end_input()
    ServiceWriter("x", {"values": ("u1", 1)}).close()


def test_a_dead_writer_is_told_once_and_then_waited_for(program: Path) -> None:
    with lone_writer() as process, talking(program, "follow", "x", 120) as talk:
        assert talk.next()["event"] == "frame"
        assert talk.next()["event"] == "timeout"
        kill(process)
        talk.until("gone")
        for _ in range(3):
            seen = talk.next()
            assert seen["event"] == "gone"
            assert seen["waited_ns"] >= 120_000_000
        talk.end_input()
    assert run(program, "describe", "x")["stale"] == 1  # a late joiner reads its last frame, too
    ServiceWriter("x", {"values": ("u1", 1)}).close()


def test_a_stopped_process_is_alive_but_silent(program: Path) -> None:
    with lone_writer() as process:
        os.kill(process.pid, signal.SIGSTOP)
        with talking(program, "follow", "x", 120) as talk:
            assert talk.next()["event"] == "frame"
            seen = talk.next()
            assert (seen["event"], seen["alive"], seen["stale"]) == ("timeout", 1, 0)
            talk.end_input()
    ServiceWriter("x", {"values": ("u1", 1)}).close()


def test_pause_resume_restructure_and_close_are_told_at_once(any_program: Path) -> None:
    with ServiceWriter("x", {"values": ("<i4", 3)}) as writer, talking(any_program, "follow", "x", LONG_MS) as talk:

        def publish(value: int) -> None:
            writer.begin()["values"][:] = value
            writer.commit(1)

        publish(1)
        assert talk.next()["event"] == "frame"
        writer.pause()
        seen = talk.next()
        assert (seen["event"], seen["state"], seen["value"]) == ("paused", _layout.STATE_PAUSED, 1)
        talk.stop()  # so that it sees the end of the pause and the frame at the same moment
        writer.resume()
        publish(2)
        talk.process.send_signal(signal.SIGCONT)
        seen = talk.next()
        assert (seen["event"], seen["value"]) == ("frame", 2)
        writer.pause()
        assert talk.next()["event"] == "paused"
        writer.resume()
        writer.restructure({"values": ("<i4", 4)})
        seen = talk.next()
        assert (seen["event"], seen["count"], seen["value"]) == ("structure changed", 4, -1)
        publish(3)
        assert talk.next()["value"] == 3
        for number in (1, 2):  # the columns are the same, but not what a table says
            writer.restructure({"values": ("<i4", 4)}, {"table": np.array([number])})
            assert talk.next()["event"] == "structure changed"
        writer.restructure({"values": ("<i4", 4)}, {"table": np.array([2])})
        assert talk.next()["event"] == "restarted"
        publish(4)
        assert talk.next()["value"] == 4
        assert talk.interrupt()["event"] == "interrupted"
        writer.close()
        seen = talk.next()
        while seen["event"] == "interrupted":
            seen = talk.next()
        assert (seen["event"], seen["state"], seen["stale"], seen["value"]) == ("gone", _layout.STATE_CLOSED, 1, 4)
        talk.end_input()


# -- files and folders that are wrong ------------------------------------------------------------------------------


def ring_file(namespace: Namespace) -> bytes:
    with DriverWriter("x", structure(), slots=2) as writer:
        for value in (1, 2, 3):
            fill(writer, value)
        return namespace.ring_path("x").read_bytes()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: d[:100], "shorter than a header"),
        (lambda d: b"", "shorter than a header"),
        (lambda d: d[:-4096], "truncated"),
        (lambda d: b"NOTARING" + d[8:], "wrong magic"),
        (lambda d: d[:8] + b"\x09\0\0\0" + d[12:], "layout version"),
        (lambda d: d[:44] + b"\xff\xff\0\0" + d[48:], "make no ring"),
        (lambda d: d[:48] + b"\xff" * 16 + d[64:], "make no ring"),
        (lambda d: d[:48] + b"\0\xf0" + b"\xff" * 6 + d[56:], "outside the file"),
        (lambda d: d[:56] + b"\xc0" + b"\xff" * 7 + d[64:], "outside the file"),
        (lambda d: d[:40] + b"\xff\xff\0\0" + d[44:], "columns do not fit"),
        (lambda d: d[:1152] + bytes(24) + d[1176:], "no proper name"),
        (lambda d: d[: 1152 + 24] + b"<c16" + d[1152 + 28 :], "dtype"),
        (lambda d: d[: 1152 + 32] + b"\xff" * 8 + d[1152 + 40 :], "column"),
        (lambda d: d[: 1152 + 40] + b"\xc0" + b"\xff" * 7 + d[1152 + 48 :], "begins at a wrong place"),
        (lambda d: d[:44] + b"\x01" + d[45:], "make no ring"),
        (lambda d: d[:56] + bytes(8) + d[64:], "make no ring"),
        (lambda d: d.replace(b"sensor_module", b"sensor_nodule"), "structure is missing"),
        (lambda d: d.replace(b"<u2", b"<f2"), "do not fit its structure"),
        (lambda d: d.replace(np.arange(6, dtype="<u4") % 2, np.arange(6, dtype="<u4")), "does not exist"),
        (lambda d: d.replace(STRAIN.to_bytes(4, "little"), b"\x63\0\0\0", 1), "not in the driver's table"),
    ],
)
def test_damaged_files_are_refused(
    any_program: Path, namespace: Namespace, damage: Callable[[bytes], bytes], words: str
) -> None:
    namespace.ring_path("x").write_bytes(damage(ring_file(namespace)))
    seen = run(any_program, "describe", "x")
    assert (seen["event"], seen["text"]) == ("refused", "the service's file cannot be read safely")
    assert words in seen["reason"]
    with pytest.raises(BadServiceFile):
        DriverReader("x")
    namespace.ring_path("x").unlink()


def test_a_later_minor_version_with_things_unknown_is_read(program: Path, namespace: Namespace) -> None:
    data = bytearray(ring_file(namespace))
    data[12] = 7  # minor version
    data[192:512] = b"\xaa" * 320  # what is reserved in the header
    data[524] = 0xF0  # state bits that nobody knows yet
    namespace.ring_path("x").write_bytes(data)
    seen = run(program, "describe", "x")
    assert (seen["event"], seen["sequence"]) == ("described", 3)
    with DriverReader("x") as reader:
        assert reader.read().sequence == 3
    namespace.ring_path("x").unlink()


def test_symlinks_fifos_and_foreign_files_are_refused(program: Path, namespace: Namespace) -> None:
    data = ring_file(namespace)
    path = namespace.ring_path("x")
    path.symlink_to("/etc/passwd")
    assert run(program, "describe", "x")["reason"] == "the file cannot be opened"
    path.unlink()
    os.mkfifo(path)
    assert run(program, "describe", "x")["reason"] == "not a regular file"
    path.unlink()
    if os.geteuid() == 0:
        path.write_bytes(data)
        os.chown(path, 12345, -1)
        assert "another user" in run(program, "describe", "x")["reason"]
        path.unlink()


def test_folders_that_cannot_be_trusted_are_refused(
    program: Path, namespace: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "no driver has run" in run(program, "describe", "x")["reason"]
    namespace.create()
    assert "no such service" in run(program, "describe", "x")["reason"]
    namespace.path.chmod(0o2777)
    assert "written by others" in run(program, "describe", "x")["reason"]
    namespace.path.chmod(0o2750)
    monkeypatch.setenv("SKINWARE_OWNER", "nobody-of-that-name")
    assert "no user of this machine" in run(program, "describe", "x")["reason"]
    monkeypatch.delenv("SKINWARE_OWNER")
    if os.geteuid() == 0:
        os.chown(namespace.path, 12345, -1)
        assert "SKINWARE_OWNER" in run(program, "describe", "x")["reason"]
        monkeypatch.setenv("SKINWARE_OWNER", "12345")
        assert "no such service" in run(program, "describe", "x")["reason"]
    link = ROOT / f"{namespace.path.name}-link"
    link.symlink_to(namespace.path)
    try:
        monkeypatch.setenv("SKINWARE_NAMESPACE", f"{namespace.name}-link")
        assert "symbolic link" in run(program, "describe", "x")["reason"]
    finally:
        link.unlink()


@pytest.mark.parametrize("name", ["", "-x", "a/b", "../x", "x" * 48, "x.ring", "\u00e4"])
def test_names_that_cannot_be_are_refused(program: Path, name: str) -> None:
    assert run(program, "describe", name)["text"] == "not the name of a service or namespace"
    if name:
        result = subprocess.run(
            [program, "describe", "x"], env={**os.environ, "SKINWARE_NAMESPACE": name}, capture_output=True, text=True
        )
        assert json.loads(result.stdout)["text"] == "not the name of a service or namespace"


HEAD_BITS = 8 * (_layout.COLUMN_OFFSET + 30 * _layout.COLUMN.itemsize)
FLIPS = st.one_of(st.integers(0, HEAD_BITS - 1), st.integers(0, 8 * 4096 * 4))
WORDS = st.tuples(
    st.integers(0, HEAD_BITS // 32 - 1),
    st.sampled_from([0, 1, 2, 63, 64, 4095, 4096, 0x7FFF_FFFF, 0xFFFF_FFC0, 0xFFFF_FFFF]),
)


@pytest.mark.parametrize("language", ["sanitized", "sanitized copies"])
def test_damage_of_any_kind_does_no_harm(
    language: str, namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(SOURCE, language, tmp_path_factory)
    data = ring_file(namespace)
    path = namespace.ring_path("x")
    attached = refused = 0
    with talking(program, "walk") as talk:

        @settings(max_examples=500, deadline=None, database=None, suppress_health_check=list(HealthCheck))
        @given(st.lists(FLIPS, max_size=4), st.lists(WORDS, max_size=3))
        def damage(flips: list[int], words: list[tuple[int, int]]) -> None:
            nonlocal attached, refused
            damaged = bytearray(data)
            for bit in flips:
                damaged[bit // 8 % len(damaged)] ^= 1 << bit % 8
            for at, value in words:
                damaged[4 * at : 4 * at + 4] = value.to_bytes(4, "little")
            path.write_bytes(damaged)
            talk.tell("x")
            if talk.next()["event"] == "attached":
                attached += 1
                _layout.parse(bytes(damaged), "x", len(damaged))  # what C takes, Python takes
            else:
                refused += 1

        damage()
    path.unlink()
    assert attached > 20
    assert refused > 20


def test_damage_while_a_file_is_read_does_no_harm(
    namespace: Namespace, tmp_path_factory: pytest.TempPathFactory
) -> None:
    program = compiled(SOURCE, "sanitized", tmp_path_factory)
    path = namespace.ring_path("x")
    path.write_bytes(ring_file(namespace))
    size = path.stat().st_size
    generator = random.Random(7)
    fd = os.open(path, os.O_RDWR)
    try:
        with talking(program, "follow", "x", 0) as talk:
            for _ in range(1000):
                offset = generator.choice([0, 512, 1152, generator.randrange(size)])
                os.pwrite(fd, generator.randbytes(min(640, size - offset)), offset)
                talk.next()
            talk.end_input()
    finally:
        os.close(fd)
    assert path.stat().st_size == size
    path.unlink()
