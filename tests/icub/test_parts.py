"""What is made of a skin device: boards, sets that differ, the old set-up; and what is said of the rest."""

from __future__ import annotations

import pytest

from skinware.errors import ConfigurationError
from skinware_drivers.can.roboskin_layout import Kind, RoboskinOptions, SpecialBoards
from skinware_drivers.icub.importer import ImportedPart
from tests.icub.conftest import DEFAULTS, WRAPPER, Made, board_sets, device, triangle_sets

ETHERNET = '<param name="skinCanAddrsPatch1"> 1 2 </param><param name="skinCanAddrsPatch2"> 13 12 </param>'


def only_part(made: Made) -> ImportedPart:
    (part,) = made.imported().parts
    return part


def options_of(made: Made) -> RoboskinOptions:
    (bus,) = only_part(made).buses
    return bus.options


def test_a_device_on_a_can_bus(made: Made) -> None:
    made.write("skin.xml", device())
    part = only_part(made)
    (bus,) = part.buses
    assert (bus.name, part.name, part.triangles) == ("can0", "torso_skin", 32)
    assert bus.options == RoboskinOptions(boards=(7, 8))
    assert made.said("unknown") == made.said("odd") == made.said("todo") == ""


def test_a_patch_is_a_bus_and_those_of_patch_2_come_first_for_the_host(made: Made) -> None:
    made.write("skin.xml", device(boards=ETHERNET, kind="embObjSkin"))
    part = only_part(made)
    assert [(bus.patch, bus.name, bus.options.boards) for bus in part.buses] == [(1, "", (1, 2)), (2, "", (13, 12))]
    assert part.part.host_order == [(2, 13), (2, 12), (1, 1), (1, 2)]
    assert "connect a CAN interface to the bus itself and fill in its name; patch 1, 2" in made.said("todo")
    assert 'name = ""  # fill in the interface that taps CAN1 of the Ethernet board, as can0' in part.configuration()


def test_a_set_holds_for_its_patch_only(made: Made) -> None:
    sets = board_sets("2 1 13 20 1 0xE0") + triangle_sets("1 1 0 3 0 2 0x2200", "2 13 4 5 1 0 0x2000")
    made.write("skin.xml", device(DEFAULTS + sets, ETHERNET, "embObjSkin"))
    first, second = only_part(made).buses
    assert first.options.special_boards == ()
    assert first.options.modules == (Kind(1, (0, 1, 2, 3), enabled=False, shift=2, cdc_offset=0x2200),)
    assert second.options.special_boards == (SpecialBoards((13, 12), 20, 1, 0xE0),)
    assert second.options.modules == (Kind(13, (4, 5), enabled=True, shift=0, cdc_offset=0x2000),)


def test_triangles_that_the_files_switch_on_in_vain_are_named(made: Made) -> None:
    sets = board_sets("0 8 8 50 1 0xf0") + triangle_sets("0 8 0 3 1 2 0x2200")
    made.write("skin.xml", device(DEFAULTS + sets))
    assert only_part(made).triangles == 16 + 4
    (line,) = made.said("odd").splitlines()
    assert line.startswith('skin.xml:9: param "boardSetCfg1": board 8: triangles 4-15 are switched on by')
    assert line.endswith("no set switches them on again: they stay off, as on the robot")


def test_a_bus_on_which_nothing_is_on_is_left_out_and_named(made: Made) -> None:
    off = DEFAULTS.replace("true", "false") + triangle_sets("1 1 0 0 1 2 0x2200")
    made.write("skin.xml", device(off, ETHERNET, "embObjSkin"))
    assert [bus.patch for bus in only_part(made).buses] == [1]
    assert "patch 2 is left out: boards 13, 12: the configuration leaves all triangles switched off" in made.said("odd")
    assert "patch 1: no triangle is switched on: board 2" in made.said("odd")


@pytest.mark.parametrize(
    ("body", "level", "words"),
    [
        (
            triangle_sets("0 9 0 1 1 2 0x2200"),
            "unknown",
            'param "triangleSetCfg1": there is no board 9 on its bus; left out',
        ),
        (triangle_sets("0 8 5 4 1 2 0x2200"), "unknown", "triangles 5 to 4: the firmware ignores a range outside 0-15"),
        (triangle_sets("0 8 0 16 1 2 0x2200"), "unknown", "triangles 0 to 16"),
        (triangle_sets("0 8 0 1 1 2"), "unknown", "6 numbers, not 7 (patch board firstTriangle"),
        (triangle_sets("0 8 0 one 1 2 3"), "unknown", "'one' is not a whole number; left out"),
        (triangle_sets("0 8 0 1 1 2 0x12200"), "unknown", "cdcOffset 0x12200 is impossible"),
        (triangle_sets("0 8 0 1 2 2 0x2200"), "info", "enabled = 2: counts as 1, as on the robot"),
        (triangle_sets("0 8 0 1 1 2 0x2200", count=2), "missing", "numOfSets is 2, but there is no triangleSetCfg2"),
        (triangle_sets("0 8 0 1 0 2 0x2200", count=0), "info", "beyond numOfSets = 0: the robot does not read it"),
        (
            triangle_sets("2 8 0 1 1 2 0x2200"),
            "odd",
            "for patch 2, but canDeviceNum is 0: the robot refuses such a file",
        ),
        (board_sets("0 9 10 50 1 0xf0"), "unknown", "no board on its bus is 9 to 10"),
        (board_sets("0 8 8 500 1 0xf0"), "unknown", "period 500, skinType 1 or noLoad 240 is impossible"),
        ('<group name="specialCfgBoards"></group>', "missing", 'group "specialCfgBoards": no usable numOfSets'),
        ('<param name="gain"> 4 </param>', "unknown", "param \"gain\": not understood: '4'"),
        ('<group name="more"><param name="x"> 1 </param></group>', "unknown", 'param "x": not understood'),
        ("<surprise> 7 </surprise>", "unknown", "surprise: not understood: '7'"),
        ('<param name="period"> 10 </param>', "info", "how often the robot's software reads its buffer"),
        ('<param name="4C_Timer"> 1 1 </param>', "info", "of the old set-up"),
        ('<param name="skinCanIds"> 9 </param>', "odd", "given again as '9'; the first counts ('7 8')"),
    ],
)
def test_every_value_that_has_no_place_is_named(made: Made, body: str, level: str, words: str) -> None:
    made.write("skin.xml", device(DEFAULTS + body))
    only_part(made)
    assert words in made.said(level)


@pytest.mark.parametrize(
    ("old", "new", "level", "words"),
    [
        ('"period"> 50 ', '"period"> 0 ', "unknown", 'param "period": 0 is outside 1-255; left out'),
        ('"period"> 50 ', '"period"> 50 51 ', "unknown", "'50 51' is not one number"),
        ('"period"> 50 ', '"periode"> 50 ', "unknown", "param \"periode\": not understood: '50'"),
        ('"noLoad"> 0xf0 ', '"noLoad"> 240.0 ', "unknown", "'240.0' is not a whole number"),
        ('"skinType"> 0 ', '"skinType"> 5 ', "odd", "no known firmware has the skin type 5"),
    ],
)
def test_defaults_that_are_no_use_are_named(made: Made, old: str, new: str, level: str, words: str) -> None:
    made.write("skin.xml", device(DEFAULTS.replace(old, new)))
    only_part(made)
    assert words in made.said(level)
    if "skinType" not in old:
        assert "the default of the robot's software" in made.said("odd")


@pytest.mark.parametrize(
    ("text", "value", "noted"),
    [
        ("true", True, False),
        ("1", True, False),
        ('"true"', True, False),
        ("false", False, False),
        ("0", False, False),
        ("fasle", False, True),
        ("fal se", False, True),
        ("True", False, True),
        ("yes", False, True),
        ("true false", True, True),
        ("", False, True),
    ],
)
def test_enabled_is_what_yarp_makes_of_it(made: Made, text: str, value: bool, noted: bool) -> None:
    sets = triangle_sets("0 7 0 0 1 2 0x2200")
    made.write("skin.xml", device(DEFAULTS.replace('"enabled"> true ', f'"enabled"> {text} ') + sets))
    assert options_of(made).enabled is value
    said = f"neither true nor false; taken to be {str(value).lower()}, as on the robot"
    assert (said in made.said("odd")) is noted
    assert made.said("unknown") == ""


def test_the_sets_of_a_can_bus_name_it_by_its_number(made: Made) -> None:
    sets = board_sets("7 8 8 20 1 0xE0") + triangle_sets("7 8 0 3 2 0 0x2000", "7 7 5 5 0 2 0x2200")
    skin = device(DEFAULTS + sets).replace('"canDeviceNum"> 0 ', '"canDeviceNum"> 7 ')
    made.write("skin.xml", skin)
    options = options_of(made)
    assert options.special_boards == (SpecialBoards((8,), 20, 1, 0xE0),)
    assert options.modules == (
        Kind(8, (0, 1, 2, 3), enabled=True, shift=0, cdc_offset=0x2000),
        Kind(7, (5,), enabled=False, shift=2, cdc_offset=0x2200),
    )
    assert "patch" not in made.said("odd")


def test_all_sets_count_however_many_the_robot_reads(made: Made) -> None:
    sets = triangle_sets(*(f"0 {7 + n // 16} {n % 16} {n % 16} 1 2 0x2200" for n in range(32)))
    made.write("skin.xml", device(DEFAULTS.replace("true", "false") + sets))
    assert only_part(made).triangles == 32
    assert "the robot's software reads the first 20 of these 32 sets; here, all count" in made.said("info")


def test_what_every_robot_has_beside_skin_needs_nobody(made: Made) -> None:
    general = '<params><group name="GENERAL"><param name="skipCalibration"> false </param></group></params>'
    made.write("general.xml", general)
    made.write("skin-eln.xml", '<params><group name="PC104"><param name="PC104IpPort"> 1 </param></group></params>')
    service = '<group name="SERVICE"><param name="type"> skin </param></group>' * 2
    includes = "".join(f'<xi:include href="{name}"/>' for name in ("general.xml", "skin-eln.xml", "arm-eln.xml"))
    made.write("skin.xml", device(includes + DEFAULTS + service))
    made.write("wrapper.xml", WRAPPER)
    made.write("robot.xml", '<robot><devices file="motor.xml"/><devices file="skin.xml"/></robot>')
    only_part(made)
    assert {note.level for note in made.notes} == {"info"}
    made.write("robot.xml", '<robot><devices file="hardware/skin/leg.xml"/></robot>')
    made.imported()
    assert "'hardware/skin/leg.xml' is not there" in made.said("missing")


@pytest.mark.parametrize(
    ("boards", "words"),
    [("7 0 8", "address 0: boards have 1 to 14"), ("7 8 15", "address 15"), ("7 8 7", "board 7 is there twice")],
)
def test_impossible_boards_are_named_and_left_out(made: Made, boards: str, words: str) -> None:
    made.write("skin.xml", device(boards=boards))
    assert options_of(made).boards == (7, 8)
    assert words in made.said("unknown")


def test_another_can_bus_is_to_be_filled_in(made: Made) -> None:
    made.write("skin.xml", device().replace("socketcan", "cfw2can"))
    assert only_part(made).buses[0].name == ""
    (line,) = made.said("todo").splitlines()
    assert line.endswith("the files do not name a CAN interface of this machine: fill in the bus")
    assert made.said("odd") == ""


def test_a_shared_can_bus_is_the_one_that_is_shared(made: Made) -> None:
    skin = (
        device()
        .replace(" socketcan ", ' "sharedcan" ')
        .replace("skinCanIds", 'physDevice"> "socketcan" </param><param name="skinCanIds')
    )
    made.write("skin.xml", skin)
    assert only_part(made).buses[0].name == "can0"


def test_the_user_names_the_buses(made: Made) -> None:
    made.write("skin.xml", device(boards=ETHERNET, kind="embObjSkin"))
    (part,) = made.imported(bus_names={2: "can7"}).parts
    assert [bus.name for bus in part.buses] == ["", "can7"]
    assert "fill in its name; patch 1" in made.said("todo")
    with pytest.raises(ConfigurationError, match="--bus 3=x: torso_skin has no patch 3"):
        made.imported(bus_names={3: "x"})


OLD = """
  <param name="4C_Timer"> 0x03 0x01 </param> <param name="4C_CDCOffsetL"> 0 0 </param>
  <param name="4C_CDCOffsetH"> 0x20 0x20 </param> <param name="4C_TimeL"> 0x00 0 </param>
  <param name="4C_TimeH"> 0x35 0 </param> <param name="4E_Shift"> 0 0 </param>
  <param name="4E_Shift3_1"> 0x22 0x33 </param> <param name="4E_NoLoad"> 0xF0 0xEB </param>
  <param name="4E_Param"> 0x00 0x29 </param> <param name="4E_EnaL"> 0xFF 0x0F </param>
  <param name="4E_EnaH"> 0xFF </param>
"""


def test_the_old_set_up(made: Made) -> None:
    made.write("skin.xml", device(OLD))
    assert options_of(made) == RoboskinOptions(
        boards=(7, 8),
        period_ms=43,
        skin_type=2,
        no_load=0xF0,
        shift=0,
        cdc_offset=0x2000,
        old_style=True,
        special_boards=(SpecialBoards((8,), period_ms=50, skin_type=1, no_load=0xEB),),
        modules=(Kind(8, (4, 5, 6, 7), enabled=False),),
    )
    assert "board 7: a period of 43.4176 ms becomes 43 ms" in made.said("info")
    assert "1 values for 2 boards; the robot takes 0xff for the others" in made.said("odd")
    assert "board 8: 4E_Param 0x29: only bits 0, 1 and 3 are understood" in made.said("unknown")
    assert "board 8: 4E_Shift3_1 0x33: areas are not used" in made.said("info")
    assert 'add kind = "fingertip", "palm" or "triangle" to the options' in made.said("todo")


def test_shifts_that_differ_from_board_to_board_are_named(made: Made) -> None:
    made.write("skin.xml", device('<param name="4E_Shift"> 2 3 </param>'))
    assert options_of(made).shift == 2
    assert "board 8 has another 4E_Shift or 4C_CDCOffset; those of board 7 are taken for all" in made.said("odd")


def test_other_devices_and_wrappers_without_a_device_are_named(made: Made) -> None:
    made.write("skin.xml", device())
    made.write("wrapper.xml", WRAPPER.replace("> torso_skin <", "> chest <"))
    made.write("inertial.xml", '<device name="i" type="embObjInertials"/>')
    made.write("motor.xml", '<device name="m" type="embObjMotionControl"/>')
    only_part(made)
    assert "there is no skin device 'chest'; its ports are not used" in made.said("missing")
    made.write("other.xml", '<device name="o" type="embObjSkin7"/>')
    made.imported()
    assert "'embObjInertials' is not imported; for inertial sensors, see the option inertial" in made.said("info")
    (line,) = made.said("unknown").splitlines()
    assert line.endswith("a device of type 'embObjSkin7' is not imported")


@pytest.mark.parametrize(
    ("wrapper", "level", "words"),
    [
        (WRAPPER.replace("0 383 0 383", "0 383 0 200"), "unknown", "the two ranges differ in length"),
        (WRAPPER.replace("0 383 0 383", "0 383"), "unknown", "2 numbers, not 4"),
        (WRAPPER.replace("0 383 0 383", "0 575 0 575"), "odd", "goes to 575, but the 2 boards have 384 values"),
        (WRAPPER.replace("0 383 0 383", "a b c d"), "unknown", "'a' is not a whole number"),
        (WRAPPER.replace("<action", '<param name="x"> 1 </param><action'), "unknown", 'param "x": not understood'),
        (WRAPPER.replace("> torso_skin <", "> torso_skin other <"), "odd", "several devices (torso_skin, other)"),
    ],
)
def test_what_is_wrong_with_ports_is_named(made: Made, wrapper: str, level: str, words: str) -> None:
    made.write("skin.xml", device())
    made.write("wrapper.xml", wrapper)
    only_part(made)
    assert words in made.said(level)


def test_of_two_robots_each_device_gets_the_wrapper_of_its_own(made: Made) -> None:
    for robot, port in (("one", "chest"), ("two", "belly")):
        made.write(f"{robot}/hardware/skin.xml", device())
        made.write(f"{robot}/wrappers/skin.xml", WRAPPER.replace('elem name="torso"', f'elem name="{port}"'))
    parts = made.imported().parts
    assert [(part.name, part.ports[0].name) for part in parts] == [("torso_skin", "chest"), ("torso_skin-2", "belly")]


def test_a_device_that_several_files_include_is_one(made: Made) -> None:
    made.write("robot.xml", '<robot><devices><xi:include href="skin.xml"/></devices></robot>')
    made.write("skin.xml", device())
    assert len(made.imported().parts) == 1


def test_parts_are_chosen_by_name(made: Made) -> None:
    made.write("a.xml", device())
    made.write("b.xml", device(boards="9").replace("torso_skin", "arm skin"))
    assert [part.name for part in made.imported(only=["arm skin"]).parts] == ["arm_skin"]
    with pytest.raises(ConfigurationError, match="--part leg: there is none; there are: arm skin, torso_skin"):
        made.imported(only=["leg"])
    with pytest.raises(ConfigurationError, match="--bus names buses of one part, but there are 2"):
        made.imported(bus_names={1: "can0"})
