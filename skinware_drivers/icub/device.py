"""Read devices and port maps of skins in a robot's XML, with all included files."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from skinware.errors import ConfigurationError
from skinware_drivers.icub.xml_tree import Element, Notes, read_xml, words

_MOST_INCLUDES = 200
_LONGEST_CHAIN = 8
_HIGHEST_FOLDER = 6
_CONTAINERS = ("devices", "params", "robot")
_FILES_OF_THE_ROBOT = ("general.xml", "pc104.xml", "-eln.xml")
"""Parameters of all robots' devices that are not about skin."""


@dataclass
class Group:
    """Named parameters, groups, and lists of elements ``elem``; ``others`` do not belong in a device."""

    element: Element
    params: dict[str, Element] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    lists: dict[str, list[Element]] = field(default_factory=dict)
    actions: list[Element] = field(default_factory=list)
    others: list[Element] = field(default_factory=list)


class DeviceReader:
    def __init__(self, notes: Notes) -> None:
        self._notes = notes
        self._files: dict[Path, Element | ConfigurationError] = {}
        self._seen: set[int] = set()

    def devices(self, path: Path) -> Iterator[Element]:
        """Return the elements ``device`` of a file and its included files, without those found before."""
        root = self._read(path)
        if root.tag != "params":  # parameters belong to the including element
            yield from self._devices(root, [path.resolve()])

    def group_of(self, device: Element) -> Group:
        group = Group(device)
        device.understood = True
        self._fill(group, device, [device.file.resolve()], [0])
        return group

    def _devices(self, element: Element, trail: list[Path]) -> Iterator[Element]:
        if element.tag == "device":
            if id(element) not in self._seen:
                self._seen.add(id(element))
                yield element
            return
        target = _target(element)
        if target is not None:
            found = self._include(element, target, trail, is_needed="skin" in target.lower())
            if found is not None:
                yield from self._devices(found, [*trail, found.file.resolve()])
            return
        for child in element.children:
            yield from self._devices(child, trail)

    def _fill(self, group: Group, element: Element, trail: list[Path], count: list[int]) -> None:
        for child in element.children:
            target = _target(child)
            if target is not None:
                child.understood = True
                count[0] += 1
                if count[0] > _MOST_INCLUDES:
                    raise ConfigurationError(f"{child.file}:{child.line}: more than {_MOST_INCLUDES} files included")
                is_needed = not target.strip().endswith(_FILES_OF_THE_ROBOT)
                found = self._include(child, target, trail, is_needed=is_needed)
                if found is not None and found.tag != "device":
                    found.understood = True
                    whole = found if found.tag in _CONTAINERS else Element("params", {}, found.file, 0, [found])
                    self._fill(group, whole, [*trail, found.file.resolve()], count)
            elif child.tag in _CONTAINERS:
                child.understood = True
                self._fill(group, child, trail, count)
            elif child.tag == "param":
                first = group.params.setdefault(child.name, child)
                if first is not child:
                    child.understood = True
                if first.text.split() != child.text.split():
                    again, counts = (" ".join(param.text.split()) for param in (child, first))
                    self._notes.at(child, "odd", f"given again as {again!r}; the first counts ({counts!r})")
            elif child.tag == "group":
                child.understood = True
                inner = group.groups.setdefault(child.name, Group(child))
                self._fill(inner, child, trail, count)
            elif child.tag == "paramlist":
                child.understood = True
                group.lists.setdefault(child.name, []).extend(child.children)
            elif child.tag == "action":
                group.actions.append(child)
                inner = Group(child)
                self._fill(inner, child, trail, count)
                group.lists.update(inner.lists)
            else:
                group.others.append(child)

    def _include(self, element: Element, target: str, trail: list[Path], *, is_needed: bool) -> Element | None:
        path = _find(target, element.file)
        if path is None:
            self._notes.at(element, "missing" if is_needed else "info", f"{target!r} is not there")
            return None
        if path.resolve() in trail:
            self._notes.at(element, "odd", f"{target!r} includes itself; left out")
            return None
        if len(trail) >= _LONGEST_CHAIN:
            self._notes.at(element, "odd", f"{target!r}: files include each other {_LONGEST_CHAIN} deep; left out")
            return None
        try:
            return self._read(path)
        except ConfigurationError as error:
            self._notes.at(element, "missing", f"{target!r} cannot be read: {error}")
            return None

    def _read(self, path: Path) -> Element:
        key = path.resolve()
        if key not in self._files:
            try:
                self._files[key] = read_xml(path, self._notes)
            except ConfigurationError as error:
                self._files[key] = error
        found = self._files[key]
        if isinstance(found, ConfigurationError):
            raise ConfigurationError(str(found))
        return found


def _target(element: Element) -> str | None:
    """Return the name that an element includes; None if it includes nothing."""
    if element.tag.rpartition(":")[2] == "include":
        return element.attributes.get("href", "")
    if element.tag in ("params", "devices"):
        return element.attributes.get("file")
    return None


def _find(target: str, near: Path) -> Path | None:
    """Return a file by its name: in the folder of another file, or (older robots) in a folder above it."""
    if "://" in target or not target.strip():
        return None
    folders = [near.parent, *near.resolve().parent.parents][:_HIGHEST_FOLDER]
    for folder in folders:
        path = Path(os.path.normpath(folder / target.strip()))
        try:
            if path.is_file():
                return path
        except (OSError, ValueError):  # an impossible name
            return None
    return None


WRAPPER = "skinWrapper"
_LARGEST_INDEX = 1 << 16
_UNUSED = {
    "period": "how often the host publishes",
    "total_taxels": "the ports say as much",
    "device": "the kind of wrapper",
}


@dataclass(frozen=True)
class PortRange:
    """A body part in a skin device's index; ``local_first`` is its first index as position files count."""

    name: str
    element: Element
    first: int
    last: int
    local_first: int


@dataclass(frozen=True, eq=False)
class Wrapper:
    """The ports of one skin device, in the order of the file, and the remarks on them."""

    element: Element
    device: str
    ports: tuple[PortRange, ...]
    notes: Notes


def read_wrapper(group: Group) -> Wrapper:
    notes = Notes()
    ports = [port for element in group.lists.get("ports", ()) if (port := _port(element, notes)) is not None]
    if not ports:
        notes.at(group.element, "missing", "no usable port in a paramlist 'ports'")
    networks = group.lists.get("networks", [])
    names = []
    for element in networks:
        element.understood = True
        names += words(element.text)
    if len(names) > 1:
        notes.at(networks[0], "odd", f"several devices ({', '.join(names)}): the ports are taken for the first")
    for name, why in _UNUSED.items():
        if name in group.params:
            group.params[name].understood = True
            notes.at(group.params[name], "info", why)
    for action in group.actions:
        action.understood = True
    rest = [*group.params.values(), *group.others, *(inner.element for inner in group.groups.values())]
    rest += [e for name, elements in group.lists.items() if name not in ("ports", "networks") for e in elements]
    for element in rest:
        if not element.understood:
            notes.at(element, "unknown", f"not understood{f': {element.text!r}' if element.text else ''}")
    return Wrapper(group.element, names[0] if names else "", tuple(ports), notes)


def _port(element: Element, notes: Notes) -> PortRange | None:
    row = notes.numbers(element)
    if row is None:
        return None
    if len(row) != 4:
        notes.refuse(element, f"{len(row)} numbers, not 4 (wholeStart wholeEnd localStart localEnd)")
        return None
    first, last, local_first, local_last = row
    if not 0 <= first <= last < _LARGEST_INDEX or local_first < 0 or last - first != local_last - local_first:
        notes.refuse(element, f"{element.text!r}: the two ranges differ in length")
        return None
    return PortRange(element.name, element, first, last, local_first)
