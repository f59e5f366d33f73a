"""Read a skin part of a robot's files: buses, boards, and the sets of boards and triangles that differ.

Sources: robotology/icub-main SkinConfigReader.cpp (the groups), embObjSkin.cpp and CanBusSkin.cpp (the devices; the
latter also the parameters ``4C_*`` and ``4E_*`` of the old set-up and their defaults).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from skinware_drivers.can.roboskin_layout import FIRST_BOARD, LAST_BOARD, TRIANGLES
from skinware_drivers.icub.device import Group
from skinware_drivers.icub.xml_tree import Element, Notes, words

ETHERNET, CAN = "embObjSkin", "canBusSkin"
_ONLY_PATCH = 1
"""The patch of the one bus of a canBusSkin; its sets name it by canDeviceNum."""
DEVICE_TYPES = (ETHERNET, CAN)
"""Devices with skin: boards behind an Ethernet board, and boards on a CAN bus of the robot's computer."""

_PATCH_PARAMETER = "skinCanAddrsPatch"
_HOST_DEFAULTS = "the default of the robot's software"
_LARGEST = {"period": 255, "skinType": 15, "noLoad": 255, "shift": 255, "cdcOffset": 0xFFFF}
_GROUPS_OF_THE_ROBOT = {"GENERAL", "PC104", "ETH", "ETH_BOARD", "SERVICE", "TRANSCEIVER", "PROTOCOL"}
"""Parameters of all robots' devices that are not about skin."""
_MOST_TRIANGLE_SETS = 20
"""Number of sets that the robot's software reads; files of legs and arms have up to twice as many."""
_SKIN_TYPES = (0, 1, 2, 3, 7, 8)


@dataclass(frozen=True)
class BoardSet:
    element: Element
    patch: int
    boards: tuple[int, ...]
    period_ms: int
    skin_type: int
    no_load: int


@dataclass(frozen=True)
class TriangleSet:
    element: Element
    patch: int
    board: int
    triangles: tuple[int, ...]
    enabled: bool
    shift: int
    cdc_offset: int


@dataclass
class DevicePart:
    """A skin device.

    Attributes:
        device_type: one of ``DEVICE_TYPES``.
        boards: addresses by patch, in the files' order; a patch is what we call a bus.
        bus_name: of the CAN bus, if the files name it.
        period_ms, skin_type, no_load, enabled, shift, cdc_offset: of boards and triangles without a set of their own.
        old: the parameters ``4C_*`` and ``4E_*`` of each board, if the files have no other set-up.
    """

    name: str
    element: Element
    device_type: str
    boards: dict[int, tuple[int, ...]] = field(default_factory=dict)
    bus_name: str = ""
    period_ms: int = 40
    skin_type: int = 0
    no_load: int = 0xF0
    enabled: bool = True
    shift: int = 0
    cdc_offset: int = 0x2200
    board_sets: list[BoardSet] = field(default_factory=list)
    triangle_sets: list[TriangleSet] = field(default_factory=list)
    old: dict[int, dict[str, int]] = field(default_factory=dict)

    @property
    def host_order(self) -> list[tuple[int, int]]:
        """(patch, board) in the order of the host's index: the boards of the higher patch come first."""
        return [(patch, board) for patch in sorted(self.boards, reverse=True) for board in self.boards[patch]]


class PartReader:
    def __init__(self, name: str, device_type: str, group: Group, notes: Notes) -> None:
        self.notes = notes
        self._group = group
        self._part = DevicePart(name, group.element, device_type)
        self._can_device: int | None = None
        self._other_patches: set[int] = set()

    def read(self) -> DevicePart:
        self._read_boards()
        old = [name for name in self._group.params if name.startswith(("4C_", "4E_"))]
        if self._part.device_type == CAN and not {"defaultCfgBoard", "defaultCfgTriangle"} & set(self._group.groups):
            self._read_old()
        else:
            for name in old:
                self._unused(self._group.params[name], "of the old set-up; the groups defaultCfg... replace it")
            self._read_defaults()
            self._read_board_sets()
            self._read_triangle_sets()
        groups = self._group.groups
        for name in sorted(_GROUPS_OF_THE_ROBOT & set(groups)):
            for element in _elements_of(groups[name]):
                element.understood = True
            self._unused(groups[name].element, "of the robot's computer and its Ethernet boards")
        for element in _elements_of(self._group):
            if not element.understood:
                element.understood = True
                self.notes.at(element, "unknown", f"not understood{f': {element.text!r}' if element.text else ''}")
        return self._part

    # Boards and buses

    def _read_boards(self) -> None:
        if self._part.device_type == CAN:
            params = self._group.params
            self._take_boards(_ONLY_PATCH, params.get("skinCanIds"), "skinCanIds")
            self._can_device = self.notes.number(params.get("canDeviceNum"), 0, 99)
            kinds = [words(params[name].text) for name in ("canbusDevice", "physDevice") if name in params]
            for name in ("canbusDevice", "physDevice"):
                if name in params:
                    params[name].understood = True
            if ["socketcan"] in kinds and self._can_device is not None:
                self._part.bus_name = f"can{self._can_device}"
            if "period" in params:
                self._unused(params["period"], "how often the robot's software reads its buffer")
            return
        patches = self._group.groups.get("patches")
        for name, element in patches.params.items() if patches else ():
            number_text = name.removeprefix(_PATCH_PARAMETER)
            if name.startswith(_PATCH_PARAMETER) and number_text in ("1", "2"):
                self._take_boards(int(number_text), element, name)
        if not self._part.boards:
            self.notes.at(self._part.element, "missing", f"no {_PATCH_PARAMETER}1 or 2 in a group 'patches': no board")

    def _take_boards(self, patch: int, element: Element | None, name: str) -> None:
        found = self.notes.numbers(element)
        if element is None:
            self.notes.at(self._part.element, "missing", f"no {name}: no board")
        if element is None or found is None:
            return
        boards: list[int] = []
        for board in found:
            if not FIRST_BOARD <= board <= LAST_BOARD:
                self.notes.refuse(element, f"address {board}: boards have {FIRST_BOARD} to {LAST_BOARD}")
            elif board in boards:
                self.notes.refuse(element, f"board {board} is there twice")
            else:
                boards.append(board)
        if boards:
            self._part.boards[patch] = tuple(boards)

    # The new set-up

    def _read_defaults(self) -> None:
        part = self._part
        board = self._params_of("defaultCfgBoard")
        part.period_ms = self._default(board, "period", part.period_ms, first=1)
        part.skin_type = self._default(board, "skinType", part.skin_type)
        part.no_load = self._default(board, "noLoad", part.no_load)
        if part.skin_type not in _SKIN_TYPES:
            self.notes.at(board["skinType"], "odd", f"no known firmware has the skin type {part.skin_type}")
        if "diagnostic" in board:
            self._unused(board["diagnostic"], "whether the robot's software logs faults; Skinware always shows them")
        triangle = self._params_of("defaultCfgTriangle")
        enabled = self.notes.truth(triangle.get("enabled"))
        if enabled is None:
            self._assume("enabled", part.enabled)
        else:
            part.enabled = enabled
        part.shift = self._default(triangle, "shift", part.shift)
        part.cdc_offset = self._default(triangle, "cdcOffset", part.cdc_offset)

    def _params_of(self, name: str) -> dict[str, Element]:
        group = self._group.groups.get(name)
        if group is None:
            self.notes.at(self._part.element, "missing", f"no group {name!r}")
            return {}
        return group.params

    def _default(self, params: dict[str, Element], name: str, default: int, first: int = 0) -> int:
        found = self.notes.number(params.get(name), first, _LARGEST[name])
        if found is None:
            self._assume(name, default)
            return default
        return found

    def _assume(self, name: str, value: object) -> None:
        self.notes.at(self._part.element, "odd", f"no usable {name!r}; taken to be {value}, {_HOST_DEFAULTS}")

    def _sets(self, group_name: str, prefix: str, columns: str) -> list[tuple[Element, list[int]]]:
        group = self._group.groups.get(group_name)
        if group is None:
            return []
        count = self.notes.number(group.params.get("numOfSets"), 0, 1000)
        if count is None:
            self.notes.at(
                group.element, "missing", "no usable numOfSets: the robot refuses such a file; no set is used"
            )
            count = 0
        if prefix == "triangleSetCfg" and count > _MOST_TRIANGLE_SETS:
            text = f"the robot's software reads the first {_MOST_TRIANGLE_SETS} of these {count} sets; here, all count"
            self.notes.at(group.element, "info", text)
        width = len(columns.split())
        sets = []
        for number in range(1, count + 1):
            element = group.params.get(f"{prefix}{number}")
            if element is None:
                self.notes.at(group.element, "missing", f"numOfSets is {count}, but there is no {prefix}{number}")
                continue
            row = self.notes.numbers(element)
            if row is None:
                continue
            if len(row) != width:
                self.notes.refuse(element, f"{len(row)} numbers, not {width} ({columns})")
            else:
                sets.append((element, row))
        for name, element in group.params.items():
            if name.startswith(prefix) and not element.understood:
                self._unused(element, f"beyond numOfSets = {count}: the robot does not read it")
        return sets

    def _read_board_sets(self) -> None:
        columns = "patch firstBoard lastBoard period skinType noLoad"
        for element, row in self._sets("specialCfgBoards", "boardSetCfg", columns):
            patch, first, last, period_ms, skin_type, no_load = row
            patch = self._patch_of(element, patch)
            of_patch = self._boards_of(element, patch)
            boards = tuple(board for board in of_patch if first <= board <= last)
            if of_patch and not boards:
                self.notes.refuse(element, f"no board on its bus is {first} to {last}")
            elif not 1 <= period_ms <= 255 or not 0 <= skin_type <= 15 or not 0 <= no_load <= 255:
                self.notes.refuse(
                    element, f"period {period_ms}, skinType {skin_type} or noLoad {no_load} is impossible"
                )
            elif boards:
                self._part.board_sets.append(BoardSet(element, patch, boards, period_ms, skin_type, no_load))

    def _read_triangle_sets(self) -> None:
        columns = "patch board firstTriangle lastTriangle enabled shift cdcOffset"
        for element, row in self._sets("specialCfgTriangles", "triangleSetCfg", columns):
            patch, board, first, last, enabled, shift, cdc_offset = row
            patch = self._patch_of(element, patch)
            of_patch = self._boards_of(element, patch)
            if of_patch and board not in of_patch:
                self.notes.refuse(element, f"there is no board {board} on its bus")
            elif not 0 <= first <= last < TRIANGLES:
                self.notes.refuse(element, f"triangles {first} to {last}: the firmware ignores a range outside 0-15")
            elif not 0 <= shift <= 255 or not 0 <= cdc_offset <= 0xFFFF:
                self.notes.refuse(element, f"shift {shift} or cdcOffset {cdc_offset:#x} is impossible")
            elif of_patch:
                if enabled not in (0, 1):
                    self.notes.at(element, "info", f"enabled = {enabled}: counts as 1, as on the robot")
                triangles = tuple(range(first, last + 1))
                self._part.triangle_sets.append(
                    TriangleSet(element, patch, board, triangles, bool(enabled), shift, cdc_offset)
                )

    def _patch_of(self, element: Element, number: int) -> int:
        if self._part.device_type == ETHERNET:
            return number
        if self._can_device not in (None, number) and number not in self._other_patches:
            self._other_patches.add(number)
            text = f"for patch {number}, but canDeviceNum is {self._can_device}: the robot refuses such a file"
            self.notes.at(element, "odd", f"{text}; it is taken to be for the only bus")
        return _ONLY_PATCH

    def _boards_of(self, element: Element, patch: int) -> tuple[int, ...]:
        boards = self._part.boards
        if patch not in boards and boards:
            self.notes.refuse(element, f"there is no patch {patch}")
        return boards.get(patch, ())

    # The old set-up

    def _read_old(self) -> None:
        boards = self._part.boards.get(_ONLY_PATCH, ())
        self._part.old = {board: dict(OLD_DEFAULTS) for board in boards}
        for name, default in OLD_DEFAULTS.items():
            element = self._group.params.get(name)
            row = self.notes.numbers(element)
            if element is None or row is None:
                continue
            if len(row) != len(boards):
                text = f"{len(row)} values for {len(boards)} boards; the robot takes {default:#x} for the others"
                self.notes.at(element, "odd", text)
            for board, value in zip(boards, row, strict=False):
                if 0 <= value <= 255:
                    self._part.old[board][name] = value
                else:
                    self.notes.refuse(element, f"{value} is not a byte")

    # Other elements

    def _unused(self, element: Element, why: str) -> None:
        element.understood = True
        self.notes.at(element, "info", why)


OLD_DEFAULTS = {
    "4C_Timer": 0x01,
    "4C_CDCOffsetL": 0x00,
    "4C_CDCOffsetH": 0x20,
    "4C_TimeL": 0x00,
    "4C_TimeH": 0x00,
    "4E_Shift": 0x02,
    "4E_Shift3_1": 0x22,
    "4E_NoLoad": 0xF0,
    "4E_Param": 0x00,
    "4E_EnaL": 0xFF,
    "4E_EnaH": 0xFF,
}
"""Parameters of the old set-up, with the host's defaults."""


def _elements_of(group: Group) -> list[Element]:
    found = [element for child in group.element.children for element in child.walk()]
    found += list(group.params.values())
    found += [element for inner in group.groups.values() for element in [inner.element, *_elements_of(inner)]]
    found += [element for elements in group.lists.values() for element in elements]
    found += [element for other in group.others for element in other.walk()]
    return found
