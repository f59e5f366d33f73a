"""Find skin devices and their other files in folders, and translate them to configurations."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware.geometry import GeometryGroup, geometry_to_toml
from skinware.tactile.regions import Region, regions_to_toml
from skinware.text import nearest_name
from skinware_drivers.can.roboskin_layout import CHANNELS
from skinware_drivers.icub.body import (
    Drawing,
    Positions,
    check_drawings,
    is_drawing,
    is_positions,
    on_bus,
    read_body,
    read_drawing,
    read_positions,
    read_text,
    regions_of,
    triangles_of,
)
from skinware_drivers.icub.device import WRAPPER, DeviceReader, PortRange, Wrapper, read_wrapper
from skinware_drivers.icub.part import DEVICE_TYPES, ETHERNET, DevicePart, PartReader
from skinware_drivers.icub.translate import (
    PartPort,
    TranslatedBus,
    configuration_text,
    enabled_places,
    service_name,
    translate,
    yarp_ports,
)
from skinware_drivers.icub.xml_tree import Element, Notes, shown

_SUFFIXES = (".xml", ".txt", ".ini")
_MOST_FILES = 20_000
_RELATED_DEVICES = ("skin", "inertial", "mtb")


@dataclass
class ImportedPart:
    """One skin device, translated.

    Attributes:
        name: of the skin; a name that a service can have.
        groups: places of its sensors, with those that are switched off.
        placed: number of sensors that are switched on and have a place.
    """

    name: str
    part: DevicePart
    ports: Sequence[PortRange]
    buses: list[TranslatedBus]
    yarp: list[PartPort]
    groups: list[GeometryGroup]
    regions: list[Region]
    triangles: int
    placed: int

    def configuration(self, geometry: str = "", root: str = "") -> str:
        """Return its configuration file.

        Args:
            geometry: name of the file with the places of the sensors.
            root: read its compensated ports, whose names begin so: ``yarp:///icub/skin``; empty: its boards.
        """
        where = shown(self.part.element.file.name)
        if root:
            lines = [f"The ports of {shown(self.part.name)}, made by skin-import from {where}."]
            lines += ['For what its boards send, leave _comp out of the names and add values = "raw".']
            ports = [(f"{root}/{port.name}_comp", "", port.options) for port in self.yarp]
            return configuration_text("yarp", self.name, ports, lines, geometry)
        lines = [f"{shown(self.part.name)} ({self.part.device_type}), made by skin-import from {where}."]
        if self.ports:
            lines.append(f"Body parts: {shown(', '.join(port.name for port in self.ports))}.")
        if self.part.device_type == ETHERNET:
            lines.append(
                "The robot reads these boards through an Ethernet board. This driver needs the CAN bus itself."
            )
            lines.append("It must be the only one that sets the boards up.")
        buses = [(bus.name, bus.comment, bus.options) for bus in self.buses]
        return configuration_text("roboskin", self.name, buses, lines, geometry)

    def geometry(self, *, by_port: bool = False) -> str:
        groups, by = self.groups, ""
        if by_port:
            groups = [group for bus, port in enumerate(self.yarp) for group in on_bus(bus, port.groups)]
            by = " by their ports"
        lines = f"Places of the sensors of {self.name}{by}, made by skin-import: its driver publishes them."
        return geometry_to_toml(groups, lines)

    def regions_text(self, *, by_port: bool) -> str:
        """Return a file of regions: the ports, or the body parts; empty if no body part is known."""
        if not by_port:
            made = f"Body parts of {self.name} as regions, made by skin-import."
            return regions_to_toml(self.regions, made) if self.regions else ""
        regions = [
            Region(port.name, "pressure", (self.name,), tuple(bus << 32 | uid for uid in port.uids), ())
            for bus, port in enumerate(self.yarp)
        ]
        return regions_to_toml(regions, f"Ports of {self.name} as regions, made by skin-import.")

    def figures(self) -> dict[str, object]:
        return {
            "name": self.name,
            "device": self.part.name,
            "type": self.part.device_type,
            "file": shown(self.part.element.file),
            "buses": [{"patch": b.patch, "name": b.name, "boards": list(b.options.boards)} for b in self.buses],
            "body_parts": [port.name for port in self.ports],
            "triangles": self.triangles,
            "sensors": self.triangles * CHANNELS,
            "sensors_with_a_place": self.placed,
        }


@dataclass
class Import:
    parts: list[ImportedPart]
    files: list[Path]


def import_files(
    paths: Iterable[Path],
    notes: Notes,
    *,
    only: Sequence[str] = (),
    positions: Mapping[str, Path] | None = None,
    bus_names: Mapping[int, str] | None = None,
    wants_buses: bool = True,
) -> Import:
    """Translate the skin devices in files and folders.

    Args:
        paths: XML of robots-configuration, position files and drawings of skinGui, and folders of them.
        notes: takes the remarks, also if this raises.
        positions: position file of a body part, if the names of the files are ambiguous.
        bus_names: bus of each patch; only for one device.
        wants_buses: their buses will be connected to this computer.
    """
    files = _Sources(dict(positions or {}), notes)
    for path in paths:
        files.add(path)
    devices = [device for device in files.devices if device.attributes.get("type") in DEVICE_TYPES]
    if not devices:
        raise ConfigurationError(f"no device of type {' or '.join(DEVICE_TYPES)} in what was read")
    for name in only:
        if not any(device.name == name for device in devices):
            others = nearest_name(name, sorted(device.name for device in devices))
            raise ConfigurationError(f"--part {name}: there is none{others}")
    devices = [device for device in devices if not only or device.name in only]
    if bus_names and len(devices) > 1:
        raise ConfigurationError(f"--bus names buses of one part, but there are {len(devices)}; choose one with --part")
    wrappers = [
        read_wrapper(files.reader.group_of(device))
        for device in files.devices
        if device.attributes.get("type") == WRAPPER
    ]
    used: list[Wrapper] = []
    parts: list[ImportedPart] = []
    for device in devices:
        part = PartReader(device.name or "skin", device.attributes["type"], files.reader.group_of(device), notes).read()
        wrapper = _wrapper_of(part, wrappers, notes)
        used += [wrapper] if wrapper else []
        ports = wrapper.ports if wrapper else ()
        body = read_body(part, ports, *files.of_ports(ports), notes)
        buses = translate(part, body, bus_names or {}, notes, wants_names=wants_buses)
        if not buses:
            continue
        quiet = Notes()
        places = {port.name: set(triangles_of(part, port, quiet).values()) for port in ports}
        enabled = enabled_places(buses)
        check_drawings(body, places, enabled, notes)
        name = service_name(part.name, {each.name for each in parts})
        placed = sum(len(group.uid) for place in enabled for group in body.groups.get(place, ()))
        patches = [bus.patch for bus in buses]
        groups = [
            group
            for bus, patch in enumerate(patches)
            for place, of_place in body.groups.items()
            if place[0] == patch
            for group in on_bus(bus, of_place)
        ]
        regions = regions_of(name, places, enabled, patches)
        yarp = yarp_ports(part, ports, buses, body, notes)
        parts.append(ImportedPart(name, part, ports, buses, yarp, groups, regions, len(enabled), placed))
    if not only:
        _name_unused(files.devices, [wrapper for wrapper in wrappers if wrapper not in used], notes)
    files.name_unused({port.name for part in parts for port in part.ports})
    return Import(parts, files.read)


def _wrapper_of(part: DevicePart, wrappers: Sequence[Wrapper], notes: Notes) -> Wrapper | None:
    """Return the wrapper with the ports of a device; with several robots, the one in the nearest folder."""
    where = part.element.file.resolve().parts

    def shared(wrapper: Wrapper) -> int:
        pairs = zip(where, wrapper.element.file.resolve().parts, strict=False)
        return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))

    of_part = [wrapper for wrapper in wrappers if wrapper.device == part.name]
    if not of_part:
        text = "no skinWrapper with its ports, so its body parts and the places of its taxels are unknown"
        notes.at(part.element, "missing", text)
        return None
    nearest = max(of_part, key=shared)
    notes.take(nearest.notes)
    return nearest


def _name_unused(devices: Sequence[Element], wrappers: Sequence[Wrapper], notes: Notes) -> None:
    """Note the wrappers of no imported device, and devices that are related to skin and not imported."""
    for wrapper in wrappers:
        notes.at(wrapper.element, "missing", f"there is no skin device {wrapper.device!r}; its ports are not used")
    for element in devices:
        kind = element.attributes.get("type", "")
        if kind in (WRAPPER, *DEVICE_TYPES) or not any(word in kind.lower() for word in _RELATED_DEVICES):
            continue
        text, is_skin = f"a device of type {kind!r} is not imported", "skin" in kind.lower()
        if not is_skin:
            text += "; for inertial sensors, see the option inertial of the driver"
        notes.at(element, "unknown" if is_skin else "info", text)


class _Sources:
    """The devices, position files and drawings in files and folders, and the position files that a person chose."""

    def __init__(self, chosen: Mapping[str, Path], notes: Notes) -> None:
        self.reader = DeviceReader(notes)
        self.devices: list[Element] = []
        self.read: list[Path] = []
        self._chosen, self._notes = chosen, notes
        self._positions: list[Path] = []
        self._drawings: list[tuple[Drawing, Notes]] = []
        self._used: set[Path] = set()

    def add(self, path: Path) -> None:
        if not path.is_dir():
            self._take(path)
            return
        found: list[Path] = []
        for where, folders, names in os.walk(path):
            folders.sort()
            found += [Path(where, name) for name in sorted(names) if name.lower().endswith(_SUFFIXES)]
            if len(found) > _MOST_FILES:
                raise ConfigurationError(f"{path}: more than {_MOST_FILES} files: give the folder of one robot")
        for file in found:
            try:
                self._take(file, is_asked_for=False)
            except ConfigurationError as error:
                self._notes.add("missing", file, f"cannot be used: {error}")

    def _take(self, path: Path, *, is_asked_for: bool = True) -> None:
        self.read.append(path)
        if path.suffix.lower() not in (".txt", ".ini"):
            self.devices += self.reader.devices(path)
            return
        text = read_text(path)
        if is_positions(text):
            self._positions.append(path)
        elif is_drawing(text):
            own = Notes()
            self._drawings.append((read_drawing(path, text, own), own))
        elif is_asked_for:
            raise ConfigurationError(f"{path}: neither a position file nor a drawing of skinGui")
        else:
            self._notes.add("info", path, "neither a position file nor a drawing of skinGui")

    def of_ports(self, ports: Sequence[PortRange]) -> tuple[dict[str, Positions], dict[str, Drawing]]:
        """Return positions and drawings by body part; with several of one part, and none chosen, none."""
        positions, drawings = {}, {}
        for port in ports:
            path = self._chosen.get(port.name) or self._positions_of(port)
            if path is not None:
                self._used.add(path)
                positions[port.name] = read_positions(path, self._notes)
            found = [(drawing, own) for drawing, own in self._drawings if drawing.part == port.name]
            self._used.update(drawing.path for drawing, _ in found)
            if len(found) > 1:
                names = ", ".join(drawing.path.name for drawing, _ in found)
                self._notes.at(port.element, "odd", f"several drawings, none used: {names}")
            elif found:
                drawings[port.name], own = found[0]
                self._notes.take(own)
        return positions, drawings

    def _positions_of(self, port: PortRange) -> Path | None:
        """Find it by the name of the file: ``torso.txt``, ``left_hand_V2_1.txt``."""
        exact = [path for path in self._positions if path.stem == port.name]
        similar = [path for path in self._positions if path.stem.startswith(f"{port.name}_")]
        candidates = exact if len(exact) == 1 else [*exact, *similar]
        if len(candidates) > 1:
            names = ", ".join(path.name for path in candidates)
            text = f"several position files ({names}), none used: choose one with --positions {port.name}=FILE"
            self._notes.at(port.element, "todo", text)
            return None
        return candidates[0] if candidates else None

    def name_unused(self, ports: set[str]) -> None:
        for name in self._chosen:
            if name not in ports:
                raise ConfigurationError(f"--positions {name}=...: no part that is imported has a port of this name")
        for path in [*self._positions, *(drawing.path for drawing, _ in self._drawings)]:
            if path not in self._used:
                self._notes.add("info", path, "no body part of this name is imported")
