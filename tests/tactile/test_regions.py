"""Regions: files and what is wrong with them, and where their sensors are whatever drivers run."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware import SkinLayout, Structure
from skinware.errors import ConfigurationError, StructureError
from skinware.geometry import Geometry
from skinware.sensor_types import PRESSURE, TEMPERATURE
from skinware.tactile.neighbours import neighbours, without_holes
from skinware.tactile.regions import Box, Region, Regions, put_region, read_regions, regions_to_toml
from tests.tactile.skins import placed, pressed, triangles

HEAD = 'format = "skinware-regions"\nversion = 1\n'


def structure(
    patches: Sequence[str] = ("board 1", "board 2"), first_uid: int = 0, with_places: bool = True
) -> Structure:
    """Of each patch two triangles, of each triangle three taxels and a temperature before them."""
    n_modules = 2 * len(patches)
    uid = first_uid + np.arange(3 * n_modules)
    made = Structure(
        types=(PRESSURE, TEMPERATURE),
        buses=["can0"],
        patch_name=list(patches),
        patch_bus=[0] * len(patches),
        module_patch=np.repeat(np.arange(len(patches)), 2),
        module_kind=["triangle"] * n_modules,
        module_name=["triangle 0", "triangle 1"] * len(patches),
        sensor_uid=np.column_stack([uid[::3], uid.reshape(-1, 3)]).ravel(),
        sensor_type=[TEMPERATURE.id, *[PRESSURE.id] * 3] * n_modules,
        sensor_module=np.repeat(np.arange(n_modules), 4),
        dtype="u1",
    )
    if not with_places:
        return made
    position = np.column_stack([np.arange(len(uid)), 0 * uid, 0 * uid]) * 0.01
    geometry = Geometry.unknown(["pressure"] * len(uid), uid.astype(np.uint64))
    geometry.position_m[:], geometry.frame[:] = position, ["palm"] * 6 + ["arm"] * (len(uid) - 6)
    return made.placed(geometry)


def positions(regions: Regions, skin: SkinLayout | Structure, name: str, type_name: str = "pressure") -> list[int]:
    n = len(skin.uids(type_name)) if isinstance(skin, SkinLayout) else len(skin.module_of(type_name))
    found: list[int] = np.arange(n)[regions.of(skin, type_name)[name]].tolist()
    return found


@pytest.mark.parametrize(
    ("selectors", "expected"),
    [
        ({"patch": ("board 2",)}, [6, 7, 8, 9, 10, 11]),
        ({"module": ("board 1, triangle 1", "board 2, triangle 0")}, [3, 4, 5, 6, 7, 8]),
        ({"uid": (11, 0, 5)}, [0, 5, 11]),
        ({"frame": ("palm",)}, [0, 1, 2, 3, 4, 5]),
        ({"box": (Box("palm", (0.02, 0, 0), (0.021, 1, 1)),)}, [1, 2, 3]),
        ({"box": (Box("palm", (0, 0, 0), (1, 1, 1)), Box("arm", (0.11, 0, 0), (0.001, 1, 1)))}, [*range(6), 11]),
        ({"uid": (9,), "module": ("board 1, triangle 0",)}, [0, 1, 2, 9]),
        ({"uid": (99,), "patch": ("board 7",), "module": ("x",), "frame": ("leg",)}, []),
        ({"driver": ("elsewhere",), "uid": (1,)}, [1]),
    ],
)
def test_what_is_in_a_region(selectors: dict[str, Any], expected: list[int]) -> None:
    assert positions(Regions([Region("it", **selectors)]), structure(), "it") == expected


def test_contiguous_sensors_are_a_slice() -> None:
    found = Regions([Region("a", patch=("board 2",)), Region("b", uid=(1, 5)), Region("c", uid=(77,))]).of(
        structure(), "pressure"
    )
    assert found["a"] == slice(6, 12)
    assert isinstance(found["b"], np.ndarray)
    assert found["b"].dtype == np.int64
    assert found["c"] == slice(0, 0)


def test_unions_and_differences_in_any_order_of_the_file() -> None:
    regions = Regions(
        [
            Region("hand", regions=("palm", "thumb"), without=("dead",)),
            Region("arm", patch=("board 1", "board 2"), without=("hand",)),
            Region("palm", patch=("board 1",)),
            Region("dead", uid=(3, 4)),
            Region("thumb", uid=(4, 8)),
        ]
    )
    assert [region.name for region in regions] == ["hand", "arm", "palm", "dead", "thumb"]
    assert list(regions.of(structure(), "pressure")) == ["hand", "arm", "palm", "dead", "thumb"]
    assert positions(regions, structure(), "hand") == [0, 1, 2, 5, 8]
    assert positions(regions, structure(), "arm") == [3, 4, 6, 7, 9, 10, 11]


def test_a_region_is_of_its_type_or_of_all() -> None:
    regions = Regions([Region("warm", type="temperature", patch=("board 1",)), Region("all", patch=("board 2",))])
    assert list(regions.of(structure(), "pressure")) == ["all"]
    assert positions(regions, structure(), "all", "temperature") == [2, 3]
    assert positions(regions, structure(), "warm", "temperature") == [0, 1]
    with pytest.raises(StructureError, match="no sensor type 'shear_x'"):
        regions.of(structure(), "shear_x")


def test_an_unknown_region_names_those_there_are() -> None:
    found = Regions([Region("palm", uid=(1,)), Region("thumb", uid=(2,))]).of(structure(), "pressure")
    with pytest.raises(ConfigurationError, match="no region 'plam'; there are: palm, thumb"):
        found["plam"]
    assert "plam" not in found
    assert found.get("plam") is None


def test_a_region_is_where_it_was_when_the_skin_changes() -> None:
    """A second driver with the same uid, another order of patches, a driver that is gone."""
    arm, hand = structure(("board 1", "board 2")), structure(("board 2", "board 3"))
    regions = Regions(
        [
            Region("of arm", driver=("arm",), uid=(0, 6)),
            Region("of both", uid=(0,)),
            Region("one board", patch=("board 2 of hand",)),
            Region("boards 2", patch=("board 2",)),
            Region("triangle", module=("board 2 of arm, triangle 1",)),
        ]
    )
    both = SkinLayout(("arm", "hand"), (arm, hand))
    assert positions(regions, both, "of arm") == [0, 6]
    assert positions(regions, both, "of both") == [0, 12]
    assert positions(regions, both, "one board") == [12, 13, 14, 15, 16, 17]
    assert positions(regions, both, "boards 2") == [*range(6, 18)]
    assert positions(regions, both, "triangle") == [9, 10, 11]
    only = SkinLayout(("hand",), (hand,))
    assert positions(regions, only, "of arm") == []
    assert positions(regions, only, "of both") == [0]
    assert positions(regions, only, "boards 2") == [*range(6)]
    other_order = SkinLayout(
        ("arm",),
        (arm.replace(sensor_uid=arm.sensor_uid[::-1].copy(), sensor_type=arm.sensor_type[::-1].copy(), geometry=None),),
    )
    uids = other_order.uids("pressure")
    assert sorted(uids[positions(regions, other_order, "of arm")].tolist()) == [0, 6]


def test_it_is_computed_once_for_a_layout() -> None:
    regions, layout = Regions([Region("a", uid=(1,))]), SkinLayout(("x",), (structure(),))
    found = regions.of(layout, "pressure")
    regions.of(layout, "temperature")
    assert regions.of(layout, "pressure") is found
    assert regions.of(SkinLayout(("x",), (structure(),)), "pressure") is not found


names = st.text(min_size=1, max_size=8)
boxes = st.builds(Box, names, st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(0.001, 2)] * 3))
selections = st.builds(
    Region,
    name=names,
    type=st.sampled_from(["", "pressure"]),
    driver=st.lists(names, max_size=2).map(tuple),
    uid=st.lists(st.integers(0, (1 << 64) - 1), min_size=1, max_size=20).map(tuple),
    patch=st.lists(names, max_size=3).map(tuple),
    module=st.lists(names, max_size=3).map(tuple),
    frame=st.lists(names, max_size=3).map(tuple),
    box=st.lists(boxes, max_size=2).map(tuple),
)


@pytest.mark.thorough
@settings(max_examples=60)
@given(st.lists(selections, unique_by=lambda region: region.name, max_size=4))
def test_what_was_written_is_read(tmp_path_factory: pytest.TempPathFactory, regions: list[Region]) -> None:
    if len(regions) > 2:
        regions[2] = Region(regions[2].name, regions=(regions[0].name,), without=(regions[1].name,))
    path = tmp_path_factory.mktemp("regions") / "regions.toml"
    path.write_text(regions_to_toml(regions, "made by a test\n\nindeed"), encoding="utf-8")
    assert path.read_text(encoding="utf-8").startswith("# made by a test\n#\n# indeed\nformat")
    assert list(read_regions(path)) == regions


BROKEN = [
    ("", 1, "no file of regions"),
    ('format = "skinware-regions"\nversion = 2\n', 2, "version 2, this Skinware reads version 1"),
    (HEAD + '\n[[region]]\nname = "a"\n', 4, "selects nothing"),
    (HEAD + "\n[[region]]\nuid = [1]\n", 4, "missing required field name"),
    (HEAD + '\n[[region]]\nname = "a"\nuid = 1\n', 6, "Expected array, got int"),
    (HEAD + '\n[[region]]\nname = "a"\nuid = [-1]\n', 6, ">= 0"),
    (HEAD + '\n[[region]]\nname = "a"\nuid = [0x10000000000000000]\n', 4, "more than 64 bits"),
    (HEAD + '\n[[region]]\nname = "a"\npatches = ["x"]\n', 4, "unknown field patches"),
    (HEAD + '\n[[region]]\nname = "a"\nuid = [1]\n[[region]]\nname = "a"\nuid = [2]\n', 7, "another region 'a'"),
    (HEAD + '\n[[region]]\nname = "a"\nregions = ["b"]\n', 4, "no region 'b'; there are: a"),
    (HEAD + '\n[[region]]\nname = "a"\nuid = [1]\nwithout = ["b"]\n', 4, "no region 'b'"),
    (HEAD + '\n[[region]]\nname = "a"\nregions = ["a"]\n', 4, "in itself: 'a' in 'a'"),
    (
        HEAD + '[[region]]\nname = "a"\nregions = ["b"]\n[[region]]\nname = "b"\nuid = [1]\nwithout = ["a"]\n',
        None,
        "a region is in itself: ",
    ),
    (
        HEAD + '[[region]]\nname = "a"\ntype = "pressure"\nregions = ["b"]\n'
        '[[region]]\nname = "b"\ntype = "temperature"\nuid = [1]\n',
        3,
        "of pressure sensors, but 'b' of temperature sensors",
    ),
    (
        HEAD + '[[region]]\nname = "a"\nbox = [{ frame = "x", centre_m = [0, 0, 0], size_m = [0, 1, 1] }]\n',
        5,
        "sizes above 0",
    ),
    (
        HEAD + '[[region]]\nname = "a"\nbox = [{ frame = "x", centre_m = [0, nan, 0], size_m = [1, 1, 1] }]\n',
        5,
        "finite",
    ),
    (HEAD + "[[region]\n", 3, "not TOML"),
]


@pytest.mark.parametrize(("text", "line", "why"), BROKEN, ids=[why for _, _, why in BROKEN])
def test_what_is_wrong_with_a_file_is_told_with_its_line(tmp_path: Path, text: str, line: int | None, why: str) -> None:
    path = tmp_path / "regions.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=re.escape(why)) as caught:
        read_regions(path)
    where = re.match(rf"{re.escape(str(path))}:(\d+): ", str(caught.value))
    assert where is not None, str(caught.value)
    assert line is None or int(where[1]) == line


def test_several_files_are_one_set(tmp_path: Path) -> None:
    one, other = tmp_path / "one.toml", tmp_path / "other.toml"
    one.write_text(regions_to_toml([Region("arm", regions=("hand",))]))
    other.write_text(regions_to_toml([Region("hand", uid=(1,))]))
    assert [region.name for region in read_regions(one, other)] == ["arm", "hand"]
    with pytest.raises(ConfigurationError, match=rf"{re.escape(str(one))}:4: .*no region 'hand'"):
        read_regions(one)
    with pytest.raises(ConfigurationError, match=rf"{re.escape(str(one))}:4: there is another region 'arm'"):
        read_regions(other, one, one)
    with pytest.raises(ConfigurationError, match="No such file"):
        read_regions(tmp_path / "none.toml")


WRITTEN = (
    HEAD
    + """
# mine
[[region]]
name = "palm"        # of the left hand
patch = ["board 1"]

[[region]]
name = "box"
[[region.box]]
frame = "x"
centre_m = [0, 0, 0]
size_m = [1, 1, 1]

# the last
[[region]]
name = "rest"
without = ["palm"]
regions = ["box"]
"""
)


@pytest.mark.parametrize("name", ["palm", "box", "rest", "new"])
def test_a_region_is_put_into_a_file_that_people_wrote(tmp_path: Path, name: str) -> None:
    path = tmp_path / "regions.toml"
    path.write_text(WRITTEN)
    before = {region.name: region for region in read_regions(path)}
    put = Region(name, type="pressure", uid=tuple(range(20)))
    put_region(path, put, replace=True)
    after = {region.name: region for region in read_regions(path)}
    assert after == before | {name: put}
    text = path.read_text()
    assert ("# mine" in text, "# the last" in text) == (True, True)
    assert list(tmp_path.iterdir()) == [path]


def test_a_region_of_a_file_is_not_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / "regions.toml"
    put_region(path, Region("palm", uid=(1,)))
    with pytest.raises(ConfigurationError, match=r"there is a region 'palm' already"):
        put_region(path, Region("palm", uid=(2,)))
    with pytest.raises(ConfigurationError, match=rf"{re.escape(str(path))}:\d+: .*no region 'x'"):
        put_region(path, Region("other", regions=("x",)))
    assert list(read_regions(path)) == [Region("palm", uid=(1,))]
    path.write_text(HEAD + 'region = [{ name = "palm", uid = [1] }, { name = "thumb", uid = [2] }]\n')
    with pytest.raises(ConfigurationError, match=r":3: regions in one value: replace 'thumb' by hand"):
        put_region(path, Region("thumb", uid=(3,)), replace=True)
    path.write_text("not regions")
    with pytest.raises(ConfigurationError, match="not TOML"):
        put_region(path, Region("palm", uid=(2,)), replace=True)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text() == "not regions"


def test_holes_of_a_painted_region_are_closed_and_its_edge_stays() -> None:
    flat = triangles(20, 20)
    table = neighbours(placed(flat))
    disc = pressed(flat, [0.06, 0.05, 0], 0.03) > 0
    painted = disc.copy()
    painted[np.flatnonzero(disc)[[20, 21, 37, 50]]] = False
    closed = without_holes(painted, table)
    assert closed[disc].all()
    assert (closed & ~disc).sum() <= 6
    edge = np.zeros(400, bool)
    edge[[row * 20 + column for row in range(1, 19) for column in range(1, 19)]] = True
    assert np.array_equal(without_holes(edge, table), edge)
    edge = flat[:, 0] < 0.06
    torn = edge.copy()
    torn[[2 * 20, 100, 102]] = False
    assert np.array_equal(without_holes(torn, table), edge)
    assert not without_holes(np.zeros(400, bool), table).any()
    one = np.zeros(400, bool)
    one[45] = True
    assert np.array_equal(without_holes(one, table), one)


def test_taxels_without_neighbours_are_never_painted_by_others() -> None:
    touched = np.array([True, False, True])
    assert np.array_equal(without_holes(touched, np.full((3, 2), -1)), touched)
    assert np.array_equal(without_holes(touched, np.zeros((3, 0), int)), touched)
