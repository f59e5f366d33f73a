"""Files that are wrong when they are attached are refused with a clear error, and never mapped out of range."""

from __future__ import annotations

import contextlib
import os
import random
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skinware import Namespace, Sample, ServiceReader, ServiceWriter
from skinware.driver_service import DriverReader, DriverWriter
from skinware.errors import (
    BadServiceFile,
    NamespaceError,
    Overrun,
    ServiceNotFound,
    ServiceTimeout,
    SkinwareError,
)
from skinware.memory import file_layout
from skinware.memory.schema import STATIC_NAME, from_file
from skinware.service import Column
from skinware.structure import Structure
from tests.core.test_structure import tables

FUZZ = settings(
    max_examples=int(os.environ.get("SKINWARE_TEST_EXAMPLES") or 400),
    deadline=None,
    database=None,
    print_blob=True,
    suppress_health_check=list(HealthCheck),
)


def ring_file(namespace: Namespace) -> bytes:
    with ServiceWriter("x", {"values": ("<u8", 512)}, {"table": np.arange(5, dtype="<u4")}):
        return namespace.ring_path("x").read_bytes()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: d[:100], "shorter than a header"),
        (lambda d: d[:-4096], "truncated"),
        (lambda d: b"NOTARING" + d[8:], "wrong magic"),
        (lambda d: d[:8] + b"\x09\0\0\0" + d[12:], "layout version 9"),
        (lambda d: d[:44] + b"\xff\xff\0\0" + d[48:], "make no ring"),
        (lambda d: d[:40] + b"\xff\xff\0\0" + d[44:], "columns do not fit"),
        (lambda d: d[: 1152 + 32] + b"\xff" * 8 + d[1152 + 40 :], "column"),
    ],
)
def test_damaged_files_are_refused(namespace: Namespace, damage: Callable[[bytes], bytes], words: str) -> None:
    data = damage(ring_file(namespace))
    namespace.ring_path("x").write_bytes(data)
    with pytest.raises(BadServiceFile, match=words):
        ServiceReader[Sample]("x")
    namespace.ring_path("x").unlink()


def forged(namespace: Namespace, offset: int, form: str, value: int) -> None:
    """The file of a dead writer that published once, with one number changed."""
    namespace.create()
    with ServiceWriter("x", {"values": ("<u8", 512)}) as writer:
        writer.begin()["values"][:] = 7
        writer.commit(1)
        data = bytearray(namespace.ring_path("x").read_bytes())
    struct.pack_into(form, data, offset, value)
    namespace.ring_path("x").write_bytes(data)


ABSURD = {
    "latest": (512, "<Q", 2**64 - 1),
    "published_before": (192, "<Q", 2**64 - 1),
    "generation": (24, "<Q", 2**64 - 1),
    "period": (88, "<q", -(2**63)),
    "pid": (64, "<Q", 2**64 - 1),
}


@pytest.mark.parametrize("field", ABSURD)
def test_a_forged_predecessor_stops_no_writer(namespace: Namespace, field: str) -> None:
    forged(namespace, *ABSURD[field])
    with ServiceWriter("x", {"values": ("<u8", 512)}) as writer, ServiceReader[Sample]("x") as reader:
        writer.begin()["values"][:] = 8
        writer.commit(2)
        frame = reader.read()
        assert (frame.column("values")[0], frame.stale) == (8, False)
        assert reader._ring.segment.published_before < 2


def test_a_forged_count_beside_the_lock_is_not_believed(namespace: Namespace) -> None:
    with ServiceWriter("x", {"values": ("<u8", 512)}):
        pass
    namespace.lock_path("x").write_bytes(b"\xff" * 8)
    with ServiceWriter("x", {"values": ("<u8", 512)}), ServiceReader[Sample]("x") as reader:
        assert reader._ring.segment.published_before == 0


def test_a_dead_writer_was_not_too_fast(namespace: Namespace, program: Path) -> None:
    forged(namespace, *ABSURD["latest"])
    with ServiceReader[Sample]("x") as reader:
        with pytest.raises(Overrun, match="its writer is dead, and its newest sample is not whole"):
            reader.read()
        with pytest.raises(Overrun, match="its writer is dead, and its newest sample is not whole"), reader.view():
            pass
    result = subprocess.run([program, "describe", "x"], capture_output=True, text=True, timeout=60)
    assert "its writer is dead" in result.stdout + result.stderr
    namespace.ring_path("x").unlink()


WITHOUT_DESCRIPTORS = """
import os, resource
from skinware import ServiceReader, Skin
resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
held = []
while True:
    try:
        held.append(os.open("/dev/null", os.O_RDONLY))
    except OSError:
        break
for free in range(8):
    for kind in (lambda: ServiceReader("x"), Skin):
        try:
            with kind() as reader:
                reader.read(timeout_s=0)
                print("read")
        except Exception as error:
            print(type(error).__name__, error)
    os.close(held.pop())
"""


@pytest.mark.thorough
def test_a_program_without_descriptors_is_not_given_the_file_to_blame() -> None:
    with DriverWriter("x", Structure(**tables()), driver_type="test", bus_counters=["n"]) as writer:
        writer.begin()
        writer.commit(1)
        result = subprocess.run([sys.executable, "-c", WITHOUT_DESCRIPTORS], capture_output=True, text=True, timeout=60)
    lines = result.stdout.splitlines()
    assert lines[-2:] == ["read", "read"], result.stderr
    assert "no more file descriptors" in lines[0]
    for line in lines:
        assert line == "read" or line.startswith(("NamespaceError", "ServiceTimeout no driver can be read")), line


def test_symlinks_fifos_and_foreign_files_are_refused(namespace: Namespace) -> None:
    data, path = ring_file(namespace), namespace.ring_path("x")
    path.symlink_to("/etc/passwd")
    with pytest.raises(BadServiceFile, match="cannot be opened"):
        ServiceReader[Sample]("x")
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(BadServiceFile, match="not a regular file"):
        ServiceReader[Sample]("x")
    path.unlink()
    if os.geteuid() == 0:
        path.write_bytes(data)
        os.chown(path, 12345, -1)
        with pytest.raises(BadServiceFile, match="owned by uid 12345"):
            ServiceReader[Sample]("x")
        path.unlink()


def test_a_folder_that_cannot_be_trusted_is_refused(namespace: Namespace) -> None:
    for place, words in ((namespace, "a driver"), (Namespace(f"{namespace.name}-calm"), "skin-calm")):
        with pytest.raises(ServiceNotFound, match=f"nor another; start {words}"):
            ServiceReader[Sample]("x", namespace=place)
    namespace.create()
    namespace.path.chmod(0o2777)
    with pytest.raises(NamespaceError, match="written by others"):
        ServiceReader[Sample]("x")
    if os.geteuid() == 0:
        namespace.path.chmod(0o2750)
        os.chown(namespace.path, 12345, -1)
        with pytest.raises(NamespaceError, match="SKINWARE_OWNER"):
            ServiceReader[Sample]("x")
        with pytest.raises(ServiceNotFound):
            ServiceReader[Sample]("x", namespace=Namespace(owner=12345))


# -- anything may be wrong ---------------------------------------------------------------------------------------


def attempt(namespace: Namespace, data: bytes) -> bool:
    """Attach whatever this is and touch everything in it; False if it was refused."""
    path = namespace.ring_path("x")
    path.write_bytes(data)
    try:
        for reader_class in (ServiceReader[Sample], DriverReader):
            try:
                reader = reader_class("x")
            except BadServiceFile:
                if reader_class is not DriverReader:
                    return False
                continue
            with reader:
                touch(reader)
    finally:
        path.unlink()
    return True


def touch(reader: ServiceReader[Sample] | DriverReader) -> None:
    size = len(reader._ring.segment.data)
    layout = reader._ring.segment.layout
    for array in reader.static().values():
        array.tobytes()
    assert layout.slot_offset + layout.slot_count * layout.slot_stride <= size
    takes: tuple[Callable[[], Sample], ...] = (
        partial(reader.read, timeout_s=0),
        partial(next, reader.in_order(timeout_s=0)),
    )
    for take in takes:
        try:
            frame = take()
        except (ServiceTimeout, Overrun):
            continue
        for name in reader.schema.columns:
            frame.column(name).tobytes()
    assert reader.rate_hz() is None or reader.writer_statistics.published >= 0
    assert isinstance(reader.kind, str)
    repr(reader)


class Files(dict[str, bytes]):
    """Contents of service files by kind."""

    def __repr__(self) -> str:
        return f"<{', '.join(self)}>"


@pytest.fixture(scope="module")
def services() -> Files:
    """The bytes of a plain service, of one with a schema, and of a driver, each with frames."""
    place = Namespace(f"files-{os.getpid()}")
    structured = Column(np.dtype([("a", "<f4", (3,)), ("b", "<u2")]), (2, 3), "m", "a test")
    found = Files()
    for kind, columns in (("plain", {"values": ("<u4", 5)}), ("schema", {"values": structured})):
        with ServiceWriter("x", columns, {"table": np.arange(5, dtype="<u4")}, namespace=place, slots=3) as writer:
            for _ in range(4):
                writer.begin()
                writer.commit(1)
            found[kind] = place.ring_path("x").read_bytes()
    with DriverWriter(
        "x", Structure(**tables()), driver_type="test", bus_counters=["n"], namespace=place, slots=3
    ) as driver:
        driver.begin()
        driver.commit(1)
        found["driver"] = place.ring_path("x").read_bytes()
    place.lock_path("x").unlink()
    place.readers_path.rmdir()
    place.path.rmdir()
    return found


@pytest.mark.parametrize("kind", ["plain", "schema", "driver"])
def test_the_undamaged_files_are_attached(services: Files, kind: str, namespace: Namespace) -> None:
    namespace.create()
    assert attempt(namespace, services[kind])


@pytest.mark.thorough
@FUZZ
@given(data=st.data())
def test_changed_bytes_never_do_harm(services: Files, data: st.DataObject) -> None:
    namespace = Namespace()
    namespace.create()
    damaged = bytearray(services[data.draw(st.sampled_from(sorted(services)))])
    head = file_layout.COLUMN_OFFSET + 30 * file_layout.COLUMN.itemsize
    for _ in range(data.draw(st.integers(1, 3))):
        offset = data.draw(st.integers(0, min(head, len(damaged)) - 1) | st.integers(0, len(damaged) - 1))
        if data.draw(st.booleans()):
            damaged[offset] ^= 1 << data.draw(st.integers(0, 7))
        else:
            width = data.draw(st.sampled_from([1, 2, 4, 8]))
            value = data.draw(st.integers(0, 256**width - 1)).to_bytes(width, "little")
            damaged[offset // width * width : offset // width * width + width] = value
    attempt(namespace, bytes(damaged))


@pytest.mark.thorough
@FUZZ
@given(
    kind=st.sampled_from(["plain", "schema", "driver"]),
    changes=st.lists(
        st.tuples(
            st.sampled_from(["header", "columns", "control"]),
            st.integers(0, 1000),
            st.integers(-4096, 4096) | st.integers(-(2**63), 2**64),
            st.booleans(),
        ),
        min_size=1,
        max_size=3,
    ),
)
def test_changed_fields_never_do_harm(services: Files, kind: str, changes: list[tuple[str, int, int, bool]]) -> None:
    """Sizes, counts and offsets that are absurd, or off by little."""
    namespace = Namespace()
    namespace.create()
    damaged = bytearray(services[kind])
    header = np.frombuffer(damaged, file_layout.HEADER, 1)
    parts = {
        "header": header,
        "columns": np.frombuffer(
            damaged, file_layout.COLUMN, int(header["column_count"][0]), file_layout.COLUMN_OFFSET
        ),
        "control": np.frombuffer(damaged, file_layout.CONTROL, 1, file_layout.CONTROL_OFFSET),
    }
    for part, which, value, relative in changes:
        rows = parts[part]
        names = [name for name in rows.dtype.names or () if rows.dtype[name].kind in "ui"]
        name, index = names[which % len(names)], which // len(names) % len(rows)
        limits = np.iinfo(rows.dtype[name])
        wanted = value + int(rows[name][index]) if relative else value
        rows[name][index] = min(max(wanted, int(limits.min)), int(limits.max))
    attempt(namespace, bytes(damaged))


@pytest.mark.thorough
@FUZZ
@given(data=st.data())
def test_any_length_is_refused(services: Files, data: st.DataObject) -> None:
    namespace = Namespace()
    namespace.create()
    whole = services[data.draw(st.sampled_from(sorted(services)))]
    length = data.draw(st.integers(0, len(whole) - 1) | st.integers(len(whole) + 1, len(whole) + 8192))
    assert not attempt(namespace, whole[:length].ljust(length, b"\0"))


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # numpy's, about old names of dtypes
@FUZZ
@given(
    text=st.binary(max_size=300)
    | st.recursive(
        st.none() | st.booleans() | st.integers() | st.sampled_from(["<f4", "<u2", "|V20", "O", "(2", "a5", "b", ""]),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["dtype", "shape", "x"]), inner),
    ).map(lambda dtype: msgspec.json.encode({"columns": {"values": {"dtype": dtype, "shape": [5]}}, "description": ""}))
)
def test_no_schema_does_harm(text: bytes) -> None:
    layout = file_layout.plan({}, {"values": ("<u4", 5)})
    try:
        schema = from_file(layout, {STATIC_NAME: np.frombuffer(text, np.uint8)}, "x.ring")
    except BadServiceFile:
        return
    values = schema.columns["values"]
    assert values.dtype.itemsize * np.prod(values.shape) == 20


def test_an_owner_that_scribbles_over_its_file_gives_readers_errors_of_ours(namespace: Namespace) -> None:
    """Only the size of the file stays: all else changes between the looks of a reader that has attached."""
    generator = random.Random(7)
    with ServiceWriter("x", {"values": ("<u8", 512)}, {"table": np.arange(5, dtype="<u4")}) as writer:
        writer.begin()
        writer.commit(1)
        with ServiceReader[Sample]("x") as reader, open(namespace.ring_path("x"), "r+b", buffering=0) as file:
            size = os.fstat(file.fileno()).st_size
            for _ in range(300):
                offset = generator.choice([0, 512, 1152, generator.randrange(size)])
                os.pwrite(file.fileno(), generator.randbytes(min(640, size - offset)), offset)
                for take in (
                    partial(reader.read, timeout_s=0),
                    partial(reader.read, newer_than=(0, 0), timeout_s=0.001),
                    partial(next, reader.in_order(timeout_s=0)),
                    partial(next, reader.samples(timeout_s=0)),
                    reader.refresh,
                ):
                    with contextlib.suppress(SkinwareError):
                        take()
                assert reader.statistics.missed >= 0
                assert reader.rate_hz() is None or reader.writer_statistics.published >= 0
