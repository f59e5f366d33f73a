"""The shared-memory format: what docs/reference/shared-memory.md says is what the code does."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from skinware import DriverWriter, Namespace, PatchState, ServiceReader, ServiceWriter
from skinware.errors import ConfigurationError
from skinware.geometry import Geometry
from skinware.memory import file_layout
from skinware.sensor_types import CATALOGUE
from skinware.structure import _COLUMNS, VALUE_DTYPES
from tests.core.test_update_groups import grouped

DOCUMENT = (Path(__file__).parents[2] / "docs" / "reference" / "shared-memory.md").read_text()


def tables(heading: str) -> list[list[list[str]]]:
    """The tables below a heading, as rows of cells."""
    sections = re.split(r"^#+ (.+)$", DOCUMENT, flags=re.M)
    section = sections[sections.index(heading) + 1]
    found: list[list[list[str]]] = [[]]
    for line in section.splitlines():
        if line.startswith("|"):
            found[-1].append([cell.strip().replace("`", "") for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
        elif found[-1]:
            found.append([])
    return [table[2:] for table in found if table]


def documented(heading: str, start: int) -> dict[str, tuple[np.dtype[Any], int]]:
    (rows, *_) = tables(heading)
    return {name: (np.dtype(_code(code)), int(offset) - start) for offset, code, name, _ in rows}


def _code(code: str) -> str:
    array = re.fullmatch(r"(\w+)\[(\d+)\]", code)
    return f"({array[2]},){array[1]}" if array else code


@pytest.mark.parametrize(
    ("heading", "dtype", "start"),
    [
        ("Header", file_layout.HEADER, 0),
        ("Control words", file_layout.CONTROL, file_layout.CONTROL_OFFSET),
        ("Statistics", file_layout.STATISTICS, file_layout.STATISTICS_OFFSET),
        ("Column table", file_layout.COLUMN, 0),
        ("Slots", file_layout.SLOT, 0),
    ],
)
def test_every_field_is_where_the_document_says(heading: str, dtype: np.dtype[Any], start: int) -> None:
    assert dtype.fields is not None
    assert documented(heading, start) == {name: (field[0], field[1]) for name, field in dtype.fields.items()}


def test_the_parts_of_a_file_and_the_limits_are_as_documented() -> None:
    rows = tables("Layout of a file")[0]
    assert [(row[0], row[1]) for row in rows[:4]] == [
        ("0", str(file_layout.HEADER.itemsize)),
        (str(file_layout.CONTROL_OFFSET), str(file_layout.CONTROL.itemsize)),
        (str(file_layout.STATISTICS_OFFSET), str(file_layout.STATISTICS.itemsize)),
        (str(file_layout.COLUMN_OFFSET), f"{file_layout.COLUMN.itemsize} each"),
    ]
    assert f"version **{file_layout.VERSION[0]}.{file_layout.VERSION[1]}**" in DOCUMENT
    header = {row[2]: row[3] for row in tables("Header")[0]}
    assert header["magic"] == file_layout.MAGIC.decode()
    assert header["version_major"] == str(file_layout.VERSION[0])
    assert header["version_minor"] == str(file_layout.VERSION[1])
    assert header["file_size"].endswith(f"2**{file_layout.MAX_FILE_SIZE.bit_length() - 1}")
    assert header["column_count"].endswith(f"at most {file_layout.MAX_COLUMNS}")
    assert header["slot_count"] == f"{file_layout.MIN_SLOTS} to {file_layout.MAX_SLOTS}"
    bits = {name: int(bit) for bit, name, _ in tables("Control words")[1]}
    assert bits == {
        "PAUSED": file_layout.STATE_PAUSED,
        "SUPERSEDED": file_layout.STATE_SUPERSEDED,
        "CLOSED": file_layout.STATE_CLOSED,
    }


def test_a_real_driver_has_the_documented_tables_and_columns() -> None:
    static, columns, *_ = tables("Drivers")
    made = grouped()
    places = Geometry.unknown(["pressure"] * made.n_sensors, made.sensor_uid)
    with DriverWriter("x", made.placed(places), bus_counters=["dropped"], patch_counters=["cycles", "late"]):
        with ServiceReader[Any]("x") as reader:
            layout = reader._ring.segment.layout
    assert {row[0]: np.dtype(row[1]) for row in static} == {c.name: c.dtype for c in layout.static}
    assert [(row[0], np.dtype(row[1])) for row in static[: len(_COLUMNS)]] == [
        (name, np.dtype(code)) for name, code in _COLUMNS
    ]
    told = {name: code for name, code, *_ in columns}
    assert [np.dtype(code) for code in told.pop("values").split()] == list(VALUE_DTYPES)
    assert {name: np.dtype(code) for name, code in told.items()} == {
        c.name: c.dtype for c in layout.slot if c.name != "values"
    }


def test_numbers_that_files_have_never_change() -> None:
    assert [(state.value, state.name) for state in PatchState] == [
        *enumerate(("EXPECTED", "LIVE", "STALE", "RESTARTED"))
    ]
    axes = [f"{name}_{axis}" for name in ("acceleration", "angular_rate", "magnetic_field", "force") for axis in "xyz"]
    names = ["pressure", "shear_x", "shear_y", "proximity", "temperature", *axes]
    assert [(t.id, t.name) for t in CATALOGUE.values()] == list(enumerate(names, 1))


# -- what the format cannot hold is refused by the writer ---------------------------------------------------------


@pytest.mark.parametrize("name", ["", "x" * 25, "höhe", "a\0b", "a\n"])
def test_column_names_that_readers_would_refuse_are_refused(name: str, namespace: Namespace) -> None:
    with pytest.raises(ConfigurationError, match="printable ASCII"):
        ServiceWriter("x", {name: ("u1", 1)})
    assert namespace.services() == []


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"t": np.zeros((2, 3))}, "one dimension"),
        ({"t": np.float32(1)}, "one dimension"),
        ({"schema": np.zeros(3)}, "is taken"),
        ({"t": np.array(["text"])}, "fixed-length bytes"),
    ],
)
def test_tables_that_the_format_cannot_hold_are_refused(table: dict[str, npt.NDArray[Any]], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        ServiceWriter("x", {"values": ("u1", 1)}, table)


def test_a_kind_that_is_too_long_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="at most 16 bytes"):
        ServiceWriter("x", {"values": ("u1", 1)}, kind="k" * 17)
