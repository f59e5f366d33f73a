"""Order the sensors of a driver as a robot's port does, and scale their values to 0 to 255, as its programs expect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.structure import Structure
from skinware.tactile.regions import Region, Regions

FULL = 255.0
"""The value of a sensor at full scale: values of iCub's compensated ports lie between 0 at rest and this."""
_OF_A_BOARD, _OF_A_TRIANGLE = 192, 12
_BUS_SHIFT, _BOARD_SHIFT, _TRIANGLE_SHIFT = 32, 16, 8

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Vector:
    """The vector of a port.

    Attributes:
        sensors: (n,) index of sensors in a frame.
        places: (n,) index of their values in the vector.
        length: of the vector; values without a sensor are 0.
        scale, offset: from raw values to physical ones.
        full: physical value that becomes 255.
    """

    sensors: Indices
    places: Indices
    length: int
    scale: float
    offset: float
    full: float

    def of(self, values: npt.NDArray[np.generic], status: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
        """Return (length,) the vector of (n_sensors,) raw values; 0 for those that are not good (status 0)."""
        vector = np.zeros(self.length)
        good = status[self.sensors] == 0
        numbers = values[self.sensors[good]].astype(np.float64) * self.scale + self.offset
        vector[self.places[good]] = np.clip(np.nan_to_num(numbers * FULL / self.full), 0.0, FULL)
        return vector


def vectors_of(
    name: str,
    structure: Structure,
    driver_type: str,
    *,
    type_name: str = "pressure",
    full_scale: float | None = None,
    regions: Sequence[Region] = (),
) -> dict[str, Vector]:
    """Return the vectors of a driver, by the last part of the names of their ports: one for each region, or one.

    The order is that of iCub's ports where it is known. A driver of the type ``roboskin`` has 192 places for each
    board, in configured order, with the boards of the last bus first. A driver of the type ``yarp`` has a port for each
    that it reads, with the same places; if these are boards, up to the end of the last board. Sensors of other drivers
    have the order of the structure.

    Args:
        full_scale: physical value that becomes 255; None: the maximum of the type.

    Raises:
        ConfigurationError: it has no such sensors, or their full scale is not known.
    """
    if type_name not in [kind.name for kind in structure.types]:
        raise ConfigurationError(f"driver {name} has no sensors of the type {type_name!r}")
    kind = structure.type(type_name)
    full = kind.maximum if full_scale is None else full_scale
    if not 0 < full < np.inf:
        raise ConfigurationError(f"driver {name}: what is 255? Its {type_name} has no maximum: give --full-scale")
    of_type = structure.index(type_name)
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
        names = []
        for number, other in zip(numbers, own, strict=True):
            port = structure.buses[number].partition("?")[0]
            last = port.rpartition("/")[2] if port.startswith("yarp://") else ""
            names.append(last or other)
        return {each: of_type[bus == number] for each, number in zip(names, numbers, strict=True)}
    if not of_driver:
        return {name: of_type}
    index = Regions(regions).of(structure, type_name)
    parts = {region.name: of_type[index[region.name]] for region in of_driver if region.name in index}
    return {part: sensors for part, sensors in parts.items() if len(sensors)}


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
