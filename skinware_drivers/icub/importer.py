"""Find skin devices and their other files in folders, and translate them to configurations."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.geometry import GeometryGroup, geometry_to_toml
from skinware.tactile.regions import Region, regions_to_toml
from skinware.text import nearest_name
from skinware_drivers.can.roboskin_options import CHANNELS
from skinware_drivers.icub.body import (
    Drawing,
    check_drawings,
    is_drawing,
    places_of,
    read_body,
    read_drawing,
    regions_of,
)
from skinware_drivers.icub.device import WRAPPER, DeviceReader, PortRange, Wrapper, read_wrapper
from skinware_drivers.icub.part import DEVICE_TYPES, ETHERNET, DevicePart, read_part
from skinware_drivers.icub.positions import Positions, is_positions, read_positions, read_text
from skinware_drivers.icub.translate import (
    TranslatedBus,
    configuration_text,
    enabled_places,
    service_name,
    translate,
    yarp_configuration_text,
)
from skinware_drivers.icub.xml_tree import Element, Level, Notes, shown
from skinware_drivers.icub.yarp import PartPort, yarp_ports

_SUFFIXES = (".xml", ".txt", ".ini")
_MOST_FILES = 20_000
_RELATED_DEVICES = ("skin", "inertial", "mtb")


@dataclass
class ImportedPart:
    """One skin device, translated.

    Attributes:
        name: of the skin; a name that a service can have.
        ports: body parts in its index.
        buses: in the order of the configuration.
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

    def configuration(self, geometry: str = "") -> str:
        """Return its configuration file; ``geometry`` is the name of the file with the places of the sensors."""
        where = shown(self.part.element.file.name)
        lines = [f"{shown(self.part.name)} ({self.part.device_type}), made by skin-import from {where}."]
        if self.ports:
            lines.append(f"Body parts: {shown(', '.join(port.name for port in self.ports))}.")
        if self.part.device_type == ETHERNET:
            lines.append(
                "The robot reads these boards through an Ethernet board. This driver needs the CAN bus itself."
            )
            lines.append("It must be the only one that sets the boards up.")
        return configuration_text(self.name, self.buses, "\n".join(lines), geometry)

    def geometry(self) -> str:
        lines = f"Places of the sensors of {self.name}, made by skin-import: its driver publishes them."
        return geometry_to_toml(self.groups, lines)

    def yarp_configuration(self, root: str, geometry: str = "") -> str:
        """Return a configuration file that reads its compensated ports.

        Args:
            root: beginning of the names of the ports' buses, as ``yarp:///icub/skin``.
            geometry: name of the file with the places of the sensors.
        """
        where = shown(self.part.element.file.name)
        lines = f"The ports of {shown(self.part.name)}, made by skin-import from {where}.\nFor what its boards send, "
        lines += 'leave _comp out of the names and add values = "raw".'
        buses = [(f"{root}/{port.name}_comp", port.options) for port in self.yarp]
        return yarp_configuration_text(self.name, buses, lines, geometry)

    def yarp_geometry(self) -> str:
        groups = [
            msgspec.structs.replace(group, uid=tuple(bus << 32 | uid for uid in group.uid))
            for bus, port in enumerate(self.yarp)
            for group in port.groups
        ]
        lines = f"Places of the sensors of {self.name} by their ports, made by skin-import: its driver publishes them."
        return geometry_to_toml(groups, lines) if groups else ""

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
    """The result of an import."""

    parts: list[ImportedPart]
    files: list[Path]


@dataclass
class _Sources:
    devices: list[Element] = field(default_factory=list)
    positions: list[Path] = field(default_factory=list)
    drawings: list[Path] = field(default_factory=list)
    files: list[Path] = field(default_factory=list)


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
    reader = DeviceReader(notes)
    sources = _Sources()
    for path in paths:
        _gather(path, reader, sources, notes)
    devices = _pick(sources.devices, only)
    if bus_names and len(devices) > 1:
        raise ConfigurationError(f"--bus names buses of one part, but there are {len(devices)}; choose one with --part")
    wrappers = _Wrappers(reader, sources.devices)
    files = _BodyFiles(sources, dict(positions or {}), notes)
    parts: list[ImportedPart] = []
    for device in devices:
        part = read_part(device.name or "skin", device.attributes["type"], reader.group_of(device), notes)
        ports = wrappers.ports_of(part, notes)
        body = read_body(part, ports, *files.of_ports(ports), notes)
        buses = translate(part, body, bus_names or {}, notes, wants_names=wants_buses)
        if not buses:
            continue
        enabled, places = enabled_places(buses), places_of(part, ports)
        check_drawings(body, places, enabled, notes)
        name = service_name(part.name, {each.name for each in parts})
        placed = sum(len(group.uid) for place in enabled for group in body.groups.get(place, ()))
        patches = [bus.patch for bus in buses]
        groups, regions = body.groups_of(patches), regions_of(name, places, enabled, patches)
        yarp = yarp_ports(part, ports, buses, body, notes)
        parts.append(ImportedPart(name, part, ports, buses, yarp, groups, regions, len(enabled), placed))
    if not only:
        wrappers.name_unused(notes)
    files.name_unused({port.name for part in parts for port in part.ports})
    return Import(parts, sources.files)


def _gather(path: Path, reader: DeviceReader, sources: _Sources, notes: Notes) -> None:
    if not path.is_dir():
        _take(path, reader, sources, notes)
        return
    for file in _files_in(path):
        try:
            _take(file, reader, sources, notes, is_asked_for=False)
        except ConfigurationError as error:
            notes.add("missing", file, f"cannot be used: {error}")


def _files_in(folder: Path) -> list[Path]:
    found: list[Path] = []
    for where, folders, names in os.walk(folder):
        folders.sort()
        found += [Path(where, name) for name in sorted(names) if name.lower().endswith(_SUFFIXES)]
        if len(found) > _MOST_FILES:
            raise ConfigurationError(f"{folder}: more than {_MOST_FILES} files: give the folder of one robot")
    return found


def _take(path: Path, reader: DeviceReader, sources: _Sources, notes: Notes, *, is_asked_for: bool = True) -> None:
    sources.files.append(path)
    if path.suffix.lower() not in (".txt", ".ini"):
        sources.devices += reader.devices(path)
        return
    text = read_text(path)
    if is_positions(text):
        sources.positions.append(path)
    elif is_drawing(text):
        sources.drawings.append(path)
    elif is_asked_for:
        raise ConfigurationError(f"{path}: neither a position file nor a drawing of skinGui")
    else:
        notes.add("info", path, "neither a position file nor a drawing of skinGui")


def _pick(devices: Sequence[Element], names: Sequence[str]) -> list[Element]:
    found = [device for device in devices if device.attributes.get("type") in DEVICE_TYPES]
    if not found:
        raise ConfigurationError(f"no device of type {' or '.join(DEVICE_TYPES)} in what was read")
    for name in names:
        if not any(device.name == name for device in found):
            others = nearest_name(name, sorted(device.name for device in found))
            raise ConfigurationError(f"--part {name}: there is none{others}")
    return [device for device in found if not names or device.name in names]


class _Wrappers:
    """The skinWrappers, and their ports of skin devices."""

    def __init__(self, reader: DeviceReader, devices: Sequence[Element]) -> None:
        self._wrappers: list[tuple[Element, Wrapper, Notes]] = []
        self._others: list[Element] = []
        for device in devices:
            device_type = device.attributes.get("type", "")
            if device_type == WRAPPER:
                own = Notes()
                self._wrappers.append((device, read_wrapper(reader.group_of(device), own), own))
            elif device_type not in DEVICE_TYPES and any(word in device_type.lower() for word in _RELATED_DEVICES):
                self._others.append(device)
        self._used: set[int] = set()

    def ports_of(self, part: DevicePart, notes: Notes) -> Sequence[PortRange]:
        """Return the ports of a device; with several robots, those of the wrapper in the nearest folder."""
        where = part.element.file.resolve().parts
        of_part = [entry for entry in self._wrappers if entry[1].device == part.name]
        if not of_part:
            text = "no skinWrapper with its ports, so its body parts and the places of its taxels are unknown"
            notes.add("missing", part.element.file, text, line=part.element.line, element=part.element.label)
            return ()
        element, wrapper, own = max(of_part, key=lambda entry: _shared(where, entry[0].file.resolve().parts))
        self._used.add(id(element))
        notes.take(own)
        return wrapper.ports

    def name_unused(self, notes: Notes) -> None:
        for element, wrapper, _ in self._wrappers:
            if id(element) not in self._used:
                text = f"there is no skin device {wrapper.device!r}; its ports are not used"
                notes.add("missing", element.file, text, line=element.line, element=element.label)
        for element in self._others:
            text = f"a device of type {element.attributes['type']!r} is not imported"
            is_skin = "skin" in element.attributes["type"].lower()
            if not is_skin:
                text += "; for inertial sensors, see the option inertial of the driver"
            notes.add("unknown" if is_skin else "info", element.file, text, line=element.line, element=element.label)


def _shared(one: Sequence[str], other: Sequence[str]) -> int:
    """Return the number of folders that two paths share."""
    return next((n for n, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), min(len(one), len(other)))


class _BodyFiles:
    def __init__(self, sources: _Sources, chosen: Mapping[str, Path], notes: Notes) -> None:
        self._chosen, self._notes = chosen, notes
        self._positions = sources.positions
        self._drawings: list[tuple[Drawing, Notes]] = []
        for path in sources.drawings:
            own = Notes()
            self._drawings.append((read_drawing(path, own), own))
        self._used: set[Path] = set()

    def of_ports(self, ports: Sequence[PortRange]) -> tuple[dict[str, Positions], dict[str, Drawing]]:
        positions, drawings = {}, {}
        for port in ports:
            path = self._chosen.get(port.name) or self._positions_of(port)
            if path is not None:
                self._used.add(path)
                positions[port.name] = read_positions(path, self._notes)
            drawing = self._drawing_of(port)
            if drawing is not None:
                drawings[port.name] = drawing
        return positions, drawings

    def name_unused(self, ports: set[str]) -> None:
        """Note the files of body parts that are not imported."""
        for name in self._chosen:
            if name not in ports:
                raise ConfigurationError(f"--positions {name}=...: no part that is imported has a port of this name")
        for path in [*self._positions, *(drawing.path for drawing, _ in self._drawings)]:
            if path not in self._used:
                self._notes.add("info", path, "no body part of this name is imported")

    def _positions_of(self, port: PortRange) -> Path | None:
        """Find it by the name of the file: ``torso.txt``, ``left_hand_V2_1.txt``."""
        exact = [path for path in self._positions if path.stem == port.name]
        similar = [path for path in self._positions if path.stem.startswith(f"{port.name}_")]
        candidates = exact if len(exact) == 1 else [*exact, *similar]
        if len(candidates) > 1:
            names = ", ".join(path.name for path in candidates)
            self._note(
                port,
                "todo",
                f"several position files ({names}), none used: choose one with --positions {port.name}=FILE",
            )
            return None
        return candidates[0] if candidates else None

    def _drawing_of(self, port: PortRange) -> Drawing | None:
        found = [(drawing, own) for drawing, own in self._drawings if drawing.part == port.name]
        self._used.update(drawing.path for drawing, _ in found)
        if len(found) > 1:
            self._note(port, "odd", f"several drawings, none used: {', '.join(d.path.name for d, _ in found)}")
            return None
        for _, own in found:
            self._notes.take(own)
        return found[0][0] if found else None

    def _note(self, port: PortRange, level: Level, text: str) -> None:
        self._notes.add(level, port.element.file, text, line=port.element.line, element=port.element.label)
