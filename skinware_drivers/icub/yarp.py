"""Translate a part's ports of YARP to options of the driver ``yarp``, with the places of their values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec.structs

from skinware.errors import ConfigurationError
from skinware.geometry import GeometryGroup
from skinware_drivers.can.roboskin import RoboskinDriver
from skinware_drivers.can.roboskin_options import CHANNELS, NON_TACTILE
from skinware_drivers.description import Module
from skinware_drivers.icub.body import Body, Place, triangles_of
from skinware_drivers.icub.device import PortRange
from skinware_drivers.icub.part import DevicePart
from skinware_drivers.icub.translate import TranslatedBus
from skinware_drivers.icub.xml_tree import Notes
from skinware_drivers.streams.yarp import Triangles, YarpOptions

_CHANNEL = 0xFF


@dataclass(frozen=True)
class PartPort:
    """One port of a part.

    Attributes:
        name: of the body part, the end of the port's name.
        options: of the driver ``yarp``.
        groups: places of its sensors; their uid lack the bus.
    """

    name: str
    options: YarpOptions
    groups: Sequence[GeometryGroup]

    @property
    def uids(self) -> list[int]:
        """Return the uids of its sensors that feel touch, without the bus."""
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
    modules = _modules(buses)
    found = []
    for name in dict.fromkeys(port.name for port in ports):
        of_name = [port for port in ports if port.name == name]
        length = max(port.local_first + port.last - port.first + 1 for port in of_name)
        places = {number: place for port in of_name for number, place in triangles_of(part, port, Notes()).items()}
        on = {number: place for number, place in places.items() if place in modules}
        try:
            options = YarpOptions(length=length, triangles=tuple(_runs(on, modules)))
        except ConfigurationError as error:
            notes.add("odd", of_name[0].element.file, f"port {name} is left out: {error}")
            continue
        if on:
            found.append(PartPort(name, options, _groups(on, body)))
    return found


def _modules(buses: Sequence[TranslatedBus]) -> dict[Place, Module]:
    return {
        (bus.patch, board, module.key): module
        for bus in buses
        for board in bus.options.boards
        for patch in RoboskinDriver(bus.options).patches_set_up([board])
        for module in patch.modules
        if module.kind in NON_TACTILE
    }


def _runs(on: Mapping[int, Place], modules: Mapping[Place, Module]) -> list[Triangles]:
    patches = Counter(board for _, board in {place[:2] for place in on.values()})
    runs: dict[tuple[object, ...], list[int]] = {}
    for number, place in sorted(on.items()):
        patch, board, triangle = place
        module = modules[place]
        thermal = tuple(k for k, sensor in enumerate(module.channels) if sensor and sensor.type_name == "temperature")
        label = board if patches[board] == 1 else 100 * patch + board
        runs.setdefault((label, CHANNELS * (number - triangle), module.kind, thermal), []).append(triangle)
    return [
        Triangles(label, first, tuple(triangles), kind, None if thermal == NON_TACTILE[kind] else thermal)  # type: ignore[arg-type, index]
        for (label, first, kind, thermal), triangles in runs.items()
    ]


def _groups(on: Mapping[int, Place], body: Body) -> list[GeometryGroup]:
    """Return the places of sensors that feel touch, by their position in the vector."""
    return [
        msgspec.structs.replace(group, uid=tuple(CHANNELS * number + (uid & _CHANNEL) for uid in group.uid))
        for number, place in sorted(on.items())
        for group in body.groups.get(place, ())
        if group.type == "pressure"
    ]
