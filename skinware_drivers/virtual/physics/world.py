"""A scene as emulated devices feel it: its time, their values, and the services beside it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from skinware.errors import ConfigurationError
from skinware.realtime import NS_PER_S
from skinware_drivers.virtual.physics.binding import Bound
from skinware_drivers.virtual.physics.body import PhysicsScene
from skinware_drivers.virtual.physics.services import WorldServices
from skinware_drivers.virtual.physics.transfer import Transfer

ArrayF = npt.NDArray[np.float64]

_LONGEST_CATCH_UP_S = 1.0
"""Time that the physics makes up for; it leaves out more."""
_AXES = "xyz"


class PhysicsWorld:
    """A scene that presses the devices of one emulator.

    Args:
        speed: seconds of the scene in a second of the devices.
        has_services: publish the services ``truth`` and ``joints``.

    Attributes:
        origin_ns: when the scene was at 0 s; later, once it has left time out.
        left_out_s: time of the scene that it left out because nothing called it.
    """

    def __init__(self, bound: Bound, *, seed: int = 0, speed: float = 1.0, has_services: bool = False) -> None:
        self.scene = PhysicsScene(bound)
        self.origin_ns: int | None = None
        self.left_out_s = 0.0
        self._speed = speed
        self._transfers = [
            Transfer(bound.settings(module.binding), module.position_m, (seed, module.binding.device, number))
            for number, module in enumerate(self.scene.modules)
        ]
        self._of_device: dict[int, list[tuple[int, int]]] = {}  # device -> modules, and their first values
        self._forces: list[ArrayF] | None = None
        next_value: dict[int, int] = {}
        for number, module in enumerate(self.scene.modules):
            device, axes = module.binding.device, module.binding.axes
            first = next_value.get(device, 0) if module.binding.first is None else module.binding.first
            next_value[device] = first + len(axes) * len(module.position_m)
            self._of_device.setdefault(device, []).append((number, first))
        self._ends = next_value
        self._file = bound.file
        self._has_services = has_services
        self._services: WorldServices | None = None
        self._at_end: Callable[[], object] | None = None

    def fit(self, numbers: Sequence[int], n_values: int) -> None:
        """Check that a binding fits the devices of an emulator."""
        for device, end in self._ends.items():
            if device not in numbers:
                known = ",".join(map(str, numbers))
                raise ConfigurationError(f"{self._file}: there is no device {device}; there are {known}")
            if end > n_values:
                raise ConfigurationError(f"{self._file}: device {device} has {n_values} values, not {end}")

    def advance(self, time_ns: int) -> None:
        """Let the physics run to a time of the devices; the first call is at 0 s of the scene."""
        if self.origin_ns is None:
            self.origin_ns = time_ns
        if self._has_services and self._services is None:
            self._services = WorldServices(self.scene)
            self._at_end = weakref.finalize(self, self._services.close)
        late_s = self.since_s(time_ns) - self.scene.time_s - _LONGEST_CATCH_UP_S * self._speed
        if late_s > 0:
            self.origin_ns += round(late_s / self._speed * NS_PER_S)
            self.left_out_s += late_s
        if self.scene.step_to(self.since_s(time_ns)):
            self._forces = None
        if self._services is not None:
            self._services.serve(time_ns)

    def since_s(self, time_ns: int) -> float:
        """Return the time of the scene at a time of the devices, s."""
        return (time_ns - (self.origin_ns or 0)) / NS_PER_S * self._speed

    def forces(self) -> list[ArrayF]:
        """Return (n, 3) the forces on each module's taxels now: shear along x and y, and normal, N."""
        if self._forces is None:
            self._forces = self.scene.newtons()
        return self._forces

    def added(self, device: int, time_ns: int, n_values: int) -> ArrayF:
        """Return (n_values,) counts by which a device's values are above their rest, at a time never before the last.

        A device's values may be asked for once at a time: its elastomer remembers.
        """
        self.advance(time_ns)
        values = np.zeros(n_values)
        for module, first in self._of_device.get(device, []):
            counts = self._transfers[module].counts(self.forces()[module], self.since_s(time_ns))
            axes = self.scene.modules[module].binding.axes
            for place, axis in enumerate(axes):
                if axis in _AXES:
                    rows = slice(first + place, first + len(axes) * len(counts), len(axes))
                    values[rows] = counts[:, _AXES.index(axis)]
        return values

    def close(self) -> None:
        """Take the services away until the physics runs on. Idempotent."""
        self._services = None
        if self._at_end is not None:
            self._at_end()
