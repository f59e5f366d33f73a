"""Translate a part to configurations, which the drivers ``roboskin`` and ``yarp`` check, and write them as text."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.geometry import GeometryGroup
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_layout import (
    CHANNELS,
    NON_TACTILE,
    TRIANGLES,
    Kind,
    RoboskinOptions,
    SpecialBoards,
    runs_text,
    usual_kind,
)
from skinware_drivers.can.roboskin_setup import BoardSetUp
from skinware_drivers.description import Module
from skinware_drivers.icub.body import Body, Place, places_text, triangles_of
from skinware_drivers.icub.device import PortRange
from skinware_drivers.icub.part import ETHERNET, DevicePart
from skinware_drivers.icub.xml_tree import Level, Notes
from skinware_drivers.streams.yarp import Triangles, YarpOptions

_HEXADECIMAL = ("cdc_offset", "no_load")
_ALWAYS = ("boards", "period_ms", "skin_type", "no_load", "shift", "cdc_offset", "enabled", "values")
"""Options that are written even if they have their defaults."""
_TABLES = ("special_boards", "modules", "triangles")


def configuration_text(
    driver: str, name: str, buses: Sequence[tuple[str, str, msgspec.Struct]], comment: Sequence[str], geometry: str = ""
) -> str:
    """Return the text of a file for ``skin-driver --config``; ``buses``: name, remark and options of each."""
    lines = [f"# {line}".rstrip() for line in comment]
    lines += [f"driver = {_value(driver)}", f"name = {_value(name)}"]
    lines += [f"geometry = {_value(geometry)}"] if geometry else []
    for bus, to_fill_in, options in buses:
        lines += ["", "[[bus]]", f"name = {_value(bus)}" + (f"  # {to_fill_in}" if to_fill_in else "")]
        lines.append("[bus.options]")
        for field in msgspec.structs.fields(options):
            value = getattr(options, field.name)
            if field.name not in _ALWAYS and value == field.default:
                continue
            if field.name in _TABLES:
                lines += [f"{field.name} = [", *(f"  {_table(row)}," for row in value), "]"]
            else:
                lines.append(f"{field.name} = {_value(value, field.name)}")
    return "\n".join(lines) + "\n"


def _table(row: msgspec.Struct) -> str:
    pairs = [
        f"{field.name} = {_value(getattr(row, field.name), field.name)}"
        for field in msgspec.structs.fields(row)
        if field.required or getattr(row, field.name) != field.default
    ]
    return f"{{ {', '.join(pairs)} }}"


def _value(value: Any, name: str = "") -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"{value:#x}" if name in _HEXADECIMAL else str(value)
    if isinstance(value, tuple):
        return f"[{', '.join(_value(item) for item in value)}]"
    return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")


_OF_A_BOARD = ("period_ms", "skin_type", "no_load")
_OF_A_BUS = (*_OF_A_BOARD, "shift", "cdc_offset")
_TICK_MS = 0.0032
_OWN_TIMER, _COMPENSATED, _NOT_COMPENSATED_TYPE, _AREA_SHIFTS = 3, 0x08, 2, 0x22
_USUAL_OLD_PERIOD_MS = 50
_BUS_COMMENT = {
    ETHERNET: "fill in the interface that taps CAN{patch} of the Ethernet board, as can0",
    "": "fill in the interface of this bus, as can0",
}


@dataclass(frozen=True)
class TranslatedBus:
    """One bus of a part; ``name``: for ``--bus``; empty: to fill in."""

    patch: int
    name: str
    comment: str
    options: RoboskinOptions


def translate(
    part: DevicePart, body: Body, bus_names: Mapping[int, str], notes: Notes, *, wants_names: bool = True
) -> list[TranslatedBus]:
    """Return the buses of a part with triangles that are switched on, in the order of their patches.

    Args:
        wants_names: note buses without a name, which the user must fill in.
    """
    buses = []
    for patch in sorted(part.boards):
        try:
            options = _old_options(part, patch, notes) if part.old else _options(part, patch)
            options = _with_kinds(options, patch, body)
            RoboskinDriver(options)  # refuses impossible options
        except ConfigurationError as error:
            notes.at(part.element, "odd", f"patch {patch} is left out: {error}")
            continue
        name = bus_names.get(patch, part.bus_name)
        comment = "" if name else _BUS_COMMENT.get(part.device_type, _BUS_COMMENT[""]).format(patch=patch)
        buses.append(TranslatedBus(patch, name, comment, options))
        _check_set_up(part, patch, options, body, notes)
    bare = enabled_places(buses) & body.bare
    if bare:
        text = "on, but without a taxel by the position files; if they show faults, add enabled = false to the modules"
        notes.at(part.element, "odd", f"{text}: {places_text(bare)}")
    for patch in bus_names:
        if patch not in part.boards:
            raise ConfigurationError(f"--bus {patch}={bus_names[patch]}: {part.name} has no patch {patch}")
    to_fill_in = [str(bus.patch) for bus in buses if wants_names and not bus.name]
    if to_fill_in and part.device_type == ETHERNET:
        text = (
            "the boards are behind an Ethernet board: connect a CAN interface to the bus itself and fill in its name;"
            f" patch {', '.join(to_fill_in)}"
        )
        notes.at(part.element, "todo", text)
    elif to_fill_in:
        notes.at(part.element, "todo", "the files do not name a CAN interface of this machine: fill in the bus")
    return buses


def enabled_places(buses: list[TranslatedBus]) -> set[Place]:
    return {
        (bus.patch, board, triangle)
        for bus in buses
        for board in bus.options.boards
        for triangle in BoardSetUp(bus.options, board).enabled
    }


def service_name(name: str, taken: set[str]) -> str:
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", name).lstrip("_-")[:40] or "skin"
    found, number = safe, 2
    while found in taken:
        found, number = f"{safe}-{number}", number + 1
    return found


def _options(part: DevicePart, patch: int) -> RoboskinOptions:
    special = [SpecialBoards(s.boards, **_taken(s, _OF_A_BOARD)) for s in part.board_sets if s.patch == patch]
    modules = [
        Kind(s.board, s.triangles, enabled=s.enabled, shift=s.shift, cdc_offset=s.cdc_offset)
        for s in part.triangle_sets
        if s.patch == patch
    ]
    return RoboskinOptions(
        boards=part.boards[patch],
        **_taken(part, _OF_A_BUS),
        enabled=part.enabled,
        special_boards=tuple(special),
        modules=tuple(modules),
    )


def _old_options(part: DevicePart, patch: int, notes: Notes) -> RoboskinOptions:
    """Return options of the old set-up: one shift and offset for a bus; the rest can differ from board to board."""
    boards = part.boards[patch]
    each = {board: _OldSettings(part, board, notes) for board in boards}
    first = each[boards[0]]
    for board, settings in each.items():
        if (settings.shift, settings.cdc_offset) != (first.shift, first.cdc_offset):
            text = f"board {board} has another 4E_Shift or 4C_CDCOffset; those of board {boards[0]} are taken for all"
            notes.at(part.element, "odd", text)
    special = tuple(
        SpecialBoards((board,), **_taken(settings, _OF_A_BOARD))
        for board, settings in each.items()
        if _taken(settings, _OF_A_BOARD) != _taken(first, _OF_A_BOARD)
    )
    modules = tuple(Kind(board, s.off, enabled=False) for board, s in each.items() if s.off)
    return RoboskinOptions(
        boards=boards,
        **_taken(first, _OF_A_BUS),
        old_style=True,
        special_boards=special,
        modules=modules,
    )


def _taken(source: object, names: Sequence[str]) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}


class _OldSettings:
    def __init__(self, part: DevicePart, board: int, notes: Notes) -> None:
        values = part.old[board]
        period_ms = float(_USUAL_OLD_PERIOD_MS)
        if values["4C_Timer"] & 0xF == _OWN_TIMER:
            period_ms = (values["4C_TimeL"] | values["4C_TimeH"] << 8) * _TICK_MS
        self.period_ms = min(max(round(period_ms), 1), 209)
        if self.period_ms != period_ms:
            level: Level = "info" if abs(self.period_ms - period_ms) < 1 else "odd"
            notes.at(part.element, level, f"board {board}: a period of {period_ms:g} ms becomes {self.period_ms} ms")
        parameter = values["4E_Param"]
        self.skin_type = parameter & 3 if parameter & _COMPENSATED else _NOT_COMPENSATED_TYPE
        if parameter & ~(_COMPENSATED | 3):
            notes.at(
                part.element, "unknown", f"board {board}: 4E_Param {parameter:#x}: only bits 0, 1 and 3 are understood"
            )
        if values["4E_Shift3_1"] != _AREA_SHIFTS:
            text = f"board {board}: 4E_Shift3_1 {values['4E_Shift3_1']:#x}: areas are not used, so 0x22 is sent"
            notes.at(part.element, "info", text)
        if values["4E_Shift"] & 0xF0:
            notes.at(part.element, "odd", f"board {board}: 4E_Shift {values['4E_Shift']:#x}: its low four bits count")
        self.shift, self.no_load = values["4E_Shift"] & 0x0F, values["4E_NoLoad"]
        self.cdc_offset = values["4C_CDCOffsetL"] | values["4C_CDCOffsetH"] << 8
        mask = values["4E_EnaL"] | values["4E_EnaH"] << 8
        self.off = tuple(triangle for triangle in range(TRIANGLES) if not mask >> triangle & 1)


def _with_kinds(options: RoboskinOptions, patch: int, body: Body) -> RoboskinOptions:
    """Return options with the kinds of triangles that differ from the type of skin."""
    kinds: dict[tuple[int, str, tuple[int, ...]], list[int]] = {}
    for board in options.boards:
        set_up = BoardSetUp(options, board)
        for triangle in sorted(set_up.enabled):
            usual = usual_kind(set_up.skin_type, triangle)
            shape = body.shapes.get((patch, board, triangle))
            if shape is not None and shape != (usual, NON_TACTILE[usual]):
                kinds.setdefault((board, *shape), []).append(triangle)
    more = tuple(
        Kind(board, tuple(triangles), kind=kind, thermal=None if thermal == NON_TACTILE[kind] else thermal)
        for (board, kind, thermal), triangles in kinds.items()
    )
    return msgspec.structs.replace(options, modules=(*options.modules, *more))


def _check_set_up(part: DevicePart, patch: int, options: RoboskinOptions, body: Body, notes: Notes) -> None:
    for board in options.boards:
        set_up = BoardSetUp(options, board)
        if set_up.wiped:
            sets = [s for s in part.board_sets if s.patch == patch and board in s.boards]
            element = sets[-1].element
            text = (
                f"board {board}: triangles {runs_text(set_up.wiped)} are switched on by defaultCfgTriangle, then off"
                " by this set, and no set switches them on again: they stay off, as on the robot"
            )
            notes.at(element, "odd", text)
    on = {(patch, board, t) for board in options.boards for t in BoardSetUp(options, board).enabled}
    off = set(options.boards) - {board for _, board, _ in on}
    if off:
        notes.at(part.element, "odd", f"patch {patch}: no triangle is switched on: board {runs_text(off)}")
    unknown = {place for place in on if place not in body.shapes and place not in body.bare}
    if unknown and part.old:
        text = (
            'the files do not say what the modules are: add kind = "fingertip", "palm" or "triangle" to the options;'
            f" without it, skin type {options.skin_type} decides"
        )
        notes.at(part.element, "todo", text)
    elif special := {p for p in unknown if usual_kind(BoardSetUp(options, p[1]).skin_type, p[2]) != "triangle"}:
        text = f"fingertips or palms? No position file says, so they are taken to be fingertips: {places_text(special)}"
        notes.at(part.element, "todo", text)


_CHANNEL = 0xFF


@dataclass(frozen=True)
class PartPort:
    """One port of a part, with options of the driver ``yarp``; the uids of its places lack the bus."""

    name: str
    options: YarpOptions
    groups: Sequence[GeometryGroup]

    @property
    def uids(self) -> list[int]:
        return [
            first + channel
            for run in self.options.triangles
            for _, first in run.places()
            for channel in range(CHANNELS)
            if channel not in run.non_tactile()
        ]


def yarp_ports(
    part: DevicePart, ports: Sequence[PortRange], buses: Sequence[TranslatedBus], body: Body, notes: Notes
) -> list[PartPort]:
    """Return the ports of a part with a triangle that is switched on, in the order of the port map.

    Args:
        ports: as its wrapper maps them; several ranges may have one name.
        buses: of the part, with the kinds of its triangles.
    """
    modules = {
        (bus.patch, board, module.key): module
        for bus in buses
        for board in bus.options.boards
        for patch in RoboskinDriver(bus.options).patches_set_up([board])
        for module in patch.modules
        if module.kind in NON_TACTILE
    }
    found = []
    for name in dict.fromkeys(port.name for port in ports):
        of_name = [port for port in ports if port.name == name]
        length = max(port.local_first + port.last - port.first + 1 for port in of_name)
        places = {number: place for port in of_name for number, place in triangles_of(part, port, Notes()).items()}
        on = {number: place for number, place in sorted(places.items()) if place in modules}
        try:
            options = YarpOptions(length=length, triangles=tuple(_runs(on, modules)))
        except ConfigurationError as error:
            notes.add("odd", of_name[0].element.file, f"port {name} is left out: {error}")
            continue
        groups = [  # of sensors that feel touch, by their position in the vector
            msgspec.structs.replace(group, uid=tuple(CHANNELS * number + (uid & _CHANNEL) for uid in group.uid))
            for number, place in on.items()
            for group in body.groups.get(place, ())
            if group.type == "pressure"
        ]
        if on:
            found.append(PartPort(name, options, groups))
    return found


def _runs(on: Mapping[int, Place], modules: Mapping[Place, Module]) -> list[Triangles]:
    patches = Counter(board for _, board in {place[:2] for place in on.values()})
    runs: dict[tuple[object, ...], list[int]] = {}
    for number, place in on.items():
        patch, board, triangle = place
        module = modules[place]
        thermal = tuple(k for k, sensor in enumerate(module.channels) if sensor and sensor.type_name == "temperature")
        label = board if patches[board] == 1 else 100 * patch + board
        runs.setdefault((label, CHANNELS * (number - triangle), module.kind, thermal), []).append(triangle)
    return [
        Triangles(label, first, tuple(triangles), kind, None if thermal == NON_TACTILE[kind] else thermal)  # type: ignore[arg-type, index]
        for (label, first, kind, thermal), triangles in runs.items()
    ]
