"""What services tell beside drivers: what is calm of them, contacts on them, and motion over their regions."""

from __future__ import annotations

from collections.abc import Collection

from skinware.driver_snapshot import DriverSnapshot
from skinware.memory.namespace import Namespace
from skinware.realtime import now_ns
from skinware.tactile.contacts_service import ContactsSample
from skinware.tactile.motion_service import MotionSample
from skinware.views.live import LiveDriver, LiveDrivers
from skinware.views.touches import live_contacts, live_motion

_PATIENCE_NS = 20_000_000
"""What is calm of a frame comes soon after it, or not at all."""


class Beside:
    """The services beside the drivers of a namespace: in it, and in the namespace of calmed drivers.

    Args:
        drivers: of the namespace.
        names: of the drivers that count; default: all.
        calm: namespace where calmed drivers are; None: nowhere.
    """

    def __init__(self, drivers: LiveDrivers, names: Collection[str] = (), calm: Namespace | None = None) -> None:
        self._calm = None if calm is None else LiveDrivers(calm, names)
        self._places = [drivers, *([self._calm] if self._calm is not None else [])]
        self._contacts = [live_contacts(place.namespace) for place in self._places]
        self._motion = [live_motion(place.namespace) for place in self._places]
        self._others: list[tuple[str, ...]] = []

    def look(self) -> None:
        """Look for what came and went.

        Raises:
            NamespaceError: the namespace of calmed drivers cannot be trusted or read.
        """
        if self._calm is not None:
            self._calm.look()
        others = [place.others for place in self._places]
        if others != self._others:
            self._others = others
            for contacts, motion, names in zip(self._contacts, self._motion, others, strict=True):
                contacts.look(names)
                motion.look(names)

    def is_due(self, live: LiveDriver) -> bool:
        """Whether the newest frame of a driver may be shown: what is calm of it is here, or will not come."""
        frame, calm = live.frame, self._calm_of(live.name)
        if frame is None or calm is None or self._calm is None:
            return frame is not None
        self._calm.poll(calm)
        is_here = calm.frame is not None and calm.frame.acquired_ns >= frame.acquired_ns
        return is_here or now_ns() - frame.published_ns > _PATIENCE_NS

    def calm_of(self, driver: str) -> DriverSnapshot | None:
        """The newest frame of a calmed driver; None where there is none, or nobody calms it any more."""
        calm = self._calm_of(driver)
        return None if calm is None or calm.frame is None or calm.frame.stale else calm.frame

    def contacts_of(self, driver: str) -> ContactsSample | None:
        """The newest contacts on a driver; None where nobody tells any."""
        return next((frame for source in self._contacts if (frame := source.of(driver)) is not None), None)

    def motion_of(self, driver: str) -> MotionSample | None:
        """The newest motion over the regions of a driver; None where nobody tells any."""
        return next((frame for source in self._motion if (frame := source.of(driver)) is not None), None)

    def close(self) -> None:
        for contacts, motion in zip(self._contacts, self._motion, strict=True):
            contacts.close()
            motion.close()
        if self._calm is not None:
            self._calm.close()

    def _calm_of(self, driver: str) -> LiveDriver | None:
        return None if self._calm is None else self._calm.get(driver)
