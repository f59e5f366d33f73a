"""Port maps of a ``skinWrapper``: which piece of a skin device's index is which part of the body.

Source: robotology/robots-configuration, ``wrappers/skin``: each port is ``wholeStart wholeEnd localStart localEnd``.
"""

from __future__ import annotations

from dataclasses import dataclass

from skinware_drivers.icub.device import Group
from skinware_drivers.icub.notes import Notes
from skinware_drivers.icub.values import Reader, words
from skinware_drivers.icub.xml_tree import Element

WRAPPER = "skinWrapper"
_LARGEST_INDEX = 1 << 16
_UNUSED = {
    "period": "how often the host publishes",
    "total_taxels": "the ports say as much",
    "device": "the kind of wrapper",
}


@dataclass(frozen=True)
class Port:
    """A body part in a skin device's index.

    Attributes:
        name: of the body part.
        element: where it stands.
        first: index of its first value in the device.
        last: of its last.
        local_first: index of its first value in the body part, as position files count.
    """

    name: str
    element: Element
    first: int
    last: int
    local_first: int


@dataclass(frozen=True)
class Wrapper:
    """The ports of one skin device.

    Attributes:
        device: name of the skin device.
        ports: in the order of the file.
    """

    device: str
    ports: tuple[Port, ...]


def read_wrapper(group: Group, notes: Notes) -> Wrapper:
    """Make sense of a wrapper; what makes none is noted."""
    return _WrapperReader(notes).read(group)


class _WrapperReader(Reader):
    def read(self, group: Group) -> Wrapper:
        ports: list[Port] = []
        for element in group.lists.get("ports", ()):
            port = self._port(element)
            if port is not None:
                ports.append(port)
        if not ports:
            self.note("missing", group.element, "no usable port in a paramlist 'ports'")
        networks = group.lists.get("networks", [])
        names = []
        for element in networks:
            element.understood = True
            names += words(element.text)
        if len(names) > 1:
            self.note("odd", networks[0], f"several devices ({', '.join(names)}): the ports are taken for the first")
        for name, why in _UNUSED.items():
            if name in group.params:
                group.params[name].understood = True
                self.note("info", group.params[name], why)
        for action in group.actions:
            action.understood = True
        for element in self._rest(group):
            if not element.understood:
                self.note("unknown", element, f"not understood{f': {element.text!r}' if element.text else ''}")
        return Wrapper(names[0] if names else "", tuple(ports))

    def _port(self, element: Element) -> Port | None:
        row = self.numbers(element)
        if row is None:
            return None
        if len(row) != 4:
            self.refuse(element, f"{len(row)} numbers, not 4 (wholeStart wholeEnd localStart localEnd)")
            return None
        first, last, local_first, local_last = row
        if not 0 <= first <= last < _LARGEST_INDEX or local_first < 0 or last - first != local_last - local_first:
            self.refuse(element, f"{element.text!r}: the two ranges differ in length")
            return None
        return Port(element.name, element, first, last, local_first)

    @staticmethod
    def _rest(group: Group) -> list[Element]:
        rest = [*group.params.values(), *group.others]
        rest += [inner.element for inner in group.groups.values()]
        rest += [e for name, elements in group.lists.items() if name not in ("ports", "networks") for e in elements]
        return rest
