"""The service ``motion``: where to and how fast what touches each region of a skin goes, frame by frame.

::

    with MotionReader(namespace="calm", timeout_s=10) as motion:
        for frame in motion:
            for region in frame:
                print(region.name, region.load, region.speed_m_s, region.direction)

Columns of a frame: those of :data:`skinware.tactile.motion.COLUMNS`, a row for each region. Static columns:
``region_name``, ``frame_name``, ``driver``, ``type_name`` and ``type_unit``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
import numpy.typing as npt

from skinware._columns import texts
from skinware.errors import ConfigurationError
from skinware.memory.namespace import Namespace
from skinware.memory.ring import Sample
from skinware.service import Column, ServiceWriter
from skinware.skin_layout import SkinLayout
from skinware.structure import Structure
from skinware.tactile.contacts import ContactSet
from skinware.tactile.motion import COLUMNS, MotionSet, RegionMotion, motion_of
from skinware.tactile.regions import Regions
from skinware.tactile.source_reader import SourceReader

KIND = NAME = "motion"

_TEXTS = {
    "load": ("", "sum of the values of its touched sensors"),
    "contacts": ("", "number of contacts that reach into it"),
    "velocity_m_s": ("m/s", "of what touches it; NaN: nothing does"),
    "speed_m_s": ("m/s", "length of it"),
    "frame": ("", "row of frame_name; -1: not known"),
}


@dataclass(frozen=True)
class MotionSource:
    """What motion is of.

    Attributes:
        driver: name of the driver of the values.
        type_name: of its sensors.
        unit: of loads.
        regions: names of the regions.
        frames: names of the coordinate frames.
    """

    driver: str
    type_name: str
    unit: str
    regions: tuple[str, ...]
    frames: tuple[str, ...]


class MotionSample(Sample):
    """The motion of all regions in one frame; going through it goes through them."""

    __slots__ = ()

    @property
    def source(self) -> MotionSource:
        """What the motion is of."""
        return cast(MotionSource, self.context)

    @property
    def motion(self) -> MotionSet:
        """As arrays."""
        arrays = {name: self.column(name) for name in COLUMNS}
        return MotionSet(names=self.source.regions, frames=self.source.frames, **arrays)

    def __iter__(self) -> Iterator[RegionMotion]:
        return iter(self.motion)


class MotionReader(SourceReader[MotionSource, MotionSample]):
    """Reads the service ``motion``: a :class:`skinware.service.ServiceReader` whose frames are motion.

    Args:
        name: of the service.
        namespace, timeout_s, announce: as for :class:`skinware.service.ServiceReader`, which also lists the errors.

    Raises:
        BadServiceFile: the service is none of motion.
    """

    kind = KIND
    frame_class = MotionSample

    @staticmethod
    def _source_of(static: Mapping[str, npt.NDArray[Any]]) -> MotionSource:
        return MotionSource(
            driver=texts(static["driver"])[0],
            type_name=texts(static["type_name"])[0],
            unit=texts(static["type_unit"])[0],
            regions=tuple(texts(static["region_name"])),
            frames=tuple(texts(static["frame_name"])),
        )

    @staticmethod
    def _layout_of(source: MotionSource) -> Mapping[str, tuple[str, tuple[int, ...]]]:
        return {name: (dtype, (len(source.regions), *shape)) for name, (dtype, shape) in COLUMNS.items()}


class MotionWriter:
    """Publishes the motion of a driver's regions.

    Args:
        structure: of the driver.
        type_name: which sensors.
        regions: which may have such sensors.
        frames: names of the coordinate frames of its contacts.
        driver: its name, told to readers.
        name: of the service.
        namespace, rate_hz, group: as for :class:`skinware.service.ServiceWriter`, which also lists the errors.

    Raises:
        StructureError: the driver has no such sensors.
        ConfigurationError: no region may have any.
    """

    def __init__(
        self,
        structure: Structure,
        type_name: str,
        regions: Regions,
        frames: tuple[str, ...],
        *,
        driver: str = "",
        name: str = NAME,
        namespace: Namespace | str | None = None,
        rate_hz: float | None = None,
        group: str | None = None,
    ) -> None:
        self._index = regions.of(SkinLayout((driver,), (structure,)), type_name)
        if not self._index:
            raise ConfigurationError(f"no region is of {type_name} sensors")
        sensor_type = structure.type(type_name)
        static = {
            "region_name": np.array([name.encode() for name in self._index]),
            "frame_name": np.array([name.encode() for name in frames], "S64"),
            "driver": np.array([driver.encode()], "S64"),
            "type_name": np.array([type_name.encode()], "S32"),
            "type_unit": np.array([sensor_type.unit.encode()], "S16"),
        }
        units = {name: unit for name, (unit, _) in _TEXTS.items()} | {"load": sensor_type.unit}
        columns = {
            column: Column(np.dtype(dtype), (len(self._index), *shape), units[column], _TEXTS[column][1])
            for column, (dtype, shape) in COLUMNS.items()
        }
        self._service = ServiceWriter(
            name,
            columns,
            static,
            namespace=namespace,
            kind=KIND,
            rate_hz=rate_hz,
            group=group,
            description=f"motion over regions of {driver or 'a skin'}, {type_name}",
        )

    @property
    def name(self) -> str:
        """Name of the service."""
        return self._service.name

    def publish(self, contacts: ContactSet, value: npt.NDArray[Any], acquired_ns: int) -> MotionSet:
        """Publish the motion of the next frame.

        Args:
            contacts: of the frame.
            value: (n,) calmed values of the n sensors.
            acquired_ns: of the frame, CLOCK_MONOTONIC ns.

        Raises:
            Closed, Paused, NameInUse: as :meth:`skinware.service.ServiceWriter.begin`.
        """
        found = motion_of(self._index, contacts, value)
        columns = self._service.begin()
        for name in COLUMNS:
            columns[name][:] = getattr(found, name)
        self._service.commit(acquired_ns)
        return found

    def close(self) -> None:
        """Withdraw the service. Idempotent."""
        self._service.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
