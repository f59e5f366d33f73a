"""Arbitrary services: any numbers, shapes and structures, described by the service itself."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from skinware import Column, Namespace, Sample, ServiceReader, ServiceWriter
from skinware.errors import BadServiceFile, ConfigurationError
from skinware.memory.file_layout import plan
from skinware.memory.schema import STATIC_NAME, Schema, from_file
from skinware.service import Columns

POSE = np.dtype([("position", "<f8", (3,)), ("quaternion", "<f4", (4,)), ("valid", "u1")])


def test_structures_and_shapes_come_out_as_they_went_in() -> None:
    columns: Columns = {
        "poses": Column(POSE, (2,), description="of both hands, in the robot's base frame"),
        "force": Column(np.dtype("<f4"), (3,), unit="N"),
        "image": ("u1", (4, 5)),
        "count": ("<u8", 1),
    }
    with ServiceWriter("hands", columns, description="where the hands are") as writer:
        frame = writer.begin()
        frame["poses"]["position"] = [[1, 2, 3], [4, 5, 6]]
        frame["poses"][1]["valid"] = 1
        frame["force"][:] = [0.5, 1.5, 2.5]
        frame["image"][2, 3] = 7
        frame["count"][0] = 1 << 60
        writer.commit(1)
        with ServiceReader[Sample]("hands") as reader:
            got = reader.read()
            assert got.column("poses").dtype == POSE
            assert got.column("poses")["position"].tolist() == [[1, 2, 3], [4, 5, 6]]
            assert got.column("poses")["valid"].tolist() == [0, 1]
            assert got.column("force").tolist() == [0.5, 1.5, 2.5]
            assert got.column("image").shape == (4, 5)
            assert got.column("image")[2, 3] == 7
            assert got.column("count").tolist() == [1 << 60]
            schema = reader.schema
            with reader.view() as view:
                assert view.column("poses")["position"][1, 2] == 6
                assert view.valid
    assert schema.description == "where the hands are"
    assert schema.columns["force"] == Column(np.dtype("<f4"), (3,), unit="N")
    assert schema.columns["poses"].description == "of both hands, in the robot's base frame"
    assert schema.columns["count"].shape == (1,)


def test_a_plain_service_describes_itself_too() -> None:
    with ServiceWriter("x", {"values": ("<u2", 7)}), ServiceReader[Sample]("x") as reader:
        assert STATIC_NAME not in reader.static()
        assert reader.schema == Schema({"values": Column(np.dtype("<u2"), (7,))})


def test_tables_of_structures_keep_their_dtype() -> None:
    poses = np.zeros(3, POSE)
    poses["valid"] = 1, 0, 1
    numbers = np.arange(5, dtype="<i4")
    with ServiceWriter("x", {"values": ("<u2", 7)}, static={"poses": poses, "numbers": numbers}) as writer:
        with ServiceReader[Sample]("x") as reader:
            assert reader.static()["poses"].dtype == POSE
            assert reader.static()["poses"]["valid"].tolist() == [1, 0, 1]
            assert reader.static()["numbers"].tolist() == [0, 1, 2, 3, 4]
            assert reader.schema.tables == {"poses": POSE}
            writer.restructure({"values": ("<u2", 7)}, static={"poses": poses[:1]})
            reader.reattach()
            assert (reader.static()["poses"] == poses[:1]).all()


@pytest.mark.parametrize("descr", ["<u8", [["a", "<u2"]], "O", "nonsense", [["a", "|O", [2]]]])
def test_a_schema_that_contradicts_a_table_is_refused(descr: object) -> None:
    layout = plan({"poses": np.zeros(2, POSE), "schema": np.zeros(4, np.uint8)}, {})
    text = msgspec.json.encode({"columns": {}, "tables": {"poses": descr}})
    with pytest.raises(BadServiceFile, match="schema"):
        from_file(layout, {STATIC_NAME: np.frombuffer(text, np.uint8)}, "x.ring")


plain = st.one_of(
    hnp.integer_dtypes(endianness="<"),
    hnp.unsigned_integer_dtypes(endianness="<"),
    hnp.floating_dtypes(endianness="<", sizes=(16, 32, 64)),
    hnp.byte_string_dtypes(min_len=1),
)
structures = hnp.nested_dtypes(plain, max_itemsize=200)


@pytest.mark.thorough
@settings(max_examples=100, deadline=None)
@given(dtype=structures, shape=hnp.array_shapes(min_dims=0, max_dims=3, max_side=4), data=st.data())
def test_any_structure_and_shape(dtype: np.dtype[np.void], shape: tuple[int, ...], data: st.DataObject) -> None:
    while dtype.subdtype is not None:  # an array dtype is a shape
        dtype, more = dtype.subdtype
        shape += more
    content = data.draw(hnp.arrays(dtype, shape))
    with ServiceWriter("x", {"a": (dtype, shape), "end": ("u1", 1)}) as writer, ServiceReader[Sample]("x") as reader:
        columns = writer.begin()
        columns["a"][...] = content
        columns["end"][:] = 77
        writer.commit(1)
        got = reader.read()
        assert reader.schema.columns["a"] == Column(dtype, shape)
        assert got.column("a").dtype == dtype
        assert got.column("a").shape == shape
        assert got.column("a").tobytes() == np.ascontiguousarray(columns["a"]).tobytes()
        assert got.column("end")[0] == 77


@pytest.mark.parametrize(
    ("column", "words"),
    [
        ((object, 3), "Python objects cannot be shared"),
        (([("a", "u1"), ("b", "O")], 3), "Python objects cannot be shared"),
        (("u1", (3, -1)), "from 0 on"),
        (("V0", 3), "give numbers"),
        ((">u4", 3), "little-endian"),
        (("<U5", 3), "fixed-length bytes"),
        (("<c8", 3), "integers, floats"),
        (Column(np.dtype("u1"), (1,), description="x" * 70_000), "shorten its texts"),
    ],
)
def test_what_cannot_be_shared_is_refused(column: object, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        ServiceWriter("x", {"a": column})  # type: ignore[dict-item]


def test_a_schema_that_contradicts_the_file_is_refused(namespace: Namespace) -> None:
    with ServiceWriter("x", {"a": Column(POSE, (2, 3), description="room for what is written over it")}):
        data = namespace.ring_path("x").read_bytes()
    at, end = data.index(b'{"description"'), data.index(b'"tables":{}}') + len('"tables":{}}')
    text = json.loads(data[at:end])
    column = text["columns"]["a"]
    column["description"] = ""

    def refused(words: str) -> None:
        wrong = json.dumps(text, separators=(",", ":")).encode()
        assert len(wrong) <= end - at, "the test's own text must fit"
        namespace.ring_path("x").write_bytes(data[:at] + wrong.ljust(end - at) + data[end:])
        with pytest.raises(BadServiceFile, match=words):
            ServiceReader[Sample]("x")

    try:
        for field, value, words in [
            ("shape", [2, 4], "contradicts its column table at 'a'"),
            ("shape", [-2, -3], "contradicts"),
            ("shape", "no", "cannot be read"),
            ("dtype", "|O", "contradicts|cannot be read"),
            ("dtype", "nonsense", "cannot be read"),
            ("dtype", [["a"]], "cannot be read"),
            ("dtype", {"a": 1}, "cannot be read"),
        ]:
            before, column[field] = column[field], value
            refused(words)
            column[field] = before
        text["columns"] = {"b": column}
        refused("contradicts its column table at 'b'")
        text["columns"] = 5
        refused("cannot be read")
    finally:
        namespace.ring_path("x").unlink(missing_ok=True)


def test_part_of_a_frame_can_be_changed() -> None:
    """A writer that begins from the last frame changes what it wants and keeps the rest."""
    with ServiceWriter("x", {"a": ("<i8", 3), "b": ("u1", 2)}, slots=3) as writer, ServiceReader[Sample]("x") as reader:
        columns = writer.begin(from_last=True)  # there is none yet
        columns["a"][:], columns["b"][:] = [1, 2, 3], [4, 5]
        writer.commit(1)
        for number in range(10):
            writer.begin(from_last=True)["a"][number % 3] = 100 + number
            writer.commit(2 + number)
            got = reader.read()
            assert got.column("b").tolist() == [4, 5]
            assert got.column("a")[number % 3] == 100 + number
        assert reader.read().column("a").tolist() == [109, 107, 108]
        assert reader.read().acquired_ns == 11


def test_a_schema_that_is_too_long_is_not_read() -> None:
    layout = plan({}, {"values": ("u1", 1)})
    text = np.frombuffer(b'{"columns": {}}'.ljust((1 << 16) + 1), np.uint8)
    with pytest.raises(BadServiceFile, match="a schema of 65537 bytes; at most 65536"):
        from_file(layout, {"schema": text}, "x.ring")
    assert from_file(layout, {"schema": text[:-1]}, "x.ring").columns["values"].shape == (1,)
