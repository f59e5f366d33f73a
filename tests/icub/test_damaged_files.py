"""Files of other robots, and damaged ones: whatever they hold, there is a clear word and no other exception."""

from __future__ import annotations

import random
import tomllib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skinware.errors import ConfigurationError
from skinware_drivers.icub.body import read_positions
from skinware_drivers.icub.importer import import_files
from skinware_drivers.icub.xml_tree import Notes
from tests.icub.conftest import DEFAULTS, WRAPPER, board_sets, configuration, device, triangle_sets
from tests.icub.test_parts import ETHERNET, OLD
from tests.icub.test_positions import DRAWING, TRIANGLE, positions


def check(files: dict[str, bytes]) -> int:
    """Import files; returns the number of parts, whose configurations are ones that the driver takes."""
    with TemporaryDirectory() as folder:
        for name, data in files.items():
            Path(folder, name).write_bytes(data)
        try:
            done = import_files([Path(folder)], Notes())
        except ConfigurationError as error:
            assert str(error)  # noqa: PT017
            return 0
    for part in done.parts:
        text = part.configuration().replace('name = ""', 'name = "can0"')
        assert len(configuration(text).settings.bus) == len(part.buses) > 0
        tomllib.loads(part.geometry())
    return len(done.parts)


SETS = board_sets("1 8 8 20 1 0xf0") + triangle_sets("1 8 0 3 1 2 0x2200", "1 7 4 5 0 1 0x2000")
SKINS = [device(DEFAULTS + SETS), device(OLD), device(DEFAULTS + SETS, ETHERNET, "embObjSkin")]
NUMBERS = [
    "0",
    "-1",
    "15",
    "16",
    "255",
    "256",
    "65536",
    "0xffffffff",
    "1e3",
    "abc",
    "",
    "NaN",
    "٣",
    "0x",
    "99999999999999",
]

replaced = st.tuples(st.integers(0, 200), st.sampled_from(NUMBERS))


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(skin=st.sampled_from(SKINS), changes=st.lists(replaced, min_size=1, max_size=6))
def test_other_values(skin: str, changes: list[tuple[int, str]]) -> None:
    words = skin.split(" ")
    places = [n for n, word in enumerate(words) if word[:1].isdigit()]
    for place, number in changes:
        words[places[place % len(places)]] = number
    check({"skin.xml": " ".join(words).encode(), "wrapper.xml": WRAPPER.encode()})


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(
    skin=st.sampled_from(SKINS),
    cuts=st.lists(st.tuples(st.integers(0, 4000), st.integers(0, 40), st.binary(max_size=4)), min_size=1, max_size=4),
)
def test_cut_and_overwritten_bytes(skin: str, cuts: list[tuple[int, int, bytes]]) -> None:
    data = skin.encode()
    for position, length, other in cuts:
        at = position % len(data)
        data = data[:at] + other + data[at + length :] or b" "
    check({"skin.xml": data, "wrapper.xml": WRAPPER.encode()})


tags = st.sampled_from(["device", "devices", "param", "params", "group", "paramlist", "elem", "action", "xi:include"])
names = st.sampled_from(
    [
        "defaultCfgBoard",
        "specialCfgTriangles",
        "numOfSets",
        "patches",
        "skinCanIds",
        "ports",
        "networks",
        "period",
        "",
        "x",
    ]
)
texts = st.sampled_from(["", "7 8", "1", "1 8 0 3 1 2 0x2200", "0 383 0 383", "torso_skin", "&amp;", "socketcan"])


def element(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    more = st.sampled_from(
        ["", ' type="canBusSkin"', ' type="embObjSkin"', ' type="skinWrapper"', ' href="a.xml"', ' file="b.xml"']
    )
    return st.builds(
        lambda tag, name, extra, children: f'<{tag} name="{name}"{extra}>{"".join(children)}</{tag}>',
        tags,
        names,
        more,
        st.lists(inner, max_size=4),
    )


trees = st.recursive(texts, element, max_leaves=20)


@pytest.mark.thorough
@settings(max_examples=150, deadline=None)
@given(a=trees, b=trees)
def test_other_trees(a: str, b: str) -> None:
    skin = f'<device name="s" type="canBusSkin"><param name="skinCanIds">7</param>{a}</device>'
    check({"skin.xml": f"<devices>{skin}{b}</devices>".encode(), "a.xml": a.encode(), "b.xml": b.encode()})


@pytest.mark.thorough
@settings(max_examples=100, deadline=None)
@given(
    changes=st.lists(
        st.tuples(st.integers(0, 10_000), st.integers(0, 30), st.binary(max_size=6)), min_size=1, max_size=4
    ),
    which=st.sampled_from(["torso.txt", "torso.ini"]),
)
def test_other_positions_and_drawings(changes: list[tuple[int, int, bytes]], which: str) -> None:
    files = {
        "skin.xml": device().encode(),
        "wrapper.xml": WRAPPER.encode(),
        "torso.txt": positions([TRIANGLE] * 32).encode(),
        "torso.ini": DRAWING.encode(),
    }
    data = files[which]
    for position, length, other in changes:
        at = position % max(1, len(data))
        data = data[:at] + other + data[at + length :]
    check({**files, which: data})


def test_the_files_are_good_as_long_as_nobody_damages_them() -> None:
    for skin in SKINS:
        assert check({"skin.xml": skin.encode(), "wrapper.xml": WRAPPER.encode()}) == 1


def variants(data: bytes, chance: random.Random, count: int) -> Iterator[bytes]:
    """Real files with lines left out, doubled and swapped, numbers changed, and bytes damaged."""
    for _ in range(count):
        lines = data.split(b"\n")
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(len(lines))
            what = chance.randrange(5)
            if what == 0:
                del lines[at]
            elif what == 1:
                lines.insert(at, lines[chance.randrange(len(lines))])
            elif what == 2:
                words = lines[at].split(b" ")
                words[chance.randrange(len(words))] = chance.choice(NUMBERS).encode()
                lines[at] = b" ".join(words)
            elif what == 3:
                lines[at] = lines[at][: chance.randrange(len(lines[at]) + 1)]
            else:
                lines[at] = bytes(chance.randrange(256) if chance.random() < 0.05 else byte for byte in lines[at])
            lines = lines or [b""]
        yield b"\n".join(lines)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_damaged_real_files(robots: Path, geometry: Path, seed: int) -> None:
    chance = random.Random(seed)
    robot = robots / "iCubGenova02"
    names = ["left_arm-eb2-j4_15-skin.xml", "left_arm-eb2-j4_15-skinSpec.xml"]
    files = {name: (robot / "hardware" / "skin" / name).read_bytes() for name in names}
    files["wrapper.xml"] = (robot / "wrappers" / "skin" / "left_arm-skin_wrapper.xml").read_bytes()
    files["left_forearm_V2.txt"] = (geometry / "left_forearm_V2.txt").read_bytes()
    files["left_arm.ini"] = (geometry / "torso.ini").read_bytes().replace(b"torso", b"left_arm")
    assert check(files) == 1
    for name, data in files.items():
        for damaged in variants(data, chance, 15):
            check({**files, name: damaged})


def test_any_bytes_as_positions(tmp_path: Path) -> None:
    chance = random.Random(5)
    path = tmp_path / "p.txt"
    for _ in range(100):
        words = [b"taxel2Repr (", b")", b"[calibration]", b"\n", b" 1", b" -1", b"0 0 0 0 0 0\n", b"\xff", b"name x\n"]
        path.write_bytes(b"".join(chance.choices(words, k=40)))
        try:
            read_positions(path, Notes())
        except ConfigurationError as error:
            assert str(path) in str(error)  # noqa: PT017
