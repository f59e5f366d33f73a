"""skinware.h against Python drivers: the same values, the same coherency."""

from __future__ import annotations

import json
import math
import os
import random
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import BusReason, BusState, DriverReader, DriverWriter, ServiceWriter, Status, get_include
from tests.compiling import LANGUAGES, compiled
from tests.core.c_programs import SOURCE, Talk, ended, run, structure, write_flat_out
from tests.core.workers import PROCESSES, running
from tests.wheel import ROOT, built_wheel

pytestmark = pytest.mark.usefixtures("process_server")


# -- the header itself --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "standard",
    ["c99", *(pytest.param(s, marks=pytest.mark.thorough) for s in ("c11", "c2x", "gnu17", "c++11", "c++17")), "c++20"],
)
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


def test_the_header_has_the_numbers_of_status_and_buses() -> None:
    text = Path(get_include(), "skinware.h").read_text()
    for prefix, kind in (("STATUS", Status), ("BUS_REASON", BusReason), ("BUS", BusState)):
        found = re.findall(rf"#define SKINWARE_{prefix}_((?!REASON_)\w+) (\d+)u", text)
        assert {name: int(value) for name, value in found} == {m.name: m.value for m in kind}


@pytest.mark.thorough
def test_the_header_is_in_the_wheel(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    shutil.unpack_archive(built_wheel(tmp_path_factory), tmp_path, "zip")
    header = Path("skinware", "include", "skinware.h")
    assert (tmp_path / header).read_bytes() == (ROOT / header).read_bytes()


# -- the same values ----------------------------------------------------------------------------------------------


def as_json(array: np.ndarray[Any, Any]) -> list[Any]:
    """Elements as c_reader prints them: numbers as doubles, text up to its NULs."""
    if array.dtype.kind == "S":
        return [element.decode() for element in array.tolist()]
    numbers = [float(element) for element in array.tolist()]
    return [x if math.isfinite(x) else "nan" if math.isnan(x) else "inf" if x > 0 else "-inf" for x in numbers]


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", ["u1", "<i2", "<u2", "<i4", "<f4"])
def test_c_reads_what_python_reads(any_program: Path, dtype: str) -> None:
    made = structure(dtype=dtype)
    with DriverWriter(
        "x",
        made,
        driver_type="test",
        bus_counters=("frames", "dropped"),
        patch_counters=("cycles",),
        rate_hz=20,
        slots=5,
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
                assert type_seen["physical"] == frame.physical(sensor_type.name).astype(np.float32).tolist()
                assert type_seen["fresh"] == frame.fresh(sensor_type.name, max_age_s=3600).tolist()
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


@pytest.mark.thorough
@pytest.mark.parametrize("slots", [2, 3, 8])
@pytest.mark.parametrize("way", ["copy", "view"])
def test_no_torn_frame_from_a_writer_flat_out(program: Path, slots: int, way: str) -> None:
    stop = PROCESSES.Event()
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
    with running(write_flat_out, 3, 40, PROCESSES.Event()) as process:
        wait_for_service(process)
        flood = Talk([str(program), "flood", "x", "0", "copy"])
        time.sleep(generator.uniform(0.0, 0.05))  # a moment of the writer's life: nothing depends on it
    with ended(flood):
        for _ in range(6):
            flood.until("gone")
            with running(write_flat_out, 3, 40, PROCESSES.Event()):
                flood.until("restarted")
                time.sleep(generator.uniform(0.0, 0.05))
        flood.until("gone")
        flood.end_input()
        seen = flood.until("flooded")
    assert seen["torn"] == seen["overruns"] == 0
    assert seen["checked"] > 0
    ServiceWriter("x", {"values": ("u1", 1)}).close()


@pytest.mark.thorough
def test_a_killed_c_reader_is_nothing_to_the_writer(program: Path) -> None:
    stop = PROCESSES.Event()
    with running(write_flat_out, 3, 40, stop) as process:
        wait_for_service(process)
        for _ in range(3):
            with ended(Talk([str(program), "flood", "x", "0", "view"]), signal.SIGKILL) as flood:
                flood.process.kill()
        wait_for_service(process)
        stop.set()
        process.join(30)
