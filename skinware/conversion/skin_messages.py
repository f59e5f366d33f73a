"""Our own messages for ROS 2, as bytes: ``skinware_msgs/SkinFrame`` and ``skinware_msgs/Sensors``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from skinware.conversion.cdr import Cdr
from skinware.driver_snapshot import DriverSnapshot
from skinware.structure import Structure


def acquired_ns(frame: DriverSnapshot, time_ns: int) -> int:
    """When the newest data of a frame was acquired, wall clock; when it was published, if it has none.

    Args:
        frame: it.
        time_ns: when it was published, wall clock.
    """
    return time_ns - (frame.published_ns - frame.acquired_ns if frame.acquired_ns else 0)


def skin_frame(frame: DriverSnapshot, time_ns: int, status: npt.NDArray[np.uint8] | None = None) -> bytes:
    """All values of a frame, as ``skinware_msgs/SkinFrame``.

    Args:
        frame: it.
        time_ns: when it was published, wall clock.
        status: (n_sensors,) of the sensors; default: as of the frame.
    """
    structure = frame.structure
    values = np.zeros(structure.n_sensors)
    for sensor_type in structure.types:
        values[structure.index(sensor_type.name)] = structure.physical(frame.values, sensor_type.name)
    cdr = Cdr().header(acquired_ns(frame, time_ns), "").numbers("Q", frame.generation, frame.sequence)
    cdr.numbers("q", frame.acquired_ns, frame.published_ns)
    return cdr.array(values).array(frame.status if status is None else status).array(frame.module_time_ns).done()


def sensors(structure: Structure, names: Sequence[str], generation: int, time_ns: int) -> bytes:
    """What the sensors of a generation are, as ``skinware_msgs/Sensors``.

    Args:
        structure: of it.
        names: of the sensors, as people know them.
        generation: its number.
        time_ns: wall clock.
    """
    types = {each.id: each for each in structure.types}
    of_sensors = [types[type_id] for type_id in structure.sensor_type.tolist()]
    cdr = Cdr().header(time_ns, "").numbers("Q", generation).array(structure.sensor_uid)
    cdr.texts(names).texts([each.name for each in of_sensors]).texts([each.unit for each in of_sensors])
    cdr.array(np.array([each.scale for each in of_sensors])).array(np.array([each.offset for each in of_sensors]))
    cdr.array(structure.sensor_module)
    geometry = structure.geometry
    places = np.full((structure.n_sensors, 3), np.nan) if geometry is None else geometry.position_m
    cdr.texts([""] * structure.n_sensors if geometry is None else geometry.frame.tolist())
    for axis in range(3):
        cdr.array(places[:, axis])
    return cdr.done()
