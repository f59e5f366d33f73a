"""A driver's sensors in the order of a robot's port, and their values as its programs expect them: 0 to 255."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.structure import Structure
from skinware.tactile.regions import Region, Regions

FULL = 255.0
"""What a sensor at its full scale becomes: iCub's compensated ports have 0 at rest and at most this."""
_OF_A_BOARD, _OF_A_TRIANGLE = 192, 12
_BUS_SHIFT, _BOARD_SHIFT, _TRIANGLE_SHIFT = 32, 16, 8

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Vector:
    """A port's vector.

    Attributes:
        sensors: (n,) index of sensors in a frame.
        places: (n,) where each has its value.
        length: values of the vector; those without a sensor are 0.
        scale: of raw values, to physical ones.
        offset: likewise.
        full: physical value that becomes 255.
    """

    sensors: Indices
    places: Indices
    length: int
    scale: float
    offset: float
    full: float

    def of(self, values: npt.NDArray[np.generic], status: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
        """(length,) of a frame; 0 where there is no good value.

        Args:
            values: (n_sensors,) raw values.
            status: (n_sensors,) of each; 0 is good.
        """
        told = np.zeros(self.length)
        good = status[self.sensors] == 0
        numbers = values[self.sensors[good]].astype(np.float64) * self.scale + self.offset
        told[self.places[good]] = np.clip(np.nan_to_num(numbers * FULL / self.full), 0.0, FULL)
        return told


def vectors_of(
    name: str,
    structure: Structure,
    driver_type: str,
    *,
    type_name: str = "pressure",
    full_scale: float | None = None,
    regions: Sequence[Region] = (),
) -> dict[str, Vector]:
    """The ports of a driver, by the last part of their names: one for each region of it, or one for all.

    The order is that of iCub's ports where it is known: drivers of the type ``roboskin`` have 192 places for each
    board, in the order of their configuration, of which the boards of the last bus come first; drivers of the type
    ``yarp`` a port for each that they read, with its places; where these are boards, up to the end of the last one.
    Sensors of others stand in the order of the structure.

    Args:
        name: of the driver.
        structure: of it.
        driver_type: as the driver tells it.
        type_name: of sensors.
        full_scale: physical value that becomes 255; None: the type's greatest.
        regions: body parts.

    Raises:
        ConfigurationError: it has no such sensors, or nobody says what their full scale is.
    """
    if type_name not in [kind.name for kind in structure.types]:
        raise ConfigurationError(f"driver {name} has no sensors of the type {type_name!r}")
    kind = structure.type(type_name)
    full = kind.maximum if full_scale is None else full_scale
    if not 0 < full < np.inf:
        raise ConfigurationError(f"driver {name}: what is 255? Its {type_name} has no greatest value: say --full-scale")
    of_type = np.arange(structure.n_sensors)[structure.index(type_name)]
    vectors = {}
    for part, sensors in _parts(name, structure, driver_type, of_type, type_name, regions).items():
        places, length = _places(structure, driver_type, sensors)
        vectors[part] = Vector(sensors, places, length, kind.scale, kind.offset, full)
    return vectors


def _parts(
    name: str, structure: Structure, driver_type: str, of_type: Indices, type_name: str, regions: Sequence[Region]
) -> Mapping[str, Indices]:
    of_driver = [region for region in regions if not region.driver or name in region.driver]
    if not of_driver and driver_type == "yarp":
        bus = structure.sensor_uid[of_type].astype(np.int64) >> _BUS_SHIFT
        numbers = np.unique(bus).tolist()
        own = [name] if len(numbers) == 1 else [f"{name}_{number}" for number in numbers]
        names = [_port_of(structure.buses[number]) or other for number, other in zip(numbers, own, strict=True)]
        return {each: of_type[bus == number] for each, number in zip(names, numbers, strict=True)}
    if not of_driver:
        return {name: of_type}
    index = Regions(regions).of(structure, type_name)
    parts = {region.name: of_type[index[region.name]] for region in of_driver if region.name in index}
    return {part: sensors for part, sensors in parts.items() if len(sensors)}


def _port_of(bus: str) -> str:
    """The last part of a port's name, of the name of its bus; empty: it is not called after a port."""
    last = bus.partition("?")[0].rpartition("/")[2]
    return last if bus.startswith("yarp://") else ""


def _places(structure: Structure, driver_type: str, sensors: Indices) -> tuple[Indices, int]:
    uid = structure.sensor_uid[sensors].astype(np.int64)
    bus, of_bus = uid >> _BUS_SHIFT, uid & (1 << _BUS_SHIFT) - 1
    if driver_type == "yarp" and len(np.unique(bus)) == 1:
        length = int(of_bus.max()) + 1
        has_boards = any(name.startswith(b"board ") for name in structure.patch_name.tolist())
        return of_bus, -(-length // _OF_A_BOARD) * _OF_A_BOARD if has_boards else length
    if driver_type == "roboskin":
        board = uid >> _BOARD_SHIFT
        _, first = np.unique(board, return_index=True)
        order = sorted(first.tolist(), key=lambda at: (-bus[at], at))
        rank = {board[at]: number for number, at in enumerate(order)}
        triangle = (of_bus >> _TRIANGLE_SHIFT) & 0xFF
        channel = of_bus & 0xFF
        start = np.array([rank[each] for each in board]) * _OF_A_BOARD
        return start + triangle * _OF_A_TRIANGLE + channel, len(order) * _OF_A_BOARD
    return np.arange(len(sensors)), len(sensors)
