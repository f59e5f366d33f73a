"""Geometry files: read what was written, and refuse what is wrong with a clear word."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import Structure
from skinware.errors import ConfigurationError, StructureError
from skinware.geometry import Geometry, GeometryGroup, geometry_of, geometry_to_toml, read_geometry
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.toml_text import TomlText

HEAD = 'format = "skinware-geometry"\nversion = 1\n'
GROUP = """
[[group]]
type = "pressure"
frame = "chest"
uid = [0x70500, 7]
position_m = [[0.1, 0.2, 0.3], [1, 0, 0]]
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_what_was_written_is_read(tmp_path: Path) -> None:
    groups = [
        GeometryGroup(
            "pressure", "chest", (5, 1 << 40), ((0.1, 0.2, 0.3), (-1e-9, 0, 2)), ((0, 0, 1), (0.6, 0.8, 0)), 0.002
        ),
        GeometryGroup("temperature", 'a "frame"\n', (5,), ((1, 2, 3),), name="x\x7f\\"),
    ]
    text = geometry_to_toml(groups, "made by a test\n\nindeed")
    geometry = read_geometry(written(tmp_path / "g.toml", text))
    assert text.startswith("# made by a test\n#\n# indeed\nformat")
    assert geometry.type_name.tolist() == ["pressure", "pressure", "temperature"]
    assert geometry.uid.tolist() == [5, 1 << 40, 5]
    assert geometry.frame.tolist() == ["chest", "chest", 'a "frame"\n']
    assert geometry.position_m.tolist() == [[0.1, 0.2, 0.3], [-1e-9, 0, 2], [1, 2, 3]]
    assert np.allclose(geometry.normal[:2], np.array([[0, 0, 1], [0.6, 0.8, 0]]))
    assert np.isnan(geometry.normal[2]).all()
    assert geometry.radius_m[:2].tolist() == [0.002, 0.002]
    assert np.isnan(geometry.radius_m[2])
    assert len(geometry) == 3
    assert geometry.known.all()


def test_places_come_in_the_order_of_a_skin(tmp_path: Path) -> None:
    structure = Structure(
        types=(PRESSURE, TEMPERATURE),
        buses=["can0"],
        patch_name=[b"p"],
        patch_bus=[0],
        module_patch=[0],
        module_kind=[b""],
        sensor_uid=[7, 8, 0x70500, 7],
        sensor_type=[1, 1, 1, 5],
        sensor_module=[0] * 4,
        dtype=np.uint8,
    )
    geometry = read_geometry(written(tmp_path / "g.toml", HEAD + GROUP))
    pressure = geometry.of(structure, "pressure")
    assert pressure.uid.tolist() == [7, 8, 0x70500]
    assert pressure.known.tolist() == [True, False, True]
    assert pressure.position_m[[0, 2]].tolist() == [[1, 0, 0], [0.1, 0.2, 0.3]]
    assert pressure.frame.tolist() == ["chest", "", "chest"]
    assert not geometry.of(structure, "temperature").known.any()
    with pytest.raises(StructureError, match="no sensor type 'shear_x'"):
        geometry.of(structure, "shear_x")


def test_a_normal_that_nobody_knows_leaves_the_place(tmp_path: Path) -> None:
    group = GeometryGroup("pressure", "f", (1, 2), ((1, 0, 0), (2, 0, 0)), ((float("nan"),) * 3, (0, 0, 1)))
    geometry = read_geometry(written(tmp_path / "g.toml", geometry_to_toml([group])))
    assert geometry.known.all()
    assert np.isnan(geometry.normal[0]).all()
    assert geometry.normal[1].tolist() == [0, 0, 1]
    for normal in ("[nan, 0, 1]", "[inf, 0, 0]"):
        with pytest.raises(ConfigurationError, match="normal: a number is not finite"):
            read_geometry(written(tmp_path / "g.toml", f"{HEAD}{GROUP}normal = [{normal}, [0, 0, 1]]\n"))


def test_normals_of_few_digits_get_the_length_1(tmp_path: Path) -> None:
    text = HEAD + GROUP + "normal = [[0.71, 0.71, 0], [0, 0, 0.99]]\n"
    geometry = read_geometry(written(tmp_path / "g.toml", text))
    assert np.allclose(np.linalg.norm(geometry.normal, axis=1), 1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = ", "not TOML"),
        ("", 'it does not say format = "skinware-geometry"'),
        ('format = "skinware-geometry"\nversion = 2', "version 2, this Skinware reads version 1"),
        (HEAD + "colour = 3", "unknown field colour"),
        (HEAD + GROUP + "color = 3", "unknown field color - at $.group[0]"),
        (HEAD + GROUP.replace('type = "pressure"', ""), "missing required field type - at $.group[0]"),
        (HEAD + GROUP.replace("[0.1, 0.2, 0.3]", "[0.1, 0.2]"), "length 3"),
        (HEAD + GROUP.replace("0.1,", "nan,"), "position_m: a number is not finite - at $.group[0]"),
        (HEAD + GROUP.replace("[0x70500, 7]", "[7]"), "1 uid, but 2 position_m - at $.group[0]"),
        (HEAD + GROUP.replace("[0x70500, 7]", "[7, 7]"), "group 1: pressure sensor 0x7 is also in group 1"),
        (HEAD + GROUP + GROUP, "group 2: pressure sensor 0x70500 is also in group 1"),
        (HEAD + GROUP.replace("0x70500", "-1"), "uid[0]"),
        (HEAD + GROUP.replace("0x70500", "0x1_0000_0000_0000_0000"), "more than 64 bits"),
        (HEAD + GROUP + "normal = [[0, 0, 1], [0, 0, 2]]", "normal 1 has the length 2, not 1"),
        (HEAD + GROUP + "normal = [[0, 0, 1]]", "2 uid, but 1 normal"),
        (HEAD + GROUP + "radius_m = 0.0", "radius_m"),
        (HEAD + GROUP + "confidence = 1.1", "confidence"),
        (HEAD + GROUP + "confidence = -0.1", "confidence"),
        (HEAD + "group = 3", "group"),
        ("a = " + "[" * 5000, "not TOML"),
        (HEAD + GROUP.replace("chest", "c" * 65), "is longer than 64 bytes - at $.group[0]"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, words: str) -> None:
    path = written(tmp_path / "g.toml", text)
    with pytest.raises(ConfigurationError) as caught:
        read_geometry(path)
    assert re.match(rf"{re.escape(str(path))}(:\d+)?: ", str(caught.value))
    assert words.lower() in str(caught.value).lower()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("\nx = ", 2),
        (HEAD + "colour = 3", 1),
        ('format = "skinware-geometry"\nversion = 2', 2),
        (HEAD + GROUP.replace("0x70500", "-1"), 7),
        (HEAD + GROUP + GROUP.replace("chest", "arm"), 13),
        (HEAD + GROUP.replace("[1, 0, 0]]", "\n[1, nan, 0]]"), 4),
        (HEAD + GROUP + "normal = 5", 9),
    ],
)
def test_the_line_of_a_mistake_is_said(tmp_path: Path, text: str, line: int) -> None:
    path = written(tmp_path / "g.toml", text)
    with pytest.raises(ConfigurationError, match=rf"^{re.escape(str(path))}:{line}: "):
        read_geometry(path)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        read_geometry(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigurationError, match="not TOML"):
        read_geometry(tmp_path / "bytes.toml")


odd: st.SearchStrategy[Any] = st.sampled_from(
    [None, True, -1, 0, 2**63, 2**64, 10**400, float("nan"), float("inf"), 1e300, "", "x", [], {}]
)
rows = st.lists(st.lists(odd | st.just(1.0), min_size=2, max_size=4) | odd, max_size=3)
groups = st.fixed_dictionaries(
    {},
    optional={
        "type": odd | st.just("pressure"),
        "frame": odd | st.just("chest"),
        "uid": st.lists(st.integers(0, 3) | odd, max_size=3),
        "position_m": rows | st.just([[1.0, 0.0, 0.0]] * 2),
        "normal": rows | st.just([[1.0, 0.0, 0.0]] * 2),
        "radius_m": odd | st.just(1.0),
        "confidence": odd | st.just(0.5),
        "name": odd,
    },
)


@pytest.mark.thorough
@settings(deadline=None, max_examples=300)
@given(group=groups)
def test_no_data_raises_anything_else(group: dict[str, Any]) -> None:
    text = TomlText(None)
    text.data = {"format": "skinware-geometry", "version": 1, "group": [group]}
    try:
        geometry = geometry_of(text)
    except ConfigurationError as error:
        assert str(error).startswith(f"{text.place(())}: ")  # noqa: PT017
    else:
        assert len(geometry) == len(group["uid"])


def test_groups_of_a_geometry_are_what_is_known_of_it_and_read_the_same(tmp_path: Path) -> None:
    nan = float("nan")
    groups = [
        GeometryGroup("pressure", "arm", (1, 2), ((0, 0, 1), (0, 1, 0)), ((0, 0, 1), (nan, nan, nan)), 0.002),
        GeometryGroup("pressure", "hand", (3,), ((1, 0, 0),)),
        GeometryGroup("pressure", "arm", (4,), ((1, 1, 0),), None, 0.001),
        GeometryGroup("pressure", "arm", (5,), ((1, 2, 0),), None, 0.001, confidence=0.9),
        GeometryGroup("temperature", "arm", (1,), ((0, 0, 2),), ((1, 0, 0),), 0.002),
    ]
    path = tmp_path / "places.toml"
    path.write_text(geometry_to_toml(groups))
    read = read_geometry(path)
    with_unknown = Geometry.joined([read, Geometry.unknown(["pressure"], np.array([9], np.uint64))])
    path.write_text(geometry_to_toml(with_unknown.to_groups()))
    again = read_geometry(path)
    for name in ("type_name", "uid", "frame"):
        assert getattr(again, name).tolist() == getattr(read, name).tolist()
    assert np.isnan(read.confidence).tolist() == [True] * 4 + [False, True]
    assert read.confidence[4] == 0.9
    for name in ("position_m", "normal", "radius_m", "confidence"):
        assert np.array_equal(getattr(again, name), getattr(read, name), equal_nan=True)
    assert Geometry.unknown(["pressure"], np.array([9], np.uint64)).to_groups() == []
