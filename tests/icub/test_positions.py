"""Positions and drawings of skinGui: what modules are, and where their sensors are."""

from __future__ import annotations

import numpy as np
import pytest

from skinware.errors import ConfigurationError
from skinware.geometry import read_geometry
from skinware_drivers.can.roboskin_layout import Kind
from skinware_drivers.icub.importer import ImportedPart
from tests.icub.conftest import DEFAULTS, WRAPPER, Made, board_sets, device, triangle_sets

TRIANGLE = [1] * 6 + [-2] + [1] * 3 + [-2, 1]
FINGERTIP, BARE = [1] * 12, [-1] * 12
ETHERNET = '<param name="skinCanAddrsPatch1"> 1 </param><param name="skinCanAddrsPatch2"> 13 </param>'


def positions(triangles: list[list[int]], *, poses: list[str] | None = None, head: str = "") -> str:
    """A file of positions; the place of channel k of triangle t is (t, k, 0) cm."""
    flat = [each for triangle in triangles for each in triangle]
    if poses is None:
        poses = [
            f"{n // 12 / 100} {n % 12 / 100} 0 0 0 1" if flat[n] != -1 else "0 0 0 0 0 0" for n in range(len(flat))
        ]
    text = " ".join(map(str, flat))
    lines = [head or "name\tchest\nspatial_sampling taxel", f"taxel2Repr ( {text} )", "[calibration]", *poses]
    return "\n".join(lines) + "\n"


def part_of(made: Made, **options: object) -> ImportedPart:
    (part,) = made.imported(**options).parts
    return part


@pytest.fixture
def torso(made: Made) -> Made:
    made.write("skin.xml", device())
    made.write("wrapper.xml", WRAPPER)
    return made


def test_modules_are_what_the_positions_say(torso: Made) -> None:
    palm, odd_palm = [1] * 11 + [-1], [1] * 7 + [-1] + [1] * 4
    odd = [-1, -1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    torso.write("torso.txt", positions([TRIANGLE] * 16 + [FINGERTIP, palm, odd_palm, odd, BARE] + [TRIANGLE] * 11))
    (bus,) = part_of(torso).buses
    assert bus.options.modules == (
        Kind(8, (0,), kind="fingertip"),
        Kind(8, (1,), kind="palm"),
        Kind(8, (2,), kind="palm", thermal=(7,)),
        Kind(8, (3,), kind="triangle", thermal=(0, 1)),
    )
    (line,) = torso.said("odd").splitlines()
    assert "on, but without a taxel by the position files" in line
    assert line.endswith("add enabled = false to the modules: patch 1 board 8: 4")


def test_places_are_keyed_as_the_driver_names_its_sensors(torso: Made) -> None:
    torso.write("torso_V2.txt", positions([TRIANGLE] * 32))
    groups = part_of(torso).groups
    assert len(groups) == 64
    tactile, thermal = groups[2 * 19], groups[2 * 19 + 1]
    assert (tactile.type, tactile.frame, tactile.name) == ("pressure", "chest", "torso, board 8, triangle 3")
    assert tactile.uid == tuple(8 << 16 | 3 << 8 | k for k in (0, 1, 2, 3, 4, 5, 7, 8, 9, 11))
    assert tactile.position_m[1] == (0.19, 0.01, 0)
    assert thermal.uid == (8 << 16 | 3 << 8 | 6, 8 << 16 | 3 << 8 | 10)
    assert thermal.normal == ((0, 0, 1), (0, 0, 1))


def test_with_two_patches_the_places_of_patch_2_come_first_in_the_file(made: Made) -> None:
    made.write("skin.xml", device(boards=ETHERNET, kind="embObjSkin"))
    made.write("wrapper.xml", WRAPPER)
    made.write("torso.txt", positions([FINGERTIP] * 16 + [TRIANGLE] * 16))
    part = part_of(made)
    first, second = part.buses
    assert (first.options.boards, first.options.modules) == ((1,), ())
    assert (second.options.boards, second.options.modules) == ((13,), (Kind(13, tuple(range(16)), kind="fingertip"),))
    assert part.groups[0].uid[0] == 1 << 16
    assert part.groups[32].uid[0] == 1 << 32 | 13 << 16  # bus 1, as the driver counts
    off = DEFAULTS.replace("true", "false") + triangle_sets("2 13 0 3 1 2 0x2200")
    made.write("skin.xml", device(off, ETHERNET, "embObjSkin"))
    part = part_of(made)
    assert [bus.patch for bus in part.buses] == [2]
    assert {uid >> 16 for group in part.groups for uid in group.uid} == {13}  # of bus 0: there is no other
    assert part.figures()["sensors_with_a_place"] == part.figures()["sensors"] == 4 * 12


def test_a_port_can_be_a_piece_of_the_index(torso: Made) -> None:
    torso.write("wrapper.xml", WRAPPER.replace("0 383 0 383", "192 383 0 191"))
    torso.write("torso.txt", positions([FINGERTIP] * 16))
    (bus,) = part_of(torso).buses
    assert bus.options.modules == (Kind(8, tuple(range(16)), kind="fingertip"),)


def test_taxels_without_a_place_and_lists_that_do_not_fit_are_named(torso: Made) -> None:
    nowhere = ["0 0 0 0 0 0"] * 12
    poses = nowhere + ["0.1 0.2 0.3 0 0 1"] * 12 * 31
    torso.write("torso.txt", positions([TRIANGLE] * 32 + [BARE], poses=poses))
    part_of(torso)
    assert "torso.txt: taxels without a place: patch 1 board 7: 0" in torso.said("info")
    assert torso.said("odd") == torso.said("missing") == ""
    torso.write("torso.txt", positions([TRIANGLE] * 33, poses=["0.1 0.2 0.3 0 0 1"] * 12 * 33 + ["1 0 0 0 0 1"]))
    part_of(torso)
    assert "12 places of triangles without a taxel, or that the port torso does not have" in torso.said("odd")
    assert "torso.txt: [calibration]: 1 entries after the last whole triangle; left out" in torso.said("odd")


def test_where_the_list_of_taxels_ends_a_channel_with_a_place_is_a_taxel(torso: Made) -> None:
    """Some legs have 80 triangles in taxel2Repr, and 112 with a place."""
    beyond = ["0.5 0 0 0 0 1" if k not in (6, 10) else "0 0 0 0 0 0" for k in range(12)]
    poses = ["0.1 0.2 0.3 0 0 1"] * 12 * 30 + beyond + ["0 0 0 0 0 0"] * 12
    torso.write("torso.txt", positions([TRIANGLE] * 30, poses=poses))
    part = part_of(torso)
    (bus,) = part.buses
    assert bus.options.modules == ()
    of_board_8 = [group for group in part.groups if group.uid[0] >> 8 == 8 << 8 | 14]
    assert [(group.type, [uid & 255 for uid in group.uid]) for group in of_board_8] == [
        ("pressure", [0, 1, 2, 3, 4, 5, 7, 8, 9, 11])
    ]
    assert part.groups[-1].uid[0] >> 8 == 8 << 8 | 14
    assert torso.said("odd").endswith("patch 1 board 8: 15")


def test_a_place_is_kept_whatever_its_normal(torso: Made) -> None:
    first = ["0.1 0.2 0.3 0 0 0", "0.1 0.2 0.4 0.3 0 -0.4", "0 0 0 0 0 1", "0.1 0 0 1.7e308 1.7e308 1.7e308"]
    none = ["0.1 0.2 0.3 0 0 0"] * 12
    rest = ["0.1 0.2 0.3 0 0 1"] * 12 * 30
    torso.write("torso.txt", positions([FINGERTIP] * 32, poses=[*first, *["0.1 0.2 0.3 0 0 1"] * 8, *none, *rest]))
    part = part_of(torso)
    path = torso.write("out.toml", part.geometry())
    geometry = read_geometry(path)
    assert len(geometry) == 384
    assert geometry.known.all()
    assert geometry.position_m[:4].tolist() == [[0.1, 0.2, 0.3], [0.1, 0.2, 0.4], [0, 0, 0], [0.1, 0, 0]]
    assert np.isnan(geometry.normal[[0, 3, *range(12, 24)]]).all()
    assert np.allclose(geometry.normal[[1, 2]], np.array([[0.6, 0, -0.8], [0, 0, 1]]))
    assert part.groups[1].normal is None
    assert torso.said("odd") == torso.said("unknown") == ""
    assert "torso.txt: 14 of 384 places have no normal" in torso.said("info")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("0.1 0.2 0.3 0 0", "not six numbers"),
        ("0.1 0.2 0.3 0 0 z", "not six numbers"),
        ("nan 0.2 0.3 0 0 1", "not six numbers"),
        ("100 0.2 0.3 0 0 1", "farther than 10 m from the link: not in metres?"),
    ],
)
def test_lines_that_are_no_place_are_named(torso: Made, line: str, words: str) -> None:
    torso.write("torso.txt", positions([TRIANGLE] * 32, poses=[line] + ["0.1 0.2 0.3 0 0 1"] * 383))
    groups = part_of(torso).groups
    assert len(groups[0].uid) == 9
    (remark,) = torso.said("unknown").splitlines()
    assert remark.startswith(f"torso.txt:5: {line}: {words}")


def test_lines_of_the_head_that_are_not_understood_are_named(torso: Made) -> None:
    head = "name chest\nspatial_sampling triangle\ncolour blue"
    torso.write("torso.txt", positions([TRIANGLE] * 32, head=head))
    part_of(torso)
    assert "torso.txt:3: colour blue: not understood" in torso.said("unknown")
    assert "spatial_sampling triangle: the file asks for one place per triangle" in torso.said("info")
    torso.write("torso.txt", positions([TRIANGLE] * 32, head="spatial_sampling taxel"))
    part_of(torso)
    assert "torso.txt: name: no frame" in torso.said("missing")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("taxel2Repr [calibration]", "it has no taxel2Repr"),
        ("taxel2Repr ( 1 2 x ) [calibration]", "taxel2Repr: 'x' is not a whole number"),
        ("taxel2Repr ( 1 2 3 )\n[calibration]\n", "no whole triangle"),
    ],
)
def test_files_that_are_no_positions_are_refused(torso: Made, text: str, words: str) -> None:
    torso.write("torso.txt", text)
    with pytest.raises(ConfigurationError, match=words):
        part_of(torso)


def test_which_file_is_meant_is_asked_where_it_is_open(torso: Made) -> None:
    first = torso.write("torso_V1.txt", positions([TRIANGLE] * 32))
    torso.write("torso_V2.txt", positions([FINGERTIP] * 32))
    torso.write("torsolike.txt", positions([FINGERTIP] * 32))
    assert part_of(torso).groups == []
    assert (
        "several position files (torso_V1.txt, torso_V2.txt), none used: choose one with --positions torso=FILE"
        in torso.said("todo")
    )
    assert len(part_of(torso, positions={"torso": first}).groups) == 64
    assert "torsolike.txt: no body part of this name is imported" in torso.said("info")
    torso.write("torso.txt", positions([FINGERTIP] * 32))
    assert len(part_of(torso).groups) == 32  # its very name
    with pytest.raises(ConfigurationError, match=r"--positions leg=.*no part that is imported has a port"):
        part_of(torso, positions={"leg": first})


DRAWING = """cardid 7 8
robotPart torso
width 500
xspot 32

[SENSORS]
#  Number X Y
triangle_10pad 0 63 -13 0 4 0   # a remark
fingertip2L 1 0 0 0 4 0
palmL 16 0 0 0 4 0
quad16 20 0 0 0 4 0
triangle
triangle_10pad 300 0 0
triangle_10pad 40 0 0
"""


def test_a_drawing_tells_what_modules_are_where_no_positions_do(torso: Made) -> None:
    torso.write("torso.ini", DRAWING)
    (bus,) = part_of(torso).buses
    assert bus.options.modules == (Kind(7, (1,), kind="fingertip"), Kind(8, (0, 1, 2, 3), kind="palm"))
    unknown = torso.said("unknown").splitlines()
    assert [line.split(": ")[0] for line in unknown] == [f"torso.ini:{n}" for n in (4, 11, 12, 13)]
    assert "a module of the kind 'quad16', which is not known here" in unknown[1]
    assert "draws triangles 40, which the port torso does not have" in torso.said("odd")
    assert "on, but not drawn: patch 1 board 7: 2-15; patch 1 board 8: 5-15" in torso.said("odd")
    assert "x, y, orientation, gain, mirror and layout of each module: for the picture" in torso.said("info")


def test_positions_beat_a_drawing(torso: Made) -> None:
    torso.write("torso.ini", DRAWING)
    torso.write("torso.txt", positions([TRIANGLE] * 16 + [BARE] * 16))
    (bus,) = part_of(torso).buses
    assert bus.options.modules == ()


def test_what_is_drawn_but_off_is_named(torso: Made) -> None:
    torso.write("skin.xml", device(DEFAULTS + triangle_sets("0 7 0 1 0 2 0x2200")))
    torso.write("torso.ini", DRAWING)
    part_of(torso)
    assert "drawn, but off: patch 1 board 7: 0-1" in torso.said("odd")


def test_several_drawings_of_one_part_are_no_use(torso: Made) -> None:
    torso.write("a.ini", DRAWING)
    torso.write("b.ini", DRAWING)
    (bus,) = part_of(torso).buses
    assert bus.options.modules == ()
    assert "several drawings, none used: a.ini, b.ini" in torso.said("odd")


def test_a_hand_of_which_no_file_tells_is_to_be_decided(torso: Made) -> None:
    torso.write("skin.xml", device(DEFAULTS + board_sets("0 8 8 50 1 0xf0") + triangle_sets("0 8 0 11 1 2 0x2200")))
    part_of(torso)
    assert "fingertips or palms? No position file says, so they are taken to be fingertips" in torso.said("todo")
    assert "patch 1 board 8: 0-11" in torso.said("todo")
