"""The bus ``virtual`` of emulated hardware whose sensors have places: it tells them, and lets programs press there."""

from __future__ import annotations

from collections.abc import Sequence

from skinware.geometry import Geometry
from skinware_drivers.description import Patch
from skinware_drivers.link import Link
from skinware_drivers.operations import operation
from skinware_drivers.virtual.bus import VirtualCanBus
from skinware_drivers.virtual.hardware import PlacedHardware, Pressing


class PlacedCanBus(VirtualCanBus):
    """A :class:`.VirtualCanBus` by name; see :class:`.hardware.PlacedHardware`."""

    hardware: PlacedHardware

    @property
    def geometry(self) -> Geometry | None:
        return self.hardware.geometry()

    @operation()
    async def press(
        self,
        link: Link,  # noqa: ARG002 - as every operation
        patches: Sequence[Patch],  # noqa: ARG002
        at_m: Sequence[float],
        force_n: float = 3.0,
        radius_m: float = 0.006,
        seconds: float = 1.0,
    ) -> dict[str, object]:
        """Press the emulated skin at a place for a while.

        Raises:
            ValueError: the numbers make no sense, or nothing of the skin would feel it.
        """
        return self.hardware.press(Pressing.of(at_m, force_n, radius_m, seconds), self._clock())
